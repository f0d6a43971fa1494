"""The pictures of pose transfer's benchmark.

    python benchmarks/pose_pictures.py runs/pose

Reads what benchmarks/pose_transfer.py trained there; writes docs/poses/NAME.png.
"""

import json
from pathlib import Path

import numpy as np
import torch
import tyro
from PIL import Image
from pose_transfer import NOISE, QUICK, other_meshes, quick_mesh
from torch import nn

from skinlib.garments.body import read_body
from skinlib.garments.garment import read_garment
from skinlib.garments.outfit import Outfit
from skinlib.geometry import mesh_edges
from skinlib.head import Head
from skinlib.paths import sample
from skinlib.pose_transfer.data import Cast, Pairs, PosePairs, normalised, size_by_edges
from skinlib.pose_transfer.refine import as_rigid_as_possible
from skinlib.pose_transfer.training import load_network
from skinlib.pose_transfer.transfer import transfer_pose
from skinlib.views import garments
from skinlib.views.picture import (
    ColourBar,
    Picture,
    new_figure,
    picture_grid,
    rasterise,
)
from skinlib.views.poses import FAR, GIVEN, draw, in_mesh_order

FOLDER = Path(__file__).resolve().parents[1] / "docs" / "poses"
NAMES = {"npt": "NPT", "corenet": "3D-CoreNet", "dsffnet": "DSFFNet"}
SHOWN = (0, 4, 10, 12, 16)  # pairs in poses that nobody has learnt
UNSEEN = range(400, 800)


