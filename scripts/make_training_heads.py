"""Make anny heads to train on, and four remeshed sets of unseen people to judge by.

    python scripts/make_training_heads.py runs/anny

Writes `train/` (160 heads, each remeshed in another way) and `test_halved/`,
`test_subdivided/`, `test_isotropic/`, `test_shuffled/` (the same 12 unseen people in
each). The first call builds anny's cache, which takes minutes. anny is CC0.
"""

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from skinlib.datasets.anny import AnnyConfig, anny_heads
from skinlib.datasets.remesh import REMESHERS, halve, isotropic
from skinlib.head import Head
from skinlib.io import write_head

TEST_SEED = 10_000
KINDS = {
    "original": 0.15,
    "halved": 0.3,
    "isotropic": 0.3,
    "subdivided": 0.1,
    "shuffled": 0.15,
}


def people(first: int, count: int, busts: bool) -> list[Head]:
    """Heads of seeds `first` on: every other one with helper bones, a third busts."""
    heads = []
    for seed in range(first, first + count):
        bust = busts and seed % 3 == 0
        config = AnnyConfig(helper_bones=seed % 2 == 0, bust=bust)
        heads.append((seed, config))
    drawn = {config: anny_heads(count, first, config) for config in {c for _, c in heads}}
    return [drawn[config][seed - first] for seed, config in heads]


def remeshed(head: Head, seed: int) -> tuple[str, Head]:
    """A head with another topology, and the name of what was done."""
    rng = np.random.default_rng([seed, 9])
    kind = rng.choice(list(KINDS), p=list(KINDS.values()))
    if kind == "halved":
        return kind, halve(head, rng, keep=rng.uniform(0.35, 0.8))
    if kind == "isotropic":
        return kind, isotropic(head, rng, vertices=int(rng.uniform(2000, 5000)))
    return kind, head if kind == "original" else REMESHERS[kind](head, rng)


def main() -> None:
    """Write all five folders."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--count", type=int, default=160, help="heads to train on")
    arguments = parser.parse_args()
    out = arguments.out
    (out / "train").mkdir(parents=True, exist_ok=True)
    for seed, head in enumerate(tqdm(people(0, arguments.count, True), "train")):
        kind, head = remeshed(head, seed)
        write_head(out / "train" / f"anny_{seed:05d}_{kind}.npz", head)
    unseen = people(TEST_SEED, 12, False)
    for kind, remesh in REMESHERS.items():
        folder = out / f"test_{kind}"
        folder.mkdir(exist_ok=True)
        for i, head in enumerate(tqdm(unseen, folder.name)):
            path = folder / f"anny_{TEST_SEED + i}.npz"
            write_head(path, remesh(head, TEST_SEED + i))


if __name__ == "__main__":
    main()
