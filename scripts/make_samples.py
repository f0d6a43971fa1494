"""Make the heads in data_samples/ again, byte for byte.

    python scripts/make_samples.py

Needs `anny`. Versions of numpy, torch and zlib other than those in constraints.txt may
move the last bits of a number, and with them a checksum.
"""

import hashlib
from dataclasses import replace
from pathlib import Path

import numpy as np
import tyro

from skinlib.datasets.anny import AnnyConfig, anny_heads
from skinlib.datasets.remesh import isotropic
from skinlib.head import Head, Skeleton
from skinlib.io import write_head

ADULT = AnnyConfig(
    age=(0.6, 0.75), expression_share=0, shape_share=0.3, shape_spread=0.2, bust=True
)
CHILD = replace(ADULT, age=(0.3, 0.4), shape_spread=0.25)
ELDER = replace(ADULT, age=(0.85, 1.0), expression_share=1, shape_spread=0.3)


def make_samples(out: Path = Path(__file__).parents[1] / "data_samples") -> None:
    """Write the sample heads and their SHA256SUMS into the folder `out`."""
    adult = _draw(20017, ADULT)
    remeshed = isotropic(_draw(20005, ADULT), 0)
    heads = {
        "adult.npz": adult,
        "adult.glb": _y_up(adult),
        "child.npz": _draw(20204, CHILD),
        "elder.npz": _draw(20101, ELDER),
        "remeshed.npz": remeshed,
        "unskinned.glb": _y_up(_draw(20022, ADULT)).replace(weights=None),
    }
    for name, head in heads.items():
        write_head(out / name, head.replace(name=Path(name).stem))
    write_sums(out)


def write_sums(out: Path) -> None:
    """List all samples in the folder `out`, heads and garments, in its SHA256SUMS."""
    samples = sorted([*out.glob("*.npz"), *out.glob("*.glb")])
    sums = [hashlib.sha256(path.read_bytes()).hexdigest() for path in samples]
    lines = [f"{sum}  {path.name}\n" for sum, path in zip(sums, samples, strict=True)]
    (out / "SHA256SUMS").write_text("".join(lines))


def _draw(seed: int, config: AnnyConfig) -> Head:
    (head,) = anny_heads(1, seed, config)
    return head


def _y_up(head: Head) -> Head:
    """Anny is Z up and faces -Y; glTF is Y up and faces +Z."""
    turn = np.float32([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    skeleton = Skeleton.from_heads_and_tails(
        head.skeleton.joints @ turn.T,
        head.skeleton.tails @ turn.T,
        head.skeleton.parents,
        head.skeleton.names,
    )
    return head.replace(
        vertices=head.vertices @ turn.T,
        normals=head.normals @ turn.T,
        skeleton=skeleton,
    )


if __name__ == "__main__":
    tyro.cli(make_samples)
