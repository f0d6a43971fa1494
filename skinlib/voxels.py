"""A head as a solid on a grid of voxels, and the shortest ways through it.

Heads are open at the neck and made of pieces that overlap, so no flood from outside
tells what is inside. The solid is what the surface winds around more than half, the
generalised winding number (Jacobson, Kavan and Sorkine-Hornung 2013): it closes holes
by itself, takes pieces together and does not ask which way a mesh faces. To this come
the voxels that the surface itself passes through.
"""

from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components, dijkstra, minimum_spanning_tree

from skinlib.head import Head, HeadError

# Half of the 26 neighbours of a voxel: each pair of voxels is met once.
NEIGHBOURS = [step for step in product((-1, 0, 1), repeat=3) if step > (0, 0, 0)]


@dataclass(frozen=True, eq=False)
class Solid:
    """Cubic voxels, counted from the centre of voxel (0, 0, 0).

    Attributes:
        filled: (X, Y, Z) bool, which voxels are solid; none at the border is.
        origin: (3,) the centre of voxel (0, 0, 0), in file units.
        size: the side of a voxel, in file units.
    """

    filled: np.ndarray
    origin: np.ndarray
    size: float

    def to_grid(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) float64: file coordinates as voxel coordinates."""
        return (np.asarray(points, np.float64) - self.origin) / self.size

    def contains(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: whether points, in voxel coordinates, lie in a solid voxel."""
        top = np.array(self.filled.shape) - 1
        return self.filled[tuple(np.clip(np.rint(points), 0, top).astype(np.int64).T)]


def solid_voxels(head: Head, resolution: int = 64) -> Solid:
    """The voxels inside a head, on its surface, or around one of its vertices.

    Voxels on the surface are those whose centre is within half a side of it: no row of
    voxels passes through a wall without meeting one.

    Args:
        resolution: voxels along the longest side of the bounding box, at least 1.

    Raises:
        HeadError: `resolution` is less than 1.
    """
    if resolution < 1:
        raise HeadError("resolution", str(resolution), "use at least 1 voxel")
    vertices = head.vertices.astype(np.float64)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = float((high - low).max()) / resolution or 1.0
    shape = np.ceil((high - low) / size - 1e-6).astype(np.int64) + 3
    # Centred on the box: a symmetric head has a symmetric solid.
    origin = (low + high) / 2 - (shape - 1) / 2 * size

    points = (vertices - origin) / size
    filled = np.zeros(shape, bool)
    filled[tuple(np.rint(points).astype(np.int64).T)] = True
    if len(head.faces):
        import igl  # here, since it takes long to load

        centres = np.argwhere(~filled).astype(np.float64)
        squared, _, _ = igl.point_mesh_squared_distance(centres, points, head.faces)
        inside = squared <= 0.25 * (1 + 1e-6)
        rest = np.flatnonzero(~inside)
        winding = igl.fast_winding_number(points, head.faces, centres[rest])
        inside[rest] = np.abs(winding) > 0.5
        filled[~filled] = inside
    return Solid(np.pad(filled[1:-1, 1:-1, 1:-1], 1), origin, size)


