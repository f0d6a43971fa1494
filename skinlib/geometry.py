"""Geometry of triangle meshes and bones: plain functions from arrays to arrays.

Symbols: V vertices, F faces, E edges, J bones. Everything is linear in V.
"""

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

MAX_COTANGENT = 100.0  # of a face's sharpest angle; half a degree


def safe_normalize(vectors: np.ndarray, fallback=(0.0, 0.0, 0.0)) -> np.ndarray:
    """Rows of unit length; a zero row becomes `fallback`.

    Rows are divided by their largest entry first, so that neither a tiny nor a huge
    row loses its direction to underflow or overflow.

    >>> safe_normalize(np.array([[0, 3e-300, 4e-300], [0, 0, 0]])).round(3).tolist()
    [[0.0, 0.6, 0.8], [0.0, 0.0, 0.0]]
    """
    vectors = np.asarray(vectors, np.float64)
    largest = np.abs(vectors).max(axis=-1, keepdims=True, initial=0)
    scaled = np.divide(vectors, largest, out=np.zeros_like(vectors), where=largest > 0)
    length = np.linalg.norm(scaled, axis=-1, keepdims=True)
    unit = np.divide(scaled, length, out=scaled, where=length > 0)
    return np.where(length > 0, unit, np.asarray(fallback, np.float64))


def row_dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(N,) dot products of rows; much faster than a product and a sum over it.

    >>> row_dot(np.array([[1.0, 2, 3]]), np.array([[4.0, 5, 6]])).tolist()
    [32.0]
    """
    return np.einsum("ij,ij->i", a, b)


def face_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(F, 3) normals whose length is twice the face's area; 0 for a flat face."""
    vertices = np.asarray(vertices, np.float64)
    # `take` is several times faster than an index in brackets.
    a, b, c = (vertices.take(corner, axis=0) for corner in faces.T)
    return np.cross(b - a, c - a)


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V, 3) float32 area-weighted unit normals; +Z where there is no face.

    >>> square = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], float)
    >>> vertex_normals(square, np.array([[0, 1, 2]]))[0].tolist()
    [0.0, 0.0, 1.0]
    """
    count = len(vertices)
    if len(faces) == 0:
        return np.tile(np.float32([0, 0, 1]), (count, 1))
    extent = np.ptp(np.asarray(vertices, np.float64), axis=0).max() or 1.0
    normals = face_normals(np.asarray(vertices, np.float64) / extent, faces)
    summed = np.stack(
        [np.bincount(faces.ravel(), np.repeat(n, 3), count) for n in normals.T], axis=1
    )
    return safe_normalize(summed, fallback=(0, 0, 1)).astype(np.float32)


def vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(V,) float64: a third of the area of the faces around each vertex."""
    areas = np.linalg.norm(face_normals(vertices, faces), axis=1) / 2
    return np.bincount(faces.ravel(), np.repeat(areas / 3, 3), len(vertices))


def mesh_edges(faces: np.ndarray) -> np.ndarray:
    """(E, 2) int64: each edge of the triangles once, smaller vertex id first.

    >>> mesh_edges(np.array([[0, 1, 2], [2, 1, 3]])).tolist()
    [[0, 1], [0, 2], [1, 2], [1, 3], [2, 3]]
    """
    if len(faces) == 0:
        return np.zeros((0, 2), np.int64)
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    a, b = np.minimum(start, end), np.maximum(start, end)
    # One number an edge: far faster to sort than rows.
    size = int(faces.max()) + 1
    key = np.sort((a * size + b)[a != b])
    key = key[np.diff(key, prepend=-1) > 0]
    return np.stack(np.divmod(key, size), axis=1)


