"""HeadBench: every method on every suite, on heads of meshes that it never saw.

A folder holds all of a bench: `networks/fold0/NAME` the trained networks, `cells/...`
the scores of one method on one suite, `results.json` what they come to. What is there
is not computed again, so that a bench can be stopped, goes on, and several processes
may share its folder.
"""

import json
import time
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from tqdm.auto import tqdm

from skinlib.evaluate import baselines, volumetric
from skinlib.evaluate.groups import FOLDS, apart, fold
from skinlib.evaluate.metrics import agreement, score
from skinlib.head import Head, HeadError
from skinlib.headbench.networks import train_networks
from skinlib.headbench.suites import SUITES, vary
from skinlib.io import atomic
from skinlib.training import WEIGHTS, load_model

OTHERS = "another artist's rig"
ALL_SUITES = (*SUITES, OTHERS)
# With every metric; the other suites, of which one has 100,000 vertices, by row-L1,
# precision and recall.
FULLY_JUDGED = ("untouched", OTHERS)
RESULTS = "results.json"
NETWORKS = "networks"
MEMORY, RATIO = "peak_mb", "row_l1_ratio"

# A head and the heads that may be copied from, to (V, J) weights.
Skin = Callable[[Head, Sequence[Head]], np.ndarray]


@dataclass(frozen=True)
class Bench:
    """What a bench is made of; see `run`."""

    heads: Sequence[Head]  # skinned, with meshes of several base meshes
    unlabelled: Sequence[Head] = ()  # whose weights nobody looks at
    others: Sequence[Head] = ()  # skinned, with other rigs, only to be judged by
    folds: tuple[int, ...] = (0, 1, 2)  # which folds are held out, in turn
    minutes: float = 8.0  # of processor time, for each network to be trained
    suites: tuple[str, ...] = ALL_SUITES  # beside the untouched heads
    methods: tuple[str, ...] = ()  # all that can be run here when empty
    few: int = 3  # heads of a fold, where a method or a suite is slow


@dataclass(frozen=True)
class Fold:
    """One fold: what is held out, what may be learnt or copied from, and who did."""

    number: int
    held_out: Sequence[Head]
    training: Sequence[Head]
    networks: Path  # a folder of checkpoints

    @property
    def name(self) -> str:
        """Name of the fold's folders."""
        return f"fold{self.number}"


def _any(head: Head, templates: Sequence[Head]) -> Head:
    """A template that a head's name decides, so that it is the same in every suite."""
    return templates[zlib.crc32(head.name.encode()) % len(templates)]


CLASSICAL: dict[str, Skin] = {
    "nearest bone": lambda head, templates: baselines.nearest_bone(head),
    "inverse distance": lambda head, templates: baselines.inverse_distance(head),
    "bone heat (ours)": lambda head, templates: baselines.bone_heat(head),
    "Blender automatic": lambda head, templates: volumetric.blender_automatic(head),
    # Coarser than the default: 15 times faster, and no worse on real heads.
    "bounded biharmonic": lambda head, templates: volumetric.bounded_biharmonic(
        head, 12
    ),
    "voxel geodesic": lambda head, templates: volumetric.voxel_geodesic(head),
    "voxel geodesic, falloff 1": lambda head, templates: volumetric.voxel_geodesic(
        head, falloff=1.0
    ),
}
TEMPLATE: dict[str, Skin] = {
    "template copy": lambda head, templates: baselines.template_copy(
        head, _any(head, templates)
    ),
    "warped template copy": lambda head, templates: baselines.warped_template_copy(
        head, _any(head, templates)
    ),
    "similar template copy": baselines.similar_template_copy,
    "robust transfer": lambda head, templates: baselines.robust_transfer(
        head, baselines.most_similar(head, templates)
    ),
}
# What takes seconds a head, and is judged on fewer but in the main suites.
LARGE = "upsampled"
SLOW = (
    "Blender automatic",
    "bounded biharmonic",
    "voxel geodesic",
    "voxel geodesic, falloff 1",
)


