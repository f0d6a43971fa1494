"""Train on a folder of heads and judge on topology groups that were held out.

    python benchmarks/rocketbox.py HEADS OUT --config.minutes 30 [--fold 0]
    python benchmarks/rocketbox.py HEADS OUT --fold none --extra MORE  # judge nothing

Folds are those of `skinlib.evaluate.groups.fold`: no edit of a base mesh is on both
sides. Writes `OUT/model` and `OUT/scores.json`, and prints the table beside the
classical methods.
"""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import tyro
from tyro.conf import Positional

from skinlib.datasets.folder import load_folder
from skinlib.evaluate.compare import evaluate, format_table
from skinlib.evaluate.groups import apart, fold
from skinlib.training import TrainConfig, load_model, train


@dataclass(frozen=True)
class Run:
    """Train on a folder of heads and judge on topology groups that were held out."""

    heads: Positional[Path]  # folder of skinned heads
    out: Positional[Path]  # folder for the model and the scores
    fold: Literal["0", "1", "2", "3", "none"] = "0"  # which of the folds is held out
    extra: Path | None = None  # folder of more heads, only to train on
    unlabelled: Path | None = None  # folder of heads whose weights are not read
    start: str | None = None  # name or folder of a network to begin with
    config: TrainConfig = field(default_factory=TrainConfig)  # every setting


def main(run: Run) -> None:
    """Split, train, judge, write."""
    heads = load_folder(run.heads)
    labelled, held_out = (
        (heads, []) if run.fold == "none" else fold(heads, int(run.fold))
    )
    # A remeshed copy is called NAME__HOW; a copy of a held-out head is held out too.
    known, hidden = ({head.name for head in some} for some in (heads, held_out))
    extra = load_folder(run.extra) if run.extra else []
    extra = [head for head in extra if head.name not in known]
    extra = [head for head in extra if head.name.split("__")[0] not in hidden]
    bare = load_folder(run.unlabelled) if run.unlabelled else []
    bare = [head.replace(weights=None) for head in apart(bare, held_out)]
    # No held-out head chooses the step that is kept: it is the last one.
    model = train(
        run.config,
        labelled + extra,
        run.out / "model",
        unlabelled=bare,
        validation=[],
        start=load_model(run.start) if run.start else None,
    )
    if not held_out:
        return
    result = evaluate(held_out, train_heads=labelled, model=model)
    result["held_out"] = [head.name for head in held_out]
    (run.out / "scores.json").write_text(json.dumps(result, indent=1))
    print(format_table(result))


if __name__ == "__main__":
    main(tyro.cli(Run))
