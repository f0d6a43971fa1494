"""The same head with another topology, its weights carried along the surface.

Anny heads share one mesh, and artists reuse base meshes: a network that sees a mesh
twice can learn to count vertices. These four give a head another mesh. Where vertices
move, each new vertex remembers which patch of the old surface it stands for and takes
its weights from the closest point of that patch. Nothing can bleed from an upper lip to
a lower one, or from a lid to the eye below it, however close they lie in space.

Every function takes a head and a random generator or a seed, returns a new `Head` with
vertices and faces in random order, and keeps skeleton and name. Memory and time are
linear in V, up to a logarithm.
"""

from collections.abc import Callable

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree
from trimesh.remesh import subdivide as midpoint_subdivide
from trimesh.triangles import closest_point, points_to_barycentric

from skinlib.geometry import (
    face_normals,
    islands,
    mesh_edges,
    safe_normalize,
    vertex_areas,
    weld,
)
from skinlib.head import Head, HeadError

SEAM_COSINE = 0.5  # seam vertices have normals less than 60 degrees apart; lips more
SEAM_WEIGHTS = 0.1  # and weights no further apart than this, in row-L1
LARGEST = 8000  # vertices that `another_mesh` makes
ISLAND_CELLS = 12  # a small island keeps at least so many vertices
_TINY = 1e-30  # keeps what has no area or no length from dividing by zero


def shuffle(head: Head, rng: np.random.Generator | int = 0) -> Head:
    """The same mesh with vertices, faces and the corners of faces in another order."""
    rng = np.random.default_rng(rng)
    order = rng.permutation(len(head.vertices))
    place = np.argsort(order)
    faces = place[head.faces][rng.permutation(len(head.faces))]
    turn = rng.integers(0, 3, (len(faces), 1))
    faces = np.take_along_axis(faces, (np.arange(3) + turn) % 3, axis=1)
    weights = None if head.weights is None else head.weights[order]
    return head.replace(
        vertices=head.vertices[order],
        faces=faces,
        normals=head.normals[order],
        weights=weights,
    )


def subdivide(head: Head, rng: np.random.Generator | int = 0) -> Head:
    """Four triangles for each: a vertex on every edge, weights the mean of its ends."""
    return shuffle(_midpoints(head), rng)


def halve(head: Head, rng: np.random.Generator | int = 0, keep: float = 0.5) -> Head:
    """A share `keep` of the triangles, by quadric edge collapse.

    A mesh of a few triangles, of which nothing would be left, stays as it is.

    Raises:
        HeadError: no faces, or `fast_simplification` is not installed.
    """
    try:
        from fast_simplification import replay_simplification, simplify
    except ImportError as error:
        raise HeadError(
            "remeshing",
            "the package fast-simplification is not installed",
            "run `pip install fast-simplification`",
        ) from error
    rng = np.random.default_rng(rng)
    # Equal costs are collapsed in the order of the faces: shuffled, seeds differ.
    source = shuffle(_without_seams(head), rng)
    vertices = np.array(source.vertices)
    faces = source.faces.astype(np.int32)
    _, _, collapses = simplify(vertices, faces, 1 - keep, return_collapses=True)
    vertices, faces, patch = replay_simplification(vertices, faces, collapses)
    if len(faces) == 0:
        return source
    return shuffle(_carried(source, vertices, faces, patch), rng)