def run(bench: Bench, out: Path) -> dict:
    """Train what is missing, judge what is missing, and say what it comes to.

    Returns:
        What `collect` returns; also in `out/results.json`.

    Raises:
        HeadError: too few heads for a fold, a head without weights, an unknown suite
            or method.
    """
    _check(bench)
    for number in bench.folds:
        training, held_out = fold(bench.heads, number)
        part = Fold(number, held_out, training, out / NETWORKS / f"fold{number}")
        bare = [
            head.replace(weights=None) for head in apart(bench.unlabelled, held_out)
        ]
        train_networks(part.networks, training, bare, bench.minutes, seed=number)
        judge(bench, part, out / "cells" / part.name)
    results = collect(out)
    _write(out / RESULTS, results)
    return results


def judge(bench: Bench, part: Fold, out: Path) -> None:
    """Write the scores of every method on every suite that are not there yet."""
    methods = available(part.networks)
    for name in bench.methods:
        if name not in methods:
            choice = ", ".join(methods)
            raise HeadError(
                "--methods", f"{name!r} is unknown", f"choose from {choice}"
            )
    methods = {name: methods[name] for name in bench.methods or methods}
    missing = {
        suite: [name for name in methods if not _cell(out, suite, name).exists()]
        for suite in dict.fromkeys(("untouched", *bench.suites))
    }
    bar = tqdm(total=sum(map(len, missing.values())), unit="cell", desc=part.name)
    with bar:
        for suite, names in missing.items():
            heads = list(_variants(bench, part, suite)) if names else []
            for name in names:
                bar.set_postfix_str(f"{name} on {suite}", refresh=True)
                fully = suite in FULLY_JUDGED
                few = not fully and (name in SLOW or suite == LARGE)
                some = heads[: bench.few] if few else heads
                judged_by = score if fully else _agreement
                scores = _scores(methods[name], some, part.training, judged_by)
                first = suite == "untouched" and part.number == bench.folds[0]
                if first and scores["heads"]:
                    scores[MEMORY] = _peak_memory(name, some[0], part)
                _write(_cell(out, suite, name), scores)
                bar.update()


def available(networks: Path) -> dict[str, Skin]:
    """Networks of a folder, best known name first, and the methods without one."""
    folders = sorted(file.parent for file in networks.glob(f"*/{WEIGHTS}"))
    trained = {folder.name: partial(_predict, folder) for folder in folders}
    return trained | TEMPLATE | CLASSICAL


@cache
def _network(folder: Path):
    return load_model(folder)


def _predict(folder: Path, head: Head, templates: Sequence[Head]) -> np.ndarray:
    return _network(folder).predict(head)


def _variants(bench: Bench, part: Fold, suite: str) -> Iterator[Head]:
    if suite == OTHERS:
        yield from bench.others
        return
    for head in part.held_out:
        others = [other for other in part.held_out if other is not head]
        try:
            yield vary(suite, head, part.number, others)
        except HeadError as error:
            tqdm.write(f"{suite}: {head.name} is left out, {error}")


def _agreement(predicted: np.ndarray, target: np.ndarray, head: Head) -> dict:
    return agreement(predicted, target)


def _scores(method: Skin, heads: Sequence[Head], templates, judged_by) -> dict:
    """{"heads": {name: scores}, "failed": {name: why}} of one method."""
    found = {"heads": {}, "failed": {}}
    for head in heads:
        began = time.perf_counter()
        try:
            weights = method(head.replace(weights=None), templates)
        except HeadError as error:
            found["failed"][head.name] = str(error)
            continue
        seconds = time.perf_counter() - began
        scores = judged_by(weights, head.weights, head) | {"seconds": seconds}
        found["heads"][head.name] = {k: round(v, 6) for k, v in scores.items()}
    return found


def _peak_memory(name: str, head: Head, part: Fold) -> float | None:
    """Megabytes that a fresh process takes to skin a head, beside the packages."""
    context = get_context("spawn")
    arguments = name, head, list(part.training), part.networks
    with ProcessPoolExecutor(1, context) as pool:
        return pool.submit(_grown, *arguments).result()