def voxel_bone_distances(head: Head, resolution: int = 64) -> np.ndarray:
    """Length of the shortest way through the solid from each vertex to each bone.

    The geodesic voxel distance of Dionne and de Lasa (2013), in J runs of Dijkstra's
    algorithm over voxels and their 26 neighbours. Such ways are up to 13 % too long
    across the grid, so what sees a bone along a straight line takes that line's length
    and ways around corners begin there. A bone outside the solid is joined to what it
    sees from there: its line enters the solid once. Pieces that do not touch are joined
    by the shortest straight bridges between them, so that every distance is finite.

    Args:
        head: V vertices, J bones; open, in pieces or without faces, in any unit.
        resolution: voxels along the longest side of the bounding box.

    Returns:
        (V, J) float64 in file units, never less than the straight line. Around a
        corner a way may be 13 % too long from there on, or cut it by half a voxel.

    Raises:
        HeadError: `resolution` is less than 1.
    """
    solid = solid_voxels(head, resolution)
    voxels = np.argwhere(solid.filled)
    vertices = solid.to_grid(head.vertices)
    nodes = np.concatenate([voxels, vertices])
    graph = _graph(solid.filled, voxels, vertices)
    clearance = _clearance(solid.filled)
    bones = head.skeleton
    heads, tails = solid.to_grid(bones.joints), solid.to_grid(bones.tails)
    distances = np.zeros((len(vertices), len(bones)))
    for bone in range(len(bones)):
        nearest = _nearest_on_segment(nodes, heads[bone], tails[bone])
        straight = np.linalg.norm(nearest - nodes, axis=1)
        seen = _enters_once(clearance, nodes, nearest, straight)
        lengths = _around_corners(graph, straight, seen)
        distances[:, bone] = lengths[len(voxels) :]
    return distances * solid.size


def _graph(filled, voxels, vertices) -> sparse.csr_matrix:
    """Voxels, then vertices, as nodes; edge lengths in voxels."""
    number = np.full(filled.shape, -1)
    number[tuple(voxels.T)] = np.arange(len(voxels))
    edges = np.concatenate([_edges(number, step) for step in NEIGHBOURS])
    lengths = _apart(voxels, edges)

    bridges = _bridges(filled, number, edges, voxels)
    gaps = _apart(voxels, bridges)
    # A vertex is joined to the solid ones of the eight voxels around it, which are all
    # neighbours of each other: no new way opens through it.
    corner = np.floor(vertices).astype(np.int64)
    links, reaches = [], []
    for step in product((0, 1), repeat=3):
        around = number[tuple((corner + step).T)]
        vertex = np.flatnonzero(around >= 0)
        links.append(np.stack([len(voxels) + vertex, around[vertex]], axis=1))
        reaches.append(np.linalg.norm((corner + step - vertices)[vertex], axis=1))
    edges = np.concatenate([edges, bridges, *links])
    lengths = np.concatenate([lengths, gaps, *reaches])
    count = len(voxels) + len(vertices)
    # For scipy an edge of length 0 is none.
    matrix = sparse.coo_matrix(
        (np.maximum(lengths, 1e-9), tuple(edges.T)), shape=(count, count)
    )
    return (matrix + matrix.T).tocsr()


def _apart(points, pairs) -> np.ndarray:
    """(E,) distances between the points of each pair."""
    return np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)


def _edges(number, step) -> np.ndarray:
    """(E, 2) pairs of numbers >= 0 that lie one `step` apart on the grid."""
    sides = list(zip(step, number.shape, strict=True))
    a = number[tuple(slice(max(0, -s), n - max(0, s)) for s, n in sides)].ravel()
    b = number[tuple(slice(max(0, s), n + min(0, s)) for s, n in sides)].ravel()
    both = (a >= 0) & (b >= 0)
    return np.stack([a[both], b[both]], axis=1)


def _bridges(filled, number, edges, voxels) -> np.ndarray:
    """(B, 2) the fewest and shortest pairs of voxels that join all pieces.

    The empty voxels are given to the solid voxel nearest to them. Where the cells so
    made of two pieces meet, a bridge may stand; a minimum spanning tree chooses.
    """
    count, piece = connected_components(
        sparse.coo_matrix(
            (np.ones(len(edges)), tuple(edges.T)), shape=(len(voxels), len(voxels))
        ),
        directed=False,
    )
    if count == 1:
        return np.zeros((0, 2), np.int64)
    nearest = ndimage.distance_transform_edt(
        ~filled, return_distances=False, return_indices=True
    )
    cell = number[tuple(nearest)]
    pairs = np.concatenate([_edges(cell, step) for step in np.eye(3, dtype=int)])
    between = np.sort(piece[pairs], axis=1)
    apart = between[:, 0] != between[:, 1]
    pairs, between = pairs[apart], between[apart]
    lengths = _apart(voxels, pairs)
    order = np.argsort(lengths, kind="stable")
    _, first = np.unique(between[order] @ [count, 1], return_index=True)
    best = order[first]  # the shortest of each two pieces
    tree = minimum_spanning_tree(
        sparse.coo_matrix((lengths[best], tuple(between[best].T)), (count, count))
    ).tocoo()
    chosen = np.isin(between[best] @ [count, 1], tree.row * count + tree.col)
    return pairs[best][chosen]