def isotropic(
    head: Head, rng: np.random.Generator | int = 0, vertices: int | None = None
) -> Head:
    """About `vertices` (default: as many as before) spread evenly over the surface.

    Geodesic Voronoi cells on a finer mesh, relaxed by Lloyd's iteration; the dual of
    the cells is the new mesh (Valette and Chassery 2004, with distances along edges).
    Small islands get at least 12 vertices each.

    Raises:
        HeadError: no faces.
    """
    rng = np.random.default_rng(rng)
    source = _without_seams(head)
    count = vertices or len(source.vertices)
    while len(source.vertices) < 8 * count:
        source = _midpoints(source)
    cell = _voronoi_cells(source, count, rng)

    # A cell on an open border is centred on its part of the border, which then stays.
    share = vertex_areas(source.vertices, source.faces) + _TINY
    border = _border(source.faces)
    share[np.isin(cell, cell[border])] *= _TINY
    share[border] = 1
    faces = cell[source.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    centres = _means(source.vertices, share, cell)
    return shuffle(_carried(source, centres, faces, cell), rng)


def another_mesh(head: Head, rng: np.random.Generator) -> Head:
    """One of `halve` and `isotropic`, at random, with a random number of vertices.

    A head without faces has no other mesh and comes back as it is.
    """
    if len(head.faces) == 0:
        return head
    if rng.random() < 0.5:
        return halve(head, rng, keep=rng.uniform(0.25, 0.9))
    count = len(head.vertices) * np.exp(rng.uniform(*np.log([0.4, 2])))
    return isotropic(head, rng, vertices=round(min(count, LARGEST)))


def coarsen(head: Head, vertices: int) -> tuple[Head, csr_matrix]:
    """The head with about `vertices` vertices, evenly spread, and the way back.

    What is computed on the coarse head comes back by interpolation on its triangles.
    A vertex reads only triangles around the geodesic Voronoi cell that it lies in: not
    those of the other lip, however close.

    Returns:
        The coarse head, without weights, W vertices; (V, W) matrix, rows sum to 1,
        that takes values at its vertices to the vertices of `head`.

    Raises:
        HeadError: no faces.
    """
    source, copy_of = _closed_seams(head)
    vertices = min(vertices, len(source.vertices))
    cell = _voronoi_cells(source, vertices, np.random.default_rng(0), iterations=2)
    corners = cell[source.faces]
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    _, once = np.unique(np.sort(corners, axis=1), axis=0, return_index=True)
    coarse = Head.create(
        _means(
            source.vertices, vertex_areas(source.vertices, source.faces) + _TINY, cell
        ),
        corners[once],
        head.skeleton,
        name=head.name,
    )

    count = len(coarse.vertices)
    corner = np.argsort(coarse.faces, axis=None, kind="stable")
    uses = np.bincount(coarse.faces.ravel(), minlength=count)
    # For each vertex, the triangles around its cell, one after the other.
    repeats = uses[cell]
    vertex = np.repeat(np.arange(len(cell)), repeats)
    place = np.arange(len(vertex)) - np.repeat(np.cumsum(repeats) - repeats, repeats)
    face = corner[(np.cumsum(uses) - uses)[cell[vertex]] + place] // 3
    found, face, share = _nearest_face(coarse, source.vertices, vertex, face)
    # A cell without triangles, in a thin strip, speaks for itself.
    alone = np.flatnonzero(repeats == 0)
    rows = np.concatenate([np.repeat(found, 3), alone])
    columns = np.concatenate([coarse.faces[face].ravel(), cell[alone]])
    values = np.concatenate([share.ravel(), np.ones(len(alone))])
    back = csr_matrix((values, (rows, columns)), (len(cell), count), np.float32)
    return coarse, back[copy_of]


def transfer_weights(
    source: Head, points: np.ndarray, normals: np.ndarray, max_angle: float = 75.0
) -> np.ndarray:
    """Weights (N, J) for any points, from the closest compatible surface of `source`.

    The closest point of each triangle nearby is a candidate; one whose triangle faces
    more than `max_angle` degrees away from the point's normal counts only when nothing
    else is near, so that a lip does not copy the other lip.

    Args:
        points: (N, 3), in the frame of `source`. normals: (N, 3), unit.

    Raises:
        HeadError: `source` has no weights or no faces.
    """
    _needs_faces(source)
    if source.weights is None:
        raise HeadError("weights", "there are none", "transfer from a labelled head")
    points = np.asarray(points, np.float64)
    near = min(32, len(source.faces))
    centres = source.vertices[source.faces].mean(axis=1, dtype=np.float64)
    _, found = cKDTree(centres).query(points, near)
    point = np.repeat(np.arange(len(points)), near)
    face = found.reshape(-1)
    facing = safe_normalize(face_normals(source.vertices, source.faces))[face]
    cosine = (facing * np.asarray(normals)[point]).sum(axis=1)
    turned = cosine < np.cos(np.radians(max_angle))
    _, _, weights = _closest(source, points, point, face, penalty=turned)
    return weights


REMESHERS: dict[str, Callable[..., Head]] = {
    "halved": halve,
    "subdivided": subdivide,
    "isotropic": isotropic,
    "shuffled": shuffle,
}


def _carried(source: Head, vertices, faces, patch) -> Head:
    """A head on a new mesh; old vertex i of `source` belongs to new vertex patch[i]."""
    member = patch[source.faces]  # (F, 3)
    face, corner = np.nonzero(member >= 0)
    point = member[face, corner]
    nearest, points, weights = _closest(source, vertices, point, face)

    faces = faces[np.isin(faces, nearest).all(axis=1)]
    _, once = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    used, faces = np.unique(faces[once], return_inverse=True)
    rows = np.searchsorted(nearest, used)
    return source.replace(
        vertices=points[rows],
        faces=faces.reshape(-1, 3),
        weights=None if weights is None else weights[rows],
    )


def _closest(source: Head, points, point, face, penalty=None):
    """Of the candidate pairs (point[i], face[i]), the closest one for each point.

    Returns the ids of points with a candidate, sorted, their closest surface points
    and the weights interpolated there.
    """
    point, face, share = _nearest_face(source, points, point, face, penalty)
    corners = source.faces[face]  # (N, 3)
    closest = np.einsum("nc,ncx->nx", share, source.vertices[corners])
    if source.weights is None:
        return point, closest, None
    return point, closest, np.einsum("nc,ncj->nj", share, source.weights[corners])


def _nearest_face(source: Head, points, point, face, penalty=None):
    """Of the candidate pairs (point[i], face[i]), the closest one for each point.

    Returns the ids of points with a candidate, sorted, their faces, and the barycentric
    coordinates (N, 3) of the closest point there.
    """
    triangles = source.vertices[source.faces[face]].astype(np.float64)
    closest = closest_point(triangles, points[point])
    distance = ((closest - points[point]) ** 2).sum(axis=1)
    keys = (distance, point) if penalty is None else (distance, penalty, point)
    order = np.lexsort(keys)
    point, first = np.unique(point[order], return_index=True)
    best = order[first]
    # A triangle without area has no such coordinates: take its first corner.
    with np.errstate(invalid="ignore", divide="ignore"):
        share = points_to_barycentric(triangles[best], closest[best], method="cross")
    share = np.where(np.isfinite(share).all(axis=1, keepdims=True), share, [1, 0, 0])
    share = np.clip(share, 0, None)
    return point, face[best], share / share.sum(axis=1, keepdims=True)


def _midpoints(head: Head) -> Head:
    values = [head.normals] if head.weights is None else [head.normals, head.weights]
    vertices, faces, attributes = midpoint_subdivide(
        head.vertices,
        head.faces,
        vertex_attributes={"values": np.concatenate(values, axis=1)},
    )
    values = attributes["values"]
    return head.replace(
        vertices=vertices,
        faces=faces,
        normals=safe_normalize(values[:, :3]),
        weights=None if head.weights is None else values[:, 3:],
    )


def _without_seams(head: Head) -> Head:
    return _closed_seams(head)[0]


def _closed_seams(head: Head) -> tuple[Head, np.ndarray]:
    """Close seams: the same position twice, with like normals and like weights.

    Lips that touch share positions too, but their normals oppose each other. Returns
    the closed head and (V,), which of its vertices each vertex has become.
    """
    place = weld(head.vertices)
    order = np.argsort(place, kind="stable")
    a, b = order[:-1], order[1:]  # neighbours in the sorted list cover each group
    same = (place[a] == place[b]) & (
        (head.normals[a] * head.normals[b]).sum(axis=1) > SEAM_COSINE
    )
    if head.weights is not None:
        same &= np.abs(head.weights[a] - head.weights[b]).sum(axis=1) < SEAM_WEIGHTS
    count = len(head.vertices)
    pairs = coo_matrix((np.ones(same.sum()), (a[same], b[same])), shape=(count, count))
    _, ids = connected_components(pairs, directed=False)
    _, first = np.unique(ids, return_index=True)
    faces = ids[head.faces]
    x, y, z = faces.T
    closed = head.replace(
        vertices=head.vertices[first],
        faces=faces[(x != y) & (y != z) & (z != x)],
        weights=None if head.weights is None else head.weights[first],
    )
    _needs_faces(closed)
    return closed, ids


def _voronoi_cells(head: Head, count: int, rng, iterations: int = 6) -> np.ndarray:
    """(V,) cell of each vertex: the nearest of `count` evenly spread seeds."""
    vertices = head.vertices.astype(np.float64)
    edges = mesh_edges(head.faces)
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    size = len(vertices)
    graph = coo_matrix((lengths + _TINY, tuple(edges.T)), (size, size)).tocsr()
    area = vertex_areas(vertices, head.faces) + _TINY
    seeds = rng.choice(size, count, replace=False, p=area / area.sum())
    # An island without seeds would disappear: give each a few more, at random.
    order = rng.permutation(size)
    island = islands(head.faces, size)[order]
    order = order[np.argsort(island, kind="stable")]
    island = np.sort(island)
    rank = np.arange(size) - np.searchsorted(island, island)
    seeds = np.union1d(seeds, order[rank < ISLAND_CELLS])
    for _ in range(iterations):
        nearest = dijkstra(graph, False, seeds, return_predecessors=True, min_only=True)
        _, cell = np.unique(nearest[2], return_inverse=True)
        offset = ((vertices - _means(vertices, area, cell)[cell]) ** 2).sum(axis=1)
        order = np.lexsort((offset, cell))
        _, first = np.unique(cell[order], return_index=True)
        seeds = order[first]
    return cell


def _means(points: np.ndarray, share: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """(C, 3): for each cell the mean of its points, weighted by `share`."""
    sums = np.stack([np.bincount(cell, share * x) for x in points.T], axis=1)
    return sums / np.bincount(cell, share)[:, None]


def _border(faces: np.ndarray) -> np.ndarray:
    """Ids of the vertices on edges that only one triangle has."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    edges, count = np.unique(sides, axis=0, return_counts=True)
    return np.unique(edges[count == 1])


def _needs_faces(head: Head) -> None:
    if len(head.faces) == 0:
        raise HeadError(
            "faces", "there are none that span an area", "give a head with a surface"
        )