def _grown(
    name: str, head: Head, templates: list[Head], networks: Path
) -> float | None:
    skin, head = available(networks)[name], head.replace(weights=None)
    if name not in TEMPLATE | CLASSICAL:
        _network(networks / name)
    try:
        _RESET_PEAK.write_text("5")
        before = _peak_kilobytes()
        skin(head, templates)
    except (HeadError, OSError):  # a method that cannot, or a system without /proc
        return None
    import resource

    children = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss
    return round(max(_peak_kilobytes() - before, children) / 1024, 1)


_RESET_PEAK = Path("/proc/self/clear_refs")  # Linux: the peak begins anew at 5


def _peak_kilobytes() -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))


# -- what the cells come to ------------------------------------------------------------


def collect(out: Path) -> dict:
    """All cells of a bench, brought together.

    Returns:
        `{suite: {method: {metric: {"mean": m, "spread": s, "heads": n}}}}`. `mean` is
        over the heads of all folds; `spread` is the standard deviation of the folds'
        means, each fold having its own heads and training seed; 0 for a single fold.
        `row_l1_ratio` has a mean alone: row-L1 over that of the same heads untouched.
    """
    results: dict = {}
    for suite in ALL_SUITES:
        for method in _methods_of(out, suite):
            files = sorted(out.glob(f"cells/*/{suite}/{method}.json"))
            cells = [json.loads(file.read_text()) for file in files]
            numbers = _summary(cells)
            if numbers:
                numbers[RATIO] = {"mean": _ratio(out, suite, method)}
                results.setdefault(suite, {})[method] = numbers
    return results


def _methods_of(out: Path, suite: str) -> list[str]:
    return sorted({file.stem for file in out.glob(f"cells/*/{suite}/*.json")})


def _summary(cells: Sequence[Mapping]) -> dict:
    heads = [[*cell["heads"].values()] for cell in cells]
    metrics = dict.fromkeys(name for rows in heads for row in rows for name in row)
    summary = {}
    for metric in metrics:
        folds = [[row[metric] for row in rows if metric in row] for rows in heads]
        summary[metric] = _spread([fold for fold in folds if fold])
    memory = [[cell[MEMORY]] for cell in cells if cell.get(MEMORY) is not None]
    if memory:
        summary[MEMORY] = _spread(memory)
    return summary


def _spread(folds: Sequence[Sequence[float]]) -> dict:
    values = [value for one in folds for value in one]
    means = [float(np.mean(one)) for one in folds]
    return {
        "mean": round(float(np.mean(values)), 5),
        "spread": round(float(np.std(means, ddof=1)) if len(means) > 1 else 0.0, 5),
        "heads": len(values),
    }


def _ratio(out: Path, suite: str, method: str) -> float | None:
    """How much larger row-L1 is on a suite than on the same heads untouched."""
    there, here = [], []
    for file in out.glob(f"cells/*/{suite}/{method}.json"):
        varied = json.loads(file.read_text())["heads"]
        file = file.parents[1] / "untouched" / file.name
        if file.exists():
            untouched = json.loads(file.read_text())["heads"]
            both = varied.keys() & untouched.keys()
            there += [varied[name]["row_l1_mean"] for name in both]
            here += [untouched[name]["row_l1_mean"] for name in both]
    return round(float(np.mean(there) / max(np.mean(here), 1e-12)), 4) if here else None


def _cell(out: Path, suite: str, method: str) -> Path:
    return out / suite / f"{method}.json"


def _write(file: Path, content: dict) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with atomic(file) as stream:
        stream.write(f"{json.dumps(content, indent=1)}\n".encode())


def _check(bench: Bench) -> None:
    for head in (*bench.heads, *bench.others):
        if head.weights is None:
            raise HeadError(
                "weights", f"head {head.name!r} has none", "judge by skinned heads"
            )
    for suite in bench.suites:
        if suite not in ALL_SUITES:
            choice = ", ".join(ALL_SUITES)
            raise HeadError(
                "--suites", f"{suite!r} is unknown", f"choose from {choice}"
            )
    for number in bench.folds:
        if not 0 <= number < FOLDS:
            raise HeadError("--folds", f"{number}", f"give 0 to {FOLDS - 1}")
