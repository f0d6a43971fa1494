"""The hybrid graph: what is connected, and above all what is not."""

import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from shapes import axis_rotations, bumpy, moved, skeleton, sphere, unwelded

from skinlib import Head
from skinlib.datasets.synthetic import HeadShape, synthetic_head_and_regions
from skinlib.geometry import mesh_edges, vertex_areas
from skinlib.graph import (
    MESH,
    SPACE,
    GraphConfig,
    build_graph,
    node_areas,
    node_normals,
    seam_nodes,
)

BONES = skeleton(3)


def edge_set(graph, kind=None) -> set[tuple[int, int]]:
    """Edges as pairs of vertex ids."""
    return {tuple(sorted(pair)) for pair in graph.vertex_edges(kind).tolist()}


def check(graph, vertex_count: int, config: GraphConfig | None = None) -> None:
    """What holds for every graph."""
    config = config or GraphConfig()
    count = len(graph)
    assert graph.node_of_vertex.shape == (vertex_count,)
    assert sorted(set(graph.node_of_vertex.tolist())) == list(range(count))
    assert (graph.node_of_vertex[graph.vertex_of_node] == np.arange(count)).all()
    assert graph.neighbours.shape == graph.kinds.shape == (count, config.neighbours)
    assert graph.neighbours.min() >= 0 and graph.neighbours.max() < count
    used = graph.kinds >= 0
    own = np.arange(count)[:, None]
    assert (graph.neighbours != own)[used].all(), "a loop"
    assert (used[:, :-1] >= used[:, 1:]).all(), "used places come first"
    assert (graph.kinds[:, :-1] <= graph.kinds[:, 1:])[used[:, 1:]].all()
    fill = np.where(used[:, :1], graph.neighbours[:, :1], own)
    assert (graph.neighbours == fill)[~used].all()
    for row, row_used in zip(graph.neighbours, used, strict=True):
        assert len(set(row[row_used])) == row_used.sum(), "an edge twice"
    assert (graph.island[graph.neighbours] == graph.island[:, None]).all()


# ---------------------------------------------------------------- by hand


def test_a_strip_by_hand():
    # 0-1-2-3-4 along x, one triangle up, one down, and so on; width 1.
    points = [[0, 0, 0], [0, 1, 0], [1, 0, 0], [1, 1, 0], [2, 0, 0]]
    head = Head.create(points, [[0, 2, 1], [1, 2, 3], [2, 4, 3]], BONES)
    graph = build_graph(head)
    check(graph, 5)
    mesh = {(0, 1), (0, 2), (1, 2), (1, 3), (2, 3), (2, 4), (3, 4)}
    assert edge_set(graph, MESH) == mesh
    # 0-3 and 1-4 by two sides: 2 / sqrt(2) = 1.41; 2 + sqrt(2) over sqrt(5) = 1.08.
    assert edge_set(graph, SPACE) == {(0, 3), (0, 4), (1, 4)}
    # Vertex 2's mesh neighbours by distance: three at 1, then 1 at sqrt(2).
    node = graph.node_of_vertex
    row = graph.vertex_of_node[graph.neighbours[node[2], :4]]
    assert row.tolist() == [0, 3, 4, 1]


def test_a_crowded_node_keeps_its_nearest_mesh_neighbours():
    angle = np.linspace(0, 2 * np.pi, 20, endpoint=False)
    radius = 1 + np.arange(20) / 20
    rim = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0 * angle], 1)
    faces = [[0, 1 + i, 1 + (i + 1) % 20] for i in range(20)]
    head = Head.create(np.concatenate([[[0, 0, 0]], rim]), faces, BONES)
    graph = build_graph(head)
    check(graph, 21)
    assert graph.neighbours[0].tolist() == list(range(1, 13))


def test_fewer_neighbours_than_asked_for_and_more():
    for neighbours in (1, 3, 20):
        config = GraphConfig(neighbours=neighbours, nearest=4)
        check(build_graph(sphere(1), config), 42, config)


# ---------------------------------------------------------------- the gates


