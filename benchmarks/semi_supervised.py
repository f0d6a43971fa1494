"""What do unlabelled heads, critics and each term give? One row an arm and seed.

    python benchmarks/semi_supervised.py HEADS OUT --unlabelled MORE --labelled 8

Of the training heads of a fold (see rocketbox.py) `labelled` keep their weights; the
others lose them and join MORE. Every arm has the same heads, seeds and minutes, and is
judged on the held-out heads, of topology groups that it never saw, with or without
weights. An arm and seed that is in OUT already is not run again.
"""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tyro
from rocketbox import split
from tqdm import tqdm
from tyro.conf import Positional

from skinlib.datasets.folder import load_folder
from skinlib.evaluate.metrics import row_l1
from skinlib.losses import LossWeights, TermWeights
from skinlib.training import AS_WRITTEN, SUPERVISED_ONLY, TermForms, TrainConfig, train

SEED_LOSS = LossWeights(row_l1=0.0, cross_entropy=0.0, seed=1.0)


def only(**weights: float) -> TermWeights:
    """The supervised term and some more."""
    return replace(SUPERVISED_ONLY, **weights)


# What differs from TrainConfig; `pseudo` 0: guessed weights are not learnt from. The
# supervised arm never sees an unlabelled head; the others also take over proportions
# of unlabelled heads (`resemble`), and "proportions" does nothing else with them.
ARMS = {
    "supervised": {"unlabelled_share": 0.0},
    "proportions": {"unlabelled_share": 0.0},
    "pseudo-labels": {},
    "consistency": {"pseudo": 0.0, "terms": only(consistency=0.5)},
    "physical": {"pseudo": 0.0, "terms": only(physical=0.001)},
    "D_s": {"unlabelled_share": 0.0, "terms": only(adversarial_s=0.1)},
    "D_u": {"pseudo": 0.0, "terms": only(adversarial_u=0.1)},
    "source, as written": {
        "pseudo": 0.0,
        "terms": TermWeights(),
        "forms": AS_WRITTEN,
        "loss": SEED_LOSS,
    },
    "source, WGAN signs": {
        "pseudo": 0.0,
        "terms": TermWeights(),
        "forms": replace(AS_WRITTEN, signs="wgan"),
        "loss": SEED_LOSS,
    },
    "source, D_u with positives": {
        "pseudo": 0.0,
        "terms": TermWeights(),
        "forms": TermForms(
            consistency="squares", smooth="neighbours", joint="joints", per_vertex=False
        ),
        "loss": SEED_LOSS,
    },
}


@dataclass(frozen=True)
class Run:
    """What do unlabelled heads, critics and each term give?"""

    heads: Positional[Path]  # folder of skinned heads
    out: Positional[Path]  # folder for the runs and results.json
    unlabelled: Path | None = None  # folder of more heads, whose weights are not read
    labelled: int = 8  # heads that keep their weights
    fold: int = 0  # which of the folds is held out
    seeds: tuple[int, ...] = (0, 1, 2)  # of the choice of heads and of the training
    arms: tuple[str, ...] = tuple(ARMS)  # which arms
    minutes: float = 5.0  # of each run
    threads: int = 2  # of each run
    config: TrainConfig = field(default_factory=TrainConfig)  # what all arms share


def main(run: Run) -> None:
    """Run what is missing, then print mean and spread of each arm."""
    training, held_out = split(load_folder(run.heads), run.fold)
    more = load_folder(run.unlabelled) if run.unlabelled else []
    path = run.out / "results.json"
    run.out.mkdir(parents=True, exist_ok=True)
    results = json.loads(path.read_text()) if path.exists() else {}
    pairs = [(seed, arm) for seed in run.seeds for arm in run.arms]
    for seed, arm in tqdm(pairs, unit="run"):
        key = f"{arm} / {run.labelled} / {run.minutes:g} min / seed {seed}"
        if key in results:
            continue
        order = np.random.default_rng(seed).permutation(len(training))
        chosen = [training[i] for i in order[: run.labelled]]
        bare = [training[i].replace(weights=None) for i in order[run.labelled :]]
        bare += [head.replace(weights=None) for head in more]
        bare = bare if arm != "supervised" else []
        config = replace(
            run.config, minutes=run.minutes, threads=run.threads, seed=seed, **ARMS[arm]
        )
        folder = run.out / key.replace(" / ", "_").replace(" ", "-").replace(",", "")
        model = train(config, chosen, folder, bare, validation=[])
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
