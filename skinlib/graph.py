"""The hybrid graph a mesh encoder runs on: mesh edges, and neighbours in space.

Space alone is not to be trusted: closed lips touch, and a lid lies on its eye. So a
neighbour in space becomes an edge only when the surface agrees that it is near.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from skinlib.geometry import (
    face_normals,
    islands,
    mesh_edges,
    row_dot,
    safe_normalize,
    vertex_areas,
    weld,
)
from skinlib.head import Head

MESH, SPACE = 0, 1
FOLD = -0.8  # least agreement of two flat normals across a cut


@dataclass(frozen=True)
class GraphConfig:
    """How the hybrid graph is built."""

    neighbours: int = 12  # edges a node keeps, mesh edges first; K
    nearest: int = 8  # how many neighbours in space are candidates
    min_cosine: float = 0.5  # least agreement of the two normals
    max_detour: float = 1.6  # longest surface path, as a multiple of the straight line


@dataclass(frozen=True, eq=False)
class HybridGraph:
    """A graph over N nodes; a node is a vertex, or several that a seam cut apart.

    Attributes:
        node_of_vertex: (V,) int64, the node of each vertex.
        vertex_of_node: (N,) int64, one vertex of each node.
        neighbours: (N, K) int64, nodes; an unused place repeats the first neighbour,
            or the node itself when it has none, so a maximum over K needs no mask.
        kinds: (N, K) int8, MESH or SPACE; -1 in an unused place.
        island: (N,) int64, the connected piece of surface each node lies on.
        edges: (E, 2) int64, mesh edges between nodes.
    """

    node_of_vertex: np.ndarray
    vertex_of_node: np.ndarray
    neighbours: np.ndarray
    kinds: np.ndarray
    island: np.ndarray
    edges: np.ndarray

    def __len__(self) -> int:
        return len(self.vertex_of_node)

    def vertex_edges(self, kind: int | None = None) -> np.ndarray:
        """(E, 2) vertex ids of the graph's edges, all or of one kind, for drawing."""
        used = self.kinds >= 0 if kind is None else self.kinds == kind
        row, place = np.nonzero(used)
        pairs = np.stack([row, self.neighbours[row, place]], axis=1)
        return self.vertex_of_node[np.unique(np.sort(pairs, axis=1), axis=0)]


