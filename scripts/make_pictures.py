"""Make the README's pictures: the demo's, and one small picture a notebook.

    make demo && make refresh && python scripts/make_pictures.py

Writes docs/demo.png and docs/thumbnails/NN.png. A notebook's thumbnail is the most
detailed picture in it, the one that takes the most bytes.
"""

import base64
import io
import shutil
from pathlib import Path

import nbformat
from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
WIDTH = 240


def pictures(notebook: Path) -> list[bytes]:
    """All pictures that a notebook's cells have put out."""
    found = []
    for cell in nbformat.read(notebook, as_version=4).cells:
        for output in cell.get("outputs", []):
            for kind, data in output.get("data", {}).items():
                if kind.startswith("image/"):
                    found.append(base64.b64decode(data))
    return found


def main() -> None:
    """Write all of them."""
    thumbnails = ROOT / "docs" / "thumbnails"
    thumbnails.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(ROOT / "demo" / "demo.png", ROOT / "docs" / "demo.png")
    for notebook in sorted((ROOT / "notebooks").glob("[0-9][0-9]_*.ipynb")):
        picture = Image.open(io.BytesIO(max(pictures(notebook), key=len)))
        picture.thumbnail((WIDTH, WIDTH))
        picture.convert("RGB").save(thumbnails / f"{notebook.name[:2]}.png")


if __name__ == "__main__":
    main()
