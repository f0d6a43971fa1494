"""Pose transfer through a skeleton: poses that are known, found again."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from test_body import small_body

from skinlib.datasets.remesh import halve
from skinlib.garments.body import Body, read_body
from skinlib.garments.motion import Motion, random_poses
from skinlib.head import HeadError, Skeleton
from skinlib.pose_transfer.data import body_on_mesh, drawn_bodies, normalised
from skinlib.pose_transfer.through_skeleton import (
    apply_pose,
    at_rest,
    fit_cloud,
    fit_pose,
    transfer,
)
from skinlib.skinning import linear_blend_skinning

POST = small_body()


def posed(head, motion: Motion, frame: int) -> np.ndarray:
    moves = motion.transforms(head.skeleton)[frame]
    return linear_blend_skinning(head.vertices, head.weights, moves)


def post_motion(seed: int = 0, size: float = 1.0) -> Motion:
    rng = np.random.default_rng(seed)
    turns = rng.uniform(-size, size, (4, 3, 3))
    names = POST.head.skeleton.names
    return Motion.create(turns, names, rng.uniform(-1, 1, (4, 3)))


@pytest.fixture(scope="module")
def body() -> Body:
    body = read_body()
    return body_on_mesh(body, halve(body.head, 0, keep=369 / len(body.head.vertices)))


@pytest.fixture(scope="module")
def poses(body) -> Motion:
    return random_poses(body.head.skeleton, 6, 5)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Degrees between rotations."""
    turn = Rotation.from_matrix(a) * Rotation.from_matrix(b).inv()
    return np.degrees(turn.magnitude())


# ---------------------------------------------------------------- with correspondence


def test_one_bone_turned_by_hand():
    """A quarter turn about Z and a shift; the joint is not at the origin."""
    skeleton = Skeleton.from_heads_and_tails([[1, 0, 0]], None, [-1], ["only"])
    rest = np.array([[1.0, 0, 0], [2, 0, 0], [1, 1, 0], [1, 0, 1]])
    head = POST.head.replace(
        vertices=rest, faces=[[0, 1, 2]], skeleton=skeleton, weights=np.ones((4, 1))
    )
    turned = np.array([[1.0, 0, 5], [1, 1, 5], [0, 0, 5], [1, 0, 6]])
    fit = fit_pose(head, turned)
    quarter = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]
    np.testing.assert_allclose(fit.rotations[0], quarter, atol=1e-6)
    np.testing.assert_allclose(fit.translation, [0, 0, 5], atol=1e-6)
    assert fit.error < 1e-6 and fit.scale == 1


@pytest.mark.parametrize("frame", range(4))
def test_a_pose_and_a_shift_are_found_again(frame):
    motion = post_motion()
    fit = fit_pose(POST, posed(POST.head, motion, frame))
    assert angles(fit.rotations, motion.matrices()[frame]).max() < 0.01
    np.testing.assert_allclose(fit.translation, motion.translations[frame], atol=1e-4)
    assert fit.error < 1e-6 and not fit.amounts.any()


@pytest.mark.parametrize("frame", range(6))
def test_a_person_in_a_wide_pose_is_found_again(body, poses, frame):
    points = posed(body.head, poses, frame)
    fit = fit_pose(body, points)
    assert fit.error < 1e-6
    np.testing.assert_allclose(apply_pose(fit, body.head), points, atol=1e-5)
    # Nothing shows how the root turns: it moves no vertex, and its children begin at
    # its own joint. All others are seen, in world axes.
    own, true = fit.rotations, poses.matrices()[frame].astype(np.float64)
    skeleton = body.head.skeleton
    assert skeleton.names[0] == "root"
    worlds = []
    for local in (own, true):
        world = local.copy()
        for bone in skeleton.order[1:].tolist():
            world[bone] = world[skeleton.parents[bone]] @ local[bone]
        worlds.append(world[1:])
    assert angles(*worlds).max() < 0.05


def test_shape_and_scale_are_found_as_well(body, poses):
    shape = {"gender": 0.4, "weight": -0.7, "muscle": 0.2, "height": 0.9}
    shaped = body.shaped(shape)
    points, _, scale = normalised(posed(shaped, poses, 2))
    fit = fit_pose(body, points, scaled=True, shaped=True)
    np.testing.assert_allclose(fit.amounts, list(shape.values()), atol=1e-3)
    assert fit.scale == pytest.approx(1 / scale.item(), rel=1e-4)
    np.testing.assert_allclose(
        at_rest(fit, body, points).vertices, shaped.vertices, atol=1e-4
    )


@pytest.mark.parametrize("frame", range(3))
def test_a_pose_goes_from_one_person_to_another(body, poses, frame):
    """The networks' task, with the order of the vertices given away."""
    source, target = drawn_bodies(body, 2, frame)
    result = transfer(
        body,
        normalised(posed(source, poses, frame))[0],
        normalised(posed(target, poses, frame + 1))[0],
    )
    truth = posed(target, poses, frame)
    np.testing.assert_allclose(normalised(result)[0], normalised(truth)[0], atol=1e-4)


def test_the_same_person_in_the_same_pose_comes_back(body, poses):
    points = normalised(posed(body.head, poses, 1))[0]
    result = normalised(transfer(body, points, points))[0]
    np.testing.assert_allclose(result, points, atol=1e-4)


