"""Virtual bones on the shipped skirt, against simpler means and the simulator.

    python benchmarks/virtual_bones.py runs/virtual_bones
    python benchmarks/virtual_bones.py runs/virtual_bones --only stream speed

First it simulates: 8 walks to judge by, motions to learn from, and one minute of
walking. Simulations and trainings go on where they stopped; the numbers of each part
are in OUT/PART.json. All errors are root mean squares over frames and vertices, in mm.
Beside them stands the floor: how far the same walk ends up from itself when the skirt
starts otherwise, which nobody can foresee. A perfect guess would be 0.7 of it off.
"""

import json
import statistics
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np
import torch
import tyro
from tqdm.auto import tqdm

from skinlib.garments.body import Body, read_body
from skinlib.garments.garment import Garment, read_garment
from skinlib.garments.loose import (
    KIND,
    LooseConfig,
    LooseGarment,
    bind,
    errors,
    fading_heat,
    random_walks,
    read_simulations,
    simulation_motions,
    train,
)
from skinlib.garments.motion import Motion, walk
from skinlib.garments.patterns import skirt
from skinlib.garments.simulation import (
    Simulated,
    SimulationConfig,
    Simulator,
    inside,
    obstacle,
    predictability,
    rms,
    root_frame,
    simulate,
    simulate_motions,
    strain,
)
from skinlib.garments.virtual_bones import (
    VirtualBonesConfig,
    bone_distances,
    bone_spacing,
    oracle,
    place_bones,
)
from skinlib.head import Head, Skeleton
from skinlib.io import atomic
from skinlib.paths import sample
from skinlib.skinning import linear_blend_skinning
from skinlib.training import load_model

UNSEEN, UNSEEN_SEED = 8, 1_000_000
BONES, INFLUENCES = (8, 16, 24, 40, 80, 160), (1, 2, 4, 8)
SWEPT = ((8, 8), (16, 8), (40, 8), (80, 8), (24, 1), (24, 2), (24, 4))
ROUNDS = 9  # of timing
MINUTE = {"seconds": 60, "speed": 0.9, "stride": 25, "turn_rate": 20}
VARIANTS = {
    "hybrid": {},
    "virtual bones alone": {"hybrid": False},
    "virtual bones that no joint carries": {"hybrid": False, "carry": False},
    "translation only": {"network": VirtualBonesConfig(rotate=False)},
    "bones that do not fade out": {"fade": False},
    "errors of vertices alone": {"edges": 0.0},
    "without collisions in the loss": {"collision": 0.0},
    "loose from 10 to 40 mm": {"threshold": 0.01, "slope": 1 / 0.03},
}
SEEDS = (1, 2)  # besides the first
FORGOTTEN = 1.0  # seconds after which a start ought to matter no more


