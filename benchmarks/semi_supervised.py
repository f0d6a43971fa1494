"""What do unlabelled heads, critics and each term give? One row an arm and seed.

    python benchmarks/semi_supervised.py HEADS OUT --unlabelled MORE --labelled 8

Of the training heads of a fold (see rocketbox.py) `labelled` keep their weights; the
others lose them and join MORE. Every arm has the same heads, seeds and minutes of
processor time, and is judged on the held-out heads, of topology groups that it never
saw, with or without weights. An arm and seed that is in OUT already is not run again.
"""

import json
import time
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tyro
from rocketbox import FOLDS, SHARED, split
from tqdm import tqdm
from tyro.conf import Positional

from skinlib.datasets.folder import load_folder
from skinlib.evaluate.groups import shared_topology
from skinlib.evaluate.metrics import row_l1
from skinlib.losses import LossWeights, TermWeights
from skinlib.training import AS_WRITTEN, SUPERVISED_ONLY, TrainConfig, Trainer

SEED_LOSS = LossWeights(row_l1=0.0, cross_entropy=0.0, seed=1.0)


def only(**weights: float) -> TermWeights:
    """The supervised term and some more."""
    return replace(SUPERVISED_ONLY, **weights)


GUESSED = {"propagate": False, "unlabelled_share": 0.25, "unlabelled_start": 0.3}
SOURCE = GUESSED | {"terms": TermWeights(), "loss": SEED_LOSS}

# What differs from TrainConfig. "supervised" never sees an unlabelled head; "all
# labels" has the weights of all heads, which is what could be had at most. All others
# use unlabelled heads' proportions (`resemble`), and "proportions" nothing else.
ARMS = {
    "supervised": {},
    "propagation": {},
    "all labels": {},
    "proportions": {"propagate": False},
    "propagation and guesses": {"pseudo": 0.5},
    "pseudo-labels": GUESSED | {"pseudo": 1.0},
    "consistency": GUESSED | {"terms": only(consistency=0.5)},
    "physical": GUESSED | {"terms": only(physical=0.001)},
    "D_s": GUESSED | {"terms": only(adversarial_s=0.1)},
    "D_u": GUESSED | {"terms": only(adversarial_u=0.1)},
    "source, as written": SOURCE | {"forms": AS_WRITTEN},
    "source, WGAN signs": SOURCE | {"forms": replace(AS_WRITTEN, signs="wgan")},
    "source, D_u with positives": SOURCE
    | {"forms": replace(AS_WRITTEN, signs="wgan", positives="labelled")},
}


def apart(heads: list, held_out: list) -> list:
    """The heads that share no topology with any of the held-out ones."""
    similarity = shared_topology([*held_out, *heads])[: len(held_out), len(held_out) :]
    return [heads[i] for i in np.flatnonzero(similarity.max(axis=0) <= SHARED)]


class ByProcessorTime(Trainer):
    """Counts the time it computes, so that no arm pays for the machine's other work."""

    clock = staticmethod(time.process_time)


@dataclass(frozen=True)
class Run:
    """What do unlabelled heads, critics and each term give?"""

    heads: Positional[Path]  # folder of skinned heads
    out: Positional[Path]  # folder for the runs and results.json
    unlabelled: Path | None = None  # folder of more heads, whose weights are not read
    labelled: int = 8  # heads that keep their weights
    fold: int | None = None  # which is held out; None: fold s of seed s
    seeds: tuple[int, ...] = (0, 1, 2)  # of the choice of heads and of the training
    arms: tuple[str, ...] = tuple(ARMS)  # which arms
    minutes: float = 5.0  # of each run
    threads: int = 2  # of each run
    config: TrainConfig = field(default_factory=TrainConfig)  # what all arms share


def main(run: Run) -> None:
    """Run what is missing, then print mean and spread of each arm."""
    heads = load_folder(run.heads)
    more = load_folder(run.unlabelled) if run.unlabelled else []
    path = run.out / "results.json"
    run.out.mkdir(parents=True, exist_ok=True)
    results = json.loads(path.read_text()) if path.exists() else {}
    pairs = [(seed, arm) for seed in run.seeds for arm in run.arms]
    for seed, arm in tqdm(pairs, unit="run"):
        key = f"{arm} / {run.labelled} / {run.minutes:g} min / seed {seed}"
        if key in results:
            continue
        fold = seed % FOLDS if run.fold is None else run.fold
        training, held_out = split(heads, fold)
        order = np.random.default_rng(seed).permutation(len(training))
        count = len(training) if arm == "all labels" else run.labelled
        chosen = [training[i] for i in order[:count]]
        bare = [training[i].replace(weights=None) for i in order[count:]]
        bare += [head.replace(weights=None) for head in apart(more, held_out)]
        bare = bare if arm not in ("supervised", "all labels") else []
        config = replace(
            run.config, minutes=run.minutes, threads=run.threads, seed=seed, **ARMS[arm]
        )
        folder = run.out / key.replace(" / ", "_").replace(" ", "-").replace(",", "")
        model = ByProcessorTime(config, chosen, folder, bare, validation=[]).run()
        errors = {
            head.name: float(row_l1(model.predict(head), head.weights).mean())
            for head in held_out
        }
        results[key] = {"row_l1_mean": float(np.mean([*errors.values()]))} | errors
        path.write_text(json.dumps(results, indent=1))
    for arm in run.arms:
        key = f"{arm} / {run.labelled} / {run.minutes:g} min / seed "
        means = [results[key + str(s)]["row_l1_mean"] for s in run.seeds]
        print(f"{arm:28} {np.mean(means):.4f} +- {np.std(means):.4f}  {means}")


if __name__ == "__main__":
    main(tyro.cli(Run))
