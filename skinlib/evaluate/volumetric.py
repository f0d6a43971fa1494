"""Weights from the volume of a head, and from Blender: what artists' tools offer.

Functions from a head to (V, J) float32 skin weights, rows >= 0 with sum 1. All take
meshes that are open, that intersect themselves and that come in pieces.
"""

from itertools import permutations, product
from pathlib import Path
from tempfile import TemporaryDirectory

import igl
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from skinlib.blender.run import run_script
from skinlib.evaluate.baselines import _rows, nearest_bone
from skinlib.graph import seam_nodes
from skinlib.head import Head, HeadError, Skeleton
from skinlib.voxels import Solid, solid_voxels, voxel_bone_distances

# Runs inside Blender.
SCRIPT = Path(__file__).with_name("automatic_weights.py")
# The corners of a cube's six tetrahedra: one for each order of going along x, y and z
# from corner (0, 0, 0) to (1, 1, 1). The faces of neighbouring cubes fit together.
TETRAHEDRA = np.array(
    [np.tri(4, 3, -1, dtype=np.int64)[:, order] for order in permutations(range(3))]
)
LEFT_HANDED = np.linalg.det(TETRAHEDRA[:, 1:]) < 0
TETRAHEDRA[LEFT_HANDED] = TETRAHEDRA[LEFT_HANDED][:, [1, 0, 2, 3]]
# Tail of a bone that has none, relative to the head's size: Blender wants one.
TAIL = 0.02


def voxel_geodesic(
    head: Head, resolution: int = 64, falloff: float = 0.2
) -> np.ndarray:
    """Geodesic voxel binding (Dionne and de Lasa 2013), which Maya offers.

    w_vj ~ ((1 - a) d + a d^2)^-2 with a = `falloff` and d the distance from vertex v to
    bone j through the solid, as a share of the longest side of the bounding box. See
    `skinlib.voxels.voxel_bone_distances`. Equation `voxel_geodesic`.

    Args:
        resolution: voxels along that side.
        falloff: 0 to 1, how much faster the weight of far bones falls.

    Raises:
        HeadError: `falloff` outside 0 to 1, or `resolution` less than 1.
    """
    if not 0 <= falloff <= 1:
        raise HeadError("falloff", str(falloff), "use a number from 0 to 1")
    distance = voxel_bone_distances(head, resolution)
    distance /= float(np.ptp(head.vertices, axis=0).max()) or 1.0
    cost = (1 - falloff) * distance + falloff * distance**2
    # Relative to the nearest bone, so that a vertex on a bone is all that bone's.
    nearest = np.maximum(cost.min(axis=1, keepdims=True), 1e-12)
    return _rows((nearest / np.maximum(cost, nearest)) ** 2)


def bounded_biharmonic(head: Head, resolution: int = 20) -> np.ndarray:
    """Bounded biharmonic weights (Jacobson et al. 2011), solved by libigl.

    Each bone's weight minimises the Laplacian energy of the volume between 0 and 1,
    with 1 on the bone and 0 on the others; rows are then divided by their sum. The
    paper wants tetrahedra inside a closed surface, which a head seldom has: here each
    voxel of `skinlib.voxels.solid_voxels` is cut into six (Kuhn 1960). Bones that pass
    a corner of a voxel share it; a bone outside of the solid takes the nearest corner;
    a piece of the solid without a bone follows the nearest one that has some.

    Args:
        resolution: voxels along the longest side of the bounding box. The time grows
            steeply with it: 0.03 s a bone at 12, 0.4 s at 20, on one core.

    Raises:
        HeadError: libigl finds no solution, or `resolution` is less than 1.
    """
    solid = solid_voxels(head, resolution)
    corners, tetrahedra = _tetrahedra(solid.filled)
    fixed, values = _constraints(head.skeleton, solid, corners)
    bound = _in_pieces_with(fixed, tetrahedra, len(corners))
    place = np.cumsum(bound) - 1
    try:
        solved = igl.bbw(
            corners[bound].astype(np.float64),
            place[tetrahedra[bound[tetrahedra[:, 0]]]],
            place[fixed],
            values,
            max_iter=8,  # the active set has settled long before
        )
    except (RuntimeError, ValueError) as error:
        raise HeadError(
            "vertices",
            f"libigl finds no bounded biharmonic weights ({error})",
            "try another resolution",
        ) from error
    _, nearest = cKDTree(corners[bound]).query(corners)
    weights = np.clip(solved, 0, 1)[nearest]
    return _rows(_interpolated(weights, corners, solid.to_grid(head.vertices)))


def blender_automatic(
    head: Head, blender: str | None = None, timeout: float = 600
) -> np.ndarray:
    """Blender's "Armature Deform With Automatic Weights", run in Blender itself.

    Vertices that Blender leaves without weight follow their nearest bone; how many they
    are, `blender_weights` tells.

    Args, Raises: as `blender_weights`.
    """
    weights = blender_weights(head, blender, timeout)
    empty = weights.sum(axis=1) <= 0
    weights[empty] = nearest_bone(head)[empty]
    return _rows(weights)


