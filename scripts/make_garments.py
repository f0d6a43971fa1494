"""Make the body and the garments in data_samples/ again, byte for byte.

    python scripts/make_garments.py

Needs `anny`. Versions of numpy, torch, libigl and zlib other than those in
constraints.txt may move the last bits of a number, and with them a checksum.
"""

from pathlib import Path

import tyro
from make_samples import write_sums

from skinlib.garments.body import anny_body, read_body, write_body
from skinlib.garments.garment import write_garment
from skinlib.garments.patterns import PATTERNS


def make_garments(out: Path = Path(__file__).parents[1] / "data_samples") -> None:
    """Write the body, its garments and their SHA256SUMS into the folder `out`."""
    write_body(out / "body.npz", anny_body())
    body = read_body(out / "body.npz").head
    for name, draft in PATTERNS.items():
        write_garment(out / f"{name}.npz", draft(body))
    write_sums(out)


if __name__ == "__main__":
    tyro.cli(make_garments)
