"""Physical terms: weights should be smooth, and stay near their bone. No labels needed.

The source adds two of them, L_const = L_smooth + L_joint; `dirichlet` and
`joint_falloff` are the same wishes in a form that a mesh or a skull does not distort.

Symbols: V vertices (or nodes of the graph), J bones, K neighbours, E edges, P the
weights (V, J), d the distances (V, J) from vertices to joints or to bone segments: a
constant of the head, from `skinlib.geometry.point_segment_distance`, in any unit; in
the frame of the head, the network's, a value means the same on every head. Equation ids
are those of docs/equations.md.
"""

import torch
from torch import Tensor

# A radius below this part of the largest one is a bone on a point, not a reach.
LEAST_RADIUS = 1e-4


def smoothness(
    weights: Tensor, neighbours: Tensor, used: Tensor | None = None
) -> Tensor:
    """The source's L_smooth as written: squared differences over neighbour lists.

    L_smooth = 1/(V J) sum_v sum_j sum_{u in N(v)} (P_vj - P_uj)^2, from 0 to 2 K / J

    Equation `smooth`. More neighbours make it larger, a finer mesh makes it smaller;
    `dirichlet` does neither.

    Args:
        weights: (V, J). neighbours: (V, K) int64 vertex ids.
        used: (V, K) bool, which places of the table count; None: all.

    Raises:
        ValueError: a table that is not one row a vertex.

    >>> path = torch.tensor([[1, 1], [0, 2], [1, 1]])  # 0 - 1 - 2, ends filled up
    >>> used = torch.tensor([[True, False], [True, True], [True, False]])
    >>> weights = torch.tensor([[1.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    >>> round(smoothness(weights, path, used).item(), 4)  # 2 x (1 + 1) / (3 x 2)
    0.6667
    """
    _check(neighbours, "neighbours", (len(weights), neighbours.shape[-1]))
    if used is None:
        used = torch.ones_like(neighbours, dtype=torch.bool)
    _check(used, "used", neighbours.shape)
    vertex, place = used.nonzero(as_tuple=True)
    squares = _squared_steps(weights, vertex, neighbours[vertex, place])
    return squares.sum() / weights.numel()


def dirichlet(weights: Tensor, edges: Tensor, cotangents: Tensor) -> Tensor:
    """Dirichlet energy of the weights on the surface, summed over bones; no unit.

    E = 1/2 sum_e c_e |P_a - P_b|^2 = 1/2 sum_j integral |grad P_j|^2, for e = (a, b)

    Equation `dirichlet`. The same weights on a finer mesh, or on a larger head, have
    the same energy.

    Args:
        weights: (V, J). edges: (E, 2) int64; cotangents: (E,); both are constants of
            the mesh, from `skinlib.geometry.cotangents`.

    Raises:
        ValueError: edges are not (E, 2), or not one cotangent an edge.

    >>> square = torch.tensor([[1.0, 0.0], [0.5, 0.5], [0.0, 1.0]])
    >>> edges, cotangents = torch.tensor([[0, 1], [1, 2]]), torch.tensor([1.0, 0.5])
    >>> dirichlet(square, edges, cotangents).item()  # (1.0 + 0.5) x 0.5 / 2
    0.375
    """
    _check(edges, "edges", (len(edges), 2))
    _check(cotangents, "cotangents", (len(edges),))
    squares = _squared_steps(weights, edges[:, 0], edges[:, 1])
    return (cotangents.to(weights.dtype) * squares).sum() / 2


def _squared_steps(weights: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """(E,) sum_j (P_start - P_end)^2."""
    # index_select: the derivative of weights[start] sorts the ids first.
    step = weights.index_select(0, start) - weights.index_select(0, end)  # (E, J)
    return step.square().sum(dim=1)


def joint_distance(weights: Tensor, distances: Tensor) -> Tensor:
    """The source's L_joint as written: weight times squared distance to its bone.

    L_joint = 1/V sum_v sum_j P_vj d_vj^2, in squared units of the distances

    Equation `joint`. It punishes a bone that reaches far, and so the skull for
    following the head bone; `joint_falloff` does not.

    Args:
        weights, distances: (V, J).

    Raises:
        ValueError: two shapes.

    >>> weights = torch.tensor([[0.5, 0.5]])
    >>> joint_distance(weights, torch.tensor([[1.0, 3.0]])).item()  # (1 + 9) / 2
    5.0
    """
    _check(distances, "distances", weights.shape)
    return (weights * distances.to(weights.dtype).square()).sum(dim=1).mean()


def falloff_radii(
    weights: Tensor, distances: Tensor, mass: Tensor | None = None
) -> Tensor:
    """(J,) how far each bone reaches: root mean square distance of its weight.

    r_j = sqrt(sum_v m_v Y_vj d_vj^2 / sum_v m_v Y_vj)

    Equation `joint_falloff`.

    Args:
        weights: (V, J), the artist's Y. distances: (V, J).
        mass: (V,) vertex areas, so that a finer region counts no more; None: all 1.

    Returns:
        Radii in the unit of the distances; NaN for a bone without weight.

    Raises:
        ValueError: shapes that do not fit.

    >>> weights = torch.tensor([[1.0, 0.0], [1.0, 0.0]])
    >>> falloff_radii(weights, torch.tensor([[3.0, 1.0], [4.0, 1.0]])).square()
    tensor([12.5000,     nan])
    """
    _check(distances, "distances", weights.shape)
    mass = weights.new_ones(len(weights)) if mass is None else mass.to(weights.dtype)
    _check(mass, "mass", weights.shape[:1])
    squares = distances.to(weights.dtype).square()
    return ((mass @ (weights * squares)) / (mass @ weights)).sqrt()


def joint_falloff(weights: Tensor, distances: Tensor, radii: Tensor) -> Tensor:
    """`joint_distance` in units of each bone's own reach.

    L = 1/V sum_v sum_j P_vj (d_vj / r_j)^2

    Equation `joint_falloff`. It is 1 for the weights that the radii were taken from.
    A bone of unknown reach (NaN or 0) costs 1 wherever it is, as weight does on
    average: no bone is a free place to leave weight.

    Args:
        weights, distances: (V, J). radii: (J,), from `falloff_radii`.

    Raises:
        ValueError: shapes that do not fit.

    >>> weights, distances = torch.tensor([[0.5, 0.5]]), torch.tensor([[1.0, 3.0]])
    >>> joint_falloff(weights, distances, torch.tensor([1.0, 3.0])).item()
    1.0
    """
    _check(distances, "distances", weights.shape)
    _check(radii, "radii", weights.shape[1:])
    radii = radii.to(weights.dtype).nan_to_num(nan=0.0, posinf=0.0)
    known = (radii > 0) & (radii >= LEAST_RADIUS * radii.max())
    cost = (distances.to(weights.dtype) / torch.where(known, radii, 1.0)).square()
    return (weights * torch.where(known, cost, 1.0)).sum(dim=1).mean()


def _check(found: Tensor, name: str, expected: tuple[int, ...]) -> None:
    if tuple(found.shape) != tuple(expected):
        raise ValueError(
            f"{name} has shape {tuple(found.shape)} instead of {tuple(expected)}: is "
            "it of another head, or per vertex where the weights are per node?"
        )