def sheets(gap: float, flip: bool, bridge: bool = False, side: int = 6) -> Head:
    """Two square sheets, one above the other, perhaps joined along one edge."""
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    sheet = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3).astype(float)
    ids = np.arange(side * side).reshape(side, side)
    a, b, c, d = ids[:-1, :-1], ids[1:, :-1], ids[1:, 1:], ids[:-1, 1:]
    lower = np.concatenate(
        [np.stack(t, axis=2).reshape(-1, 3) for t in ((a, b, c), (a, c, d))]
    )
    upper = (lower[:, ::-1] if flip else lower) + side * side
    faces = [lower, upper]
    if bridge:
        low, high = ids[0], ids[0] + side * side
        faces += [np.stack([low[:-1], low[1:], high[1:]], 1)]
        faces += [np.stack([low[:-1], high[1:], high[:-1]], 1)]
    points = np.concatenate([sheet, sheet + np.array([0, 0, gap])])
    return Head.create(points, np.concatenate(faces), BONES)


def crossings(graph, half: int, kind: int) -> int:
    """Edges of one kind between the lower and the upper sheet."""
    return sum((a < half) != (b < half) for a, b in edge_set(graph, kind))


def test_sheets_that_do_not_touch_stay_apart():
    head = sheets(gap=0.1, flip=False)
    assert crossings(build_graph(head), 36, SPACE) == 0


@pytest.mark.parametrize("flip", [False, True])
def test_joined_sheets_are_not_short_circuited(flip):
    # Both sheets are one island now; without the other gates they would mix.
    head = sheets(gap=0.1, flip=flip, bridge=True)
    graph = build_graph(head)
    check(graph, 72)
    assert graph.island.max() == 0
    assert crossings(graph, 36, MESH) > 0
    # Next to the bridge the way around is short; two rows on it is not.
    far = [pair for pair in edge_set(graph, SPACE) if pair[0] % 36 >= 12]
    assert all((a < 36) == (b < 36) for a, b in far)
    open_gates = GraphConfig(min_cosine=-1, max_detour=np.inf)
    assert crossings(build_graph(head, open_gates), 36, SPACE) > 20


def test_the_normal_gate_alone():
    # A thin wedge: two faces of a folded square, whose free corners nearly touch.
    points = [[0, 0, 0], [0, 1, 0], [1, 0, 0.1], [1, 0, -0.1]]
    head = Head.create(points, [[0, 1, 2], [0, 3, 1]], BONES)
    strict = GraphConfig(min_cosine=0.5, max_detour=np.inf)
    assert edge_set(build_graph(head, strict), SPACE) == set()
    loose = GraphConfig(min_cosine=-1, max_detour=np.inf)
    assert edge_set(build_graph(head, loose), SPACE) == {(2, 3)}


def between(edges, one, other):
    """The rows of `edges` that lead from one set of vertices to the other."""
    a, b = np.isin(edges, one), np.isin(edges, other)
    return np.sort(edges[(a & b[:, ::-1]).any(axis=1)], axis=1)


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("lids", ["closed", "open"])
def test_no_edge_crosses_closed_lips_or_lids(seed, lids):
    shape = HeadShape(lid_opening=0.0 if lids == "closed" else 0.5)
    head, regions = synthetic_head_and_regions(seed, vertices=1500, shape=shape)
    graph = build_graph(head)
    check(graph, len(head.vertices))
    skin = np.setdiff1d(np.arange(len(head.vertices)), regions.eyes)
    # At each of the four corners of two open eyes a lid's last vertex sees the other
    # lid's: there the surface is as short as the straight line.
    corners = 4 if lids == "open" else 0
    for one, other, allowed in (
        (regions.upper_lip, regions.lower_lip, 0),
        (regions.upper_lids, regions.lower_lids, corners),
        (regions.eyes, skin, 0),
    ):
        assert len(one) and len(other)
        assert len(between(graph.vertex_edges(SPACE), one, other)) <= allowed
        mesh = set(map(tuple, mesh_edges(head.faces).tolist()))
        crossing = between(graph.vertex_edges(MESH), one, other)
        assert set(map(tuple, crossing.tolist())) <= mesh
        # No vertex of one side shares its node with the other side.
        nodes = graph.node_of_vertex
        assert not set(nodes[one].tolist()) & set(nodes[other].tolist())


def test_the_lips_would_be_crossed_without_the_gates():
    head, regions = synthetic_head_and_regions(1, vertices=1500)
    graph = build_graph(head, GraphConfig(min_cosine=-1, max_detour=np.inf))
    edges = graph.vertex_edges(SPACE)
    assert len(between(edges, regions.upper_lip, regions.lower_lip)) > 10


