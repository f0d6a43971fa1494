"""Which number per vertex knows best where a predicted head is wrong?

    python benchmarks/confidence.py HEADS OUT --networks 0 A 1 B [--fit calibration/]

A and B are folders of networks that never saw the held-out heads of folds 0 and 1 (see
rocketbox.py). Each candidate is calibrated on the other folds, networks and heads, and
judged on its own: metrics of `skinlib.evaluate.calibration`. Writes
`OUT/confidence.json`, prints the same, and paints confidence beside the true error for
the first `pictures` held-out heads. With `--fit`, the chosen one's calibration on all
folds given goes there.
"""

import json
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from tqdm import tqdm
from tyro.conf import Positional

from skinlib.datasets.augment import jitter, mirror, rotate
from skinlib.datasets.folder import load_folder
from skinlib.evaluate.calibration import calibration_scores
from skinlib.evaluate.groups import fold
from skinlib.evaluate.metrics import row_l1
from skinlib.geometry import mesh_edges
from skinlib.graph import build_graph
from skinlib.head import Head
from skinlib.model.confidence import TOLERANCE, Calibration, doubt, other_view
from skinlib.model.inputs import bone_frame, mesh_input, skeleton_input
from skinlib.painting import prune
from skinlib.skinning import mirror_pairs
from skinlib.training import load_model
from skinlib.views.picture import ColourBar, picture_grid
from skinlib.views.scenes import THREE_QUARTER, View, colour_by_value, render

BEHIND = View(azimuth=150.0)
CHOSEN = "gini x mirrored and warped"
# Passes through the network beside the one that predicts.
PASSES = {"mirrored": 1, "mirrored and warped": 1, CHOSEN: 1, "three jitters": 3}


@dataclass(frozen=True)
class Run:
    """Which number per vertex knows best where a predicted head is wrong?"""

    heads: Positional[Path]  # folder of skinned heads
    out: Positional[Path]  # folder for confidence.json and the pictures
    networks: dict[int, Path]  # fold and folder of a network that never saw it, pairs
    tolerance: float = TOLERANCE  # row-L1 up to which a vertex counts as right
    pictures: int = 2  # held-out heads of each fold to paint
    fit: Path | None = None  # folder for the calibration.json of all folds together
    fitted_on: str = ""  # what that file says about itself


def main(run: Run) -> None:
    """Predict all held-out heads once, then calibrate and judge crosswise."""
    heads = load_folder(run.heads)
    held_out = {number: fold(heads, number)[1] for number in run.networks}
    judged = {
        number: [judge(load_model(run.networks[number]), head) for head in tqdm(some)]
        for number, some in held_out.items()
    }
    names = list(next(iter(judged.values()))[0]["scores"])
    result = {
        "heads": {n: [head.name for head in some] for n, some in held_out.items()},
        "row_l1_mean": {
            n: mean_of([h["error"].mean() for h in some]) for n, some in judged.items()
        },
        "seconds_a_pass": mean_of(
            [head["seconds"] for some in judged.values() for head in some]
        ),
        "candidates": {},
    }
    for name in names:
        folds = {}
        for number, some in judged.items():
            others = [h for n, more in judged.items() if n != number for h in more]
            # One fold alone can only be judged by its own calibration.
            calibration = fit(others or some, name, run.tolerance)
            folds[number] = scores(some, name, calibration)
        result["candidates"][name] = {
            "extra_passes": PASSES.get(name, 0),
            "mean": means(list(folds.values())),
            "folds": folds,
        }
    run.out.mkdir(parents=True, exist_ok=True)
    text = json.dumps(result, indent=1)
    (run.out / "confidence.json").write_text(text + "\n")
    print(text)
    if run.fit:
        run.fit.mkdir(parents=True, exist_ok=True)
        everything = [head for some in judged.values() for head in some]
        fit(everything, CHOSEN, run.tolerance, run.fitted_on).write(run.fit)
    for number, some in held_out.items():
        others = [h for n, more in judged.items() if n != number for h in more]
        calibration = fit(others or judged[number], CHOSEN, run.tolerance)
        for head, found in list(zip(some, judged[number], strict=True))[: run.pictures]:
            paint(head, found, calibration, run.out)


