"""Virtual bones for loose garments: where they sit, what they move, how they move.

A skirt does not follow the legs. Virtual bones spread over the cloth carry its loose
part and the joints of the body the rest; a recurrent network reads how the body moves
and says where the virtual bones are. After a Chinese patent application of 2025 whose
formulas were lost in the text; each is reconstructed in docs/equations.md, with what
else it could have been. Its closest relative: Pan et al., Predicting Loose-Fitting
Garment Deformations Using Bone-Driven Motion Networks, SIGGRAPH 2022.

Everything happens in the frame of the root, in which the root stands as at rest: where
a body walks and which way it faces makes no difference.

Symbols: V vertices, N virtual bones, J joints of the body, T frames, B sequences.
Metres, seconds, Z up.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike
from scipy.cluster.vq import kmeans
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist
from torch import Tensor, nn

from skinlib.garments.motion import Motion
from skinlib.geometry import islands, mesh_edges
from skinlib.head import HeadError, Skeleton

Array = TypeVar("Array", np.ndarray, torch.Tensor)

KERNELS = ("gauss", "exponential")
REDUCTIONS = ("mean", "p90")
ORACLES = ("affine", "rigid", "translation")

THRESHOLD = 0.003  # metres: LBS this far from the truth is good enough
SLOPE = 100.0  # per metre: 1 cm further and a vertex is loose altogether
LEAST_TOTAL = 0.5  # vertices: a joint that moves less of a garment is left out
LEAST_SPREAD = 1e-3  # of a feature: one that hardly varies is noise, not blown up


# --- where virtual bones sit ----------------------------------------------------------


def place_bones(
    vertices: np.ndarray, faces: np.ndarray, count: int, seed: int = 0
) -> np.ndarray:
    """(N,) int64 ids, ascending: the vertices nearest to the centres of k-means.

    The centres start on vertices as far from each other as can be, the first one drawn.
    Two that end at one vertex are one bone; further bones, as far as can be from the
    others, make up for it.

    Args:
        vertices: (V, 3). faces: (F, 3); a vertex of no face gets no bone.
        count: N, 1 or more.

    Raises:
        HeadError: fewer than `count` vertices to choose from, or one is not finite.

    >>> line = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [9, 0, 0], [10, 0, 0]])
    >>> place_bones(line, np.array([[0, 1, 2], [2, 3, 4]]), 2).tolist()
    [1, 3]
    """
    _check_finite("vertices", vertices)
    used = np.unique(faces)
    if not 1 <= count <= len(used):
        raise HeadError(
            "bones",
            f"{count} virtual bones for {len(used)} vertices with a face",
            f"ask for 1 to {len(used)}",
        )
    points = vertices[used].astype(np.float64)
    first = np.random.default_rng(seed).integers(len(points))
    centres, _ = kmeans(points, points[_spread(points, np.array([first]), count)])
    nearest = np.unique(cKDTree(points).query(centres)[1])
    return np.sort(used[_spread(points, nearest, count)]).astype(np.int64)


def _spread(points: np.ndarray, chosen: np.ndarray, count: int) -> np.ndarray:
    """`chosen` and further points, each the farthest from those before, `count` ids."""
    chosen = chosen.tolist()
    distance = cdist(points, points[chosen]).min(axis=1)
    distance[chosen] = -1  # never again, even where points coincide
    while len(chosen) < count:
        chosen.append(int(distance.argmax()))
        away = np.linalg.norm(points - points[chosen[-1]], axis=1)
        distance = np.minimum(distance, away)
        distance[chosen[-1]] = -1
    return np.array(chosen)


def bone_distances(
    vertices: np.ndarray, faces: np.ndarray, bones: np.ndarray
) -> np.ndarray:
    """(V, N) float64 metres along the cloth from each bone to each vertex.

    By the heat method of Crane, Weischedel and Wardetzky, Geodesics in Heat, TOG 2013.
    Infinite between pieces; a piece without any bone is as far as a straight line.

    Args:
        bones: (N,) vertex ids.

    Raises:
        HeadError: a vertex is not finite, or an id out of range.
    """
    _check_finite("vertices", vertices)
    if not len(bones) or bones.min() < 0 or bones.max() >= len(vertices):
        raise HeadError(
            "bones",
            f"ids {bones[:5].tolist()} for {len(vertices)} vertices",
            f"give one or more, from 0 to {len(vertices) - 1}",
        )
    points = vertices.astype(np.float64)
    piece = islands(faces, len(points))
    distances = np.full((len(points), len(bones)), np.inf)
    # Piece by piece: beyond a gap, the heat method would return numbers all the same.
    for label in np.unique(piece[bones]):
        ids = np.flatnonzero(piece == label)
        there = np.flatnonzero(piece[bones] == label)
        local = np.searchsorted(ids, faces[piece[faces[:, 0]] == label])
        found = _geodesics(points[ids], local, np.searchsorted(ids, bones[there]))
        # Where cloth is narrow or folded the heat method may fall short of this.
        straight = cdist(points[ids], points[bones[there]])
        distances[np.ix_(ids, there)] = np.maximum(found, straight)
    bare = np.isinf(distances).all(axis=1)
    distances[bare] = cdist(points[bare], points[bones])
    return distances


def _geodesics(
    points: np.ndarray, faces: np.ndarray, sources: np.ndarray
) -> np.ndarray:
    """(V, N) distances on one connected piece."""
    if not len(faces):
        return np.zeros((len(points), len(sources)))
    import igl  # here, since it takes long to load

    data = igl.HeatGeodesicsData()
    try:
        igl.heat_geodesics_precompute(points, faces, data)
        found = [igl.heat_geodesics_solve(data, np.array([s])) for s in sources]
        distances = np.stack(found, axis=1)
    except RuntimeError:  # all of it is hem
        distances = np.full((1, 1), np.nan)
    if not np.isfinite(distances).all():  # or slivers: go along the edges instead
        a, b = mesh_edges(faces).T
        lengths = np.linalg.norm(points[a] - points[b], axis=1)
        graph = coo_matrix((lengths, (a, b)), (len(points),) * 2).tocsr()
        distances = dijkstra(graph, directed=False, indices=sources).T
    return distances


def bone_spacing(distances: np.ndarray, bones: np.ndarray) -> float:
    """Metres from a virtual bone to its nearest neighbour, in the mean; 1 if alone.

    Args:
        distances: (V, N) from `bone_distances`. bones: (N,).
    """
    between = distances[bones] + np.diag(np.full(len(bones), np.inf))
    nearest = between.min(axis=0)
    near = nearest[np.isfinite(nearest) & (nearest > 0)]
    return float(near.mean()) if len(near) else 1.0


# --- what they move -------------------------------------------------------------------


def heat_weights(
    distances: np.ndarray, alpha: float, influences: int = 4, kernel: str = "gauss"
) -> np.ndarray:
    """(V, N) float32: shares of the hottest bones. Equation `heat_weights`.

    Rows sum to 1, at most `influences` in a row are above 0. However far a vertex is
    from all bones, the nearest ones share it: what all exponents of a row have in
    common is taken out before it can underflow.

    Args:
        distances: (V, N) from `bone_distances`; infinite where no heat arrives.
        alpha: how far heat reaches, metres, above 0; such as `bone_spacing`.
        influences: the most bones that move a vertex, 1 or more.
        kernel: "gauss", exp(-(d / alpha)^2), or "exponential", exp(-d / alpha).

    Raises:
        HeadError: a vertex that no heat reaches, a distance that is NaN or negative, or
            another argument out of range.

    >>> heat_weights(np.array([[0.0, 1, 2], [1, 0, 1]]), 1.0, influences=2).round(3)
    array([[0.731, 0.269, 0.   ],
           [0.269, 0.731, 0.   ]], dtype=float32)
    """
    if kernel not in KERNELS:
        raise HeadError("kernel", f"it is {kernel!r}", f"use {' or '.join(KERNELS)}")
    if not 0 < alpha < np.inf:
        raise HeadError("alpha", f"it is {alpha:g} m", "give a length above 0")
    if influences < 1:
        raise HeadError("influences", f"there are {influences}", "give 1 or more")
    if not (distances >= 0).all():  # false for NaN, too
        raise HeadError(
            "distances", "some are NaN or negative", "compute them by bone_distances"
        )
    least = distances.min(axis=1, keepdims=True)
    if np.isinf(least).any():
        raise HeadError(
            "distances",
            f"{np.isinf(least).sum()} vertices are infinitely far from every bone",
            "put a bone on each piece of the garment, or use bone_distances",
        )
    power = 2 if kernel == "gauss" else 1
    heat = np.exp((least / alpha) ** power - (distances / alpha) ** power)
    order = np.argsort(distances, axis=1, kind="stable")
    np.put_along_axis(heat, order[:, influences:], 0, axis=1)
    return (heat / heat.sum(axis=1, keepdims=True)).astype(np.float32)


def virtual_bind(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bind and offset matrices, (N, 4, 4) float32 each. Equation `virtual_bind`.

    A bone stands at its point, not rotated and not scaled; the offset undoes that. The
    joints of a body take part in the same way: by the points `skeleton.joints`.

    Args:
        points: (N, 3).

    Raises:
        HeadError: a point is not finite.

    >>> bind, offset = virtual_bind(np.array([[1.0, 2, 3]]))
    >>> bind[0, :3, 3].tolist(), offset[0, :3, 3].tolist()
    ([1.0, 2.0, 3.0], [-1.0, -2.0, -3.0])
    """
    _check_finite("points", points)
    binds = np.tile(np.eye(4, dtype=np.float32), (len(points), 1, 1))
    offsets = binds.copy()
    binds[:, :3, 3], offsets[:, :3, 3] = points, -points
    return binds, offsets


