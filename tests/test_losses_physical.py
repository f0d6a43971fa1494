"""The physical terms: by hand, on spheres, and what they think of a head."""

import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree
from shapes import sphere, unwelded
from torch.autograd import gradcheck

from skinlib.datasets.synthetic import synthetic_head
from skinlib.geometry import cotangents, mesh_edges, point_segment_distance
from skinlib.graph import MESH, build_graph
from skinlib.losses import (
    dirichlet,
    falloff_radii,
    joint_distance,
    joint_falloff,
    smoothness,
)

NO_FACES = np.zeros((0, 3), np.int64)
TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
FACE = np.array([[0, 1, 2]])

# A path 0 - 1 - 2 and a vertex of its own; the places after the first are filled up.
NEIGHBOURS = torch.tensor([[1, 1], [0, 2], [1, 1], [3, 3]])
USED = torch.tensor([[True, False], [True, True], [True, False], [False, False]])
PATH = torch.tensor([[0, 1], [1, 2]])
CONDUCTS = torch.tensor([1.0, 0.5], dtype=torch.float64)
WEIGHTS = torch.tensor([[1.0, 0, 0], [0, 1, 0], [0, 0.5, 0.5], [0, 0, 1]]).double()
DISTANCES = torch.tensor([[1.0, 2, 3], [2, 2, 2], [4, 2, 4], [1, 1, 0]]).double()
RADII = torch.tensor([1.0, 2.0, 4.0], dtype=torch.float64)


def tensor(array) -> torch.Tensor:
    return torch.from_numpy(np.array(array, np.int64 if array.dtype == int else float))


# -- cotangents ----------------------------------------------------------------------


def test_cotangents_of_a_right_angle_by_hand():
    edges, weights = cotangents(TRIANGLE, FACE)
    assert edges.tolist() == [[0, 1], [0, 2], [1, 2]]
    # Opposite the short sides: 45 degrees; opposite the long one: 90.
    np.testing.assert_allclose(weights, [0.5, 0.5, 0], atol=1e-12)


def test_two_faces_add_up_and_may_be_negative():
    # A flat rhombus: its long diagonal lies opposite two angles of 120 degrees.
    points = np.array([[-(3**0.5), 0, 0], [3**0.5, 0, 0], [0, 1, 0], [0, -1, 0]])
    edges, weights = cotangents(points, np.array([[0, 1, 2], [0, 3, 1]]))
    diagonal = (edges == [0, 1]).all(axis=1)
    np.testing.assert_allclose(weights[diagonal], -1 / 3**0.5)
    np.testing.assert_allclose(weights[~diagonal], 3**0.5 / 2)


def test_the_edges_are_those_of_the_mesh_whatever_the_size_and_orientation():
    ball = sphere(2)
    edges, weights = cotangents(ball.vertices, ball.faces)
    assert (edges == mesh_edges(ball.faces)).all()
    for size in (1e-10, 1e10):
        points = ball.vertices.astype(float) * size
        _, again = cotangents(points, ball.faces[::-1, ::-1])
        np.testing.assert_allclose(again, weights, rtol=1e-6)


def test_faces_without_area_count_nothing():
    points = np.concatenate([TRIANGLE, TRIANGLE[:1], [[2.0, 0, 0]]])
    flat = np.array([[0, 1, 4], [0, 3, 1], [0, 0, 1], [2, 2, 2]])
    edges, weights = cotangents(points, np.concatenate([FACE, flat]))
    known = {tuple(e): w for e, w in zip(edges.tolist(), weights, strict=True)}
    assert known.pop((0, 1)) == pytest.approx(0.5)
    assert known.pop((0, 2)) == pytest.approx(0.5)
    assert list(known.values()) == pytest.approx([0] * len(known), abs=1e-12)


def test_a_sliver_does_not_outweigh_a_head_and_keeps_its_energy_above_zero():
    for height in 10.0 ** -np.arange(1, 21):
        points = np.array([[0, 0, 0], [1, 0, 0], [0.5, height, 0]])
        edges, weights = cotangents(points, FACE)
        assert np.abs(weights).max() <= 50
        matrix = np.zeros((3, 3))
        matrix[tuple(edges.T)] = -weights
        matrix += matrix.T
        matrix -= np.diag(matrix.sum(axis=1))
        assert np.linalg.eigvalsh(matrix).min() > -1e-9