def cotangents(
    vertices: np.ndarray, faces: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The edges of a mesh and how strongly the surface joins their ends.

    c_ab = (cot alpha + cot beta) / 2, for the angles opposite the edge. Equation
    `dirichlet`. Where two faces are obtuse it is negative; the energy never is.

    Args:
        vertices: (V, 3), any unit. faces: (F, 3), any orientation. A seam cuts the
            surface; to close it, pass the nodes of a graph instead of the vertices.

    Returns:
        edges: (E, 2) int64, those of `mesh_edges`.
        weights: (E,) float64, finite. A face of no area counts nothing, and one with an
            angle below about half a degree less, so that no sliver outweighs a head.

    >>> square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    >>> edges, weights = cotangents(square, np.array([[0, 1, 2], [0, 2, 3]]))
    >>> edges.tolist(), weights.round(6).tolist()
    ([[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]], [0.5, 0.0, 0.5, 0.5, 0.5])
    """
    edges = mesh_edges(faces)
    if len(edges) == 0:
        return edges, np.zeros(0)
    import igl  # here, since it takes long to load

    halves = igl.cotmatrix_entries(np.asarray(vertices, np.float64), faces)  # (F, 3)
    largest = np.abs(halves).max(axis=1, keepdims=True)
    # Each face as a whole: with one angle clipped its energy could fall below 0.
    share = np.minimum(1, MAX_COTANGENT / 2 / np.maximum(largest, 1e-300))
    halves = np.multiply(
        halves, share, out=np.zeros_like(halves), where=np.isfinite(largest)
    )
    opposite = faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2)  # the order of `halves`
    a, b = np.sort(opposite, axis=1).T
    size = len(vertices)
    summed = coo_matrix((halves.ravel(), (a, b)), shape=(size, size)).tocsr()
    return edges, np.asarray(summed[edges[:, 0], edges[:, 1]]).reshape(-1)


def weld(vertices: np.ndarray, tolerance: float = 1e-6) -> np.ndarray:
    """(V,) int64: vertices at the same position share an id, 0 .. W-1.

    Args:
        tolerance: how far apart the same position may lie, as a fraction of the
            longest side of the bounding box.

    >>> weld(np.array([[0, 0, 0], [1, 0, 0], [0, 0, 0]], float)).tolist()
    [0, 1, 0]
    """
    vertices = np.asarray(vertices, np.float64)
    extent = np.ptp(vertices, axis=0).max()
    if extent == 0:
        return np.zeros(len(vertices), np.int64)
    # Round to the bounding box's own grid: positions in one file repeat exactly or
    # differ by float32 noise, so a grid finds what a search in a ball would.
    grid = np.round((vertices - vertices.min(axis=0)) / (extent * tolerance))
    order = np.lexsort(grid.T)  # stable: the first of each position comes first
    starts = np.diff(grid[order], axis=0, prepend=-1).any(axis=1)
    first = np.zeros_like(order)
    first[order] = order[starts][np.cumsum(starts) - 1]
    return (np.cumsum(first == np.arange(len(first))) - 1)[first]


def islands(
    faces: np.ndarray, vertex_count: int, welded: np.ndarray | None = None
) -> np.ndarray:
    """(V,) int64: which connected piece of the surface each vertex belongs to.

    Args:
        welded: ids from `weld`, to count a piece cut along a seam as one.
    """
    ids = np.arange(vertex_count) if welded is None else welded
    edges = ids[faces[:, [0, 1, 1, 2]].reshape(-1, 2)]
    size = int(ids.max()) + 1
    graph = coo_matrix((np.ones(len(edges)), tuple(edges.T)), shape=(size, size))
    _, label = connected_components(graph, directed=False)
    return label[ids].astype(np.int64)


def neighbourhood_kinds(
    vertices: np.ndarray, faces: np.ndarray, rings: int = 3
) -> np.ndarray:
    """(V,) uint64: what the mesh around each vertex is like, `rings` edges far.

    Two vertices have the same number when connectivity alone does not tell them apart,
    in one mesh or in two; positions, vertex order and seams do not matter. These are
    Weisfeiler-Lehman colours: a vertex starts with its number of neighbours, and each
    round mixes in the sum of the neighbours' hashed colours.

    >>> square = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
    >>> kinds = neighbourhood_kinds(square, np.array([[0, 1, 2], [0, 2, 3]]))
    >>> bool(kinds[0] == kinds[2]), bool(kinds[0] == kinds[1])
    (True, False)
    """
    position = weld(vertices)
    edges = mesh_edges(position[faces])
    count = int(position.max(initial=-1)) + 1
    a, b = np.concatenate([edges, edges[:, ::-1]]).T
    colour = np.bincount(a, minlength=count).astype(np.uint64)
    for _ in range(rings):
        mixed = _mix(colour)
        total = np.zeros(count, np.uint64)
        np.add.at(total, a, mixed[b])
        colour = _mix(mixed * np.uint64(3) + total)
    return colour[position]


def _mix(values: np.ndarray) -> np.ndarray:
    """The finaliser of splitmix64 (Steele, Lea and Flood 2014): spreads all bits."""
    values = values + np.uint64(0x9E3779B97F4A7C15)
    values = (values ^ (values >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    values = (values ^ (values >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return values ^ (values >> np.uint64(31))


def point_segment_distance(
    points: np.ndarray, heads: np.ndarray, tails: np.ndarray
) -> np.ndarray:
    """(N, J) distances from N points to J bone segments; a bone may be a point.

    >>> point_segment_distance(
    ...     np.array([[0, 1, 0], [3, 0, 0]], float),
    ...     np.array([[-1, 0, 0]], float), np.array([[1, 0, 0]], float)).tolist()
    [[1.0], [2.0]]
    """
    axis = np.asarray(tails, np.float64) - heads
    squared = (axis**2).sum(axis=1)
    offset = points[:, None] - np.asarray(heads, np.float64)[None]  # (N, J, 3)
    along = (offset * axis).sum(axis=2) / np.where(squared > 0, squared, 1)
    along = np.clip(along, 0, 1)
    return np.linalg.norm(offset - along[..., None] * axis, axis=2)


def curvature(
    vertices: np.ndarray, normals: np.ndarray, edges: np.ndarray
) -> np.ndarray:
    """(V,) float64 mean curvature in 1 / unit: positive where the surface is convex.

    Along an edge the normal curvature is k = (n_b - n_a) . (b - a) / |b - a|^2; a
    vertex takes the mean over its edges. It asks for nothing but an edge list, so it
    also works on open, non-manifold and welded meshes. Equation `curvature`.

    >>> circle = np.array([[np.cos(t), np.sin(t), 0] for t in (0.0, 0.1)]) * 2
    >>> curvature(circle, circle / 2, np.array([[0, 1]])).round(3).tolist()
    [0.5, 0.5]
    """
    a, b = edges.T
    vertices = np.asarray(vertices, np.float64)
    normals = np.asarray(normals, np.float64)
    step = vertices.take(b, axis=0) - vertices.take(a, axis=0)
    turn = normals.take(b, axis=0) - normals.take(a, axis=0)
    squared = row_dot(step, step)
    bend = np.divide(
        row_dot(turn, step), squared, out=np.zeros(len(step)), where=squared > 0
    )
    return _edge_mean(edges, bend, len(vertices))


def normal_deviation(normals: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(V,) float64 in 0 .. 2: mean of 1 - n_a . n_b over a vertex's edges.

    Equation `normal_deviation`.

    >>> normals = np.array([[0, 0, 1.0], [0, 1, 0]])
    >>> normal_deviation(normals, np.array([[0, 1]])).tolist()
    [1.0, 1.0]
    """
    a, b = edges.T
    normals = np.asarray(normals, np.float64)
    bend = 1 - row_dot(normals.take(a, axis=0), normals.take(b, axis=0))
    return _edge_mean(edges, bend, len(normals))


def _edge_mean(edges: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    total = np.bincount(edges.ravel(), np.repeat(values, 2), count)
    return total / np.maximum(np.bincount(edges.ravel(), minlength=count), 1)


class Frame(NamedTuple):
    """A head's own coordinates: `(x - centre) @ rotation.T / scale`.

    Attributes:
        rotation: (3, 3), its rows are the lateral, up and forward axes in file space.
        centre: (3,) file coordinates of the origin.
        scale: file units per head unit.
    """

    rotation: np.ndarray
    centre: np.ndarray
    scale: float

    def apply(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) points from file coordinates into the frame."""
        offset = np.asarray(points, np.float64) - self.centre
        return offset @ self.rotation.T / self.scale

    def rotate(self, vectors: np.ndarray) -> np.ndarray:
        """(N, 3) directions from file axes into the frame's."""
        return np.asarray(vectors, np.float64) @ self.rotation.T


def canonical_frame(
    vertices: np.ndarray,
    faces: np.ndarray,
    joints: np.ndarray,
    parents: np.ndarray,
) -> Frame:
    """The frame of a head: x lateral, y up, z out of the face; any up-axis in.

    Artists model along the axes of the file, so the frame is one of its 24 axis-aligned
    rotations. The lateral axis is the one whose mirror image fits the bones best; up
    leads from the root to the face bones and forward from the skull's middle to them.
    The origin is the area-weighted mean of the surface and the scale its area-weighted
    root mean square radius: a finer mesh of the same head has the same frame.

    Args:
        vertices: (V, 3). faces: (F, 3). joints: (J, 3). parents: (J,).
    """
    vertices = np.asarray(vertices, np.float64)
    joints = np.asarray(joints, np.float64)
    areas = vertex_areas(vertices, faces) if len(faces) else np.zeros(len(vertices))
    mass = areas / areas.sum() if areas.sum() > 0 else np.full(len(vertices), 1.0)
    mass = mass / mass.sum()
    centre = mass @ vertices
    scale = np.sqrt(mass @ ((vertices - centre) ** 2).sum(axis=1))
    # A single point, but for rounding; float32 positions differ by more.
    if scale <= 1e-9 * np.abs(vertices).max():
        spread = np.abs(joints - centre).max()
        scale = spread if spread > 0 else 1.0

    lateral = int(np.argmin([_mirror_misfit(joints, mass, vertices, a) for a in "xyz"]))
    has_child = np.isin(np.arange(len(joints)), parents)
    leaves = joints[~has_child].mean(axis=0)
    rise = leaves - joints[parents < 0].mean(axis=0)
    rise += (centre - joints.mean(axis=0)) / 4
    reach = leaves - centre
    axes = [axis for axis in range(3) if axis != lateral]
    best, choice = -np.inf, None
    for up, forward in (axes, axes[::-1]):
        for up_sign in (1, -1):
            for forward_sign in (1, -1):
                fit = up_sign * rise[up] + forward_sign * reach[forward]
                if fit > best + 1e-9 * scale:
                    best, choice = fit, (up, up_sign, forward, forward_sign)
    up, up_sign, forward, forward_sign = choice
    rows = np.zeros((3, 3))
    rows[1, up], rows[2, forward] = up_sign, forward_sign
    rows[0] = np.cross(rows[1], rows[2])
    return Frame(rows, centre, float(scale))


def _mirror_misfit(joints, mass, vertices, axis) -> float:
    """How far the bones lie from their own mirror image, relative to their spread."""
    axis = "xyz".index(axis)
    spread = np.ptp(joints, axis=0).max()
    if len(joints) < 3 or spread == 0:
        # Too few bones to tell: a head is narrower from ear to ear than the rest.
        offset = vertices[:, axis] - mass @ vertices[:, axis]
        return float(np.sqrt(mass @ offset**2))
    mirrored = joints.copy()
    plane = np.median(joints[:, axis])
    mirrored[:, axis] = 2 * plane - mirrored[:, axis]
    distance, _ = cKDTree(joints).query(mirrored)
    return float(distance.mean() / spread)
