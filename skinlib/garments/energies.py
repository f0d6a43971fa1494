"""The potential energies of cloth: training lowers them, no simulation is copied.

A cloth that lies still has come to a place of low potential energy, so a network that
puts it there needs no simulated cloth to learn from. Each function is one energy of a
batch of poses, in SI units before its weight, and differentiable everywhere: an edge of
length 0 or a triangle without area has a finite derivative too.

Symbols: B poses, V vertices, F triangles, E edges, H hinges. Equation ids are those of
docs/equations.md.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from math import isfinite

import numpy as np
import torch
from torch import Tensor, nn

from skinlib.geometry import mesh_edges, vertex_areas
from skinlib.head import HeadError

GRAVITY = 9.81
"""m/s^2."""

LEAST_LENGTH = 1e-9
"""m: an edge far shorter than this has no direction, and its derivative fades to 0."""

LEAST_AREA = 1e-8
"""m^2, twice the area: the same for the normal of a triangle; 0.1 mm square."""


class Cloth(nn.Module):
    """What does not change when a garment moves: its springs, hinges and masses.

    A module without parameters, so that `.to(device)` moves all of it.

    Attributes:
        faces: (F, 3) int64.
        edges: (E, 2) int64, each once. rest_lengths: (E,) metres.
        hinges: (H, 2) int64, the two faces at each inner edge.
        hinge_edges: (H, 2) int64, the vertices of that edge, in the order of the first
            face.
        masses: (V,) kg: `density` times a third of the area of the faces around.
            PBNS's own code gives each vertex the same; then a finely meshed hem is
            heavier than a coarse one.

    Args:
        vertices: (V, 3) at rest, metres; their precision is that of the attributes.
        faces: (F, 3) vertex ids. `Garment.create` checks more of both.
        density: kg/m^2; 0.30 is a heavy jersey or a light denim.

    Raises:
        HeadError: a density that is not above 0; an edge that has more than two faces,
            or two that do not turn the same way.

    >>> square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
    >>> cloth = Cloth(square, np.array([[0, 1, 2], [0, 2, 3]]), density=0.3)
    >>> cloth.hinge_edges.tolist(), cloth.masses
    ([[0, 2]], tensor([0.1000, 0.0500, 0.1000, 0.0500]))
    """

    faces: Tensor
    edges: Tensor
    rest_lengths: Tensor
    hinges: Tensor
    hinge_edges: Tensor
    masses: Tensor

    def __init__(self, vertices: np.ndarray, faces: np.ndarray, density: float = 0.30):
        super().__init__()
        if not (isfinite(density) and density > 0):
            raise HeadError("density", f"{density:g} kg/m^2", "give more than 0")
        precision = np.result_type(vertices, np.float32)
        rest, faces = vertices.astype(np.float64), faces.astype(np.int64)
        edges = mesh_edges(faces)
        hinges, hinge_edges = _hinges(faces, len(rest))
        lengths = np.linalg.norm(rest[edges[:, 1]] - rest[edges[:, 0]], axis=1)
        for name, array in {
            "faces": faces,
            "edges": edges,
            "rest_lengths": lengths.astype(precision),
            "hinges": hinges,
            "hinge_edges": hinge_edges,
            "masses": (density * vertex_areas(rest, faces)).astype(precision),
        }.items():
            self.register_buffer(name, torch.from_numpy(array), persistent=False)


def face_normals(vertices: Tensor, faces: Tensor, eps: float = LEAST_AREA) -> Tensor:
    """(B, F, 3) unit normals; shorter than 1, down to 0, as the area goes to 0.

    n = c / sqrt(|c|^2 + eps^2) for c = (p_1 - p_0) x (p_2 - p_0)

    Args:
        vertices: (B, V, 3). faces: (F, 3) int64.
        eps: m^2. It bounds the derivative; a normal is 1 - (eps / |c|)^2 / 2 long.
    """
    return _face_normals(_vertices_first(vertices), faces, eps).permute(2, 0, 1)


def edge_energy(
    vertices: Tensor, cloth: Cloth, rest_lengths: Tensor | None = None
) -> Tensor:
    """(B,) m^2: the springs along the edges, stretched or pressed together.

    L_edge = sum_e (|p_a - p_b| - l_e)^2 for e = (a, b)

    Equation `pbns_edge`.

    Args:
        vertices: (B, V, 3) metres.
        rest_lengths: (B, E) metres, for cloth that is cut to another size in each pose;
            those of the cloth when left out.
    """
    start, end = cloth.edges.unbind(1)
    points = _vertices_first(vertices)
    step = points.index_select(0, end) - points.index_select(0, start)
    lengths = (_squares(step) + LEAST_LENGTH**2).sqrt()  # (E, B)
    rest = cloth.rest_lengths[:, None] if rest_lengths is None else rest_lengths.T
    stretch = lengths - rest.to(lengths.dtype)
    return stretch.square().sum(0)


def bend_energy(vertices: Tensor, cloth: Cloth) -> Tensor:
    """(B,) no unit: how far the cloth is folded at its inner edges.

    L_bend = sum_h |n_a - n_b|^2 = sum_h 2 (1 - cos angle_h), from 0, flat, to 4 a hinge

    Equation `pbns_bend`.

    Args:
        vertices: (B, V, 3) metres.
    """
    normals = _face_normals(_vertices_first(vertices), cloth.faces, LEAST_AREA)
    first, second = cloth.hinges.unbind(1)
    turn = normals.index_select(0, first) - normals.index_select(0, second)
    return _squares(turn).sum(0)


def collision_energy(
    vertices: Tensor, body_points: Tensor, body_normals: Tensor, epsilon: float = 0.004
) -> Tensor:
    """(B,) m^2: how far the cloth is inside the body, or nearer to it than epsilon.

    L_collision = sum_i min((p_i - b_i) . n_i - epsilon, 0)^2

    Equation `pbns_collision`.

    Args:
        vertices: (B, V, 3) metres.
        body_points: (B, V, 3) metres, the point of the body nearest to each vertex.
        body_normals: (B, V, 3), its unit normal, outwards.
        epsilon: metres; 4 mm is the source's.
    """
    gap = ((vertices - body_points) * body_normals).sum(-1) - epsilon
    return gap.clamp(max=0).square().sum(1)


def gravity_energy(vertices: Tensor, cloth: Cloth, up: int = 2) -> Tensor:
    """(B,) joules: the weight of the cloth times its height above the origin.

    L_gravity = sum_i m_i g z_i, g = 9.81 m/s^2

    Equation `pbns_gravity`.

    Args:
        vertices: (B, V, 3) metres. up: the axis that points up, 2 for Z.
    """
    return GRAVITY * (vertices[..., up] @ cloth.masses.to(vertices.dtype))


def pin_energy(offsets: Tensor, pinned: Tensor) -> Tensor:
    """(B,) m^2: how far the network moves vertices that should stay on the body.

    L_pin = sum_i b_i |dt_i|^2, b_i = 1 for a pinned vertex and 0 for others

    Equation `pbns_pin`.

    Args:
        offsets: (B, V, 3) metres, dt, what the network adds before the bones move it.
        pinned: (V,) bool.
    """
    return offsets.square().sum(-1) @ pinned.to(offsets.dtype)


@dataclass(frozen=True)
class EnergyWeights:
    """The factor of each energy; with these units the sum is in joules.

    For sums over vertices, edges and hinges. Where they differ from those of PBNS they
    measured better (benchmarks/README.md): a stiffer hinge keeps waves and smooths out
    crumples, and a collision has to outweigh the springs next to it.

    Attributes:
        edge: N/m; the springs' stiffness is twice that, as there is no half.
        bend: J. collision, layer: N/m, against the body and an inner layer.
        gravity: no unit; 1 is the earth's. pin: N/m.

    Raises:
        HeadError: a weight that is negative, NaN or infinite.
    """

    edge: float = 15.0
    bend: float = 5e-4  # the source: 5e-5
    collision: float = 400.0  # the source: 25
    gravity: float = 1.0
    pin: float = 10.0
    layer: float = 250.0  # the source: 25

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            if not (isfinite(value) and value >= 0):
                raise HeadError(
                    f"weight of {field.name}", f"{value:g}", "give 0 or more"
                )


def total_energy(terms: Mapping[str, Tensor], weights: EnergyWeights) -> Tensor:
    """(B,) joules: the energies of one batch, each times its weight, summed.

    L = sum_k lambda_k L_k

    Equation `pbns_total`. A term of weight 0 is left out, so that not even its NaN
    reaches the sum.

    Args:
        terms: (B,) each, by the names of `EnergyWeights`; those left out count 0.

    Raises:
        ValueError: no terms, or a name that has no weight.

    >>> terms = {"edge": torch.tensor([0.2]), "pin": torch.tensor([0.1])}
    >>> total_energy(terms, EnergyWeights(edge=10, pin=5))
    tensor([2.5000])
    """
    unknown = sorted(set(terms) - {field.name for field in fields(weights)})
    if unknown or not terms:
        raise ValueError(f"terms {unknown} have no weight" if unknown else "no terms")
    start = torch.zeros_like(next(iter(terms.values())))
    factors = {name: getattr(weights, name) for name in terms}
    return sum((factors[k] * terms[k] for k in terms if factors[k]), start)


def _vertices_first(vertices: Tensor) -> Tensor:
    """(V, 3, B) from (B, V, 3).

    A vertex of all poses is one row of memory then, which is what index_select and its
    derivative copy fastest, and x, y and z are separate runs of B numbers.
    """
    return vertices.permute(1, 2, 0).contiguous()


def _face_normals(points: Tensor, faces: Tensor, eps: float) -> Tensor:
    """(F, 3, B) from (V, 3, B)."""
    # index_select: the derivative of points[corner] sorts the ids first.
    a, b, c = (points.index_select(0, corner) for corner in faces.unbind(1))
    (ux, uy, uz), (vx, vy, vz) = (b - a).unbind(1), (c - a).unbind(1)
    # Written out: torch.linalg.cross is slow along an inner axis.
    cross = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    shrink = (sum(k * k for k in cross) + eps**2).rsqrt()
    return torch.stack([k * shrink for k in cross], dim=1)


def _squares(vectors: Tensor) -> Tensor:
    """(N, B) squared lengths of (N, 3, B); written out, half the time of a sum."""
    x, y, z = vectors.unbind(1)
    return x * x + y * y + z * z


def _hinges(faces: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """(H, 2) faces at each inner edge, and (H, 2) its vertices as the first turns."""
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    forwards, backwards = start * count + end, end * count + start
    _, places, counts = np.unique(forwards, return_index=True, return_counts=True)
    if (counts > 1).any():
        place = places[counts.argmax()]
        raise HeadError(
            "faces",
            f"two of them run from vertex {start[place]} to {end[place]}: more than two"
            " faces at that edge, or two that turn in opposite ways",
            "split the mesh there, or turn its faces the same way",
        )
    _, here, there = np.intersect1d(forwards, backwards, return_indices=True)
    once = start[here] < end[here]
    here, there = here[once], there[once]
    edges = np.stack([start[here], end[here]], axis=1)
    return np.stack([here // 3, there // 3], axis=1), edges