def test_cotangents_without_faces():
    edges, weights = cotangents(TRIANGLE, NO_FACES)
    assert edges.shape == (0, 2) and weights.shape == (0,)


# -- smoothness ----------------------------------------------------------------------


def test_smoothness_by_hand():
    # Path 0 - 1: 1 + 1; 1 - 2: 1/4 + 1/4; both ways; 4 vertices and 3 bones.
    expected = 2 * (2 + 0.5) / (4 * 3)
    assert smoothness(WEIGHTS, NEIGHBOURS, USED).item() == pytest.approx(expected)
    # Without the mask a vertex of one neighbour counts it twice.
    filled = (4 + 2.5 + 1) / (4 * 3)
    assert smoothness(WEIGHTS, NEIGHBOURS).item() == pytest.approx(filled)


def test_dirichlet_by_hand():
    assert dirichlet(WEIGHTS, PATH, CONDUCTS).item() == (1.0 * 2 + 0.5 * 0.5) / 2


def ball_weights(subdivisions):
    """Two bones whose weights (1 + z) / 2 and (1 - z) / 2 change over a unit sphere."""
    head = sphere(subdivisions)
    z = head.vertices[:, 2].astype(float)
    return head, torch.from_numpy(np.stack([(1 + z) / 2, (1 - z) / 2], axis=1))


def nearest(head, count):
    _, ids = cKDTree(head.vertices).query(head.vertices, k=count + 1)
    return torch.from_numpy(ids[:, 1:])


def energy(head, weights):
    edges, conducts = cotangents(head.vertices, head.faces)
    return dirichlet(weights, *map(torch.from_numpy, (edges, conducts))).item()


def test_the_sources_smoothness_grows_with_the_number_of_neighbours():
    head, weights = ball_weights(3)
    few, twice, more = (smoothness(weights, nearest(head, k)) for k in (3, 6, 12))
    # More than in proportion: the neighbours that are added lie further away.
    assert twice > 2 * few and more > 2 * twice


def test_the_sources_smoothness_shrinks_as_the_mesh_is_refined():
    values = []
    for level in (2, 3, 4):
        head, weights = ball_weights(level)
        values.append(smoothness(weights, nearest(head, 6)).item())
    # Half the edge length, a quarter of the squares.
    assert np.divide(values[:-1], values[1:]) == pytest.approx([4, 4], rel=0.02)


def test_the_dirichlet_energy_converges_as_the_mesh_is_refined():
    # Of (1 + z) / 2 on the unit sphere it is 1/8 of the integral of 1 - z^2: pi / 3.
    exact = 2 * np.pi / 3
    errors = [exact - energy(*ball_weights(level)) for level in (1, 2, 3, 4)]
    assert errors[-1] == pytest.approx(0, abs=0.002 * exact)
    assert np.divide(errors[:-1], errors[1:]) == pytest.approx([4] * 3, rel=0.1)


def test_the_dirichlet_energy_does_not_depend_on_size():
    head, weights = ball_weights(2)
    large = head.replace(vertices=head.vertices * 100)
    assert energy(large, weights) == pytest.approx(energy(head, weights), rel=1e-5)


def test_a_seam_opens_the_surface_and_the_nodes_of_the_graph_close_it():
    head, weights = ball_weights(2)
    apart, old = unwelded(head)
    graph = build_graph(apart)
    edges, conducts = cotangents(
        apart.vertices[graph.vertex_of_node], graph.node_of_vertex[apart.faces]
    )
    nodes = weights[old[graph.vertex_of_node]]
    closed = dirichlet(nodes, torch.from_numpy(edges), torch.from_numpy(conducts))
    assert closed.item() == pytest.approx(energy(head, weights))


@pytest.mark.parametrize("seed", range(3))
def test_the_two_smoothnesses_of_one_head_in_two_meshes(seed):
    smooth, tight = [], []
    for vertices in (700, 2800):
        head = synthetic_head(seed, vertices)
        graph, weights = build_graph(head), tensor(head.weights)
        nodes, mesh = graph.vertex_of_node, torch.from_numpy(graph.kinds == MESH)
        neighbours = torch.from_numpy(graph.neighbours)
        smooth.append(smoothness(weights[nodes], neighbours, mesh).item())
        tight.append(energy(head, weights))
    assert smooth[0] > 2.5 * smooth[1]
    assert tight[0] == pytest.approx(tight[1], rel=0.15)