# ---------------------------------------------------------------- seams


@pytest.mark.parametrize("subdivisions", [0, 2, 3])
def test_a_sphere_cut_along_every_edge_has_the_same_graph(subdivisions):
    whole = bumpy(sphere(subdivisions), 0.02)
    apart, old = unwelded(whole)
    graph, reference = build_graph(apart), build_graph(whole)
    check(graph, len(apart.vertices))
    assert len(graph) == len(whole.vertices)
    assert (graph.vertex_of_node[graph.node_of_vertex] <= np.arange(len(old))).all()
    for kind in (MESH, SPACE):
        cut = {tuple(sorted(old[list(e)].tolist())) for e in edge_set(graph, kind)}
        assert cut == edge_set(reference, kind)


def test_a_seam_joins_two_halves_and_keeps_their_corners():
    # One square, cut along its diagonal.
    points = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 0, 0], [1, 1, 0], [0, 1, 0]]
    head = Head.create(points, [[0, 1, 2], [3, 4, 5]], BONES)
    assert seam_nodes(head).tolist() == [0, 1, 2, 0, 2, 3]
    assert build_graph(head).island.tolist() == [0] * 4


def fan(*folds: float) -> Head:
    """A triangle over each side of (0, 0, 0) - (1, 0, 0), turned by so many degrees."""
    angles = np.radians(folds)
    tips = np.stack([0 * angles, np.cos(angles), np.sin(angles)], axis=1)
    corners = [[tip, [1, 0, 0], [0, 0, 0]] for tip in tips]
    # Every other one the other way round, so that its side runs against the others'.
    corners = [c[::-1] if i % 2 else c for i, c in enumerate(corners)]
    faces = np.arange(3 * len(folds)).reshape(-1, 3)
    return Head.create(np.reshape(corners, (-1, 3)), faces, BONES)


@pytest.mark.parametrize(
    "folds, nodes",
    [
        ((0, 180), 4),  # flat
        ((0, 70), 4),  # a crease sharper than a right angle
        ((0, 10), 6),  # folded back onto itself, as a card
        ((0, 70, 0, 70), 6),  # four sides: only those that face one way
    ],
)
def test_a_cut_along_a_crease_is_a_seam(folds, nodes):
    found = seam_nodes(fan(*folds))
    assert found.max() + 1 == nodes


def test_flat_triangles_of_their_own_have_the_nodes_and_normals_of_the_mesh():
    whole = sphere(2)
    soup = unwelded(whole)[0].replace(normals=None)
    nodes = seam_nodes(soup)
    assert nodes.max() + 1 == len(whole.vertices)
    areas = vertex_areas(soup.vertices, soup.faces)
    normals = node_normals(soup.normals, nodes, len(whole.vertices), areas)
    first = np.unique(nodes, return_index=True)[1]
    place = cKDTree(whole.vertices).query(soup.vertices[first])[1]
    np.testing.assert_allclose(normals, whole.normals[place], atol=1e-5)


def test_sides_that_face_each_other_are_no_seam():
    # The same two triangles at one place, back to back: lips, not a seam.
    points = np.tile([[0, 0, 0], [1, 0, 0], [0, 1, 0]], (2, 1))
    head = Head.create(points, [[0, 1, 2], [3, 5, 4]], BONES)
    assert len(set(seam_nodes(head).tolist())) == 6
    graph = build_graph(head)
    assert graph.island.tolist() == [0, 0, 0, 1, 1, 1]
    check(graph, 6)


def test_touching_spheres_are_no_seam():
    # They share a position, but no border.
    ball = sphere(1)
    points = np.concatenate([ball.vertices, ball.vertices + np.array([2, 0, 0])])
    faces = np.concatenate([ball.faces, ball.faces + 42])
    graph = build_graph(Head.create(points, faces, BONES))
    assert len(graph) == 84 and len(set(graph.island.tolist())) == 2


# ---------------------------------------------------------------- odd meshes


