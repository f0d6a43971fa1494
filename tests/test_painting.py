from itertools import combinations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import linprog
from scipy.spatial import Delaunay
from shapes import mirrored_square, sphere, unwelded

from skinlib.datasets.synthetic import synthetic_head, synthetic_head_and_regions
from skinlib.evaluate.metrics import deformation_errors
from skinlib.geometry import mesh_edges
from skinlib.graph import seam_nodes
from skinlib.head import Head, HeadError, Skeleton
from skinlib.painting import (
    finish,
    limit_influences,
    lock_bones,
    lock_vertices,
    prune,
    smooth_weights,
    symmetrize,
)
from skinlib.skinning import find_bones, mirror_pairs, mirror_vertices


@pytest.fixture(scope="module")
def head():
    return synthetic_head(5, vertices=600, bones=14, up="y", shuffle=False)


def random_weights(rng, shape):
    weights = rng.random(shape) ** 4
    return (weights / weights.sum(axis=1, keepdims=True)).astype(np.float32)


# --- prune, limit -----------------------------------------------------------------


def test_prune_keeps_the_largest_weight_always():
    weights = np.array([[0.4, 0.35, 0.25], [0.96, 0.04, 0.0]], np.float32)
    np.testing.assert_allclose(
        prune(weights, 0.5), [[1, 0, 0], [1, 0, 0]], rtol=0, atol=0
    )
    np.testing.assert_allclose(prune(weights, 0.3)[0], [0.4 / 0.75, 0.35 / 0.75, 0])


@pytest.mark.parametrize("count", [1, 4, 8])
def test_limit_keeps_the_largest_and_sums_to_one(count):
    weights = random_weights(np.random.default_rng(1), (200, 12))
    limited = limit_influences(weights, count)
    assert limited.dtype == np.float32
    assert ((limited > 0).sum(axis=1) <= count).all()
    np.testing.assert_allclose(limited.sum(axis=1), 1, atol=1e-6)
    assert (limited.argmax(axis=1) == weights.argmax(axis=1)).all()
    dropped = np.where(limited == 0, weights, 0).max(axis=1)
    kept = np.where(limited > 0, weights, 1).min(axis=1)
    assert (dropped <= kept).all()


def test_limit_leaves_rows_within_the_limit_alone():
    weights = np.array([[0.7, 0.2, 0.1], [0.3, 0.7, 0.0]], np.float32)
    assert (limit_influences(weights, 2)[1] == weights[1]).all()
    assert (limit_influences(weights, 3) == weights).all()
    with pytest.raises(ValueError, match="at least 1"):
        limit_influences(weights, 0)


def test_no_other_choice_of_bones_and_weights_is_nearer():
    """Least |w - v| over all v on two bones: a linear program for each pair."""
    weights = random_weights(np.random.default_rng(4), (25, 5)).astype(np.float64)
    limited = limit_influences(weights, 2)
    for row, kept in zip(weights, limited, strict=True):
        least = np.inf
        for pair in combinations(range(5), 2):
            # v >= 0, t >= |w - v|, v sums to 1 and is 0 outside the pair.
            bounds = [(0, 1 if j in pair else 0) for j in range(5)] + [(0, None)] * 5
            eye = np.eye(5)
            above = np.block([[eye, -eye], [-eye, -eye]])
            cost, total = np.repeat([0, 1], 5), np.repeat([[1, 0]], 5, axis=1)
            best = linprog(cost, above, [*row, *-row], total, [1], bounds)
            least = min(least, best.fun)
        assert np.abs(row - kept).sum() == pytest.approx(least, abs=1e-6)


def test_what_is_dropped_goes_to_the_kept_bone_that_moves_most_alike():
    # The tongue moves with the jaw and a little about its own joint, close by.
    bones = Skeleton.from_heads_and_tails(
        [[0, 0, 0], [0, 1, 0], [0, 1, 1], [5, 1, 0]],
        None,
        [-1, 0, 1, 0],
        ["head", "jaw", "tongue", "ear"],
    )
    head = Head.create([[0, 1, 1.5]] * 2, np.zeros((0, 3)), bones)
    weights = np.array([[0.5, 0.25, 0.25, 0], [0.5, 0.3, 0, 0.2]])
    limited = limit_influences(weights, 2, head)
    np.testing.assert_allclose(
        limited, [[0.5, 0.5, 0, 0], weights[1] + [0.2, 0, 0, -0.2]]
    )