class Benchmark:
    """What all parts need: the skirt, its simulations, and what was trained."""

    def __init__(self, out: Path, motions: int, config: LooseConfig):
        self.out, self.config = out, config
        self.body, self.garment = read_body(), read_garment(sample("skirt.npz"))
        skeleton = self.body.head.skeleton
        sets = {
            "unseen": random_walks(skeleton, UNSEEN_SEED, UNSEEN, seconds=5),
            "learnt": simulation_motions(skeleton, config.seed, motions),
            "minute": [walk(skeleton, **MINUTE)],
        }
        for name, chosen in sets.items():
            folder = out / "simulated" / name
            simulate_motions(self.garment, self.body.head, chosen, folder)
        self.sets = {
            name: read_simulations(out / "simulated" / name)[: len(chosen)]
            for name, chosen in sets.items()
        }

    def trained(self, name: str, **changes) -> LooseGarment:
        """A garment trained with the configuration, some of it changed."""
        config = replace(self.config, **changes)
        folder = self.out / "runs" / name.replace(" ", "_")
        return train(config, self.body, self.garment, self.sets["learnt"], folder)

    def disturbed(self, name: str) -> list[Simulated]:
        """The first walks of a set, started as the skirt hung amid another motion.

        The simulator remembers nothing but the start: what differs then, one second
        later, could not be known from how the body moves.
        """
        path = self.out / "simulated" / f"{name}_disturbed.npz"
        chosen = self.sets[name][:UNSEEN]
        if not path.exists():
            other = self.sets["learnt"][-1]
            start = self.seen_by_root(other)[-1]
            moved = {
                str(i): simulate(self.garment, self.body.head, s.motion, start=start)
                for i, s in enumerate(tqdm(chosen, desc=f"{name}, disturbed"))
            }
            with atomic(path) as file:
                np.savez(file, **{name: found.posed for name, found in moved.items()})
        with np.load(path) as arrays:
            posed = [arrays[str(i)] for i in range(len(chosen))]
        return [s._replace(posed=after) for s, after in zip(chosen, posed, strict=True)]

    def floor(self, name: str, vertices: np.ndarray | slice = slice(None)) -> float:
        """mm between the first walks of a set and the same started otherwise."""
        pairs = []
        for one, two in zip(self.sets[name], self.disturbed(name), strict=False):
            late = round(FORGOTTEN * one.motion.fps)
            pairs.append((one.posed[late:, vertices], two.posed[late:, vertices]))
        return 1000 * rms(*map(np.concatenate, zip(*pairs, strict=True)))

    def seen_by_root(self, simulated: Simulated) -> np.ndarray:
        """(T, V, 3)."""
        return root_frame(simulated.posed, self.roots(simulated.motion))

    def roots(self, motion: Motion) -> np.ndarray:
        """(T, 4, 4)."""
        return motion.transforms(self.body.head.skeleton)[:, 0]


def simulator(bench: Benchmark) -> dict:
    """How good the truth is, and how much of it nobody can predict."""
    part = obstacle(bench.garment, bench.body.head)
    found = []
    for item, other in zip(
        bench.sets["unseen"], bench.disturbed("unseen"), strict=True
    ):
        period = one_cycle(item.motion)
        steady = bench.seen_by_root(item)[period:]
        floor, deviation = predictability(steady, period)
        late = round(FORGOTTEN * item.motion.fps)
        apart = rms(item.posed[late:], other.posed[late:])
        stretched = strain(item.posed, bench.garment.vertices, bench.garment.faces)
        below = inside(item.posed[::3], every_third(item.motion), bench.body.head, part)
        found.append(
            {
                "p99 strain, %": 100 * stretched.p99,
                "inside, %": 100 * float(below.mean()),
                "one period apart, mm": 1000 * floor,
                "disturbed at the start, mm": 1000 * apart,
                "standard deviation, mm": 1000 * deviation,
                "one period apart / deviation": floor / deviation,
                "disturbed / deviation": apart / deviation,
            }
        )
    worst = {key: max(row[key] for row in found) for key in found[0]}
    means = {key: statistics.mean(row[key] for row in found) for key in found[0]}
    return {"mean": means, "worst": worst, "walks": found}


def one_cycle(motion: Motion) -> int:
    """Frames after which all bones but the root, which turns on, are as they were."""
    bones = motion.rotations[:, 1:]
    return next(
        frames
        for frames in range(2, len(motion))
        if np.abs(bones[frames:] - bones[:-frames]).max() < 1e-4
    )


def every_third(motion: Motion) -> Motion:
    """Ten frames a second are enough to judge by."""
    return Motion.create(
        motion.rotations[::3],
        motion.bone_names,
        motion.translations[::3],
        motion.fps / 3,
    )