@pytest.mark.parametrize("gates", ["shut", "open"])
def test_islands_get_no_edges_between_them_however_near(gates):
    config = GraphConfig()
    if gates == "open":
        config = GraphConfig(min_cosine=-1, max_detour=np.inf)
    ball = sphere(1)
    points = np.concatenate([ball.vertices, ball.vertices * 1.001])
    faces = np.concatenate([ball.faces, ball.faces + 42])
    graph = build_graph(Head.create(points, faces, BONES), config)
    check(graph, 84)
    assert len(graph) == 84 and set(graph.island.tolist()) == {0, 1}


@pytest.mark.parametrize("count", [1, 2, 40])
def test_points_without_faces(count):
    points = np.random.default_rng(0).normal(size=(count, 3))
    graph = build_graph(Head.create(points, [], BONES))
    check(graph, count)
    assert graph.edges.shape == (0, 2) and (graph.kinds == -1).all()
    assert graph.neighbours[:, 0].tolist() == list(range(count))
    assert graph.vertex_edges().shape == (0, 2)


def test_an_isolated_vertex_has_only_itself():
    ball = sphere(0)
    points = np.concatenate([ball.vertices, [[0, 0, 3]]])
    graph = build_graph(Head.create(points, ball.faces, BONES))
    check(graph, 13)
    assert (graph.neighbours[12] == 12).all()
    assert graph.island[12] not in graph.island[:12]


@pytest.mark.parametrize("faces", [[], [[0, 1, 2], [2, 1, 3]], [[0, 0, 0]]])
def test_all_vertices_at_one_point(faces):
    head = Head.create(np.ones((30, 3)), faces, BONES)
    check(build_graph(head), 30)


def test_zero_area_and_repeated_faces():
    points = [[0, 0, 0], [1, 0, 0], [2, 0, 0], [1, 1, 0]]
    faces = [[0, 1, 2], [0, 1, 3], [0, 1, 3], [1, 1, 2], [3, 3, 3]]
    graph = build_graph(Head.create(points, faces, BONES))
    check(graph, 4)
    assert edge_set(graph, MESH) == {(0, 1), (0, 2), (1, 2), (0, 3), (1, 3)}


def test_an_edge_of_three_faces():
    points = [[0, 0, 0], [0, 0, 1], [1, 0, 0], [0, 1, 0], [-1, -1, 0]]
    graph = build_graph(Head.create(points, [[0, 1, 2], [0, 1, 3], [0, 1, 4]], BONES))
    check(graph, 5)
    assert len(edge_set(graph, MESH)) == 7


# ---------------------------------------------------------------- equivariance


def test_renumbering_vertices_renumbers_the_graph():
    head = bumpy(synthetic_head_and_regions(4, vertices=800)[0])
    order = np.random.default_rng(0).permutation(len(head.vertices))
    other = Head.create(
        head.vertices[order],
        np.argsort(order)[head.faces],
        head.skeleton,
        normals=head.normals[order],
    )
    mine = build_graph(head)
    theirs = build_graph(other)
    for kind in (MESH, SPACE):
        assert edge_set(mine, kind) == {
            tuple(sorted(order[list(e)].tolist())) for e in edge_set(theirs, kind)
        }


def test_turning_and_scaling_change_nothing():
    head = bumpy(synthetic_head_and_regions(4, vertices=800)[0])
    graph = build_graph(head)
    for rotation in axis_rotations()[::5]:
        for scale in (1e-3, 512.0):
            other = build_graph(moved(head, rotation, scale))
            for kind in (MESH, SPACE):
                assert edge_set(graph, kind) == edge_set(other, kind)


# ---------------------------------------------------------------- nodes


def test_node_areas_and_normals_add_up():
    whole = sphere(2)
    apart, old = unwelded(whole)
    nodes = seam_nodes(apart)
    areas = node_areas(apart, nodes, 162)
    expected = node_areas(whole, np.arange(162), 162)
    place = nodes[np.unique(old, return_index=True)[1]]
    np.testing.assert_allclose(areas[place], expected, rtol=1e-5)
    assert areas.sum() == pytest.approx(4 * np.pi, rel=0.05)
    normals = node_normals(apart.normals, nodes, 162, np.ones(len(nodes)))
    np.testing.assert_allclose(normals[place], whole.normals, atol=1e-5)


def test_the_graph_of_a_large_mesh_is_one_piece():
    graph = build_graph(sphere(4))
    pairs = graph.vertex_edges()
    links = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(2562, 2562))
    assert connected_components(links)[0] == 1