# -- joints --------------------------------------------------------------------------


def test_joint_distance_by_hand():
    # Rows: 1; 4; (4 + 16) / 2; 0.
    assert joint_distance(WEIGHTS, DISTANCES).item() == (1 + 4 + 10 + 0) / 4


def test_falloff_radii_by_hand():
    # Bone 1: weight 1 at 2, weight 1/2 at 2. Bone 2: weight 1/2 at 4, weight 1 at 0.
    expected = torch.tensor([1, 2, (0.5 * 16 / 1.5) ** 0.5], dtype=torch.float64)
    torch.testing.assert_close(falloff_radii(WEIGHTS, DISTANCES), expected)
    mass = torch.tensor([1.0, 1, 2, 0])
    found = falloff_radii(WEIGHTS, DISTANCES, mass)
    torch.testing.assert_close(found, expected.new_tensor([1, 2, 4]))


def test_joint_falloff_by_hand():
    # Rows: 1; (2/2)^2; ((2/2)^2 + (4/4)^2) / 2; 0.
    assert joint_falloff(WEIGHTS, DISTANCES, RADII).item() == (1 + 1 + 1 + 0) / 4


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_the_falloff_of_its_own_weights_is_one_in_any_unit(size):
    head = synthetic_head(0, 700)
    weights, distances, _ = seen_by_segments(head)
    distances = distances * size
    radii = falloff_radii(weights, distances)
    assert joint_falloff(weights, distances, radii).item() == pytest.approx(1)


@pytest.mark.parametrize("unknown", [0.0, np.nan, np.inf, 1e-30])
def test_a_bone_of_unknown_reach_costs_one(unknown):
    radii = RADII.clone()
    radii[2] = unknown
    weights = WEIGHTS.float().requires_grad_()
    loss = joint_falloff(weights, DISTANCES.float(), radii.float())
    # Rows: 1; 1; (1 + 1) / 2; 1.
    assert loss.item() == 1
    (gradient,) = torch.autograd.grad(loss, weights)
    assert (gradient[:, 2] == 0.25).all() and gradient.isfinite().all()


def test_no_bone_of_known_reach():
    assert joint_falloff(WEIGHTS, DISTANCES, torch.full((3,), torch.nan)).item() == 1
    idle = torch.tensor([[1.0, 0.0]] * 4)
    assert falloff_radii(idle, DISTANCES[:, :2]).isnan().tolist() == [False, True]


def seen_by_segments(head):
    """Weights, distances to bone segments, and which vertices are the skull's."""
    bones = head.skeleton
    distances = point_segment_distance(head.vertices, bones.joints, bones.tails)
    skull = head.weights[:, bones.names.index("head")] > 0.99
    return tensor(head.weights), tensor(distances), skull


def nearest_bone(cost):
    return torch.eye(cost.shape[1], dtype=cost.dtype)[cost.argmin(dim=1)]


@pytest.mark.parametrize("seed", range(4))
def test_joint_distance_punishes_the_skull_for_following_the_head_bone(seed):
    head = synthetic_head(seed, 700)
    weights, distances, skull = seen_by_segments(head)
    bone = head.skeleton.names.index("head")
    radii = falloff_radii(weights, distances)
    torn = nearest_bone(distances)  # every vertex to the bone nearest to it

    # As written, tearing the skull apart between the bones of the face pays.
    assert joint_distance(torn, distances) < 0.6 * joint_distance(weights, distances)
    assert joint_falloff(torn, distances, radii) > 2  # and the artist's weights have 1

    def follows(term):
        """The share of the skull whose cheapest bone is the head bone."""
        leaf = weights.clone().requires_grad_()
        (slope,) = torch.autograd.grad(term(leaf), leaf)
        return (slope.argmin(dim=1).numpy()[skull] == bone).mean()

    assert follows(lambda p: joint_distance(p, distances)) < 0.6
    assert follows(lambda p: joint_falloff(p, distances, radii)) > 0.75