def accuracy(bench: Benchmark) -> dict:
    """Errors on walks that nothing has learnt, by how loose the skirt is, and more."""
    found: dict[str, float] = {}
    learnt: dict[str, float] = {}
    where: dict[str, dict] = {}
    looks: dict[str, dict] = {}
    parts = by_looseness(bench)
    truth = np.concatenate([s.posed for s in bench.sets["unseen"]])
    for name, changes in VARIANTS.items():
        garment = bench.trained(name, **changes)
        scores = errors(garment, bench.sets["unseen"])
        found |= {name: scores.pop(KIND)}
        found |= {baseline: scores[baseline] for baseline in scores}
        posed = np.concatenate([garment.pose(s.motion) for s in bench.sets["unseen"]])
        where[name] = {
            part: 1000 * rms(posed[:, ids], truth[:, ids])
            for part, ids in parts.items()
        }
        looks[name] = cloth(bench, garment)
        sample_of = bench.sets["learnt"][:UNSEEN]
        learnt[name] = errors(garment, sample_of, baselines=False)[KIND]
    ratios = {
        f"hybrid / {name}": found["hybrid"] / found[name]
        for name in found
        if name != "hybrid"
    }
    where["floor"] = {part: bench.floor("unseen", ids) for part, ids in parts.items()}
    return {
        "unseen, mm": found | {"floor": bench.floor("unseen")},
        "vertices": {part: len(ids) for part, ids in parts.items()},
        "unseen, by looseness, mm": where,
        "learnt, mm": learnt | {"floor": bench.floor("learnt")},
        "unseen, cloth": looks,
        "ratios": ratios,
    }


def by_looseness(bench: Benchmark) -> dict[str, np.ndarray]:
    """Vertices that joints have most of, that they have a share of, and no share of."""
    hybrid = bind(bench.config, bench.body, bench.garment, bench.sets["learnt"])
    loose = hybrid.weights[:, : len(hybrid.bones)].sum(axis=1)
    parts = {
        "tight": loose < 0.5,
        "between": (loose >= 0.5) & (loose < 0.999),
        "loose": loose >= 0.999,
    }
    return {name: np.flatnonzero(part) for name, part in parts.items()}


def cloth(bench: Benchmark, garment: LooseGarment) -> dict[str, float]:
    """What the mean error does not tell: is it torn, is the body outside."""
    stretched, below = [], []
    part = obstacle(bench.garment, bench.body.head)
    for item in bench.sets["unseen"]:
        posed = garment.pose(item.motion)
        tensed = strain(posed, bench.garment.vertices, bench.garment.faces)
        stretched.append(tensed.p99)
        motion = every_third(item.motion)
        below.append(inside(posed[::3], motion, bench.body.head, part).mean())
    return {
        "p99 strain, %": 100 * statistics.mean(stretched),
        "inside, %": 100 * float(np.mean(below)),
    }


def stream(bench: Benchmark) -> dict:
    """A minute, frame by frame: does it drift, and is it what a batch gives."""
    garment, (item,) = bench.trained("hybrid"), bench.sets["minute"]
    frames = item.motion.transforms(bench.body.head.skeleton)
    streamed = np.stack(list(garment.stream(frames, item.motion.fps)))
    seconds = round(10 * item.motion.fps)
    first, last = (
        1000 * rms(streamed[part], item.posed[part])
        for part in (slice(seconds), slice(-seconds, None))
    )
    period = one_cycle(item.motion)
    floor = predictability(bench.seen_by_root(item)[period:], period).floor
    return {
        "first 10 s, mm": first,
        "last 10 s, mm": last,
        "floor, one period apart, mm": 1000 * floor,
        "last / first": last / first,
        "from the batch, mm": 1000
        * float(np.abs(streamed - garment.pose(item.motion)).max()),
    }