def main(runs: tyro.conf.Positional[Path]) -> None:
    """Draw who takes whose pose, other meshes, noise, and how training went."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    networks = {label: load_network(runs / "long" / n)[0] for n, label in NAMES.items()}
    (cast,) = QUICK.casts("judge")
    pairs = PosePairs(cast, cast, 20, 3, poses=UNSEEN).batch(SHOWN)
    keep("transfer", transfers(networks, pairs))
    keep("meshes", meshes(networks["DSFFNet"], cast))
    keep("noise", noise(networks["DSFFNet"], cast))
    keep("dressed", dressed(cast))
    keep("curves", curves(runs))


def keep(name: str, picture: Picture) -> None:
    """Write it in few colours: a page shows it, nobody measures it."""
    image = Image.fromarray(picture.image).quantize(128)
    image.save(FOLDER / f"{name}.png", optimize=True)


@torch.inference_mode()
def transfers(networks: dict[str, nn.Module], pairs: Pairs) -> Picture:
    """A row for each pair: source, identity, every way painted by its error, truth."""
    mesh = quick_mesh()
    made = {name: net(*pairs.inputs) for name, net in networks.items()}
    made = {name: in_mesh_order(points, pairs.order) for name, points in made.items()}
    source = in_mesh_order(pairs.source, pairs.source_order)
    identity, truth = (
        in_mesh_order(points, pairs.order) for points in (pairs.identity, pairs.truth)
    )
    made["DSFFNet, kept in shape"] = np.stack(
        [stiff(*both, mesh) for both in zip(made["DSFFNet"], identity, strict=True)]
    )
    images = []
    for i, height in enumerate(pairs.height.tolist()):
        images += [
            draw(mesh, points[i], colours=GIVEN) for points in (source, identity)
        ]
        for points in made.values():
            off = 100 * np.linalg.norm(points[i] - truth[i], axis=-1) / height
            images.append(draw(mesh, points[i], off))
        images.append(draw(mesh, truth[i], colours=GIVEN))
    return picture_grid(
        images,
        ["source", "identity", *made, "truth"] + [""] * (len(images) - len(made) - 3),
        columns=len(made) + 3,
        colour_bar=ColourBar("off, % of height", 0, FAR),
    )


def stiff(points: np.ndarray, identity: np.ndarray, mesh: Head) -> np.ndarray:
    """What a user gets, in the box again."""
    edges = mesh_edges(mesh.faces)
    points = points * size_by_edges(points, identity, edges)
    return normalised(as_rigid_as_possible(points, identity, edges))[0]


@torch.inference_mode()
def meshes(network: nn.Module, native: Cast) -> Picture:
    """One pair, the identity on other meshes."""
    images, titles = [], []
    for label, (cast, mesh) in other_meshes().items():
        pairs = PosePairs(native, cast, 20, 3, poses=UNSEEN).batch([SHOWN[1]])
        posed = in_mesh_order(network(*pairs.inputs), pairs.order)[0]
        truth = in_mesh_order(pairs.truth, pairs.order)[0]
        off = 100 * np.linalg.norm(posed - truth, axis=-1) / pairs.height.item()
        images.append(draw(mesh, posed, off))
        titles.append(label)
    bar = ColourBar("off, % of height", 0, FAR)
    return picture_grid(images, titles, columns=len(images), colour_bar=bar)


@torch.inference_mode()
def noise(network: nn.Module, cast: Cast) -> Picture:
    """Above the source with more and more noise, below what comes of it."""
    mesh, rows = quick_mesh(), [[], []]
    for amount in (0.0, *NOISE):
        pairs = PosePairs(cast, cast, 20, 3, poses=UNSEEN, noise=amount)
        some = pairs.batch([SHOWN[1]])
        posed = network(*some.inputs)
        source = in_mesh_order(some.source, some.source_order)[0]
        rows[0].append(draw(mesh, source, colours=GIVEN))
        rows[1].append(draw(mesh, in_mesh_order(posed, some.order)[0]))
    titles = [f"{amount:.0%}" for amount in (0.0, *NOISE)] + [""] * (1 + len(NOISE))
    return picture_grid(
        rows[0] + rows[1],
        titles,
        columns=1 + len(NOISE),
        row_titles=["source", "result"],
    )


def dressed(cast: Cast) -> Picture:
    """The shipped body in a T-shirt, one mesh without a rig, by the shipped network."""
    network, _ = load_network("poses")
    pairs = PosePairs(cast, cast, 20, 3, poses=UNSEEN).batch(SHOWN)
    sources = in_mesh_order(pairs.source, pairs.source_order)
    outfit = Outfit.create(read_body(), [read_garment(sample("t_shirt.npz"))])
    target = garments.dressed(outfit)
    colours = np.tile(garments.SKIN, (len(target.vertices), 1))
    colours[len(outfit.body.head.vertices) :] = garments.CLOTHS[0]
    mesh, size = quick_mesh(), (200, 224)
    images = [draw(mesh, s, colours=GIVEN, size=size) for s in sources]
    for source in sources:
        posed = transfer_pose(network, mesh.replace(vertices=source), target)
        images.append(draw(target, normalised(posed)[0], colours=colours, size=size))
    rows = ["source", "target, moved"]
    return picture_grid(images, columns=len(sources), row_titles=rows)


def curves(runs: Path) -> Picture:
    """The training error over the steps, for all three and for both starts of alpha."""
    with new_figure(7.5, 3) as figure:
        left, right = figure.subplots(1, 2, sharey=True)
        for name, label in NAMES.items():
            left.plot(*history(runs / "long" / name), label=label)
        for start in ("0.5", "0"):
            for seed in range(3):
                steps, values = history(runs / "start" / f"{start}_{seed}")
                look = {"color": "C3" if start == "0" else "C0"}
                label = rf"$\alpha, \beta$ from {start}" if not seed else None
                right.plot(steps, values, label=label, **look)
        for axes, title in ((left, "4,000 steps"), (right, "DSFFNet, 400 steps")):
            axes.set(xlabel="step", yscale="log", title=title)
            axes.legend()
        left.set_ylabel("training PMD, 1e-4")
        return rasterise(figure, "training error")


def history(run: Path) -> tuple[list[int], list[float]]:
    """Steps and errors."""
    entries = json.loads((run / "history.json").read_text())
    return [e["step"] for e in entries], [e["PMD e-4"] for e in entries]


if __name__ == "__main__":
    tyro.cli(main)