def test_to_the_joint_alone_the_falloff_does_not_free_the_skull():
    # The head's joint lies at its base: only the segment leads up into the skull.
    head = synthetic_head(0, 700)
    weights, _, skull = seen_by_segments(head)
    joints = head.skeleton.joints
    distances = tensor(point_segment_distance(head.vertices, joints, joints))
    radii = falloff_radii(weights, distances)
    torn = nearest_bone(distances)
    assert joint_falloff(torn, distances, radii) > 2
    cheapest = (distances / radii).argmin(dim=1).numpy()[skull]
    assert (cheapest == head.skeleton.names.index("head")).mean() < 0.5


# -- all -----------------------------------------------------------------------------

TERMS = {
    "smooth": lambda p: smoothness(p, NEIGHBOURS, USED),
    "dirichlet": lambda p: dirichlet(p, PATH, CONDUCTS),
    "joint": lambda p: joint_distance(p, DISTANCES),
    "joint_falloff": lambda p: joint_falloff(p, DISTANCES, RADII),
    "radii": lambda p: falloff_radii(p, DISTANCES).sum(),
}


@pytest.mark.parametrize("term", TERMS)
def test_derivatives(term):
    torch.manual_seed(0)
    weights = torch.rand(4, 3, dtype=torch.float64).softmax(1).requires_grad_()
    assert gradcheck(TERMS[term], (weights,))


@pytest.mark.parametrize("term", TERMS)
def test_float32_weights_and_float64_constants(term):
    loss = TERMS[term](WEIGHTS.float())
    assert loss.dtype == torch.float32
    torch.testing.assert_close(loss.double(), TERMS[term](WEIGHTS))


def test_permuting_bones_and_vertices_changes_nothing():
    torch.manual_seed(1)
    v, j = torch.randperm(4), torch.randperm(3)
    new = v.argsort()  # the new id of an old vertex
    weights, distances = WEIGHTS[v][:, j], DISTANCES[v][:, j]
    permuted = {
        "smooth": smoothness(weights, new[NEIGHBOURS[v]], USED[v]),
        "dirichlet": dirichlet(weights, new[PATH].flip(1), CONDUCTS),
        "joint": joint_distance(weights, distances),
        "joint_falloff": joint_falloff(weights, distances, RADII[j]),
        "radii": falloff_radii(weights, distances).sum(),
    }
    for name, value in permuted.items():
        torch.testing.assert_close(value, TERMS[name](WEIGHTS))


@pytest.mark.parametrize("term", ["smooth", "dirichlet"])
def test_an_isolated_vertex_is_free(term):
    leaf = WEIGHTS.clone().requires_grad_()
    (gradient,) = torch.autograd.grad(TERMS[term](leaf), leaf)
    assert (gradient[3] == 0).all() and (gradient[:3] != 0).any()


def test_a_graph_without_edges_costs_nothing():
    weights = WEIGHTS.clone().requires_grad_()
    nothing = torch.zeros(0, 2, dtype=torch.int64)
    for loss in (
        smoothness(weights, torch.zeros(4, 0, dtype=torch.int64)),
        smoothness(weights, NEIGHBOURS, torch.zeros_like(USED)),
        dirichlet(weights, nothing, torch.zeros(0)),
    ):
        assert loss.item() == 0
        assert not torch.autograd.grad(loss, weights)[0].any()


WRONG = {
    "neighbours": lambda: smoothness(WEIGHTS, NEIGHBOURS[:3]),
    "used": lambda: smoothness(WEIGHTS, NEIGHBOURS, USED[:, :1]),
    "edges": lambda: dirichlet(WEIGHTS, PATH.repeat(1, 2), CONDUCTS),
    "cotangents": lambda: dirichlet(WEIGHTS, PATH, CONDUCTS[:1]),
    "distances": lambda: joint_distance(WEIGHTS, DISTANCES[:, :2]),
    "mass": lambda: falloff_radii(WEIGHTS, DISTANCES, torch.ones(3)),
    "radii": lambda: joint_falloff(WEIGHTS, DISTANCES, RADII[:2]),
}


@pytest.mark.parametrize("name", WRONG)
def test_shapes_that_do_not_fit_are_refused(name):
    with pytest.raises(ValueError, match=rf"^{name} has shape \(.+\) instead of \("):
        WRONG[name]()