def seam_nodes(head: Head) -> np.ndarray:
    """(V,) int64: vertices that a seam cut apart share a node, 0 .. N-1.

    Two vertices are one when they lie at the same position, both on an open border,
    and their normals agree, or just two open edges lie there. Closed lips lie at the
    same position too, but they are no border, or they face each other.
    """
    position = weld(head.vertices)
    if position.max(initial=-1) + 1 == len(position):
        return position
    edges = np.sort(head.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    unique, uses = np.unique(edges, axis=0, return_counts=True)
    border = np.zeros(len(position), bool)
    border[unique[uses == 1]] = True
    border[np.bincount(head.faces.ravel(), minlength=len(position)) == 0] = True

    # Chain the vertices of one position in order; join neighbours in the chain.
    order = np.argsort(position, kind="stable")
    joins = [_sewn(head, position, border)]
    for reach in (1, 2, 3):
        a, b = order[:-reach], order[reach:]
        same = (position[a] == position[b]) & border[a] & border[b]
        facing = (head.normals[a] * head.normals[b]).sum(axis=1) > 0
        joins.append(np.stack([a, b], axis=1)[same & facing])
    joins = np.concatenate(joins)
    count = len(position)
    links = coo_matrix((np.ones(len(joins)), tuple(joins.T)), shape=(count, count))
    return connected_components(links, directed=False)[1].astype(np.int64)


def _sewn(head: Head, position: np.ndarray, border: np.ndarray) -> np.ndarray:
    """(M, 2) vertices to join where two open edges lie on each other, head to tail.

    Just two, as of a cut, however sharp the crease; four edges may be two lips. Cards
    painted on both sides fold back onto themselves and stay apart.

    Args:
        border: (V,) bool, vertices on open edges.
    """
    sides = head.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    face = np.repeat(np.arange(len(head.faces)), 3)
    open_, face = (part[border[sides].all(axis=1)] for part in (sides, face))
    open_, face = (part[_shared_by(open_, 1)] for part in (open_, face))
    ends = position[open_]
    pairs = np.flatnonzero(_shared_by(ends, 2))
    # The two of a pair come one after the other.
    one, other = pairs[np.argsort(_keys(ends[pairs]), kind="stable")].reshape(-1, 2).T
    flat = safe_normalize(face_normals(head.vertices, head.faces))
    opposed = (ends[one] == ends[other][:, ::-1]).all(axis=1)
    opposed &= row_dot(flat[face[one]], flat[face[other]]) > FOLD
    one, other = open_[one[opposed]], open_[other[opposed]]
    return np.stack([one.ravel(), other[:, ::-1].ravel()], axis=1)


def _keys(edges: np.ndarray) -> np.ndarray:
    """(E,) a number for each edge, whatever its direction."""
    return edges.min(axis=1) * (edges.max(initial=0) + 1) + edges.max(axis=1)


def _shared_by(edges: np.ndarray, count: int) -> np.ndarray:
    """(E,) bool: edges that are there just so many times, in any direction."""
    _, place, uses = np.unique(_keys(edges), return_inverse=True, return_counts=True)
    return uses[place] == count


def build_graph(
    head: Head, config: GraphConfig | None = None, threads: int = 1
) -> HybridGraph:
    """The hybrid graph of a head: O(V) time and memory.

    Mesh edges come first, shortest first; the places left are filled with neighbours
    in space, nearest first, that pass three gates: the same island, normals that agree,
    and a path of at most two mesh edges not much longer than the straight line.

    Args:
        threads: how many look for the neighbours in space; the graph is the same.

    >>> from skinlib.head import Skeleton
    >>> bone = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["head"])
    >>> square = Head.create([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]],
    ...                      [[0, 1, 2], [0, 2, 3]], bone)
    >>> graph = build_graph(square)
    >>> graph.vertex_edges(MESH).tolist()
    [[0, 1], [0, 2], [0, 3], [1, 2], [2, 3]]
    >>> graph.vertex_edges(SPACE).tolist()
    [[1, 3]]
    """
    config = config or GraphConfig()
    node_of_vertex = seam_nodes(head)
    count = int(node_of_vertex.max()) + 1
    vertex_of_node = np.full(count, -1)
    vertex_of_node[node_of_vertex[::-1]] = np.arange(len(node_of_vertex))[::-1]
    positions = head.vertices[vertex_of_node].astype(np.float64)
    faces = node_of_vertex[head.faces]
    edges = mesh_edges(faces)
    areas = vertex_areas(head.vertices, head.faces)
    normals = node_normals(head.normals, node_of_vertex, count, areas)
    island = islands(faces, count)

    mesh, length = _mesh_table(positions, edges, config.neighbours)
    straight, candidate = _nearest(positions, config.nearest, threads)
    passed = _gates(straight, candidate, normals, island, mesh, length, config)
    table, kinds = _append(mesh, np.isfinite(length), candidate, passed)
    return HybridGraph(node_of_vertex, vertex_of_node, table, kinds, island, edges)


def node_normals(normals, node_of_vertex, count, areas) -> np.ndarray:
    """(N, 3) float64 unit normals of nodes: the mean over a node's vertices.

    It is weighted by their (V,) areas, so that flat triangles with vertices of their
    own have the normals of the mesh that they make up.
    """
    areas = np.maximum(areas, 1e-12 * areas.max(initial=1e-300))
    weighted = normals * areas[:, None]
    summed = [np.bincount(node_of_vertex, axis, count) for axis in weighted.T]
    return safe_normalize(np.stack(summed, axis=1), fallback=(0, 0, 1))


def node_areas(head: Head, node_of_vertex: np.ndarray, count: int) -> np.ndarray:
    """(N,) float64 surface area of nodes."""
    return np.bincount(node_of_vertex, vertex_areas(head.vertices, head.faces), count)


def _mesh_table(positions, edges, width):
    """(N, K) mesh neighbours, shortest first, and (N, K) lengths, inf when unused."""
    count = len(positions)
    a, b = edges.T
    step = positions.take(a, axis=0) - positions.take(b, axis=0)
    length = np.sqrt(row_dot(step, step))
    # Edges come in the order of their ends, which stays where lengths are equal.
    shortest = np.argsort(length, kind="stable")
    ranked = edges.take(shortest, axis=0)
    # By node, then by length: one number holds both, and numbers are fast to sort.
    key = np.sort((ranked * len(edges) + np.arange(len(edges))[:, None]).ravel())
    row, rank = np.divmod(key, max(1, len(edges)))
    degree = np.bincount(row, minlength=count)
    place = np.arange(len(row)) - np.repeat(np.cumsum(degree) - degree, degree)
    kept = place < width
    row, rank, place = row[kept], rank[kept], place[kept]
    neighbours = np.repeat(np.arange(count)[:, None], width, axis=1)
    lengths = np.full((count, width), np.inf)
    neighbours[row, place] = (a + b)[shortest][rank] - row  # the other end
    lengths[row, place] = length[shortest][rank]
    return neighbours, lengths


def _nearest(positions, nearest, threads):
    """(N, nearest + 1) distances, increasing, and nodes; those not to use at inf."""
    width = min(nearest + 2, len(positions))
    tree = cKDTree(positions)
    straight, candidate = tree.query(positions, k=np.arange(width) + 1, workers=threads)
    # Of neighbours equally far away take all or none, or the order of vertices decides.
    if width == nearest + 2:
        straight[straight >= straight[:, -1:] * (1 - 1e-6)] = np.inf
    return straight, candidate


def _gates(straight, candidate, normals, island, mesh, length, config, chunk=2048):
    """(N, nearest) bool: which candidates become edges."""
    passed = np.isfinite(straight) & (candidate != np.arange(len(candidate))[:, None])
    passed &= island[candidate] == island[:, None]
    for neighbour in mesh.T:
        passed &= candidate != neighbour[:, None]
    rows, places = np.nonzero(passed)
    goal = candidate[rows, places]
    cosine = row_dot(normals.take(goal, axis=0), normals.take(rows, axis=0))

    # The shortest path of two mesh edges: meet at a common neighbour.
    shortest, width = np.full(len(rows), np.inf), mesh.shape[1]
    mesh = mesh.astype(np.int32)  # half the bytes to compare
    for start in range(0, len(rows), chunk):
        part = slice(start, start + chunk)
        here, there = mesh.take(rows[part], axis=0), mesh.take(goal[part], axis=0)
        meet = here[:, :, None] == there[:, None, :]  # (P, K, K)
        pair, place = np.divmod(np.flatnonzero(meet), width**2)
        out, back = np.divmod(place, width)
        pair += start
        path = length[rows[pair], out] + length[goal[pair], back]
        np.minimum.at(shortest, pair, path)
    near = shortest <= config.max_detour * straight[rows, places]
    passed[rows, places] = near & (cosine >= config.min_cosine)
    return passed


def _append(mesh, used, candidate, passed):
    """(N, K) neighbours and kinds: of the mesh, then those that passed, then filling.

    The used places of `mesh` come first in a row.
    """
    count, width = mesh.shape
    number = used.sum(axis=1)
    place = number[:, None] + np.cumsum(passed, axis=1) - 1
    row, which = np.nonzero(passed & (place < width))
    place = place[row, which]
    kinds = np.where(used, MESH, -1).astype(np.int8)
    kinds[row, place] = SPACE
    table = mesh.copy()
    table[row, place] = candidate[row, which]
    first = np.where(kinds[:, 0] >= 0, table[:, 0], np.arange(count))
    return np.where(kinds >= 0, table, first[:, None]), kinds