def test_limiting_along_the_skeleton_is_as_near_and_deforms_less():
    gain = []
    for seed in range(3):
        head = synthetic_head(seed, vertices=600, bones=14)
        full = prune(smooth_weights(head, head.weights, 6), 0.01)
        plain = limit_influences(full, 2)
        kin = limit_influences(full, 2, head)
        l1 = [np.abs(limited - full).sum(axis=1) for limited in (plain, kin)]
        np.testing.assert_allclose(*l1, atol=1e-6)
        errors = [
            deformation_errors(limited, full, head, seed)["deformation_mean"]
            for limited in (plain, kin)
        ]
        gain.append(errors[0] / errors[1])
    assert min(gain) > 1.05


def test_what_comes_first_is_kept_unless_it_is_nothing():
    weights = np.array([[0.5, 0.25, 0.25, 0.0]])
    first = np.array([[False, False, True, True]])
    limited = limit_influences(weights, 2, first=first)
    np.testing.assert_allclose(limited, [[2 / 3, 0, 1 / 3, 0]])


# --- lock -----------------------------------------------------------------------------


def test_locked_columns_are_kept_to_the_bit():
    rng = np.random.default_rng(2)
    original, predicted = random_weights(rng, (300, 9)), random_weights(rng, (300, 9))
    locked = lock_bones(predicted, original, [1, 4])
    assert locked.dtype == original.dtype
    assert (locked[:, [1, 4]] == original[:, [1, 4]]).all()
    assert locked.min() >= 0
    np.testing.assert_allclose(locked.sum(axis=1), 1, atol=1e-6)
    free = [0, 2, 3, 5, 6, 7, 8]
    np.testing.assert_allclose(
        locked[:, free] / locked[:, free].sum(axis=1, keepdims=True),
        predicted[:, free] / predicted[:, free].sum(axis=1, keepdims=True),
        atol=1e-5,
    )


def test_lock_when_the_prediction_leaves_the_rest_nothing():
    original = np.array([[0.25, 0.5, 0.25], [1, 0, 0]], np.float32)
    predicted = np.array([[1, 0, 0], [0, 1, 0]], np.float32)
    np.testing.assert_array_equal(lock_bones(predicted, original, [0]), original)
    everything = lock_bones(predicted, original, [0, 1, 2])
    np.testing.assert_array_equal(everything, original)


def test_rounding_gives_no_bone_a_weight():
    original = np.array([[0.3, 0.7, 0], [0.1, 0.9, 0]], np.float32)
    predicted = np.array([[0.1, 0.1, 0.8]] * 2, np.float32)
    np.testing.assert_array_equal(lock_bones(predicted, original, [0, 1]), original)


def test_locked_rows_are_kept_to_the_bit():
    rng = np.random.default_rng(6)
    original, predicted = random_weights(rng, (50, 4)), random_weights(rng, (50, 4))
    mask = rng.random(50) < 0.5
    locked = lock_vertices(predicted, original, mask)
    assert (locked[mask] == original[mask]).all()
    assert (locked[~mask] == predicted[~mask]).all()


# --- mirror ---------------------------------------------------------------------------


def test_symmetrize_averages_with_the_other_side():
    head = mirrored_square()
    weights = np.zeros((6, 3), np.float32)
    weights[:, 0] = 1
    weights[0] = [0.5, 0.5, 0]  # only the left side follows its bone
    result = symmetrize(head, weights)
    np.testing.assert_allclose(result[0], [0.75, 0.25, 0])
    np.testing.assert_allclose(result[2], [0.75, 0, 0.25])
    np.testing.assert_allclose(symmetrize(head, result), result)
    np.testing.assert_allclose(result.sum(axis=1), 1)


def test_symmetrize_leaves_vertices_without_a_partner():
    head = mirrored_square()
    vertices = np.array(head.vertices)
    vertices[0] = [1.4, -0.3, 0]
    head = head.replace(vertices=vertices)
    weights = random_weights(np.random.default_rng(3), (6, 3))
    np.testing.assert_array_equal(symmetrize(head, weights)[[0, 2]], weights[[0, 2]])


