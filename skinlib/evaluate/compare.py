"""A model and the classical methods on the same heads, in one table."""

import sys
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Protocol

import numpy as np
from tqdm.auto import tqdm

from skinlib.evaluate import baselines
from skinlib.evaluate.metrics import score
from skinlib.head import Head, HeadError

# From a head, the training heads without it, and its number, to weights.
Method = Callable[[Head, Sequence[Head], int], np.ndarray]

CLASSICAL: dict[str, Method] = {
    "nearest_bone": lambda head, templates, i: baselines.nearest_bone(head),
    "inverse_distance": lambda head, templates, i: baselines.inverse_distance(head),
    "bone_heat": lambda head, templates, i: baselines.bone_heat(head),
}

# The first two take the training heads in turn: their mean is that of any template.
TEMPLATE: dict[str, Method] = {
    "template_copy": lambda head, templates, i: baselines.template_copy(
        head, templates[i % len(templates)]
    ),
    "warped_template_copy": lambda head, templates, i: baselines.warped_template_copy(
        head, templates[i % len(templates)]
    ),
    "similar_template_copy": lambda head, templates, i: baselines.similar_template_copy(
        head, templates
    ),
    "robust_transfer": lambda head, templates, i: baselines.robust_transfer(
        head, baselines.most_similar(head, templates)
    ),
}

COLUMNS = {
    "row_l1_mean": "row-L1",
    "face_row_l1_mean": "face",
    "row_l1_p95": "p95",
    "row_l1_max": "max",
    "precision": "precision",
    "recall": "recall",
    "dominant_bone_accuracy": "dominant",
    "deformation_mean": "deform %",
    "lip_bleed": "lip bleed",
    "seconds": "seconds",
}


class Predictor(Protocol):
    """Anything that skins a head, for instance a `SkinningModel`."""

    def predict(self, head: Head) -> np.ndarray:
        """(V, J) weights of a head, rows >= 0 with sum 1."""


def evaluate(
    heads: Iterable[Head],
    train_heads: Iterable[Head] | None = None,
    model: Predictor | None = None,
    methods: Sequence[str] | None = None,
    progress: bool = True,
) -> dict:
    """Score every method on every head that has weights.

    Args:
        heads: to judge on; those without weights are skipped with a message.
        train_heads: templates for the methods that copy; a head is never its own
            template. Without any, those methods are left out.
        model: scored under the name `skinlib`.
        methods: names to restrict to, out of `skinlib`, `CLASSICAL` and `TEMPLATE`.
        progress: whether to show a progress bar.

    Returns:
        `{"methods": {NAME: {"mean": {...}, "heads": {HEAD_NAME: {...}}}}}`; the inner
        dicts hold the metrics of `skinlib.evaluate.metrics.score` and `seconds`.

    Raises:
        HeadError: no head has weights, two heads share a name, an unknown method, or
            no method is left.
    """
    heads, templates = list(heads), _labelled(train_heads or [], "as a template")
    labelled = _labelled(heads, "for judging")
    if not labelled:
        raise HeadError(
            "heads",
            f"none of {len(heads)} has weights",
            "give heads that an artist has painted, to compare with",
        )
    names = [head.name for head in labelled]
    twice = {name for name in names if names.count(name) > 1}
    if twice:
        raise HeadError(
            "heads",
            f"the name {min(twice)!r} is used twice",
            "give each head a name of its own",
        )
    chosen = _methods(model, templates, methods)

    result = {name: {"mean": {}, "heads": {}} for name in chosen}
    steps = tqdm(total=len(labelled) * len(chosen), disable=not progress, unit="skin")
    for number, head in enumerate(labelled):
        others = [template for template in templates if not _same(template, head)]
        for name, method in chosen.items():
            steps.set_postfix_str(f"{name} on {head.name}", refresh=False)
            steps.update()
            if name in TEMPLATE and not others:
                continue
            start = time.perf_counter()
            weights = method(head, others, number)
            seconds = time.perf_counter() - start
            scores = score(weights, head.weights, head)
            result[name]["heads"][head.name] = scores | {"seconds": seconds}
    steps.close()

    for name in list(result):
        rows = result[name]["heads"].values()
        if not rows:
            del result[name]
            continue
        # A head whose rig has no lids has no lid metric: the mean is over the others.
        for metric in dict.fromkeys(metric for row in rows for metric in row):
            values = [row[metric] for row in rows if metric in row]
            result[name]["mean"][metric] = float(np.mean(values))
    return {"methods": result}


def format_table(result: dict) -> str:
    """The mean of each method as text, best row-L1 first.

    >>> nearest = {"mean": {"row_l1_mean": 1.25}}
    >>> print(format_table({"methods": {"nearest_bone": nearest}}))
    method        row-L1
    nearest_bone   1.250
    """
    methods = result["methods"]
    columns = [
        metric
        for metric in COLUMNS
        if any(metric in method["mean"] for method in methods.values())
    ]
    lines = [["method", *(COLUMNS[metric] for metric in columns)]]
    ranked = sorted(methods, key=lambda name: methods[name]["mean"]["row_l1_mean"])
    for name in ranked:
        mean = methods[name]["mean"]
        lines.append([name, *(f"{mean[m]:.3f}" if m in mean else "-" for m in columns)])
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    return "\n".join(
        "  ".join(
            cell.rjust(width) if place else cell.ljust(width)
            for place, (cell, width) in enumerate(zip(line, widths, strict=True))
        )
        for line in lines
    )


def _labelled(heads: Iterable[Head], use: str) -> list[Head]:
    kept = []
    for head in heads:
        if head.weights is None:
            message = f"{head.name or 'a head'}: no weights, left out {use}"
            tqdm.write(message, file=sys.stderr)
        else:
            kept.append(head)
    return kept


def _methods(model, templates, wanted) -> dict[str, Method]:
    available = dict(CLASSICAL) | (TEMPLATE if templates else {})
    if model is not None:
        available = {
            "skinlib": lambda head, templates, i: model.predict(head)
        } | available
    unknown = [name for name in wanted or [] if name not in available]
    if unknown:
        raise HeadError(
            "methods",
            f"{unknown[0]!r} is not available",
            f"choose among {', '.join(available)}; template methods need training "
            "heads, skinlib needs a model",
        )
    return {name: available[name] for name in wanted or available}


def _same(a: Head, b: Head) -> bool:
    """Whether two heads are one, whatever their names."""
    return a is b or np.array_equal(a.vertices, b.vertices)
