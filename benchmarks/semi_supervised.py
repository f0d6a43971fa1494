"""What do unlabelled heads, critics and each term give? One row an arm and seed.

    python benchmarks/semi_supervised.py HEADS OUT --unlabelled MORE --labelled 8

Of the training heads of a fold (see rocketbox.py) `labelled` keep their weights; the
others lose them and join MORE. Every arm has the same heads, seeds and minutes of
processor time, and is judged on the held-out heads, of topology groups that it never
saw, with or without weights, and on those whose weights it did not get to see. An arm
and seed that is in OUT already is not run again; several processes may share OUT.
"""

import json
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm
from tyro.conf import Positional

from skinlib.datasets.folder import load_folder
from skinlib.evaluate.groups import FOLDS, apart, fold
from skinlib.evaluate.metrics import row_l1
from skinlib.headbench.networks import ByProcessorTime
from skinlib.losses import LossWeights, TermWeights
from skinlib.training import AS_WRITTEN, SUPERVISED_ONLY, TrainConfig

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
    minutes: float = 5.0  # of processor time, of each run
    config: TrainConfig = field(default_factory=TrainConfig)  # what all arms share


def main(run: Run) -> None:
    """Run what is missing, then print and write what is there."""
    heads = load_folder(run.heads)
    more = load_folder(run.unlabelled) if run.unlabelled else []
    for seed, arm in tqdm([(s, a) for s in run.seeds for a in run.arms], unit="run"):
        words = arm.replace(",", "").replace(" ", "-")
        name = f"{words}_{run.labelled}_{run.minutes:g}-min_seed-{seed}"
        folder = run.out / name
        if (folder / "scores.json").exists():
            continue
        training, held_out = fold(heads, seed % FOLDS if run.fold is None else run.fold)
        order = np.random.default_rng(seed).permutation(len(training))
        painted, hidden = np.split(order, [run.labelled])
        painted, hidden = ([training[i] for i in ids] for ids in (painted, hidden))
        bare = [
            head.replace(weights=None) for head in [*hidden, *apart(more, held_out)]
        ]
        if arm == "all labels":
            painted, hidden = training, []
        if arm in ("supervised", "all labels"):
            bare = []
        # With one thread the processor's time is the run's.
        changes = {"minutes": run.minutes, "seed": seed, "threads": 1}
        config = replace(run.config, **changes, **ARMS[arm])
        model = ByProcessorTime(config, painted, folder, bare, validation=[]).run()
        scores = {"arm": arm, "labelled": run.labelled, "minutes": run.minutes}
        scores |= {"seed": seed, "held_out": errors(model, held_out)}
        scores |= {"hidden": errors(model, hidden)}
        (folder / "scores.json").write_text(json.dumps(scores, indent=1))
    results = collect(run.out)
    (run.out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    for setting, arms in results.items():
        print(setting)
        for arm, numbers in arms.items():
            print(
                f"  {arm:28}",
                *(f"{k} {np.mean(v):.4f} {v}" for k, v in numbers.items()),
            )


def errors(model, heads) -> dict[str, float]:
    """Mean row-L1 of each head."""
    return {h.name: float(row_l1(model.predict(h), h.weights).mean()) for h in heads}


def collect(out: Path) -> dict[str, dict[str, dict[str, list[float]]]]:
    """{setting: {arm: {kind: mean row-L1 of each seed}}} of all runs that have ended.

    Kinds: `held_out` heads, and `hidden` ones, which the arm may have seen without
    their weights.
    """
    scores = [json.loads(file.read_text()) for file in out.glob("*/scores.json")]
    scores.sort(
        key=lambda s: (s["labelled"], s["minutes"], [*ARMS].index(s["arm"]), s["seed"])
    )
    results = {}
    for one in scores:
        setting = f"{one['labelled']} labelled, {one['minutes']:g} minutes"
        arm = results.setdefault(setting, {}).setdefault(one["arm"], {})
        for kind in ("held_out", "hidden"):
            if one[kind]:
                mean = round(float(np.mean([*one[kind].values()])), 4)
                arm.setdefault(kind, []).append(mean)
    return results


if __name__ == "__main__":
    main(tyro.cli(Run))