def looseness(
    lbs: np.ndarray,
    simulated: np.ndarray,
    threshold: float = THRESHOLD,
    slope: float = SLOPE,
    reduce: str = "mean",
) -> np.ndarray:
    """(V,) float32 in 0..1: how much of a vertex joints cannot move.

    Equation `looseness`: clamp(k (d - t), 0, 1), d the distance between both sequences.

    Args:
        lbs: (T, V, 3) the garment moved by the joints alone.
        simulated: (T, V, 3) the truth, in the same frame.
        threshold: t, metres, 0 or more. slope: k, per metre, above 0.
        reduce: of the T distances, their "mean" or "p90", which 10 % of them exceed.

    Raises:
        HeadError: shapes that differ, values that are not finite (a simulation that
            exploded), or another argument out of range.

    >>> moved = np.zeros((1, 3, 3))
    >>> moved[0, :, 0] = 0.005, 0.02, 1
    >>> looseness(np.zeros((1, 3, 3)), moved, 0.01, 50.0).tolist()
    [0.0, 0.5, 1.0]
    """
    if lbs.shape != simulated.shape or lbs.ndim != 3 or not len(lbs):
        raise HeadError(
            "simulated",
            f"shape {simulated.shape}, and {lbs.shape} for the skinned garment",
            "give both as (frames, vertices, 3)",
        )
    _check_finite("lbs", lbs)
    _check_finite("simulated", simulated)
    if not (0 <= threshold < np.inf and 0 < slope < np.inf):
        raise HeadError(
            "looseness",
            f"threshold {threshold:g} m, slope {slope:g} per metre",
            "give a threshold of 0 or more and a slope above 0",
        )
    if reduce not in REDUCTIONS:
        raise HeadError("reduce", f"it is {reduce!r}", f"use {' or '.join(REDUCTIONS)}")
    distance = np.linalg.norm(lbs.astype(np.float64) - simulated, axis=-1)
    if reduce == "mean":
        distance = distance.mean(axis=0)
    else:
        distance = np.quantile(distance, 0.9, axis=0)
    return np.clip(slope * (distance - threshold), 0, 1).astype(np.float32)


