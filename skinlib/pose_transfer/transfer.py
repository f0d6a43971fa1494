"""Use and judge a trained network: one mesh in the pose of another."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import nn
from tqdm.auto import tqdm

from skinlib.garments.garment import MESH_FILES, Z_UP
from skinlib.geometry import mesh_edges
from skinlib.head import Head, HeadError
from skinlib.io import atomic
from skinlib.pose_transfer.data import (
    PosePairs,
    normalised,
    size_by_edges,
    vertex_shares,
)
from skinlib.pose_transfer.metrics import Scores, mean_scores, score
from skinlib.pose_transfer.refine import REACH, as_rigid_as_possible

SAME = 1e-5
"""Two meshes are one when each point of either lies closer than this, in the cube from
-1 to 1, to a point of the other."""


@torch.inference_mode()
def transfer_pose(
    network: nn.Module,
    source: Head | trimesh.Trimesh,
    target: Head | trimesh.Trimesh,
    reach: float = REACH,
) -> np.ndarray:
    """(N, 3) float32: the target in the pose of the source, in its own size and order.

    A network sees both meshes in the cube from -1 to 1. Its result is scaled so that
    edges are as long as they were, and put where the target stood: on the same floor,
    in the middle of the same box; its shape is that of the target as far as the pose
    allows. A mesh in its own pose stays as it is.

    Args:
        source: M vertices, upright and facing as in training: Z up, facing -Y.
        target: N vertices, so, too; skeletons are not looked at.
        reach: of `as_rigid_as_possible`; 0 for what the network gives.

    Raises:
        HeadError: fewer than two vertices, NaN, all points at one place, no edge with a
            length, or more vertices than the network can take.
    """
    boxed = _boxed("source", source.vertices), _boxed("target", target.vertices)
    rest = np.asarray(target.vertices)
    if _same(*boxed):
        return rest.astype(np.float32)
    device = next(network.parameters()).device
    points = [torch.tensor(p[None], dtype=torch.float32, device=device) for p in boxed]
    faces = [torch.tensor(np.asarray(m.faces), device=device) for m in (source, target)]
    shares = map(vertex_shares, points, faces)
    posed = network(*points, *shares)[0].cpu().numpy()
    edges = mesh_edges(np.asarray(target.faces))
    posed = posed * size_by_edges(posed, rest, edges)
    posed = as_rigid_as_possible(posed, rest, edges, reach)
    low, high = posed.min(0), posed.max(0)
    floor, top = rest.min(0), rest.max(0)
    place = (floor + top) / 2 - (low + high) / 2
    place[2] = floor[2] - low[2]
    return (posed + place).astype(np.float32)


def _boxed(name: str, points: np.ndarray) -> np.ndarray:
    try:
        return normalised(np.asarray(points, np.float64))[0]
    except HeadError as error:
        raise HeadError(name, error.found, error.fix) from error


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    if len(a) != len(b):
        return False
    there, back = cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]
    return bool(max(there.max(), back.max()) < SAME)


# --- files ----------------------------------------------------------------------------


def read_mesh(path: str | Path) -> trimesh.Trimesh:
    """All triangles of a mesh file as one mesh, Z up, vertices in the file's order.

    glTF is Y up by its standard and is turned; the other formats are taken as they are.

    Raises:
        HeadError: it cannot be read, or holds no triangle, or NaN.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_FILES:
        raise HeadError(
            "file",
            f"the name ends in {path.suffix!r}",
            f"use one of {', '.join(MESH_FILES)}",
            path,
        )
    if not path.is_file():
        raise HeadError(
            "file", "there is no such file", "check the name and the folder", path
        )
    try:
        scene = trimesh.load_scene(path, process=False, maintain_order=True)
        mesh = scene.to_mesh()
    except Exception as error:  # whatever a library raises on a malformed file
        raise HeadError(
            "file",
            f"it cannot be read ({type(error).__name__}: {str(error)[:200]})",
            "export it again",
            path,
        ) from error
    if not len(mesh.faces):
        raise HeadError("faces", "there are none", "export the mesh's triangles", path)
    if not np.isfinite(mesh.vertices).all():
        raise HeadError(
            "vertices",
            "some are NaN or infinite",
            "export the mesh again with finite values",
            path,
        )
    if _is_gltf(path):
        mesh.vertices = mesh.vertices @ Z_UP.T
    return mesh


def write_mesh(path: str | Path, mesh: trimesh.Trimesh) -> None:
    """Write a mesh, with its texture coordinates, whole or not at all."""
    path = Path(path)
    check_mesh_target(path)
    mesh = mesh.copy()
    if _is_gltf(path):
        mesh.vertices = mesh.vertices @ Z_UP
    content = mesh.export(file_type=path.suffix.lower()[1:])
    with atomic(path) as file:
        file.write(content if isinstance(content, bytes) else content.encode())


def check_mesh_target(path: str | Path) -> None:
    """Refuse a file that could not be written, before the work is done."""
    path = Path(path)
    if path.suffix.lower() not in (".glb", ".obj", ".ply", ".stl"):
        raise HeadError(
            "OUT",
            f"the name ends in {path.suffix!r}",
            "use one of .glb, .obj, .ply, .stl",
            path,
        )
    if not path.absolute().parent.is_dir():
        raise HeadError("OUT", "there is no such folder", "make it first", path)


def _is_gltf(path: Path) -> bool:
    return path.suffix.lower() in (".glb", ".gltf")


def transfer_file(
    network: nn.Module,
    source: str | Path,
    target: str | Path,
    out: str | Path,
    reach: float = REACH,
) -> None:
    """Write the mesh of `target` in the pose of `source`; `reach`: `transfer_pose`.

    Raises:
        HeadError: as `read_mesh` and `transfer_pose`; the message names the file.
    """
    check_mesh_target(out)
    poser, mesh = read_mesh(source), read_mesh(target)
    try:
        mesh.vertices = transfer_pose(network, poser, mesh, reach)
    except HeadError as error:
        file = source if error.field == "source" else target
        raise HeadError(error.field, error.found, error.fix, file) from error
    write_mesh(out, mesh)


# --- how good it is -------------------------------------------------------------------


@torch.inference_mode()
def judge(
    network: nn.Module | None, kinds: Iterable[PosePairs], batch: int = 8
) -> Scores:
    """The mean scores over all pairs; of copying the identity without a network.

    Args:
        kinds: from one mesh to another each, see `skinlib.pose_transfer.population`.
    """
    scores = []
    for pairs in kinds:
        items = range(len(pairs))
        steps = range(0, len(pairs), batch)
        for first in tqdm(steps, "judged", unit="batch", delay=2, leave=False):
            some = pairs.batch(items[first : first + batch])
            posed = some.identity
            if network is not None:
                posed = network(*some.inputs)
            rows = (posed, some.truth, some.edges)
            rows = (part.cpu().numpy() for part in rows)
            for one in zip(*rows, some.height.tolist(), strict=True):
                scores.append(score(*one))
    return mean_scores(scores)