def test_the_free_side_follows_the_locked_one():
    head = mirrored_square()
    weights = random_weights(np.random.default_rng(7), (6, 3))
    locked = np.zeros((6, 3), bool)
    locked[[0, 3, 5]] = True  # 0 mirrors 2, 3 mirrors 5
    result = symmetrize(head, weights, locked)
    np.testing.assert_array_equal(result[[0, 3, 5]], weights[[0, 3, 5]])
    np.testing.assert_array_equal(result[2], weights[0, [0, 2, 1]])
    # The middle mirrors itself: the mean of both sides, as without locks.
    np.testing.assert_allclose(result[[1, 4]], symmetrize(head, weights)[[1, 4]])

    locked = np.zeros((6, 3), bool)
    locked[:, 1] = True  # the bone on one side
    weights = np.array([[0.5, 0.5, 0], [1, 0, 0], [0.4, 0.2, 0.4]] * 2)
    result = symmetrize(head, weights, locked)
    np.testing.assert_array_equal(result[:, 1], weights[:, 1])
    np.testing.assert_allclose(result[0], [0.3, 0.5, 0.2])
    np.testing.assert_allclose(result[2], [0.3, 0.2, 0.5])


def test_what_follows_gives_way_to_what_is_locked():
    head = mirrored_square()
    weights = np.zeros((6, 3))
    weights[:, 0] = 1
    weights[0], weights[2] = [0.1, 0.9, 0], [0.4, 0.6, 0]
    locked = np.zeros((6, 3), bool)
    locked[:, 1] = True
    # 0.6 of vertex 2 is locked on the one bone, 0.9 should follow on the other.
    result = symmetrize(head, weights, locked)
    np.testing.assert_allclose(result[2], [0, 0.6, 0.4])
    np.testing.assert_allclose(result.sum(axis=1), 1)


# --- smooth ---------------------------------------------------------------------------


def plane(seed: int, weights, stretch: float = 1.0) -> Head:
    """A flat patch of 400 random points; `weights` of two bones from (V, 2) places."""
    rng = np.random.default_rng(seed)
    xy = np.stack(np.meshgrid(np.arange(20), np.arange(20)), -1).reshape(-1, 2)
    xy = xy + rng.uniform(-0.4, 0.4, (400, 2))
    share = weights(xy)
    bones = Skeleton.from_heads_and_tails(np.eye(2, 3), None, [-1, 0], "ab")
    points = np.pad(xy * [stretch, 1], ((0, 0), (0, 1)))
    faces = Delaunay(xy).simplices
    return Head.create(points, faces, bones, np.stack([share, 1 - share], axis=1))


@pytest.mark.parametrize("stretch", [1, 3])
@pytest.mark.parametrize("seed", range(2))
def test_an_even_slope_is_smooth_on_any_triangulation(seed, stretch):
    head = plane(seed, lambda xy: (xy[:, 0] + 1) / 22, stretch)
    smoothed = smooth_weights(head, head.weights, 3)
    place = head.vertices[:, :2] / [stretch, 1]
    inside = (np.abs(place - 9.5) < 5.5).all(axis=1)
    change = np.abs(smoothed - head.weights)[inside].max() * 22  # in edge lengths
    assert change < 0.01

    # The plain mean of the neighbours moves it by a third of an edge.
    edges = mesh_edges(head.faces)
    both = np.concatenate([edges, edges[:, ::-1]])
    degree = np.bincount(both[:, 0])
    mean = np.bincount(both[:, 0], head.weights[both[:, 1], 0]) / degree
    assert np.abs(mean - head.weights[:, 0])[inside].max() * 22 > 0.3


def test_smoothing_calms_a_noisy_paint():
    head = plane(0, lambda xy: 0.25 + 0.5 * (np.arange(400) % 2))
    spread = [head.weights[:, 0].std()]
    for steps in (1, 4):
        spread.append(smooth_weights(head, head.weights, steps)[:, 0].std())
    assert spread[2] < spread[1] / 2 < spread[0] / 2


def test_a_square_by_hand():
    """The right angle adds tan 45 / 1, the diagonal twice tan 22.5 / sqrt 2."""
    bones = Skeleton.from_heads_and_tails(np.eye(2, 3), None, [-1, 0], "ab")
    corners = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    head = Head.create(corners, [[0, 1, 2], [0, 2, 3]], bones)
    weights = np.array([[1.0, 0], [0, 1], [0, 1], [0, 1]])
    smoothed = smooth_weights(head, weights)
    tan = np.sqrt(2) - 1  # of 22.5 degrees
    np.testing.assert_allclose(smoothed[0], [0.5, 0.5])
    np.testing.assert_allclose(smoothed[1], [0.25, 0.75])
    diagonal = 2 * tan / np.sqrt(2)
    share = diagonal / (diagonal + 2 * tan) / 2
    np.testing.assert_allclose(smoothed[2], [share, 1 - share])