def hybrid_weights(
    loose: np.ndarray, virtual: np.ndarray, joints: np.ndarray
) -> np.ndarray:
    """(V, N + J) float32: virtual bones first, then joints. Equation `hybrid_weights`.

    Rows sum to 1 when those of both do.

    Args:
        loose: (V,) in 0..1: 0 for joints alone, 1 for virtual bones alone.
        virtual: (V, N), from `heat_weights`.
        joints: (V, J), from `skinlib.garments.binding.closest_point_weights`.

    Raises:
        HeadError: shapes that differ, or looseness outside 0..1.

    >>> hybrid_weights(np.array([0.25]), np.array([[1.0, 0]]), np.array([[1.0]]))
    array([[0.25, 0.  , 0.75]], dtype=float32)
    """
    if not len(loose) == len(virtual) == len(joints):
        raise HeadError(
            "weights",
            f"{len(loose)}, {len(virtual)} and {len(joints)} rows",
            "give looseness and weights of the same vertices",
        )
    if not ((loose >= 0) & (loose <= 1)).all():
        raise HeadError("looseness", "some are not in 0 to 1", "compute it again")
    share = loose[:, None]
    return np.hstack([share * virtual, (1 - share) * joints]).astype(np.float32)


def prune_joints(
    weights: np.ndarray, least: float = LEAST_TOTAL, virtual: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    """Leave out joints that move next to nothing, and share out what they had.

    Once on the joint weights, for what the network reads, and once on the hybrid
    weights, for what moves the garment. A joint stays when its weights sum to `least`
    or more over the vertices, or when a vertex would be left with nothing.

    Args:
        weights: (V, C). least: in vertices, 0 or more.
        virtual: how many of the first columns are virtual bones, which all stay.

    Returns:
        (V, K) weights, rows summing to 1, and the (K,) columns that are left.

    Raises:
        HeadError: a row has no weight at all.

    >>> weights, kept = prune_joints(np.array([[0.6, 0.2, 0.2], [0, 0.8, 0.2]]), 0.5)
    >>> kept.tolist(), weights.round(2).tolist()
    ([0, 1], [[0.75, 0.25], [0.0, 1.0]])
    """
    if not (weights.sum(axis=1) > 0).all():
        raise HeadError("weights", "a row is empty or NaN", "bind every vertex")
    stays = weights.sum(axis=0) >= least
    stays[:virtual] = True
    bare = weights[:, stays].sum(axis=1) <= 1e-6
    stays[weights[bare].argmax(axis=1)] = True
    kept = np.flatnonzero(stays)
    weights = weights[:, kept].astype(np.float64)
    weights /= weights.sum(axis=1, keepdims=True)
    return weights.astype(np.float32), kept


def hybrid_skinning(
    rest: Array, weights: Array, transforms: Array, offsets: Array
) -> Array:
    """(..., V, 3) posed vertices: sum_c w_c T_c O_c v. Equation `hybrid_skinning`.

    numpy arrays or torch tensors in, the same out. A stream that runs the network in
    torch had better skin there, too: two libraries' threads are in each other's way.

    Args:
        rest: (V, 3). weights: (V, C), virtual bones and joints.
        transforms: (..., C, 4, 4), where each bone stands: for a joint what
            `forward_kinematics` returns times its bind matrix.
        offsets: (C, 4, 4) from `virtual_bind`.
    """
    moved = (transforms @ offsets)[..., :3, :]  # (..., C, 3, 4)
    flat = moved.reshape(*moved.shape[:-2], 12).swapaxes(-1, -2)  # (..., 12, C)
    blended = flat @ weights.T  # (..., 12, V): far quicker than vertex by vertex
    columns = blended.reshape(*flat.shape[:-2], 3, 4, -1)
    x, y, z = rest.T
    posed = columns[..., 0, :] * x + columns[..., 1, :] * y
    posed = posed + columns[..., 2, :] * z + columns[..., 3, :]  # (..., 3, V)
    return posed.swapaxes(-1, -2)


def oracle(
    rest: np.ndarray, weights: np.ndarray, posed: np.ndarray, kind: str = "affine"
) -> np.ndarray:
    """(T, N, 4, 4) float32: the best that any network could do with these weights.

    The transforms, from rest, of least squared error in `linear_blend_skinning`; frame
    by frame, so that they need not be smooth in time. "rigid" ones are found bone by
    bone in turns, from the affine ones on (as in Le and Deng, Smooth Skinning
    Decomposition with Rigid Bones, TOG 2012, equation 8): near the best, not
    necessarily the best.

    Args:
        rest: (V, 3). weights: (V, N). posed: (T, V, 3).
        kind: "affine", "rigid", or "translation", which keeps rotations as at rest.

    Raises:
        HeadError: an unknown kind, or values that are not finite.
    """
    if kind not in ORACLES:
        raise HeadError("kind", f"it is {kind!r}", f"use one of {', '.join(ORACLES)}")
    for field, array in (("rest", rest), ("weights", weights), ("posed", posed)):
        _check_finite(field, array)
    rest, weights = rest.astype(np.float64), weights.astype(np.float64)
    count, frames = weights.shape[1], len(posed)
    # Round the middle of what a bone moves, lengths and shifts are of one size.
    total = np.maximum(weights.sum(axis=0), 1e-12)
    centres = weights.T @ rest / total[:, None]
    around = np.concatenate(
        [rest[:, None] - centres, np.ones((len(rest), count, 1))], axis=-1
    )
    if kind == "translation":
        around[..., :3] = 0
    basis = (weights[..., None] * around).reshape(len(rest), -1)  # (V, 4 N)
    # What moves from where it is at rest: a bone without a vertex stays.
    moved = posed - weights.sum(axis=1, keepdims=True) * rest
    moved = moved.transpose(1, 0, 2).reshape(len(rest), -1)
    found = np.linalg.lstsq(basis, moved, rcond=1e-8)[0].reshape(count, 4, frames, 3)
    found = found.transpose(2, 0, 3, 1)  # (T, N, 3, 4)
    linear, shift = found[..., :3] + np.eye(3), found[..., 3] + centres
    if kind == "rigid":
        linear = nearest_rotation(linear)
        _fit_rigid(around[..., :3], weights, posed, linear, shift)
    shift = shift - (linear @ centres[..., None])[..., 0]
    return _rigid(linear, shift).astype(np.float32)


def _fit_rigid(around, weights, posed, turned, shift, rounds: int = 12) -> None:
    """Improve rotations and places of bones in place, one bone after the other.

    Args:
        around: (V, N, 3) vertices at rest, seen from each bone. weights: (V, N).
        posed: (T, V, 3). turned: (T, N, 3, 3). shift: (T, N, 3).
    """

    def part(bone: int) -> np.ndarray:
        ids = near[bone]
        posed = around[ids, bone] @ turned[:, bone].swapaxes(-1, -2)
        return weights[ids, bone, None] * (posed + shift[:, None, bone])

    bones = range(weights.shape[1])
    near = [np.flatnonzero(weights[:, bone] > 1e-6) for bone in bones]
    left = posed.astype(np.float64)
    for bone in bones:
        left[:, near[bone]] -= part(bone)
    for _ in range(rounds):
        for bone in bones:
            ids = near[bone]
            if not len(ids):
                continue
            goal = left[:, ids] + part(bone)  # w (R r + t) at its best
            w, points = weights[ids, bone, None], around[ids, bone]
            squares = (w * w).sum()
            middle = (w * w * points).sum(axis=0) / squares
            target = (w * goal).sum(axis=1) / squares
            covariance = np.einsum("tvi,vj->tij", w * goal, points - middle)
            turned[:, bone] = nearest_rotation(covariance)
            shift[:, bone] = target - turned[:, bone] @ middle
            left[:, ids] = goal - part(bone)


# --- the frame of the root ------------------------------------------------------------


def in_root_frame(transforms: np.ndarray, root: int = 0) -> np.ndarray:
    """(..., J, 4, 4) float64: the same, as seen by a root that stands as at rest.

    Args:
        transforms: (..., J, 4, 4) from rest, as of `Motion.transforms`.
    """
    return undone(transforms[..., root, :, :])[..., None, :, :] @ transforms


def undone(rigid: np.ndarray) -> np.ndarray:
    """(..., 4, 4) float64: the inverse of rigid transforms."""
    back = np.swapaxes(rigid[..., :3, :3], -1, -2).astype(np.float64)
    return _rigid(back, -(back @ rigid[..., :3, 3:])[..., 0])


def nearest_rotation(matrices: np.ndarray) -> np.ndarray:
    """(..., 3, 3) the rotation nearest to each matrix, in the sum of squares.

    >>> nearest_rotation(np.diag([2.0, 0.5, 1])).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    left, _, right = np.linalg.svd(matrices)
    turned = left @ right
    mirrored = np.linalg.det(turned) < 0
    if mirrored.any():
        left[..., 2] *= np.where(mirrored, -1, 1)[..., None]
        turned = left @ right
    return turned


def rotation_vectors(rotations: np.ndarray) -> np.ndarray:
    """(..., 3) axis times angle in radians of (..., 3, 3) rotations.

    Half a turn, which has two directions, gives 0. For a single rotation, as in each
    frame of a stream, `scipy.spatial.transform.Rotation` takes three times as long.

    >>> rotation_vectors(np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])).round(3)
    array([0.   , 0.   , 1.571])
    """
    skew = rotations - rotations.swapaxes(-1, -2)
    axis = skew[..., [2, 0, 1], [1, 2, 0]] / 2
    sine = np.sqrt(np.square(axis).sum(axis=-1))
    cosine = (rotations.trace(axis1=-2, axis2=-1) - 1) / 2
    # Without a turn the axis is 0 itself.
    return axis * (np.arctan2(sine, cosine) / np.maximum(sine, 1e-12))[..., None]


def _rigid(linear: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """(..., 4, 4) from (..., 3, 3) and (..., 3)."""
    transforms = np.zeros((*shift.shape[:-1], 4, 4))
    transforms[..., :3, :3], transforms[..., :3, 3] = linear, shift
    transforms[..., 3, 3] = 1
    return transforms


def carriers(
    transforms: np.ndarray, weights: np.ndarray, points: np.ndarray
) -> np.ndarray:
    """(..., N, 4, 4) float32: where virtual bones would stand if joints moved them.

    Each is where blend skinning takes its point, turned by the rotation nearest to the
    blended matrix. What the network learns is the difference to that.

    Args:
        transforms: (..., J, 4, 4) of the joints, from `in_root_frame`.
        weights: (N, J) at the points; of a skirt those after `binding.smooth`.
        points: (N, 3) of the bones at rest.
    """
    flat = transforms.reshape(*transforms.shape[:-2], 16)
    blended = (weights @ flat).reshape(*flat.shape[:-2], len(weights), 4, 4)
    place = (blended[..., :3, :3] @ points[..., None])[..., 0] + blended[..., :3, 3]
    turned = nearest_rotation(blended[..., :3, :3])
    return _rigid(turned, place).astype(np.float32)


def features(
    motion: Motion, skeleton: Skeleton, joints: Sequence[int] | np.ndarray
) -> np.ndarray:
    """(T, 9 K + 9) float32: `pose_features` of a whole motion.

    Args:
        joints: (K,) ids, such as `prune_joints` leaves.

    Raises:
        HeadError: the bones of the motion are not those of the skeleton.
    """
    transforms = motion.transforms(skeleton)
    return pose_features(transforms, skeleton, joints, motion.fps)


def pose_features(
    transforms: np.ndarray,
    skeleton: Skeleton,
    joints: Sequence[int] | np.ndarray,
    fps: float,
    before: np.ndarray | None = None,
    root: int = 0,
    local: np.ndarray | None = None,
) -> np.ndarray:
    """(T, 9 K + 9) float32: what the network reads, the same wherever the body faces.

    Of each joint, in the frame of the root, two columns of its rotation and its place;
    of the root velocity (m/s), angular velocity (rad/s) and the direction of gravity,
    along its own axes. Velocities look back one frame, so that a stream has them, too.

    Args:
        transforms: (T, J, 4, 4) from rest, of successive frames.
        joints: (K,) ids. fps: frames per second, above 0.
        before: (4, 4) of the root, one frame before; without it the root starts still.
        local: (T, J, 4, 4) from `in_root_frame`, if known.
    """
    joints = np.asarray(joints, np.int64)
    if not len(joints):
        raise HeadError("joints", "there are none", "keep at least one")
    if not 0 < fps < np.inf:
        raise HeadError("fps", f"it is {fps:g}", "give frames per second")
    _check_finite("transforms", transforms)
    if local is None:
        local = in_root_frame(transforms, root)
    local = local[:, joints]
    points = skeleton.joints[joints].astype(np.float64)
    places = (local[..., :3, :3] @ points[..., None])[..., 0] + local[..., :3, 3]
    columns = local[..., :3, :2].swapaxes(-1, -2).reshape(*places.shape[:2], 6)

    roots = transforms[:, root].astype(np.float64)
    first = roots[:1] if before is None else before[None].astype(np.float64)
    last = np.concatenate([first, roots[:-1]])
    since = undone(last) @ roots  # from the last frame to this one, in its axes
    turned = rotation_vectors(since[:, :3, :3])
    hip = skeleton.joints[root].astype(np.float64)
    path = (roots - last)[:, :3, :3] @ hip + (roots - last)[:, :3, 3]
    along = path[:, None] @ roots[:, :3, :3]  # R^T of it
    down = -roots[:, 2, :3]  # R^T of what points down
    parts = [columns, places, fps * along, fps * turned, down]
    flat = [part.reshape(len(roots), -1) for part in parts]
    return np.concatenate(flat, axis=1).astype(np.float32)


# --- how they move --------------------------------------------------------------------


@dataclass(frozen=True)
class VirtualBonesConfig:
    """How large the network is, and what it may do to a bone."""

    hidden: int = 128  # width of all layers and of the memory
    rotate: bool = True  # bones turn; else they only shift: 3 numbers instead of 9


class VirtualBonesNet(nn.Module):
    """From how a body moves to where the virtual bones of its garment stand.

    Perceptron, gated recurrent unit, perceptron. The last layer starts at 0: untrained,
    the bones stand where `carriers` puts them, and the garment moves as by blend
    skinning. Rotations are learnt as two columns, made perpendicular (Zhou et al., On
    the Continuity of Rotation Representations in Neural Networks, CVPR 2019).

    Attributes:
        mean, scale: (F,) of the features, from `standardise`.
    """

    def __init__(
        self, inputs: int, bones: int, config: VirtualBonesConfig | None = None
    ):
        super().__init__()
        if inputs < 1 or bones < 1:
            raise HeadError(
                "bones", f"{bones} bones, {inputs} features", "give 1 or more of each"
            )
        self.config = config = config or VirtualBonesConfig()
        self.bones, width = bones, config.hidden
        self.register_buffer("mean", torch.zeros(inputs))
        self.register_buffer("scale", torch.ones(inputs))
        self.encoder = nn.Sequential(
            nn.Linear(inputs, width), nn.PReLU(), nn.Linear(width, width), nn.PReLU()
        )
        self.memory = nn.GRU(width, width, batch_first=True)
        self.decoder = nn.Sequential(
            nn.Linear(width, width),
            nn.PReLU(),
            nn.Linear(width, bones * (9 if config.rotate else 3)),
        )
        nn.init.zeros_(self.decoder[-1].weight)
        nn.init.zeros_(self.decoder[-1].bias)

    def describe(self) -> dict:
        """The configuration and the sizes, as plain numbers."""
        sizes = {"inputs": len(self.mean), "bones": self.bones}
        return asdict(self.config) | sizes

    def standardise(self, features: ArrayLike) -> None:
        """Take mean and spread of the features from those of the training, (..., F).

        Raises:
            HeadError: another number of features, or values that are not finite.
        """
        array = np.asarray(features, np.float64)
        if array.shape[-1:] != (len(self.mean),) or not array.size:
            raise HeadError(
                "features",
                f"shape {array.shape}",
                f"give rows of {len(self.mean)}, as many as the network reads",
            )
        _check_finite("features", array)
        rows = array.reshape(-1, array.shape[-1])
        self.mean.copy_(torch.from_numpy(rows.mean(axis=0)))
        spread = np.maximum(rows.std(axis=0), LEAST_SPREAD)
        self.scale.copy_(torch.from_numpy(spread))

    def forward(self, features: Tensor, carrier: Tensor) -> Tensor:
        """(B, T, N, 4, 4) where the bones stand in each frame, in the root's frame.

        Args:
            features: (B, T, F), whole sequences. carrier: (B, T, N, 4, 4).
        """
        hidden, _ = self.memory(self._encoded(features))
        return self._placed(hidden, carrier)

    def step(
        self, feature: Tensor, carrier: Tensor, state: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """One frame of a stream: (B, N, 4, 4) transforms, and the state to go on with.

        As `forward` on all frames so far, to rounding.

        Args:
            feature: (B, F). carrier: (B, N, 4, 4).
            state: of the frame before; none at the start.
        """
        hidden, memory = self._encoded(feature), self.memory
        state = torch.zeros_like(hidden) if state is None else state
        inner = memory.weight_ih_l0, memory.weight_hh_l0
        inner += memory.bias_ih_l0, memory.bias_hh_l0
        state = torch.gru_cell(hidden, state, *inner)  # `memory` takes twice as long
        return self._placed(state, carrier), state

    def _encoded(self, features: Tensor) -> Tensor:
        return self.encoder((features - self.mean) / self.scale)

    def _placed(self, hidden: Tensor, carrier: Tensor) -> Tensor:
        change = self.decoder(hidden).unflatten(-1, (self.bones, -1))
        place = carrier[..., :3, 3:] + change[..., :3, None]
        turned = carrier[..., :3, :3]
        if self.config.rotate:
            turned = rotation_from_columns(change[..., 3:]) @ turned
        top = torch.cat([turned, place], dim=-1)
        return torch.cat([top, carrier[..., 3:, :]], dim=-2)


def rotation_from_columns(change: Tensor) -> Tensor:
    """(..., 3, 3) rotations from (..., 6): by how much two columns leave the identity.

    Finite, and with a derivative, also where the columns end up parallel.

    >>> rotation_from_columns(torch.zeros(6)).tolist()
    [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    """
    ways = torch.eye(3, dtype=change.dtype, device=change.device)
    first = nn.functional.normalize(change[..., :3] + ways[0], dim=-1)
    second = change[..., 3:] + ways[1]
    second = second - (first * second).sum(-1, keepdim=True) * first
    second = nn.functional.normalize(second, dim=-1)
    return torch.stack([first, second, torch.linalg.cross(first, second)], dim=-1)


def _check_finite(field: str, array: np.ndarray) -> None:
    bad = ~np.isfinite(array)
    if bad.any():
        place = [int(where[0]) for where in np.nonzero(bad)]
        raise HeadError(
            field,
            f"{bad.sum()} values are NaN or infinite, the first at {place}",
            "give finite numbers",
        )