def speed(bench: Benchmark, frames: int = 300) -> dict:
    """Median milliseconds a frame, at 5,000 vertices: parts, and all there is to it.

    Stream and simulator take turns, as other work on a machine slows both.
    """
    body, (item,) = bench.body, bench.sets["minute"]
    garment = skirt(body.head, rings=50, segments=100)
    rest = garment.vertices
    motion = item.motion
    transforms = motion.transforms(body.head.skeleton)
    loose = bound(bench.config, body, garment, motion)
    inputs = loose.inputs(transforms[:frames], motion.fps)
    roots = torch.from_numpy(transforms[:, 0])
    state = None
    parts: dict[str, list[float]] = {"inputs": [], "network": [], "skinning": []}
    with torch.inference_mode():
        for i in range(1, frames):
            one = slice(i, i + 1)
            times = [time.perf_counter()]
            loose.inputs(transforms[one], motion.fps, transforms[i - 1, 0])
            times.append(time.perf_counter())
            moved, state = loose.network.step(inputs[0][one], inputs[1][one], state)
            times.append(time.perf_counter())
            placed = torch.cat([moved, inputs[2][one]], dim=1)
            loose.skin(placed, roots[one]).numpy()
            times.append(time.perf_counter())
            for name, spent in zip(parts, np.diff(times), strict=True):
                parts[name].append(1000 * spent)
    medians = {name: statistics.median(times) for name, times in parts.items()}
    simulated = Simulator(garment, body.head, SimulationConfig(settle=0, lead=0))
    rounds = [
        (
            per_frame(after_the_first(loose.stream(transforms[:frames], motion.fps))),
            per_frame(islice(after_the_first(simulated.frames(motion, rest)), 10)),
        )
        for _ in range(ROUNDS)
    ]
    ours, theirs = map(statistics.median, zip(*rounds, strict=True))
    ratios = [there / here for here, there in rounds]
    return medians | {
        "a frame of the stream": ours,
        "a frame of the simulator": theirs,
        "vertices": len(garment.vertices),
        "threads": torch.get_num_threads(),
        "simulator / stream": statistics.median(ratios),
        "in the worst of the rounds": min(ratios),
    }