def test_lips_lids_and_eyes_stay_apart():
    steps = 3
    head, regions = synthetic_head_and_regions(4, vertices=2500)
    names = [find_bones(head.skeleton, part)[0] for part in ("jaw", "lid", "eye")]
    edges = mesh_edges(head.faces)
    edge = np.linalg.norm(np.subtract(*head.vertices[edges.T]), axis=1).mean()
    for bone, moving, still in (
        (names[0], regions.lower_lip, regions.upper_lip),
        (names[1], regions.upper_lids, regions.lower_lids),
        (names[2], regions.eyes, np.r_[regions.upper_lids, regions.lower_lids]),
    ):
        weights = np.zeros_like(head.weights)
        weights[:, 0 if bone else 1] = 1
        weights[moving] = np.eye(len(head.skeleton))[bone]
        smoothed = smooth_weights(head, weights, steps)
        reached = np.zeros(len(weights), bool)
        reached[moving] = True
        for _ in range(steps):  # along the surface, round the corners
            both = np.concatenate([edges, edges[:, ::-1]])
            reached[both[reached[both[:, 0]], 1]] = True
        assert (smoothed[~reached, bone] == 0).all()
        assert not reached[still].all()
        gap = head.vertices[still][:, None] - head.vertices[moving]
        near = np.linalg.norm(gap, axis=2).min(axis=1) < edge
        assert (near & ~reached[still]).sum() > 5  # the air is no way across


@pytest.mark.parametrize("steps", [1, 2])
def test_a_vertex_gains_only_bones_of_its_neighbours(head, steps):
    weights = np.eye(14, dtype=np.float32)[np.arange(len(head.vertices)) % 14]
    smoothed = smooth_weights(head, weights, steps)
    edges = mesh_edges(head.faces)
    allowed = weights > 0
    for _ in range(steps):
        wider = allowed.copy()
        np.logical_or.at(wider, edges[:, 0], allowed[edges[:, 1]])
        np.logical_or.at(wider, edges[:, 1], allowed[edges[:, 0]])
        allowed = wider
    assert ((smoothed > 0) <= allowed).all()
    assert smoothed.dtype == np.float32
    np.testing.assert_allclose(smoothed.sum(axis=1), 1, atol=1e-6)


def test_both_sides_of_a_seam_move_as_one():
    ball = sphere(2)
    weights = random_weights(np.random.default_rng(1), (len(ball.vertices), 5))
    apart, old = unwelded(ball)
    assert len(np.unique(seam_nodes(apart))) == len(ball.vertices)
    smoothed = smooth_weights(apart, weights[old], 2)
    expected = smooth_weights(ball, weights, 2)
    np.testing.assert_allclose(smoothed, expected[old], atol=1e-6)
    # One locked vertex speaks for those that the seam cut from it.
    locked = np.zeros(len(old), bool)
    locked[0] = True
    smoothed = smooth_weights(apart, weights[old], 2, locked=locked)
    np.testing.assert_array_equal(smoothed[0], weights[old[0]])
    np.testing.assert_allclose(smoothed[old == old[0]], smoothed[[0] * 5], atol=1e-6)


def test_locked_vertices_stay_and_have_a_say():
    head = plane(0, lambda xy: xy[:, 0] > 9.5)
    locked = np.arange(400) % 3 == 0
    smoothed = smooth_weights(head, head.weights, 4, locked=locked)
    assert (smoothed[locked] == head.weights[locked]).all()
    assert (smoothed[~locked] != head.weights[~locked]).any()


def test_unit_order_and_lonely_vertices_change_nothing(head):
    weights = random_weights(np.random.default_rng(2), head.weights.shape)
    smoothed = smooth_weights(head, weights, 2)
    order = np.random.default_rng(3).permutation(len(weights))
    place = np.argsort(order)
    other = Head.create(
        1000 * head.vertices[order], place[head.faces], head.skeleton, None
    )
    np.testing.assert_allclose(
        smooth_weights(other, weights[order], 2), smoothed[order], atol=1e-5
    )
    alone = Head.create(head.vertices, np.zeros((0, 3)), head.skeleton)
    np.testing.assert_allclose(smooth_weights(alone, weights), weights, atol=1e-6)
    np.testing.assert_allclose(smooth_weights(head, weights, 0), weights, atol=1e-6)


