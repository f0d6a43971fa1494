"""Is the adversarial training stable for long? All five terms, both critics, one chart.

    python benchmarks/long_run.py HEADS OUT --unlabelled MORE --config.minutes 60

Half of the training heads of fold 0 (see rocketbox.py) lose their weights; the terms
run in their default forms, the physical one with a weight that fits its size. A number
that is not finite stops the run with an error. Writes `OUT/history.json`, which the
chart `OUT/long_run.png` shows.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path

import tyro
from tyro.conf import Positional

from skinlib.datasets.folder import load_folder
from skinlib.evaluate.groups import apart, fold
from skinlib.losses import TermWeights
from skinlib.training import HISTORY, TrainConfig, train
from skinlib.views.plots import training_curves


@dataclass(frozen=True)
class Run:
    """Is the adversarial training stable for long?"""

    heads: Positional[Path]  # folder of skinned heads
    out: Positional[Path]  # folder for the run and the chart
    unlabelled: Path | None = None  # folder of more heads, whose weights are not read
    config: TrainConfig = field(
        default_factory=lambda: TrainConfig(
            terms=TermWeights(physical=0.001), validations=60
        )
    )


def main(run: Run) -> None:
    """Train, then draw."""
    training, held_out = fold(load_folder(run.heads), 0)
    labelled, hidden = training[::2], training[1::2]
    more = load_folder(run.unlabelled) if run.unlabelled else []
    bare = [head.replace(weights=None) for head in [*hidden, *apart(more, held_out)]]
    # The average is kept at every validation; the held-out heads choose nothing.
    train(run.config, labelled, run.out, bare, validation=held_out)
    draw(run.out)


def draw(out: Path) -> None:
    """The chart of a history."""
    history = json.loads((out / HISTORY).read_text())
    minutes = [entry["minutes"] for entry in history]
    curves = {
        "row-L1, held-out heads": [entry["validation_row_l1"] for entry in history],
        "row-L1, training": [entry["train_row_l1"] for entry in history],
        "consistency": [entry["terms"]["consistency"] for entry in history],
    }
    for name, label in (("adversarial_s", "D_s"), ("adversarial_u", "D_u")):
        curves[f"{label}: real - fake"] = [
            entry["terms"][f"{name}_real"] - entry["terms"][f"{name}_fake"]
            for entry in history
        ]
    picture = training_curves(
        {name: (minutes, values) for name, values in curves.items()},
        title="All five terms, both critics",
        x_label="minutes",
        y_label="row-L1, or scores",
    )
    picture.save(out / "long_run.png")


if __name__ == "__main__":
    main(tyro.cli(Run))
