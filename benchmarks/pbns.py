"""PBNS against skinning alone: T-shirt, skirt, two layers, and what each part gives.

    python benchmarks/pbns.py runs/pbns
    python benchmarks/pbns.py runs/pbns --only t_shirt skirt

Every garment is trained from physics alone and judged on 200 random poses that it has
not learnt, on 200 of which some press one limb against another, and on eight motions.
Skinning alone has the weights of the closest points of the body. Runs go on where they
stopped; the numbers of each are in OUT/NAME.json.
"""

import json
import statistics
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import torch
import tyro

from skinlib.garments.body import read_body
from skinlib.garments.garment import read_garment
from skinlib.garments.measures import joined, measure, skinned
from skinlib.garments.motion import (
    Motion,
    held_out_motions,
    random_poses,
    read_motion,
    write_motion,
)
from skinlib.garments.outfit import Outfit, load_outfit
from skinlib.garments.training import GarmentConfig, train, training_poses
from skinlib.paths import sample

SHAPES = (
    {"weight": 0.5},
    {"weight": -0.5},
    {"height": 0.4},
    {"gender": -0.5, "muscle": 0.5},
)
TEST_SEED, TEST_GAP = 1_000_000, 0.02  # metres between the limbs: hands off


@dataclass(frozen=True)
class Experiment:
    """Garments from the skin outwards, and what is different in their training."""

    garments: tuple[str, ...]
    steps: int = 10_000
    changes: dict = field(default_factory=dict)
    energies: dict = field(default_factory=dict)
    network: dict = field(default_factory=dict)

    def config(self, threads: int) -> GarmentConfig:
        """The default configuration with the changes."""
        standard = GarmentConfig()
        return replace(
            standard,
            steps=self.steps,
            threads=threads,
            energies=replace(standard.energies, **self.energies),
            network=replace(standard.network, **self.network),
            **self.changes,
        )


FIXED = {"learn_weights": False}
SOURCE = {
    "hidden": 32,
    "embedding": 32,
    "slope": 0.0,
    "rounding": 0.0,
    "learn_weights": False,
}
PUBLISHED = {"bend": 5e-5, "collision": 25.0, "layer": 25.0}
SHIRT, SKIRT, LAYERS = ("t_shirt",), ("skirt",), ("t_shirt", "jacket")
HANGING, NEAREST = {"smoothing": 50, "touch": 0.0}, {"smoothing": 0}
EXPERIMENTS = {
    # The shipped one: other bodies, too, stiffer folds, harder skin.
    "t_shirt": Experiment(
        SHIRT, 24_000, {"shapes": True}, {"bend": 7.5e-4, "collision": 500.0}
    ),
    "all_terms": Experiment(SHIRT, 4_000),
    # Without gravity, too: else the shirt falls through the body and lies below it.
    "no_collision": Experiment(
        SHIRT, 4_000, energies={"collision": 0.0, "gravity": 0.0}
    ),
    "fixed_weights": Experiment(SHIRT, 4_000, network=FIXED),
    "as_published": Experiment(SHIRT, 4_000, NEAREST, PUBLISHED, SOURCE),
    "trousers": Experiment(("trousers",), 6_000),
    "skirt": Experiment(SKIRT, 6_000, HANGING),
    "skirt_fixed": Experiment(SKIRT, 6_000, HANGING, network=FIXED),
    "skirt_nearest": Experiment(SKIRT, 6_000, HANGING | NEAREST, network=FIXED),
    "layers": Experiment(LAYERS, 5_000),
    "no_layer": Experiment(LAYERS, 5_000, energies={"layer": 0.0}),
}


def main(
    out: tyro.conf.Positional[Path],
    *,
    only: tuple[str, ...] = tuple(EXPERIMENTS),
    threads: int = 2,
) -> None:
    """Train and judge, or go on where it stopped.

    Args:
        out: Folder for the garments and their numbers.
        only: These experiments.
        threads: CPU cores to use.
    """
    body = read_body()
    skeleton = body.head.skeleton
    standard, file = GarmentConfig(), out / "poses.npz"
    if not file.exists():
        out.mkdir(parents=True, exist_ok=True)
        drawn = (standard.poses, standard.seed, standard.gap)
        write_motion(file, training_poses(body.head, *drawn))
    poses = read_motion(file)
    tests = {
        "poses": random_poses(skeleton, 200, TEST_SEED, body.head, TEST_GAP),
        "pressed": random_poses(skeleton, 200, TEST_SEED, body.head),
        "motions": every_third(joined(held_out_motions(skeleton))),
    }
    for name in only:
        experiment = EXPERIMENTS[name]
        config = experiment.config(threads)
        garments = [read_garment(sample(f"{part}.npz")) for part in experiment.garments]
        train(config, Outfit.create(body, garments), out / name, poses)
        outfit, network = load_outfit(out / name)
        state = json.loads((out / name / "config.json").read_text())
        result = {
            "minutes": state["seconds"] / 60,
            "frame_ms": frame_ms(outfit, network),
        }
        for test, motion in tests.items():
            known = out / "skinned" / f"{'_'.join(experiment.garments)}_{test}.json"
            result[test] = judged(outfit, network, motion, known)
        for shape in SHAPES if config.shapes else ():
            label = ", ".join(f"{key} {value:+g}" for key, value in shape.items())
            known = out / "skinned" / f"{label}.json"
            result[label] = judged(outfit, network, tests["motions"], known, shape)
        path = out / f"{name}.json"
        path.write_text(json.dumps(result, indent=1) + "\n")
        print(f"{name}: {result['minutes']:.1f} minutes, {result['frame_ms']:.2f} ms")
        for test in list(result)[2:]:
            for method, values in result[test].items():
                numbers = "  ".join(f"{k} {v:.3f}" for k, v in values.items())
                print(f"  {test:12s} {method:15s} {numbers}")


def every_third(motion: Motion) -> Motion:
    """Ten frames a second are enough to judge by."""
    return replace(
        motion,
        rotations=motion.rotations[::3],
        translations=motion.translations[::3],
    )


def judged(outfit, network, motion, known: Path, shape=None) -> dict:
    """The measures of skinning alone, kept in the file `known`, and of the network."""
    if not known.exists():
        alone = measure(outfit, motion, skinned(outfit, motion, shape), shape)
        known.parent.mkdir(exist_ok=True)
        known.write_text(json.dumps(asdict(alone)))
    ours = measure(outfit, motion, outfit.pose(network, motion, shape), shape)
    return {"skinning alone": json.loads(known.read_text()), "PBNS": asdict(ours)}


def frame_ms(outfit, network, frames: int = 300) -> float:
    """Median milliseconds of one pose: network and skinning, without the bones."""
    motion = held_out_motions(outfit.body.head.skeleton)[0]
    inputs = network.inputs(motion.rotations)
    transforms = torch.from_numpy(motion.transforms(outfit.body.head.skeleton))
    times = []
    with torch.inference_mode():
        for i in range(frames):
            one = slice(i % len(motion), i % len(motion) + 1)
            began = time.perf_counter()
            network(inputs[one], transforms[one])
            times.append(time.perf_counter() - began)
    return 1000 * statistics.median(times)


if __name__ == "__main__":
    tyro.cli(main)
