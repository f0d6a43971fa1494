"""Train on a folder of heads and judge on topology groups that were held out.

    python benchmarks/rocketbox.py HEADS OUT --minutes 30 [--fold 0] [--extra MORE]

Heads are split into `FOLDS` folds by topology group; a group that holds more than a
quarter of all heads is always trained on. Groups are joined at 0.47 shared topology,
more strictly than the default, so that no edit of a base mesh is on both sides. Writes
`OUT/model` and `OUT/scores.json`, and prints the table beside the classical methods.
"""

import argparse
import json
from pathlib import Path

import numpy as np

from skinlib.datasets.folder import load_folder
from skinlib.evaluate.compare import evaluate, format_table
from skinlib.evaluate.groups import topology_groups
from skinlib.training import TrainConfig, train

FOLDS = 4
SHARED = 0.47


def split(heads: list, fold: int) -> tuple[list, list]:
    """(training heads, held-out heads) of a fold; they share no topology group."""
    groups = np.array(topology_groups(heads, SHARED))
    sizes = np.bincount(groups)
    small = np.flatnonzero(sizes <= len(heads) / 4)
    held_out = np.isin(groups, small[fold::FOLDS])
    pairs = list(zip(heads, held_out, strict=True))
    return [h for h, out in pairs if not out], [h for h, out in pairs if out]


def main() -> None:
    """Split, train, judge, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("heads", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--minutes", type=float, default=30)
    parser.add_argument("--fold", type=int, default=0, choices=range(FOLDS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--extra", type=Path, help="more heads, only to train on")
    parser.add_argument("--limit", type=int, help="at most this many extra heads")
    arguments = parser.parse_args()
    labelled, held_out = split(load_folder(arguments.heads), arguments.fold)
    extra = load_folder(arguments.extra)[: arguments.limit] if arguments.extra else []
    config = TrainConfig(
        minutes=arguments.minutes, seed=arguments.seed, threads=arguments.threads
    )
    folder = arguments.out / "model"
    # Held-out heads are looked at once, after the last step: none of them chooses it.
    model = train(config, labelled + extra, folder, validation=[])
    result = evaluate(held_out, train_heads=labelled, model=model)
    result["held_out"] = [head.name for head in held_out]
    (arguments.out / "scores.json").write_text(json.dumps(result, indent=1))
    print(format_table(result))


if __name__ == "__main__":
    main()
