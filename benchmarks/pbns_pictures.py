"""The pictures of the benchmark of PBNS: rest, extreme poses, collisions painted.

    python benchmarks/pbns_pictures.py runs/pbns

Reads what benchmarks/pbns.py trained in that folder; writes docs/garments/NAME.png.
"""

from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from skinlib.garments.measures import skinned
from skinlib.garments.motion import Motion, random_poses
from skinlib.garments.outfit import load_outfit
from skinlib.views.garments import UPPER, WHOLE, colour_bar, painted
from skinlib.views.picture import picture_grid

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "garments"
VIEWS = {"t_shirt": UPPER, "skirt": WHOLE, "layers": UPPER}
SEED, GAP = 1_000_000, 0.02


def main(runs: tyro.conf.Positional[Path]) -> None:
    """Draw the T-shirt, the skirt and the two layers."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name, view in VIEWS.items():
        outfit, network = load_outfit(runs / name)
        skeleton = outfit.body.head.skeleton
        drawn = random_poses(skeleton, 8, SEED, outfit.body.head, GAP).rotations
        # The rest pose, then the wide ones: every second.
        poses = np.concatenate([np.zeros_like(drawn[:1]), drawn[::2]])
        motion = Motion.create(poses, skeleton.names)
        methods = {
            "skinning alone": skinned(outfit, motion),
            "PBNS": outfit.pose(network, motion),
        }
        images, titles = [], []
        for method, posed in methods.items():
            for frame in range(len(motion)):
                images.append(painted(outfit, motion, posed, "depth", frame, view=view))
                titles.append(method if frame else f"{method}, at rest")
        picture = picture_grid(
            images, titles, columns=len(motion), colour_bar=colour_bar("depth")
        )
        Image.fromarray(picture.image).save(FOLDER / f"{name}.png", optimize=True)


if __name__ == "__main__":
    tyro.cli(main)
