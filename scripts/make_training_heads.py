"""Make the heads that the shipped network learns from, and those it is judged by.

    python scripts/make_training_heads.py runs/heads [--own DIR]

Writes into runs/heads:

    train/             anny heads, each remeshed in another way, and synthetic heads;
                       with --own also each head in DIR and a remeshed copy of it
    test_halved/ test_subdivided/ test_isotropic/ test_shuffled/
                       the same 12 unseen anny people, remeshed in four ways

The first call builds anny's cache, which takes minutes. anny is CC0.
"""

import argparse
from pathlib import Path

import numpy as np
from tqdm import tqdm

from skinlib.datasets.anny import AnnyConfig, anny_heads
from skinlib.datasets.folder import load_folder
from skinlib.datasets.remesh import REMESHERS, halve, isotropic
from skinlib.datasets.synthetic import synthetic_heads
from skinlib.head import Head
from skinlib.io import write_head

TEST_SEED = 10_000
SYNTHETIC_SEED = 100
KINDS = {"halved": 0.4, "isotropic": 0.35, "shuffled": 0.2, "subdivided": 0.05}


def people(first: int, count: int, busts: bool) -> list[Head]:
    """Heads of seeds `first` on: every other one with helper bones, a third busts."""
    configs = [
        AnnyConfig(helper_bones=seed % 2 == 0, bust=busts and seed % 3 == 0)
        for seed in range(first, first + count)
    ]
    drawn = {config: anny_heads(count, first, config) for config in set(configs)}
    return [drawn[config][i] for i, config in enumerate(configs)]


def remeshed(head: Head, seed: int) -> tuple[str, Head]:
    """A head with another topology, and the name of what was done."""
    rng = np.random.default_rng([seed, 9])
    kind = str(rng.choice(list(KINDS), p=list(KINDS.values())))
    if kind == "halved":
        return kind, halve(head, rng, keep=rng.uniform(0.35, 0.8))
    if kind == "isotropic":
        return kind, isotropic(head, rng, vertices=int(rng.uniform(2000, 5000)))
    return kind, REMESHERS[kind](head, rng)


def main() -> None:
    """Write all folders."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--own", type=Path, help="a folder of your own skinned heads")
    parser.add_argument("--anny", type=int, default=100, help="anny heads to train on")
    parser.add_argument("--synthetic", type=int, default=8, help="synthetic ones")
    options = parser.parse_args()

    train = options.out / "train"
    train.mkdir(parents=True, exist_ok=True)
    for seed, head in enumerate(tqdm(people(0, options.anny, True), "anny")):
        kind, head = remeshed(head, seed)
        write_head(train / f"anny_{seed:05d}_{kind}.npz", head)
    for i, head in enumerate(synthetic_heads(options.synthetic, SYNTHETIC_SEED)):
        write_head(train / f"synthetic_{i:02d}.npz", head)
    for i, head in enumerate(tqdm(load_folder(options.own) if options.own else [])):
        rng = np.random.default_rng(i)
        write_head(train / f"{head.name}.npz", head)
        if i % 2:
            copy, kind = halve(head, rng, keep=rng.uniform(0.4, 0.8)), "halved"
        else:
            size = int(rng.uniform(1200, 3000))
            copy, kind = isotropic(head, rng, vertices=size), "isotropic"
        write_head(train / f"{head.name}__{kind}.npz", copy)

    unseen = people(TEST_SEED, 12, False)
    for kind, remesh in REMESHERS.items():
        folder = options.out / f"test_{kind}"
        folder.mkdir(exist_ok=True)
        for i, head in enumerate(tqdm(unseen, folder.name)):
            path = folder / f"anny_{TEST_SEED + i}.npz"
            write_head(path, remesh(head, TEST_SEED + i))


if __name__ == "__main__":
    main()