def _clearance(filled) -> np.ndarray:
    """(X, Y, Z) how far a line may go from a voxel and meet none of the other kind.

    Positive in the solid, negative outside; at least 1 long.
    """
    to_other = ndimage.distance_transform_edt(filled)
    to_other += ndimage.distance_transform_edt(~filled)
    # Both ends may be off their voxel's centre, by half a diagonal each.
    far = np.maximum(to_other - np.sqrt(3), 1)
    return np.where(filled, far, -far).astype(np.float32)


def _enters_once(clearance, starts, ends, lengths) -> np.ndarray:
    """(N,) bool: which lines, from the solid, do not come back once they have left it.

    They are walked in steps as long as `clearance` allows.
    """
    rise = (ends - starts) / np.maximum(lengths, 1e-9)[:, None]
    # At the border of the grid a line is outside for good.
    border = np.where(rise > 0, np.array(clearance.shape) - 1, 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        leaves = np.where(rise == 0, np.inf, (border - starts) / rise).min(axis=1)
    stops = np.minimum(lengths, leaves).astype(np.float32)
    rise, rounded = rise.astype(np.float32), (starts + 0.5).astype(np.float32)

    field, (_, height, depth) = clearance.ravel(), clearance.shape
    seen, outside = np.ones(len(starts), bool), np.zeros(len(starts), bool)
    line, along = np.arange(len(starts)), np.zeros(len(starts), np.float32)
    while len(line):
        x, y, z = (rounded[line] + along[:, None] * rise[line]).astype(np.int64).T
        free = field[(x * height + y) * depth + z]
        back = (free > 0) & outside[line]
        seen[line[back]] = False
        outside[line] = free <= 0
        stop = stops[line]
        on = ~back & (along < stop)
        along = np.minimum(along + np.abs(free), stop)[on]
        line = line[on]
    return seen


def _nearest_on_segment(points, head, tail) -> np.ndarray:
    """(N, 3) the point of a segment that is nearest to each of N points."""
    axis = tail - head
    along = (points - head) @ axis / max(axis @ axis, 1e-18)
    return head + np.clip(along, 0, 1)[:, None] * axis


def _around_corners(graph, straight, seen) -> np.ndarray:
    """(N,) lengths of the shortest ways: straight where `seen`, else along the graph.

    Nothing is shorter than a straight line, so Dijkstra's algorithm runs over the
    nodes that are not seen, from one source that is joined to what they border on.
    """
    lengths, hidden = straight.copy(), np.flatnonzero(~seen)
    if len(hidden) == 0:
        return lengths
    rows = graph[hidden]
    ways = rows.data + np.where(seen, straight, np.inf)[rows.indices]
    first = np.minimum.reduceat(ways, rows.indptr[:-1])  # each node has a neighbour
    border = np.flatnonzero(np.isfinite(first))
    count = len(hidden)
    # One more voxel, taken off below: for scipy an edge of length 0 is none.
    entry = sparse.csr_matrix(
        (first[border] + 1, (np.zeros(len(border), np.int64), border)), (1, count)
    )
    whole = sparse.vstack([rows[:, hidden], entry]).tocsr()
    whole.resize((count + 1, count + 1))
    lengths[hidden] = dijkstra(whole, indices=count)[:count] - 1
    return lengths