def after_the_first(frames: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    """What comes later is quicker."""
    next(frames)
    return frames


def times(bench: Benchmark, frames: int = 300) -> dict:
    """Milliseconds a frame of a stream, by virtual bones and influences."""
    motion = bench.sets["minute"][0].motion
    transforms = motion.transforms(bench.body.head.skeleton)[:frames]
    pairs = {(bones, bench.config.influences) for bones in BONES}
    pairs |= {(bench.config.bones, influences) for influences in INFLUENCES}
    rows = []
    for bones, influences in sorted(pairs):
        config = replace(bench.config, bones=bones, influences=influences)
        garment = bound(config, bench.body, bench.garment, motion)
        steps = after_the_first(garment.stream(transforms, motion.fps))
        rows.append({"bones": bones, "influences": influences, "ms": per_frame(steps)})
    return {"stream": rows}


def bound(
    config: LooseConfig, body: Body, garment: Garment, motion: Motion
) -> LooseGarment:
    """An untrained garment that was never simulated: as quick as a trained one."""
    rest = garment.vertices
    roots = motion.transforms(body.head.skeleton)[:, :1]
    one = np.ones((len(rest), 1), np.float32)
    rigid = linear_blend_skinning(rest, one, roots)
    return bind(config, body, garment, [Simulated(motion, rigid, rest)])


def per_frame(frames: Iterator[np.ndarray]) -> float:
    """Median milliseconds of each."""
    times, began = [], time.perf_counter()
    for _ in frames:
        now = time.perf_counter()
        times.append(1000 * (now - began))
        began = now
    return statistics.median(times)


def curves(bench: Benchmark) -> dict:
    """What more virtual bones, and more of them on a vertex, would give at best."""
    unseen = [bench.seen_by_root(item)[::10] for item in bench.sets["unseen"]]
    posed = np.concatenate(unseen)
    rest, faces = bench.sets["unseen"][0].rest, bench.garment.faces
    standard = bench.config
    rows = []
    pairs = {(bones, standard.influences) for bones in BONES}
    pairs |= {(standard.bones, influences) for influences in INFLUENCES}
    for bones, influences in sorted(pairs):
        ids = place_bones(rest, faces, bones, standard.seed)
        distances = bone_distances(rest, faces, ids)
        weights = fading_heat(distances, bone_spacing(distances, ids), influences)
        row: dict = {"bones": bones, "influences": influences}
        for kind in ("rigid", "translation"):
            transforms = oracle(rest, weights, posed, kind)
            fitted = linear_blend_skinning(rest, weights, transforms)
            row[f"best {kind}, mm"] = 1000 * rms(fitted, posed)
        rows.append(row)
    return {"oracle": rows}


def sweep(bench: Benchmark) -> dict:
    """The same, trained; without collisions, which take half of the time."""
    rows = []
    without = VARIANTS["without collisions in the loss"]
    for bones, influences in SWEPT:
        changes = {"bones": bones, "influences": influences} | without
        garment = bench.trained(f"{bones} x {influences}", **changes)
        found = errors(garment, bench.sets["unseen"], baselines=False)
        rows.append({"bones": bones, "influences": influences, "mm": found[KIND]})
    return {"trained": rows, "floor, mm": bench.floor("unseen")}


def weights(bench: Benchmark) -> dict:
    """Other ways to share the cloth among the same bones, and what they give at best.

    The network of Part I has learnt heads; here it skins a skirt, its virtual bones
    given as joints without parents and tails.
    """
    posed = np.concatenate(
        [bench.seen_by_root(item)[::10] for item in bench.sets["unseen"]]
    )
    rest, faces = bench.sets["unseen"][0].rest, bench.garment.faces
    standard = bench.config
    ids = place_bones(rest, faces, standard.bones, standard.seed)
    along = bone_distances(rest, faces, ids)
    straight = np.linalg.norm(rest[:, None] - rest[ids], axis=-1)
    names = [f"virtual_{i}" for i in range(len(ids))]
    skeleton = Skeleton.from_heads_and_tails(rest[ids], None, [-1] * len(ids), names)
    skirt = Head.create(rest, faces, skeleton)
    spacing, most = bone_spacing(along, ids), standard.influences
    ways = {
        "heat along the cloth": fading_heat(along, spacing, most),
        "heat through the air": fading_heat(straight, spacing, most),
        "the nearest bone alone": np.eye(len(ids))[along.argmin(axis=1)],
        "the network of Part I": load_model("heads").predict(skirt),
    }
    found = {}
    for way, shares in ways.items():
        transforms = oracle(rest, shares, posed, "rigid")
        fitted = linear_blend_skinning(rest, shares, transforms)
        found[f"{way}, mm"] = 1000 * rms(fitted, posed)
    return found


def seeds(bench: Benchmark) -> dict:
    """Is the hybrid better than without joints, or was it luck?"""
    found = {}
    for seed in SEEDS:
        for name in tuple(VARIANTS)[:3]:
            garment = bench.trained(f"{name} {seed}", **VARIANTS[name], seed=seed)
            error = errors(garment, bench.sets["unseen"], baselines=False)[KIND]
            found[f"{name}, seed {seed}, mm"] = error
    return found | {"floor, mm": bench.floor("unseen")}


PARTS: dict[str, Callable[[Benchmark], dict]] = {
    "simulator": simulator,
    "accuracy": accuracy,
    "stream": stream,
    "speed": speed,
    "times": times,
    "curves": curves,
    "weights": weights,
    "sweep": sweep,
    "seeds": seeds,
}


def main(
    out: tyro.conf.Positional[Path],
    *,
    only: tuple[str, ...] = tuple(PARTS),
    motions: int = 112,
    threads: int = 2,
) -> None:
    """Simulate, train and judge, or go on where it stopped.

    Args:
        out: Folder for simulations, garments and numbers.
        only: These parts.
        motions: How many to learn from.
        threads: CPU cores to use.
    """
    torch.set_num_threads(threads)
    bench = Benchmark(out, motions, LooseConfig(threads=threads))
    for name in only:
        result = PARTS[name](bench)
        (out / f"{name}.json").write_text(json.dumps(result, indent=1) + "\n")
        print(f"{name}:")
        show(result)


def show(result: dict | Sequence, indent: int = 1) -> None:
    """Print nested numbers, one in a line, and those of a row in one line."""
    rows = result.items() if isinstance(result, dict) else [("", r) for r in result]
    for name, value in rows:
        if isinstance(value, dict) and indent > 1:
            value = ", ".join(f"{k} {v:.4g}" for k, v in value.items())
        if isinstance(value, dict | list):
            print("  " * indent + name)
            show(value, indent + 1)
        else:
            value = f"{value:.4g}" if isinstance(value, float) else value
            print("  " * indent + f"{name:28s} {value}")


if __name__ == "__main__":
    tyro.cli(main)
