"""A network's result, made locally stiff: it keeps the pose and gets its shape back.

What a network gets wrong from vertex to vertex looks worse than what it gets wrong at
large: creases, thin wrists, dents. The target's mesh knows better. Source: Sorkine and
Alexa 2007, *As-Rigid-As-Possible Surface Modeling*, SGP, with every vertex held softly
where the network wants it.
"""

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import factorized
from scipy.spatial import cKDTree

from skinlib.geometry import row_dot, weld
from skinlib.head import HeadError

REACH = 0.07  # of the target's size: so far a vertex feels the others
ROUNDS = 10
AROUND = 64  # vertices among which one of another piece is looked for


def as_rigid_as_possible(
    points: np.ndarray,
    target: np.ndarray,
    edges: np.ndarray,
    reach: float = REACH,
    rounds: int = ROUNDS,
) -> np.ndarray:
    """(N, 3) float64: near the points, with the edges of the target, each turned.

    Lowers, by turns over the rotations R and the positions x,

        sum_i |x_i - y_i|^2 + s / 2 sum_i sum_j |x_i - x_j - R_i (p_i - p_j)|^2

    over the neighbours j of i; y: points, p: target, s the square of `reach` in mean
    edges, so that a finer mesh is as stiff. Vertices at one place of the target stay
    together. Equation `rigid_refinement`.

    Args:
        points: (N, 3), in the size of the target. target: (N, 3). edges: (E, 2).
        reach: relative to the longest side of the target; 0 leaves the points alone.
        rounds: how often the rotations are found anew.

    Raises:
        HeadError: a negative reach, or shapes that do not fit.

    >>> square = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    >>> edges = np.array([[0, 1], [1, 2], [2, 3], [3, 0], [0, 2], [1, 3]])
    >>> bent = square + [[0, 0, 0], [0.2, 0, 0], [0, 0, 0], [0, 0, 0]]
    >>> bool(np.abs(as_rigid_as_possible(bent, square, edges, 10) - square).max() < 0.1)
    True
    """
    if not 0 <= reach < np.inf:
        raise HeadError("reach", f"{reach}", "give 0 or more")
    points, target = (np.asarray(a, np.float64) for a in (points, target))
    if points.shape != target.shape:
        raise HeadError(
            "points",
            f"{len(points)} for a target of {len(target)}",
            "give one for each vertex",
        )
    place = weld(target)
    _, first = np.unique(place, return_index=True)
    edges = np.unique(np.sort(place[edges], axis=1), axis=0)
    edges = edges[edges[:, 0] != edges[:, 1]]
    y, p = points[first], target[first]
    if not len(edges) or not reach:
        return points
    count, size = len(p), np.ptp(p, axis=0).max()
    sides = p[edges[:, 0]] - p[edges[:, 1]]
    stiffness = (reach * size / np.sqrt(row_dot(sides, sides)).mean()) ** 2
    edges = np.concatenate([edges, _ties(p, edges, reach * size)])
    a, b = np.concatenate([edges, edges[:, ::-1]]).T
    rest = p[a] - p[b]
    gather = csr_matrix((np.ones(len(a)), (a, np.arange(len(a)))), (count, len(a)))
    degree = np.bincount(a, minlength=count)
    neighbours = csr_matrix((np.ones(len(a)), (a, b)), (count, count))
    system = diags(1 + stiffness * degree) - stiffness * neighbours
    solve = factorized(system.tocsc())
    x = y
    for _ in range(rounds):
        now = x[a] - x[b]
        spread = gather @ (now[:, :, None] * rest[:, None, :]).reshape(-1, 9)
        turns = _rotations(spread.reshape(-1, 3, 3))
        pulled = np.einsum("eij,ej->ei", (turns[a] + turns[b]) / 2, rest)
        right = y + stiffness * (gather @ pulled)
        x = np.stack([solve(column) for column in right.T], axis=1)
    return x[place]


def _ties(points: np.ndarray, edges: np.ndarray, reach: float) -> np.ndarray:
    """(T, 2) from each vertex to the nearest one of another piece, within reach."""
    count = len(points)
    graph = coo_matrix((np.ones(len(edges)), tuple(edges.T)), (count, count))
    pieces, piece = connected_components(graph, directed=False)
    if pieces == 1:
        return np.zeros((0, 2), np.int64)
    distance, found = cKDTree(points).query(points, k=min(AROUND, count))
    other = (piece[found] != piece[:, None]) & (distance < reach)
    tied = np.flatnonzero(other.any(axis=1))
    ties = np.stack([tied, found[tied, other[tied].argmax(axis=1)]], axis=1)
    return np.unique(np.sort(ties, axis=1), axis=0)


def _rotations(matrices: np.ndarray) -> np.ndarray:
    """(N, 3, 3): the rotation closest to each matrix (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.linalg.det(u @ vt)[:, None]
    return u @ vt
