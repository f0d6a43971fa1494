"""What riggers do to skin weights: prune, limit, lock, mirror and smooth them.

Symbols: V vertices, J bones. All take (V, J) weights whose rows are >= 0 and sum to 1,
and return new ones like that.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from scipy.sparse import csr_array, diags_array

from skinlib.graph import seam_nodes
from skinlib.head import Head, HeadError, Skeleton
from skinlib.skinning import descendants, mirror_pairs, mirror_vertices

# What smoothing spreads below this is pruned, as the network's own weights are.
LEAST_WEIGHT = 0.01
# Rows miss 1 by less than this when they are stored as float32.
ROUNDING = 5e-7


def prune(weights: np.ndarray, threshold: float) -> np.ndarray:
    """(V, J) weights without those below `threshold`; rows sum to 1 again.

    A row's largest weight always stays.

    >>> prune(np.array([[0.9, 0.0625, 0.0375]]), 0.05).round(4).tolist()
    [[0.9351, 0.0649, 0.0]]
    """
    kept = weights >= np.minimum(threshold, weights.max(axis=1, keepdims=True))
    return _normalize_rows(np.where(kept, weights, 0))


def limit_influences(
    weights: np.ndarray,
    count: int,
    head: Head | None = None,
    first: np.ndarray | None = None,
) -> np.ndarray:
    """(V, J) weights with at most `count` bones a vertex; rows sum to 1 again.

    The largest are kept. No other row v on so few bones S, whatever its weights, is
    nearer in row-L1: v lacks what w has outside S, and as both sum to 1, v has as much
    too much inside. So |w - v| >= 2 (1 - w(S)), least for the largest weights, and
    reached wherever inside S the rest goes.

    Args:
        head: the rest of a vertex goes to those kept bones that move most like the
            dropped ones there, which deforms a head less; without it, to all kept
            bones in their proportions.
        first: (V, J) bool, weights above 0 that are kept before all others.

    >>> limit_influences(np.array([[0.5, 0.125, 0.375]]), 2).round(4).tolist()
    [[0.5714, 0.0, 0.4286]]
    """
    if count < 1:
        raise ValueError(f"at least 1 influence is needed, found {count}")
    # Rows that are within the limit stay as they are, to the bit.
    over = np.flatnonzero((weights > 0).sum(axis=1) > count)
    rows = weights[over]
    rank = rows if first is None else rows + 2 * (first[over] & (rows > 0))
    kept = np.argsort(-rank, axis=1, kind="stable")[:, :count]
    cut = np.zeros_like(rows)
    np.put_along_axis(cut, kept, np.take_along_axis(rows, kept, 1), 1)
    if head is not None:
        _hand_over(cut, rows, kept, head.vertices[over], head.skeleton)
    limited = np.array(weights)
    limited[over] = _normalize_rows(cut)
    return limited


def _hand_over(cut, rows, kept, points, skeleton: Skeleton, chunk: int = 4096) -> None:
    """Give each weight that `cut` lacks to the kept bone that moves most like its own.

    When every bone turns a little by chance, the motions of two bones at a point p
    differ by those on the path between them, each by |p - joint|^2 on average.
    """
    above = np.array([descendants(skeleton, [bone]) for bone in range(len(skeleton))]).T
    # The last bone that the paths from the root to two bones share; J for none.
    shared = above[:, None] & above
    meet = np.where(shared, skeleton.depths + 1, 0).argmax(axis=2)
    meet[~shared.any(axis=2)] = len(skeleton)
    joints = skeleton.joints.astype(np.float64)
    for start in range(0, len(rows), chunk):
        part = slice(start, start + chunk)
        reach = ((points[part, None] - joints) ** 2).sum(axis=2)  # (R, J)
        path = np.pad(reach @ above.T, ((0, 0), (0, 1)))  # (R, J + 1), from the root
        row, dropped = np.nonzero((rows[part] > 0) & (cut[part] == 0))
        place, dropped = row[:, None], dropped[:, None]
        heirs = kept[part][row]  # (P, count)
        # The path from the dropped bone is the same for all heirs.
        unlike = path[place, heirs] - 2 * path[place, meet[dropped, heirs]]
        heir = np.take_along_axis(heirs, unlike.argmin(axis=1)[:, None], 1)
        np.add.at(cut[part], (place, heir), rows[part][place, dropped])


def lock_bones(
    weights: np.ndarray, original: np.ndarray, bone_ids: np.ndarray | Sequence[int]
) -> np.ndarray:
    """`weights` with the columns `bone_ids` of `original`, bit by bit.

    The other bones share what the locked ones leave, in their own proportions; where
    `weights` gives them nothing, in the proportions of `original`.

    Args:
        weights: (V, J) predicted. original: (V, J) the artist's. bone_ids: locked.

    Returns:
        (V, J) in the type of `original`, rows >= 0 with sum 1.

    >>> lock_bones(np.array([[0.5, 0.25, 0.25]]), np.array([[0.25, 0.5, 0.25]]), [0])
    array([[0.25 , 0.375, 0.375]])
    """
    locked = np.zeros(original.shape[1], bool)
    locked[np.asarray(bone_ids, np.int64)] = True
    return _lock(weights, original, locked)


def lock_vertices(
    weights: np.ndarray, original: np.ndarray, locked: np.ndarray
) -> np.ndarray:
    """`weights` with the rows of `original` where `locked`, bit by bit.

    Args:
        weights: (V, J) predicted. original: (V, J) the artist's. locked: (V,) bool.

    Returns:
        (V, J) in the type of `original`.

    >>> lock_vertices(np.eye(2), np.full((2, 2), 0.5), np.array([True, False]))
    array([[0.5, 0.5],
           [0. , 1. ]])
    """
    return np.where(locked[:, None], original, weights).astype(original.dtype)


def symmetrize(
    head: Head, weights: np.ndarray, locked: np.ndarray | None = None
) -> np.ndarray:
    """(V, J) weights averaged with those of the mirrored vertex, sides exchanged.

    Partners are `mirror_vertices` and `mirror_pairs`; vertices without one keep their
    weights.

    Args:
        locked: (V, J) bool, weights that stay to the bit. Where one of two partners is
            locked the other becomes its mirror image; where both are, both stay.
    """
    return _mean_of_sides(weights, _reflection(head), locked)


def smooth_weights(
    head: Head,
    weights: np.ndarray,
    steps: int = 1,
    strength: float = 0.5,
    locked: np.ndarray | None = None,
) -> np.ndarray:
    """(V, J) weights smoothed along the surface, one ring of vertices a step.

    w_v <- (1 - strength) w_v + strength sum_u a_vu w_u over the neighbours u on the
    mesh, with the mean value coordinates a (M. S. Floater, "Mean value coordinates",
    CAGD 2003). They are never negative, as cotangents are at one edge in seven of a
    game head, and leave a weight that falls off evenly as it is on any triangulation,
    which the plain mean does not.

    Vertices that a seam cut apart move as one; nothing crosses the air, so that lips,
    lids, teeth and eyes stay apart, and a vertex only gains bones of its neighbours.

    Args:
        steps: how many rings of vertices have a say.
        strength: 0 nothing changes, 1 a vertex becomes the mean of its neighbours.
        locked: (V,) bool, vertices that keep their weights to the bit.

    Raises:
        ValueError: steps below 0, or a strength that is not from 0 to 1.
    """
    if steps < 0 or not 0 <= strength <= 1:
        raise ValueError(f"steps >= 0, strength 0 to 1; found {steps}, {strength}")
    node, locked = seam_nodes(head), _mask(locked, len(weights))
    count = int(node.max()) + 1
    # A locked vertex speaks for those that a seam cut from it.
    fixed = np.bincount(node[locked], minlength=count) > 0
    speaks = (locked | ~fixed[node]).astype(np.float64)
    share = speaks / np.bincount(node, speaks, count)[node]
    gather = csr_array((share, (node, np.arange(len(node)))), (count, len(node)))

    average = _mean_value_average(head.vertices[_first(node)], node[head.faces])
    lonely = np.asarray(average.sum(axis=1)) == 0
    rate = np.where(fixed | lonely, 0, strength)
    step = diags_array(1 - rate) + diags_array(rate) @ average
    values = gather @ weights
    for _ in range(steps):
        values = step @ values
    smoothed = _normalize_rows(values[node]).astype(weights.dtype)
    return lock_vertices(smoothed, weights, locked)


def finish(
    head: Head,
    weights: np.ndarray,
    *,
    locked_bones: Sequence[int] = (),
    locked_vertices: np.ndarray | None = None,
    smooth: int = 0,
    symmetric: bool = False,
    max_influences: int | None = None,
    file: str | Path | None = None,
) -> np.ndarray:
    """(V, J) predicted weights as a rigger orders them, in this order.

    Locked bones and vertices get the weights of `head` back, to the bit, and the rest
    renormalises around them; smoothed and pruned; made symmetric, where the free side
    follows the locked one; limited, where what is locked takes its influences first.

    Args:
        locked_bones: ids. locked_vertices: (V,) bool. Both need weights in `head`.
        smooth: steps of `smooth_weights`.
        file: named in the error.

    Raises:
        HeadError: a vertex needs more influences for what is locked alone.
    """
    locked = np.repeat(
        _mask(locked_vertices, len(weights))[:, None], len(head.skeleton), 1
    )
    locked[:, list(locked_bones)] = True
    original = head.weights if locked.any() else weights
    weights = _lock(weights, original, locked)
    if smooth:
        weights = smooth_weights(head, weights, smooth, locked=locked_vertices)
        weights = _lock(weights, original, locked)
    if symmetric:
        reflected = _reflection(head)
        weights = _mean_of_sides(weights, reflected, locked)
        locked = locked | reflected(locked)
    original = weights
    if smooth:
        weights = _lock(prune(weights, LEAST_WEIGHT), original, locked)
    if max_influences is not None:
        weights = limit_influences(weights, max_influences, head, first=locked)
    weights = _lock(weights, original, locked)
    used = (weights > 0).sum(axis=1)
    most = int(used.max())
    if max_influences is not None and most > max_influences:
        raise HeadError(
            "--max-influences",
            f"what is locked leaves vertex {used.argmax()} with {most} influences",
            f"allow {most}, or lock less",
            file,
        )
    return weights


def _reflection(head: Head) -> Callable[[np.ndarray], np.ndarray]:
    """What turns (V, J) values into their mirror image, the bones' sides exchanged.

    A vertex without a partner has its own values.
    """
    partner, pairs = mirror_vertices(head), mirror_pairs(head.skeleton)
    found = (partner >= 0)[:, None]
    return lambda values: np.where(found, values[partner][:, pairs], values)


def _mean_of_sides(weights, reflected, locked) -> np.ndarray:
    """See `symmetrize`."""
    mirrored = reflected(weights)
    mean = (weights + mirrored) / 2
    if locked is None:
        return mean
    pinned = np.where(locked, weights, mirrored)
    result = _lock(mean, pinned, locked | reflected(locked))
    # A row can hold more than 1 that is locked or follows: what is locked has it.
    return _lock(result, weights, locked)


def _mask(vertices: np.ndarray | None, count: int) -> np.ndarray:
    return np.zeros(count, bool) if vertices is None else vertices


def _first(node: np.ndarray) -> np.ndarray:
    """(N,) a vertex of each node."""
    return np.unique(node, return_index=True)[1]


def _lock(weights: np.ndarray, original: np.ndarray, locked: np.ndarray) -> np.ndarray:
    """`original` where `locked` ((J,) or (V, J)); the other weights share the rest."""
    if not locked.any():
        return weights
    locked = np.broadcast_to(locked, original.shape)
    free = np.where(locked, 0, np.asarray(weights, np.float64))
    empty = free.sum(axis=1) <= 0
    free[empty] = np.where(locked, 0, original)[empty]
    left = 1 - np.where(locked, original, 0).sum(axis=1, dtype=np.float64)
    left[left < ROUNDING] = 0
    share = left / np.maximum(free.sum(axis=1), np.finfo(np.float64).tiny)
    shared = (free * share[:, None]).astype(original.dtype)
    return np.where(locked, original, shared)


def _mean_value_average(points: np.ndarray, faces: np.ndarray) -> csr_array:
    """(N, N): a point's mean value coordinates over its neighbours; rows sum to 1.

    Each triangle adds tan(angle / 2) / length to the two edges that leave its corner.
    A point on no triangle that has an area has an empty row.
    """
    points = points.astype(np.float64)
    rows, columns, values = [], [], []
    for corner in range(3):
        at, left, right = np.roll(faces, -corner, axis=1).T
        a, b = points[left] - points[at], points[right] - points[at]
        la, lb = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
        sine = np.linalg.norm(np.cross(a, b), axis=1)
        cosine = np.einsum("fx,fx->f", a, b)
        # tan(angle / 2) = sin / (1 + cos), all times both lengths.
        below = np.maximum(la * lb + cosine, 1e-9 * la * lb)
        sound = sine > 0
        half = sine[sound] / below[sound]
        rows += [at[sound], at[sound]]
        columns += [left[sound], right[sound]]
        values += [half / la[sound], half / lb[sound]]
    places = np.concatenate(rows), np.concatenate(columns)
    table = csr_array((np.concatenate(values), places), (len(points), len(points)))
    total = np.asarray(table.sum(axis=1))
    return diags_array(1 / np.where(total > 0, total, 1)) @ table


def _normalize_rows(weights: np.ndarray) -> np.ndarray:
    total = weights.sum(axis=1, keepdims=True, dtype=np.float64)
    return (weights / np.where(total > 0, total, 1)).astype(weights.dtype)