def test_a_body_on_its_head_is_found_as_well(body, poses):
    """Each bone starts from the turn of its own vertices, so no turn is too large."""
    over = Rotation.from_rotvec([3.0, 0.5, 0.0]).as_matrix()
    points = posed(body.head, poses, 2) @ over.T
    fit = fit_pose(body, points, iterations=12)
    assert fit.error < 1e-5


def test_noise_averages_out(body, poses):
    points = posed(body.head, poses, 3)
    side = np.ptp(points, axis=0).max()
    noise = np.random.default_rng(0).uniform(-0.02, 0.02, points.shape) * side
    result = apply_pose(fit_pose(body, points + noise), body.head)
    left = np.sqrt(((result - points) ** 2).mean())
    assert left < 0.7 * np.sqrt((noise**2).mean())


def test_what_no_shape_can_express_is_kept():
    """A bump on a post comes back to where it was at rest."""
    rest = POST.head.vertices.copy()
    rest[100] += np.float32([0.02, 0, 0])
    bumpy = POST.head.replace(vertices=rest)
    points = posed(bumpy, post_motion(1, 0.6), 2)
    fit = fit_pose(POST, points)
    back = at_rest(fit, POST, points).vertices
    np.testing.assert_allclose(back, rest, atol=2e-3)
    assert np.linalg.norm(back[100] - POST.head.vertices[100]) > 0.018


def test_a_reflection_is_no_rotation():
    mirrored = POST.head.vertices * np.float32([-1, 1, 1])
    fit = fit_pose(POST, mirrored)
    np.testing.assert_allclose(np.linalg.det(fit.rotations), 1, atol=1e-6)


def test_the_target_needs_the_same_bones():
    fit = fit_pose(POST, POST.head.vertices)
    with pytest.raises(HeadError, match="the target has none"):
        apply_pose(fit, POST.head.replace(weights=None))
    skeleton = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["only"])
    count = len(POST.head.vertices)
    other = POST.head.replace(skeleton=skeleton, weights=np.ones((count, 1)))
    with pytest.raises(HeadError, match="the target has 1 bones"):
        apply_pose(fit, other)
    with pytest.raises(HeadError, match="points: 5 of them"):
        at_rest(fit, POST, POST.head.vertices[:5])


@pytest.mark.parametrize("fit", [fit_pose, fit_cloud])
@pytest.mark.parametrize(
    "points, found",
    [
        (np.zeros((0, 3)), "of shape"),
        (np.zeros((5, 2)), "of shape"),
        (np.zeros((530, 3)), "at one place"),
        (np.full((530, 3), np.nan), "NaN"),
    ],
)
def test_impossible_points(fit, points, found):
    with pytest.raises(HeadError, match=found):
        fit(POST, points)


def test_impossible_bodies():
    points = POST.head.vertices
    with pytest.raises(HeadError, match="points: 9 of them for a body of 506"):
        fit_pose(POST, points[:9])
    with pytest.raises(HeadError, match="weights"):
        fit_pose(POST.head.replace(weights=None), points)
    with pytest.raises(HeadError, match="shapes"):
        fit_pose(POST.head, points, shaped=True)
    joints = POST.head.skeleton.joints
    roots = Skeleton.from_heads_and_tails(joints, None, [-1, 0, -1], "abc")
    with pytest.raises(HeadError, match="several roots"):
        fit_pose(POST.head.replace(skeleton=roots), points)


# ---------------------------------------------------------------- a cloud of points


def test_a_moderate_pose_is_found_in_a_shuffled_cloud(body, poses):
    somebody = drawn_bodies(body, 1, 4)[0]
    points = normalised(posed(somebody, poses, 3))[0]
    order = np.random.default_rng(0).permutation(len(points))
    fit = fit_cloud(body, points[order], scaled=True, shaped=True)
    assert fit.error < 0.01
    found = apply_pose(fit, somebody)
    truth = posed(somebody, poses, 3)
    offset = normalised(found)[0] - normalised(truth)[0]
    assert np.linalg.norm(offset, axis=1).mean() < 0.01


def test_known_poses_are_where_it_starts_from(body, poses):
    """A wide pose is out of reach from the rest pose; each second vertex is there."""
    truth = posed(body.head, poses, 0)
    lost, found = (
        fit_cloud(body, truth[::2], poses=known, starts=2, rounds=15)
        for known in (None, poses)
    )
    off = [
        np.linalg.norm(apply_pose(fit, body.head) + fit.translation - truth, axis=1)
        for fit in (lost, found)
    ]
    assert off[0].mean() > 0.1 and off[1].mean() < 0.02


def test_impossible_starts(body):
    with pytest.raises(HeadError, match="0 with 60 rounds"):
        fit_cloud(POST, POST.head.vertices, starts=0)
    with pytest.raises(HeadError, match="8 with 0 rounds"):
        fit_cloud(POST, POST.head.vertices, rounds=0)
    with pytest.raises(HeadError, match="bone_names"):
        fit_cloud(
            POST, POST.head.vertices, poses=random_poses(body.head.skeleton, 1, 0)
        )