def test_a_triangle_without_area_is_no_neighbour():
    bones = Skeleton.from_heads_and_tails(np.eye(2, 3), None, [-1, 0], "ab")
    points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0]]
    head = Head.create(points, [[0, 1, 2], [0, 1, 3], [1, 1, 3]], bones)
    weights = np.eye(2)[[0, 0, 1, 1]]
    smoothed = smooth_weights(head, weights)
    np.testing.assert_array_equal(smoothed[3], weights[3])
    np.testing.assert_allclose(smoothed.sum(axis=1), 1)


@pytest.mark.parametrize(("steps", "strength"), [(-1, 0.5), (1, 1.5), (1, -0.1)])
def test_smoothing_out_of_range_is_refused(head, steps, strength):
    with pytest.raises(ValueError, match="steps >= 0, strength 0 to 1"):
        smooth_weights(head, head.weights, steps, strength)


# --- all of it ------------------------------------------------------------------------


@settings(max_examples=40, deadline=None, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    bones=st.lists(st.integers(0, 13), max_size=3, unique=True),
    part=st.sampled_from([0, 0.02, 0.4, 1]),
    smooth=st.integers(0, 2),
    symmetric=st.booleans(),
    limit=st.sampled_from([None, 5, 7, 14]),
)
def test_locks_hold_whatever_else_is_asked(
    head, seed, bones, part, smooth, symmetric, limit
):
    rng = np.random.default_rng(seed)
    painted = limit_influences(random_weights(rng, head.weights.shape), 4)
    head = head.replace(weights=painted)
    predicted = random_weights(rng, painted.shape)
    mask = rng.random(len(painted)) < part
    options = {"smooth": smooth, "symmetric": symmetric, "max_influences": limit}
    try:
        weights = finish(
            head, predicted, locked_bones=bones, locked_vertices=mask, **options
        )
    except HeadError as error:
        # Bones that are locked take up to 3 places here; what follows them as many.
        assert symmetric and bones and limit == 5, error
        return
    assert (weights[mask] == head.weights[mask]).all()
    assert (weights[:, bones] == head.weights[:, bones]).all()
    assert (weights >= 0).all()
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=2e-6)
    assert (weights > 0).sum(axis=1).max() <= (limit or 14)
    if symmetric:
        partner = mirror_vertices(head)
        follows = ~mask & (partner >= 0) & mask[partner]
        image = head.weights[partner][:, mirror_pairs(head.skeleton)]
        if not bones:
            np.testing.assert_allclose(weights[follows], image[follows], atol=1e-6)


@pytest.fixture
def corner():
    """A triangle on four bones; the artist used the first three."""
    bones = Skeleton.from_heads_and_tails(np.eye(4, 3), None, [-1, 0, 0, 0], "abcd")
    painted = np.tile([0.25, 0.5, 0.25, 0], (3, 1))
    return Head.create(np.eye(3), [[0, 1, 2]], bones, painted)


def test_a_locked_bone_takes_one_of_the_influences(corner):
    predicted = np.tile([0.0, 0.25, 0.125, 0.625], (3, 1))
    weights = finish(corner, predicted, locked_bones=[0], max_influences=2)
    np.testing.assert_allclose(weights, np.tile([0.25, 0, 0, 0.75], (3, 1)))


def test_an_unpainted_locked_bone_takes_none(corner):
    predicted = np.tile([0.1, 0.2, 0.3, 0.4], (3, 1))
    weights = finish(corner, predicted, locked_bones=[3], max_influences=2)
    assert (weights[:, 3] == 0).all()
    assert ((weights > 0).sum(axis=1) == 2).all()


@pytest.mark.parametrize(
    ("locks", "limit", "most"),
    [
        ({"locked_bones": [0, 1]}, 1, 3),
        ({"locked_vertices": np.array([False, False, True])}, 2, 3),
    ],
)
def test_locks_that_need_more_influences_are_an_error(corner, locks, limit, most):
    message = rf"a.glb: --max-influences: .* vertex \d with {most} influences\. Allow"
    with pytest.raises(HeadError, match=message):
        finish(corner, corner.weights, max_influences=limit, file="a.glb", **locks)


def test_smoothing_is_followed_by_pruning(head):
    weights = finish(head, head.weights, smooth=3)
    spread = smooth_weights(head, head.weights, 3)
    assert weights[weights > 0].min() >= 0.01
    assert (weights > 0).sum() < (spread > 0).sum()