@torch.no_grad()
def judge(model, head: Head) -> dict:
    """Row-L1 and every candidate's doubt (V,) of a head, and seconds a pass takes."""
    graph, pairs = build_graph(head, model.config.graph), mirror_pairs(head.skeleton)

    def weights(view):
        return model(mesh_input(view, graph), skeleton_input(view)).numpy()

    def apart(view, columns: slice | np.ndarray = slice(None)):
        return row_l1(weights(view)[:, columns], predicted)

    began = time.perf_counter()
    predicted = weights(head)
    seconds = time.perf_counter() - began
    bare, rng = head.replace(weights=None), np.random.default_rng(0)
    turned = [rotate(jitter(bare, rng), rng, 2.0) for _ in range(3)]
    second = weights(other_view(bare))[:, pairs]
    error = row_l1(prune(predicted, 0.01), head.weights)
    found = {
        "random": rng.random(len(error)),
        "1 - max": 1 - predicted.max(axis=1),
        "entropy": -(predicted * np.log(predicted.clip(1e-12))).sum(axis=1),
        "gini": 1 - (predicted**2).sum(axis=1),
        "spread of the bones": spread(head, predicted),
        "roughness": roughness(head, predicted),
        "mirrored": apart(mirror(bare), pairs),
        "mirrored and warped": row_l1(second, predicted),
        CHOSEN: doubt(predicted, second),
        "three jitters": np.mean([apart(view) for view in turned], axis=0),
        "oracle": error,
    }
    # Rounding leaves some a little below 0.
    found = {name: np.maximum(value, 0) for name, value in found.items()}
    return {"error": error, "scores": found, "seconds": seconds}


def spread(head: Head, weights: np.ndarray) -> np.ndarray:
    """(V,) how far apart the joints lie that share a vertex: standard deviation."""
    joints = bone_frame(head).apply(head.skeleton.joints)
    return np.sqrt(
        (weights @ (joints**2).sum(1) - ((weights @ joints) ** 2).sum(1)).clip(0)
    )


def roughness(head: Head, weights: np.ndarray) -> np.ndarray:
    """(V,) mean row-L1 between a vertex and its neighbours on the mesh."""
    a, b = mesh_edges(head.faces).T
    step, count = row_l1(weights[a], weights[b]), len(weights)
    total = np.bincount(a, step, count) + np.bincount(b, step, count)
    degree = np.bincount(a, minlength=count) + np.bincount(b, minlength=count)
    return total / degree.clip(1)


def fit(judged: list[dict], name: str, tolerance: float, words: str = ""):
    """A candidate's calibration on some heads."""
    found = [head["scores"][name] for head in judged]
    return Calibration.fit(found, [head["error"] for head in judged], tolerance, words)


def scores(judged: list[dict], name: str, calibration: Calibration) -> dict:
    """Mean over the heads; ranks by the candidate itself, ECE over all their vertices.

    The order is the candidate's own, as a calibration may give several vertices one
    confidence. `pooled_auroc` and `pooled_average_precision` are over all vertices at
    once: they also ask whether a bad head is known from a good one.
    """
    tolerance = calibration.tolerance
    mean = means(
        [
            calibration_scores(-head["scores"][name], head["error"], tolerance)
            for head in judged
        ]
    )
    doubts = np.concatenate([head["scores"][name] for head in judged])
    errors = np.concatenate([head["error"] for head in judged])
    confidence = calibration.confidence(doubts)
    mean["ece"] = calibration_scores(confidence, errors, tolerance)["ece"]
    expected = calibration.expected_error(doubts)
    mean["expected_row_l1"], mean["row_l1"] = expected.mean(), errors.mean()
    pooled = calibration_scores(-doubts, errors, tolerance)
    for key in ("auroc", "average_precision"):
        mean[f"pooled_{key}"] = pooled[key]
    return {key: round(float(value), 4) for key, value in mean.items()}


def means(dicts: list[dict]) -> dict[str, float]:
    """Mean of each number over the dicts that have it."""
    keys = dict.fromkeys(key for one in dicts for key in one)
    return {key: mean_of([one[key] for one in dicts if key in one]) for key in keys}


def mean_of(values: list) -> float:
    """Mean with four digits."""
    return round(float(np.mean(values)), 4)


def paint(head: Head, found: dict, calibration: Calibration, out: Path) -> None:
    """Doubt, the error to expect and the true error of a head, side by side."""
    doubts = found["scores"][CHOSEN]
    shown = {
        "1 - confidence": 1 - calibration.confidence(doubts),
        "row-L1 to expect": calibration.expected_error(doubts),
        "true row-L1": found["error"],
    }
    bar = ColourBar("1 - confidence, or row-L1; 1 and above in one colour")
    images = [
        render(head, colour_by_value(value.clip(0, 1), 0.0, 1.0), view=view)
        for view in (THREE_QUARTER, BEHIND)
        for value in shown.values()
    ]
    picture_grid(
        images,
        list(shown),
        out / f"{head.name}.png",
        columns=len(shown),
        title=head.name,
        colour_bar=bar,
    )


if __name__ == "__main__":
    main(tyro.cli(Run))
