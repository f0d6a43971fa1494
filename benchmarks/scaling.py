"""Time and memory of `SkinningModel.predict` over the number of vertices.

    python benchmarks/scaling.py [VERTICES ...]

Prints, for each size, the vertices, seconds (the faster of two runs; the first also
warms up), CPU time a vertex (which a busy machine changes less), and the megabytes by
which the process grew beyond the loaded packages, the head and the model. The head is
a bumpy sphere with 60 random bones, the model the default one, untrained: its numbers
cost the same. Every size runs in a process of its own, so that its peak is its own.
"""

import json
import resource
import subprocess
import sys
import time

import numpy as np
import torch
import trimesh

from skinlib import Head, Skeleton
from skinlib.model import SkinningModel

BONES, THREADS = 60, 2
SIZES = (1_000, 4_000, 16_000, 64_000, 256_000, 1_000_000)


def sphere_head(size: int) -> Head:
    """A bumpy sphere of about `size` vertices around a random tree of bones."""
    rng = np.random.default_rng(0)
    # A grid of latitude and longitude, so that any size can be had.
    rows = max(4, round((size / 4) ** 0.5))  # rows x 4 rows, about
    ball = trimesh.creation.uv_sphere(count=[rows, 2 * rows])
    vertices = ball.vertices * (1 + 0.1 * np.sin(5 * ball.vertices[:, [1, 2, 0]]))
    joints = rng.normal(0, 0.4, (BONES, 3))
    parents = [-1] + [int(rng.integers(bone)) for bone in range(1, BONES)]
    names = [f"bone_{bone}" for bone in range(BONES)]
    skeleton = Skeleton.from_heads_and_tails(joints, None, parents, names)
    return Head.create(vertices, ball.faces, skeleton)


def peak_megabytes() -> float:
    """The most memory this process has held so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


def measure(size: int) -> dict:
    """One row of the table, measured in this process."""
    torch.set_num_threads(THREADS)
    torch.manual_seed(0)
    model, head = SkinningModel().eval(), sphere_head(size)
    before = peak_megabytes()
    seconds, cpu = [], []
    for _ in range(2):
        began, cpu_began = time.perf_counter(), time.process_time()
        weights = model.predict(head)
        seconds.append(time.perf_counter() - began)
        cpu.append(time.process_time() - cpu_began)
    assert np.isfinite(weights).all()
    count = len(head.vertices)
    return {
        "vertices": count,
        "seconds": round(min(seconds), 3),
        "cpu_microseconds_a_vertex": round(1e6 * min(cpu) / count, 1),
        "peak_mb": round(peak_megabytes() - before),
        "kilobytes_a_vertex": round((peak_megabytes() - before) * 1024 / count, 1),
    }


def main() -> None:
    """Measure every size and print the table as JSON."""
    if sys.argv[1:2] == ["--one"]:
        print(json.dumps(measure(int(sys.argv[2]))))
        return
    rows = []
    for size in [int(word) for word in sys.argv[1:]] or SIZES:
        command = [sys.executable, __file__, "--one", str(size)]
        rows.append(json.loads(subprocess.check_output(command, text=True)))
        print(rows[-1], file=sys.stderr, flush=True)
    print(json.dumps({"bones": BONES, "threads": THREADS, "rows": rows}, indent=1))


if __name__ == "__main__":
    main()
