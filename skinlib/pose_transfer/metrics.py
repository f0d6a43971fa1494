"""How far a transferred mesh is from the truth, as the papers measure it and in plainer
units.

PMD, CD and EMD depend on how meshes were normalised: compare them only within one way,
here the cube from -1 to 1 (`skinlib.pose_transfer.data.normalised`). `Scores.line`
prints them with the papers' powers of ten.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from skinlib.geometry import row_dot
from skinlib.head import HeadError

SAMPLED = 1024  # points that are matched for EMD; the time grows with their cube


def pmd(predicted: np.ndarray, truth: np.ndarray) -> float:
    """The mean over vertices and coordinates of squared differences.

    "Point-wise mesh Euclidean distance" in the papers' tables, but a distance it is
    not: NPT's code takes the mean of squares over all coordinates, a third of the mean
    squared distance, and no root. Boxes are not aligned first.

    Args:
        predicted, truth: (N, 3), in one order.

    Raises:
        HeadError: no points, NaN, or two different shapes.

    >>> pmd(np.array([[0.0, 0, 0]]), np.array([[0.0, 0, 3]]))
    3.0
    """
    predicted, truth = _in_one_order(predicted, truth)
    return float(((predicted - truth) ** 2).mean())


def chamfer(a: np.ndarray, b: np.ndarray) -> float:
    """CD: squared distances to the nearest point of the other set, both means summed.

    Neither order nor number of points has to agree.

    Args:
        a: (N, 3). b: (M, 3).

    Raises:
        HeadError: no points, or NaN.

    >>> chamfer(np.array([[0.0, 0, 0]]), np.array([[0.0, 0, 1], [0, 0, 2]]))
    3.5
    """
    a, b = checked_points(a), checked_points(b)
    there, back = cKDTree(b).query(a)[0], cKDTree(a).query(b)[0]
    return float((there**2).mean() + (back**2).mean())


def earth_mover(
    a: np.ndarray, b: np.ndarray, points: int = SAMPLED, seed: int = 0
) -> float:
    """EMD: the mean distance, not squared, when each point is matched with another one.

    The matching is exact (`scipy.optimize.linear_sum_assignment`), on points drawn from
    larger meshes; the papers run an approximate auction on all. Two meshes with as many
    vertices give the same vertices, so that a mesh is at 0 from itself; else both are
    drawn on their own, and two samplings of one surface are apart by about their
    spacing.

    Args:
        a: (N, 3). b: (M, 3).
        points: at most so many of each, fewer where a mesh has fewer.

    Raises:
        HeadError: no points, NaN, or less than one point to match.

    >>> pair = np.array([[0.0, 0, 0], [1, 0, 0]])
    >>> earth_mover(pair, np.array([[1.0, 0, 0], [0, 0, 2]]))
    1.0
    """
    a, b = checked_points(a), checked_points(b)
    if points < 1:
        raise HeadError("points", f"there are {points}", "match one or more")
    size = min(points, len(a), len(b))
    a, b = (
        p[np.random.default_rng(seed).permutation(len(p))[:size]]
        if len(p) > size
        else p
        for p in (a, b)
    )
    cost = cdist(a, b)
    return float(cost[linear_sum_assignment(cost)].mean())


def edge_error(predicted: np.ndarray, truth: np.ndarray, edges: np.ndarray) -> float:
    """The mean over edges of |length / true length - 1|, in percent.

    Edges that have no length in truth are left out.

    Args:
        predicted, truth: (N, 3), in one order. edges: (E, 2).

    Raises:
        HeadError: as `pmd`, or no edge has a length in truth.

    >>> edge_error(np.eye(3), 2 * np.eye(3), np.array([[0, 1], [1, 2]]))
    50.0
    """
    predicted, truth = _in_one_order(predicted, truth)
    now, true = (
        np.linalg.norm(p[edges[:, 0]] - p[edges[:, 1]], axis=1)
        for p in (predicted, truth)
    )
    kept = true > 0
    if not kept.any():
        raise HeadError(
            "edges", "none has a length in truth", "give the edges of a mesh"
        )
    return float(100 * np.abs(now[kept] / true[kept] - 1).mean())


def vertex_error(predicted: np.ndarray, truth: np.ndarray, height: float) -> float:
    """The mean distance between vertex and true vertex, in percent of a height.

    Args:
        predicted, truth: (N, 3), in one order.
        height: of the standing body, in the unit of the points.

    Raises:
        HeadError: as `pmd`, or a height that is not above 0.

    >>> vertex_error(np.array([[0.0, 0, 0]]), np.array([[0.0, 3, 4]]), 200)
    2.5
    """
    predicted, truth = _in_one_order(predicted, truth)
    if not 0 < height < np.inf:
        raise HeadError("height", f"it is {height:g}", "give how tall the body stands")
    offset = predicted - truth
    return float(100 * np.sqrt(row_dot(offset, offset)).mean() / height)


@dataclass(frozen=True)
class Scores:
    """All measures of one mesh, or their means; the smaller, the better."""

    pmd: float
    chamfer: float
    earth_mover: float
    edge_error: float  # percent
    vertex_error: float  # percent of the height

    def line(self) -> str:
        """All numbers in one line, scaled as in the papers."""
        return (
            f"PMD {1e4 * self.pmd:.2f} e-4, CD {1e4 * self.chamfer:.2f} e-4, "
            f"EMD {1e3 * self.earth_mover:.2f} e-3, edges {self.edge_error:.2f} %, "
            f"vertices {self.vertex_error:.2f} % of height"
        )


def score(
    predicted: np.ndarray, truth: np.ndarray, edges: np.ndarray, height: float
) -> Scores:
    """All measures of one mesh; see the functions for the arguments.

    Raises:
        HeadError: as those do.
    """
    return Scores(
        pmd(predicted, truth),
        chamfer(predicted, truth),
        earth_mover(predicted, truth),
        edge_error(predicted, truth, edges),
        vertex_error(predicted, truth, height),
    )


def mean_scores(scores: Sequence[Scores]) -> Scores:
    """The means of one or more scores.

    Raises:
        HeadError: there are none.

    >>> mean_scores([Scores(1, 0, 0, 0, 0), Scores(3, 0, 0, 0, 0)]).pmd
    2.0
    """
    if not scores:
        raise HeadError("scores", "there are none", "score one mesh or more")
    rows = [asdict(one) for one in scores]
    return Scores(**{name: float(np.mean([r[name] for r in rows])) for name in rows[0]})


def checked_points(points: np.ndarray) -> np.ndarray:
    """(N, 3) float64, one or more, all of them finite.

    Raises:
        HeadError: they are not.
    """
    points = np.asarray(points, np.float64)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) == 0:
        raise HeadError(
            "points", f"an array of shape {points.shape}", "give (N, 3), N > 0"
        )
    if not np.isfinite(points).all():
        raise HeadError("points", "they hold NaN or infinity", "give finite values")
    return points


def _in_one_order(predicted, truth) -> tuple[np.ndarray, np.ndarray]:
    predicted, truth = checked_points(predicted), checked_points(truth)
    if predicted.shape != truth.shape:
        raise HeadError(
            "points",
            f"{len(predicted)} of them, {len(truth)} in truth",
            "compare vertex by vertex, or use chamfer or earth_mover",
        )
    return predicted, truth
