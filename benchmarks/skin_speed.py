"""Seconds to skin the sample head, beside the classical methods in the same process.

    python benchmarks/skin_speed.py

`data_samples/adult.glb` has 4,864 vertices and 64 bones. The first row reads the file,
predicts and writes a skinned .glb, with the checkpoint loaded; the others compute
weights of a head in memory. Median of 9 after one warm-up, on two threads.
"""

import json
import statistics
import tempfile
import time
from pathlib import Path

import torch

from skinlib.evaluate import baselines
from skinlib.io import read_head, write_head
from skinlib.paths import DEFAULT_CHECKPOINT, sample
from skinlib.training import load_model

ROUNDS = 9


def median_seconds(function) -> float:
    """Median wall-clock seconds of a call, after one that does not count."""
    function()
    seconds = []
    for _ in range(ROUNDS):
        began = time.perf_counter()
        function()
        seconds.append(time.perf_counter() - began)
    return round(statistics.median(seconds), 4)


def main() -> None:
    """Print the table as JSON."""
    torch.set_num_threads(2)
    model = load_model(DEFAULT_CHECKPOINT)
    source = sample("adult.glb")
    head = read_head(source)
    templates = [read_head(sample(f"{name}.npz")) for name in ("child", "elder")]

    with tempfile.TemporaryDirectory() as folder:
        target = Path(folder) / "skinned.glb"

        def skin_file():
            read = read_head(source)
            write_head(target, read.replace(weights=model.predict(read)), source=source)

        rows = {
            "skinlib, file to file": skin_file,
            "skinlib": lambda: model.predict(head),
            "bone_heat": lambda: baselines.bone_heat(head),
            "template_copy": lambda: baselines.template_copy(head, templates[0]),
            "warped_template_copy": lambda: baselines.warped_template_copy(
                head, templates[0]
            ),
            "similar_template_copy, of 2": lambda: baselines.similar_template_copy(
                head, templates
            ),
            "robust_transfer": lambda: baselines.robust_transfer(head, templates[0]),
        }
        print(
            json.dumps({name: median_seconds(f) for name, f in rows.items()}, indent=1)
        )


if __name__ == "__main__":
    main()
