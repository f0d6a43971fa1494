"""How many skinned heads does it take? From nothing, and from a network of others.

    python benchmarks/learning_curve.py HEADS OUT --others OTHERS

A network learns on OTHERS first: heads with another rig, such as the anny heads of
scripts/make_training_heads.py. The shipped network will not do as a start here, since
it has learnt from HEADS. Then 1, 2, 5, ... heads of a fold are learnt from, from
nothing and from that network, as `skinlib train` does without and with `--start`, and
judged on the held-out heads of the fold. Minutes are of processor time on one thread;
seed s has fold s. What is in OUT already is not run again.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tyro
from tqdm import tqdm
from tyro.conf import Positional

from skinlib.datasets.folder import load_folder
from skinlib.evaluate.groups import fold
from skinlib.evaluate.metrics import row_l1
from skinlib.headbench.networks import ByProcessorTime
from skinlib.training import TrainConfig, load_model

SIZES = (1, 2, 5, 10, 20, 56)


@dataclass(frozen=True)
class Run:
    """How many skinned heads does it take?"""

    heads: Positional[Path]  # folder of skinned heads
    out: Positional[Path]  # folder for the runs and results.json
    others: Path  # folder of skinned heads with another rig, to begin with
    first_minutes: float = 12.0  # on OTHERS
    minutes: float = 1.5  # on HEADS
    seeds: tuple[int, ...] = (0, 1)
    sizes: tuple[int, ...] = SIZES  # the last one: as many as the fold has


def main(run: Run) -> None:
    """Run what is missing, then write and print what is there."""
    heads, others = load_folder(run.heads), load_folder(run.others)
    own = {head.name for head in heads}
    others = [head for head in others if head.name.split("__")[0] not in own]
    first = TrainConfig(minutes=run.first_minutes, threads=1)
    trainer = ByProcessorTime(first, others, run.out / "others", validation=[])
    start = load_model(run.out / "others") if trainer.finished else trainer.run()

    results = {"from nothing": {}, "from the other rig": {}}
    runs = [(n, s, kind) for n in run.sizes for s in run.seeds for kind in results]
    for size, seed, kind in tqdm(runs, unit="run"):
        training, held_out = fold(heads, seed)
        order = np.random.default_rng(seed).permutation(len(training))
        some = [training[i] for i in order[:size]]
        folder = run.out / f"{kind.replace(' ', '-')}_{len(some)}_seed-{seed}"
        config = TrainConfig(minutes=run.minutes, seed=seed, threads=1)
        model = start if kind == "from the other rig" else None
        if not (folder / "scores.json").exists():
            trained = ByProcessorTime(
                config, some, folder, validation=[], start=model
            ).run()
            folder.joinpath("scores.json").write_text(
                json.dumps(errors(trained, held_out), indent=1)
            )
        scores = json.loads((folder / "scores.json").read_text())
        results[kind].setdefault(str(size), []).append(
            round(float(np.mean([*scores.values()])), 4)
        )
    untrained = [errors(start, fold(heads, seed)[1]) for seed in run.seeds]
    results["from the other rig"]["0"] = [
        round(float(np.mean([*scores.values()])), 4) for scores in untrained
    ]
    (run.out / "results.json").write_text(json.dumps(results, indent=1) + "\n")
    print(json.dumps(results, indent=1))


def errors(model, heads) -> dict[str, float]:
    """Mean row-L1 of each head."""
    return {h.name: float(row_l1(model.predict(h), h.weights).mean()) for h in heads}


if __name__ == "__main__":
    main(tyro.cli(Run))