def blender_weights(
    head: Head, blender: str | None = None, timeout: float = 600
) -> np.ndarray:
    """(V, J) what Blender's automatic weights find: 0 in the rows where they fail.

    They are a heat equilibrium (`skinlib.evaluate.baselines.bone_heat`). One triangle
    without area is enough to leave a whole head without weights. Seams are closed
    before, the head has the size of Blender's first cube, and a bone without a tail
    gets one that is 2 % of the head's size long, along its parent.

    Args:
        blender: a `blender` program or a Python with `bpy`; else what the variable
            SKINLIB_BLENDER names, or the `blender` on the PATH.
        timeout: seconds that Blender may take.

    Raises:
        HeadError: there is no Blender, it crashed, or it took too long.
    """
    node = seam_nodes(head)
    _, first = np.unique(node, return_index=True)
    low, high = head.vertices.min(axis=0), head.vertices.max(axis=0)
    centre, scale = (low + high) / 2, 2 / (float((high - low).max()) or 1.0)
    bones, tails = head.skeleton, _visible_tails(head)
    with TemporaryDirectory(prefix="skinlib-") as folder:
        given, found = Path(folder, "head.npz"), Path(folder, "weights.npz")
        np.savez(
            given,
            vertices=(head.vertices[first] - centre) * scale,
            faces=node[head.faces],
            heads=(bones.joints - centre) * scale,
            tails=(tails - centre) * scale,
            parents=bones.parents,
        )
        run_script(SCRIPT, given, found, blender=blender, timeout=timeout)
        try:
            with np.load(found, allow_pickle=False) as answer:
                return answer["weights"].astype(np.float32)[node]
        except OSError as error:
            raise HeadError(
                "Blender", "it ended without an answer", "try another version of it"
            ) from error


def _tetrahedra(filled) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) corners of the solid voxels, (T, 4) tetrahedra between them.

    Voxel (x, y, z) lies between the corners (x, y, z) and (x + 1, y + 1, z + 1).
    """
    shape = np.array(filled.shape) + 1
    ends = np.argwhere(filled)[:, None, None] + TETRAHEDRA  # (voxels, 6, 4, 3)
    key = np.ravel_multi_index(tuple(np.moveaxis(ends, -1, 0)), shape)
    used, number = np.unique(key, return_inverse=True)
    corners = np.stack(np.unravel_index(used, shape), axis=1)
    return corners, number.reshape(-1, 4).astype(np.int64)


def _constraints(bones: Skeleton, solid: Solid, corners) -> tuple:
    """(K,) ids of the corners on bones, (K, J) the weights there, with row sum 1."""
    tree, values = cKDTree(corners), np.zeros((len(corners), len(bones)))
    heads, tails = solid.to_grid(bones.joints), solid.to_grid(bones.tails)
    for bone, (start, end) in enumerate(zip(heads, tails, strict=True)):
        steps = int(np.ceil(2 * np.linalg.norm(end - start)))
        points = np.linspace(start, end, steps + 1)
        inside = solid.contains(points)
        gaps, _ = tree.query(points + 0.5)
        held = inside if inside.any() else gaps == gaps.min()
        # All that are equally near, so that a bone in the middle stays there.
        near = tree.query_ball_point(points[held] + 0.5, gaps[held] + 1e-2)
        values[np.concatenate(near).astype(np.int64), bone] = 1
    fixed = np.flatnonzero(values.any(axis=1))
    return fixed, values[fixed] / values[fixed].sum(axis=1, keepdims=True)


def _in_pieces_with(fixed, tetrahedra, count) -> np.ndarray:
    """(count,) bool: corners that tetrahedra join to one of the `fixed` corners."""
    first, others = np.repeat(tetrahedra[:, 0], 3), tetrahedra[:, 1:].ravel()
    links = sparse.coo_matrix((np.ones(len(first)), (first, others)), (count, count))
    _, piece = connected_components(links, directed=False)
    return np.isin(piece, piece[fixed])


def _interpolated(weights, corners, points) -> np.ndarray:
    """(V, J) `weights` of the corners of the voxel around each point, trilinearly."""
    number = np.zeros(corners.max(axis=0) + 1, np.int64)
    number[tuple(corners.T)] = np.arange(len(corners))
    voxel = np.rint(points).astype(np.int64)
    along = points - voxel + 0.5  # 0 to 1
    total = np.zeros((len(points), weights.shape[1]))
    for corner in product((0, 1), repeat=3):
        share = np.where(corner, along, 1 - along).prod(axis=1)
        total += share[:, None] * weights[number[tuple((voxel + corner).T)]]
    return total


def _visible_tails(head: Head) -> np.ndarray:
    """(J, 3) tails; a bone of length 0 goes on a little along its parent, or +Z."""
    bones = head.skeleton
    directions = bones.directions.copy()
    for bone in bones.order:
        if not directions[bone].any():
            parent = bones.parents[bone]
            directions[bone] = directions[parent] if parent >= 0 else (0, 0, 1)
    shortest = TAIL * (float(np.ptp(head.vertices, axis=0).max()) or 1.0)
    lengths = np.where(bones.lengths > 0, bones.lengths, shortest)
    return bones.joints + lengths[:, None] * directions
