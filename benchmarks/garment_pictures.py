"""The pictures of the garments' benchmarks: extreme poses, errors painted.

    python benchmarks/garment_pictures.py runs/pbns runs/virtual_bones

Reads what benchmarks/pbns.py and benchmarks/virtual_bones.py trained in these folders;
writes docs/garments/NAME.png.
"""

from pathlib import Path

import numpy as np
import tyro
from PIL import Image

from skinlib.garments.loose import load_loose, read_simulations
from skinlib.garments.measures import skinned
from skinlib.garments.motion import Motion, random_poses
from skinlib.garments.outfit import load_outfit
from skinlib.views.garments import UPPER, WHOLE, colour_bar, painted
from skinlib.views.loose import hung, strip
from skinlib.views.picture import picture_grid

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "garments"
VIEWS = {"t_shirt": UPPER, "skirt": WHOLE, "layers": UPPER}
SEED, GAP = 1_000_000, 0.02


def main(
    runs: tyro.conf.Positional[Path], loose_runs: tyro.conf.Positional[Path]
) -> None:
    """Draw the T-shirt, the skirt and the two layers, and the skirt that swings."""
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
    swinging(loose_runs)


def swinging(runs: Path) -> None:
    """An unseen walk: the simulation, three ways without learning, and ours."""
    garment = load_loose(runs / "runs" / "hybrid")
    seen = read_simulations(runs / "simulated" / "unseen")[1]
    shown = {"simulation": seen.posed}
    shown |= garment.baselines(seen.motion)
    shown |= {"virtual bones": garment.pose(seen.motion)}
    del shown["skinning, smooth"], shown["rigid"]
    frames = np.linspace(15, len(seen.motion) - 1, 8).astype(int).tolist()
    picture = strip(hung(garment), seen.motion, shown, frames, paint="error")
    Image.fromarray(picture.image).quantize(256).save(FOLDER / "virtual_bones.png")


if __name__ == "__main__":
    tyro.cli(main)
