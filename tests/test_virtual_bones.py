"""Virtual bones: placed, bound, blended with joints, and moved by a network."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from test_body import bends, sleeve, small_body

from skinlib.garments.binding import closest_point_weights, smooth
from skinlib.garments.motion import Motion
from skinlib.garments.virtual_bones import (
    VirtualBonesConfig,
    VirtualBonesNet,
    bone_distances,
    bone_spacing,
    carriers,
    features,
    heat_weights,
    hybrid_skinning,
    hybrid_weights,
    in_root_frame,
    looseness,
    nearest_rotation,
    oracle,
    place_bones,
    pose_features,
    prune_joints,
    rotation_from_columns,
    undone,
    virtual_bind,
)
from skinlib.head import HeadError
from skinlib.skinning import linear_blend_skinning

BODY, CLOTH = small_body(), sleeve(0.15)
SKELETON = BODY.head.skeleton
COUNT = 6
ALL = np.arange(3)


def grid(rows: int, columns: int, slit: float = 0.0) -> tuple[np.ndarray, np.ndarray]:
    """A flat sheet of cells of 0.1; a slit up the middle column of cells, from above.

    Vertices go row by row from below; the slit ends `slit` above the lower hem.
    """
    y, x = np.mgrid[:rows, :columns] / 10
    vertices = np.stack([x, y, 0 * x], axis=-1).reshape(-1, 3)
    ids = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = ids[:-1, :-1], ids[:-1, 1:], ids[1:, :-1], ids[1:, 1:]
    faces = np.concatenate([np.stack([a, b, d], -1), np.stack([a, d, c], -1)])
    faces = faces.reshape(-1, 3)
    if slit:
        middle = vertices[faces].mean(axis=1)
        across = np.abs(middle[:, 0] - (columns - 1) / 20) < 0.05
        faces = faces[~(across & (middle[:, 1] > slit))]
    return vertices, faces


def turned(motion: Motion, angle: float, shift) -> Motion:
    """The same motion, the body facing elsewhere and standing elsewhere."""
    turn = Rotation.from_rotvec([0, 0, angle])
    rotations = motion.rotations.copy()
    rotations[:, 0] = (turn * Rotation.from_rotvec(rotations[:, 0])).as_rotvec()
    moved = turn.apply(motion.translations) + shift
    return Motion.create(rotations, motion.bone_names, moved, motion.fps)


def smoothly(frames: int = 20, seed: int = 0) -> Motion:
    """The small body swaying, walking about and turning."""
    rng = np.random.default_rng(seed)
    time = np.arange(frames)[:, None, None] / 10
    rotations = 0.5 * np.sin(time * rng.uniform(0.5, 2, (3, 3)) + seed)
    turn = Rotation.from_rotvec(time[:, 0] * [0, 0, 1])
    rotations[:, 0] = (turn * Rotation.from_rotvec(0.2 * rotations[:, 0])).as_rotvec()
    path = np.stack([np.sin(time[:, 0, 0]), time[:, 0, 0], 0 * time[:, 0, 0]], axis=1)
    return Motion.create(rotations, SKELETON.names, path, 30)


class Rig:
    """Everything that binds the sleeve to six virtual bones and the three joints."""

    def __init__(self):
        self.rest = CLOTH.vertices
        self.bones = place_bones(self.rest, CLOTH.faces, COUNT)
        self.points = self.rest[self.bones]
        distances = bone_distances(self.rest, CLOTH.faces, self.bones)
        alpha = bone_spacing(distances, self.bones)
        self.virtual = heat_weights(distances, alpha, 3)
        self.joints = closest_point_weights(CLOTH, BODY.head)
        self.smooth = smooth(self.joints, CLOTH.faces, 20)
        centres = np.concatenate([self.points, SKELETON.joints])
        self.binds, self.offsets = virtual_bind(centres)

    def stands(self, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
        """Carriers (T, N, 4, 4) and joints (T, J, 4, 4) in the frame of the root."""
        local = in_root_frame(motion.transforms(SKELETON))
        joints = (local @ self.binds[COUNT:]).astype(np.float32)
        return carriers(local, self.smooth[self.bones], self.points), joints


@pytest.fixture(scope="module")
def rig() -> Rig:
    return Rig()


# --- where they sit -------------------------------------------------------------------


@pytest.mark.parametrize("count", [1, 2, 7, 40, 312])
def test_as_many_bones_as_asked_each_on_its_own_vertex(count):
    bones = place_bones(CLOTH.vertices, CLOTH.faces, count)
    assert len(np.unique(bones)) == len(bones) == count
    assert (np.diff(bones) > 0).all() and bones.dtype == np.int64


def test_bones_spread_evenly_over_a_sheet():
    vertices, faces = grid(11, 11)
    bones = place_bones(vertices, faces, 4)
    quarters = {tuple(corner) for corner in (vertices[bones, :2] > 0.5)}
    assert len(quarters) == 4
    assert np.abs(np.abs(vertices[bones, :2] - 0.5) - 0.25).max() < 0.08


def test_copies_at_one_place_are_different_bones():
    vertices, faces = grid(2, 3)
    twice = np.concatenate([vertices, vertices])
    bones = place_bones(twice, np.concatenate([faces, faces + 6]), 12)
    assert bones.tolist() == list(range(12))


def test_a_vertex_without_a_face_gets_no_bone():
    vertices, faces = grid(3, 3)
    vertices = np.concatenate([[[9.0, 9, 9]], vertices])
    assert place_bones(vertices, faces + 1, 9).tolist() == list(range(1, 10))
    with pytest.raises(HeadError, match="10 virtual bones for 9 vertices"):
        place_bones(vertices, faces + 1, 10)


def test_the_same_seed_gives_the_same_bones_and_another_one_others():
    first, again, other = (
        place_bones(CLOTH.vertices, CLOTH.faces, 10, seed) for seed in (3, 3, 4)
    )
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_bones_that_cannot_be_are_refused():
    vertices, faces = grid(3, 3)
    for count in (0, -1, 10):
        with pytest.raises(HeadError, match="virtual bones for 9"):
            place_bones(vertices, faces, count)
    vertices[4] = np.nan
    with pytest.raises(HeadError, match=r"3 values are NaN.* at \[4, 0\]"):
        place_bones(vertices, faces, 2)
    with pytest.raises(HeadError, match="NaN"):
        bone_distances(vertices, faces, np.array([0]))
    for ids in ([], [9], [-1]):
        with pytest.raises(HeadError, match="for 9 vertices"):
            bone_distances(grid(3, 3)[0], faces, np.array(ids, int))


# --- how far they are -----------------------------------------------------------------


def test_on_a_flat_strip_the_distance_is_the_straight_line():
    vertices, faces = grid(4, 31)
    sources = np.array([0, 46, 123])
    found = bone_distances(vertices, faces, sources)
    straight = np.linalg.norm(vertices[:, None] - vertices[sources], axis=-1)
    assert (found >= straight - 1e-12).all() and not found[sources, ALL].any()
    assert np.abs(found - straight).max() < 0.06 * straight.max()
    assert np.abs(found - straight).mean() < 0.02 * straight.mean()


def test_across_a_slit_it_is_far_along_the_cloth():
    vertices, faces = grid(21, 30, slit=0.2)
    left, right = 20 * 30 + 14, 20 * 30 + 15  # at the upper hem, on either side
    assert np.linalg.norm(vertices[left] - vertices[right]) == pytest.approx(0.1)
    distances = bone_distances(vertices, faces, np.array([left, right]))
    assert distances[right, 0] == pytest.approx(3.7, rel=0.05)  # down and up again
    weights = heat_weights(distances, 0.5)
    assert weights[left].tolist() == pytest.approx([1, 0], abs=1e-6)


def test_between_pieces_it_is_infinite_and_a_bare_piece_is_a_straight_line_away():
    vertices, faces = grid(3, 3)
    shifts = np.array([[0, 0, 0], [0, 0, 0.01], [0, 0, 2]])
    points = (vertices + shifts[:, None]).reshape(-1, 3)
    three = np.concatenate([faces, faces + 9, faces + 18])
    distances = bone_distances(points, three, np.array([0, 9]))
    assert np.isinf(distances[:9, 1]).all() and np.isinf(distances[9:18, 0]).all()
    assert np.isfinite(distances[:9, 0]).all()
    assert distances[18].tolist() == pytest.approx([2, 1.99])
    weights = heat_weights(distances, 0.1)
    assert weights[:9].tolist() == [[1, 0]] * 9
    assert np.allclose(weights.sum(axis=1), 1) and weights[18, 1] > weights[18, 0] > 0


def test_a_single_triangle_and_a_loose_vertex_have_distances():
    vertices = np.array([[0.0, 0, 0], [3, 0, 0], [0, 4, 0], [9, 9, 9]])
    found = bone_distances(vertices, np.array([[0, 1, 2]]), np.array([1, 3]))
    assert found[:3, 0].tolist() == pytest.approx([3, 0, 5])
    assert found[3].tolist() == [np.inf, 0]


def test_the_spacing_of_bones_by_hand():
    distances = np.array([[0.0, 1, 4], [1, 0, 3], [4, 3, 0], [2, 2, 2]])
    assert bone_spacing(distances, ALL) == pytest.approx((1 + 1 + 3) / 3)
    assert bone_spacing(np.array([[0.0], [2]]), np.array([0])) == 1
    apart = np.array([[0, np.inf], [np.inf, 0]])
    assert bone_spacing(apart, np.arange(2)) == 1


# --- what they move -------------------------------------------------------------------


def test_heat_by_hand():
    distances = np.array([[0.0, 0.2, 0.4]])
    gauss = np.exp([0, -1, -4.0])
    assert heat_weights(distances, 0.2, 3)[0] == pytest.approx(gauss / gauss.sum())
    plain = np.exp([0, -1, -2.0])
    found = heat_weights(distances, 0.2, 3, "exponential")[0]
    assert found == pytest.approx(plain / plain.sum())
    two = np.exp([0, -1.0])
    found = heat_weights(distances, 0.2, 2)[0]
    assert found == pytest.approx([*two / two.sum(), 0])
    assert heat_weights(distances, 0.2, 1).tolist() == [[1, 0, 0]]
    assert np.array_equal(heat_weights(distances, 0.2, 9), heat_weights(distances, 0.2))


@pytest.mark.parametrize("kernel", ["gauss", "exponential"])
@pytest.mark.parametrize("influences", [1, 3, 4])
def test_rows_of_heat_sum_to_1_and_hold_no_more_than_asked(kernel, influences):
    distances = np.random.default_rng(0).uniform(0, 2, (50, 8))
    weights = heat_weights(distances, 0.4, influences, kernel)
    assert weights.dtype == np.float32 and (weights >= 0).all()
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-5
    assert ((weights > 0).sum(axis=1) <= influences).all()
    order = distances.argsort(axis=1)
    assert (np.diff(np.take_along_axis(weights, order, 1), axis=1) <= 0).all()


def test_heat_does_not_die_out_far_away():
    """exp(-10^6) is 0: without care these rows would be 0 / 0."""
    weights = heat_weights(np.array([[1000.0, 1000.0005, 1001]]), 1.0, 3)
    assert weights[0] == pytest.approx([1 / (1 + np.exp(-1)), 1 / (1 + np.e), 0])


@pytest.mark.parametrize(
    "distances, alpha, influences, kernel, message",
    [
        ([[0, np.nan]], 1.0, 4, "gauss", "NaN or negative"),
        ([[0, -1]], 1.0, 4, "gauss", "NaN or negative"),
        ([[np.inf, np.inf]], 1.0, 4, "gauss", "1 vertices are infinitely far"),
        ([[0, 1]], 0.0, 4, "gauss", "alpha"),
        ([[0, 1]], np.nan, 4, "gauss", "alpha"),
        ([[0, 1]], 1.0, 0, "gauss", "influences"),
        ([[0, 1]], 1.0, 4, "cubic", "gauss or exponential"),
    ],
)
def test_heat_that_cannot_be_is_refused(distances, alpha, influences, kernel, message):
    with pytest.raises(HeadError, match=message):
        heat_weights(np.array(distances, float), alpha, influences, kernel)


def test_bind_and_offset_undo_each_other(rig):
    binds, offsets = rig.binds, rig.offsets
    assert np.array_equal(binds @ offsets, np.tile(np.eye(4), (COUNT + 3, 1, 1)))
    assert np.array_equal(binds[:COUNT, :3, 3], rig.points)
    assert np.array_equal(binds[:, :3, :3], np.tile(np.eye(3), (COUNT + 3, 1, 1)))
    at_rest = hybrid_skinning(rig.rest, rig.virtual, binds[:COUNT], offsets[:COUNT])
    assert np.abs(at_rest - rig.rest).max() < 1e-6
    with pytest.raises(HeadError, match="points"):
        virtual_bind(np.array([[np.inf, 0, 0]]))


def test_looseness_by_hand():
    by = {"threshold": 0.01, "slope": 1 / 0.03}  # loose altogether from 40 mm on
    lbs = np.zeros((10, 4, 3))
    simulated = np.zeros((10, 4, 3))
    simulated[:, 0, 0] = 0.008
    simulated[:, 1] = [0.015, 0.02, 0]  # 25 mm
    simulated[:, 2, 1] = -0.05
    simulated[9, 3, 2] = 0.2  # 20 mm in the mean
    found = looseness(lbs, simulated, **by)
    assert found == pytest.approx([0, 0.5, 1, 1 / 3]) and found.dtype == np.float32
    assert looseness(lbs, simulated, reduce="p90", **by)[3] == pytest.approx(1 / 3)
    simulated[7:, 3, 2] = 0.035
    assert looseness(lbs, simulated, reduce="p90", **by)[3] == pytest.approx(5 / 6)
    assert not looseness(lbs, lbs).any()


def test_looseness_that_cannot_be_is_refused():
    good = np.zeros((2, 3, 3))
    exploded = good.copy()
    exploded[1, 2, 0] = np.nan
    with pytest.raises(HeadError, match=r"simulated.* 1 values .*\[1, 2, 0\]"):
        looseness(good, exploded)
    for other in (good[:1], good[:, :2], good[0]):
        with pytest.raises(HeadError, match="Give both as"):
            looseness(good, other)
    with pytest.raises(HeadError, match="slope"):
        looseness(good, good, slope=0.0)
    with pytest.raises(HeadError, match="threshold"):
        looseness(good, good, threshold=-0.1)
    with pytest.raises(HeadError, match="mean or p90"):
        looseness(good, good, reduce="max")


# --- joints and virtual bones together ------------------------------------------------


def test_hybrid_rows_sum_to_1(rig):
    loose = np.linspace(0, 1, len(rig.rest))
    weights = hybrid_weights(loose, rig.virtual, rig.joints)
    assert weights.shape == (len(rig.rest), COUNT + 3)
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-5
    assert np.allclose(weights[:, :COUNT].sum(axis=1), loose, atol=1e-6)
    with pytest.raises(HeadError, match="rows"):
        hybrid_weights(loose[1:], rig.virtual, rig.joints)
    for bad in (1.1, -0.1, np.nan):
        with pytest.raises(HeadError, match="0 to 1"):
            hybrid_weights(np.full(len(loose), bad), rig.virtual, rig.joints)


def test_where_nothing_is_loose_it_is_blend_skinning(rig):
    motion = bends()
    _, joints = rig.stands(motion)
    anywhere = np.random.default_rng(0).normal(size=(12, COUNT, 4, 4))
    transforms = np.concatenate([anywhere, joints], axis=1)
    none = np.zeros(len(rig.rest))
    weights = hybrid_weights(none, rig.virtual, rig.joints)
    found = hybrid_skinning(rig.rest, weights, transforms, rig.offsets)
    local = in_root_frame(motion.transforms(SKELETON))
    expected = linear_blend_skinning(rig.rest, rig.joints, local)
    assert np.abs(found - expected).max() < 1e-5
    # And where the root stands in the world, as the body has it.
    roots = motion.transforms(SKELETON)[:, :1]
    world = linear_blend_skinning(rig.rest, rig.joints, motion.transforms(SKELETON))
    back = found @ roots[:, 0, :3, :3].swapaxes(1, 2) + roots[:, :, :3, 3]
    assert np.abs(back - world).max() < 1e-5


def test_where_all_is_loose_joints_have_no_effect(rig):
    carrier, joints = rig.stands(bends())
    elsewhere = np.random.default_rng(0).normal(size=joints.shape).astype(np.float32)
    weights = hybrid_weights(np.ones(len(rig.rest)), rig.virtual, rig.joints)
    one, other = (
        hybrid_skinning(
            rig.rest, weights, np.concatenate([carrier, stand], axis=1), rig.offsets
        )
        for stand in (joints, elsewhere)
    )
    assert np.array_equal(one, other)


def test_hybrid_skinning_in_torch_agrees_with_numpy(rig):
    carrier, joints = rig.stands(bends())
    transforms = np.concatenate([carrier, joints], axis=1)
    loose = np.linspace(0, 1, len(rig.rest))
    arrays = (
        rig.rest,
        hybrid_weights(loose, rig.virtual, rig.joints),
        transforms,
        rig.offsets,
    )
    found = hybrid_skinning(*(torch.tensor(array) for array in arrays))
    assert np.abs(found.numpy() - hybrid_skinning(*arrays)).max() < 1e-5


def test_pruning_drops_light_joints_and_keeps_rows_at_1(rig):
    joints = np.hstack([rig.joints * 0.999, np.full((len(rig.rest), 1), 0.001)])
    weights, kept = prune_joints(joints, 0.5)
    assert kept.tolist() == [0, 1, 2] and weights.dtype == np.float32
    assert np.allclose(weights, rig.joints, atol=1e-6)

    loose = np.clip(0.7 - rig.rest[:, 2], 0, 1) ** 0.1  # tight above 0.7
    mixed = hybrid_weights(loose, rig.virtual, rig.joints)
    weights, kept = prune_joints(mixed, 20.0, virtual=COUNT)
    assert kept[:COUNT].tolist() == list(range(COUNT))
    assert COUNT < len(kept) < COUNT + 3
    assert np.abs(weights.sum(axis=1) - 1).max() < 1e-5


def test_pruning_never_leaves_a_vertex_with_nothing():
    weights, kept = prune_joints(np.array([[1.0, 0, 0], [1, 0, 0], [0, 0.3, 0.7]]), 1.5)
    assert kept.tolist() == [0, 2]
    assert weights.tolist() == [[1, 0], [1, 0], [0, 1]]
    assert prune_joints(np.eye(3), 0.0)[1].tolist() == [0, 1, 2]
    for bad in (0.0, np.nan):
        with pytest.raises(HeadError, match="empty or NaN"):
            prune_joints(np.full((2, 2), bad))


# --- the best there is ----------------------------------------------------------------


@pytest.fixture(scope="module")
def moved(rig) -> tuple[np.ndarray, np.ndarray]:
    """Random rigid transforms from rest (5, N, 4, 4), and the sleeve they move."""
    rng = np.random.default_rng(1)
    transforms = np.tile(np.eye(4), (5, COUNT, 1, 1))
    turns = Rotation.from_rotvec(rng.normal(0, 0.4, (5 * COUNT, 3)))
    transforms[..., :3, :3] = turns.as_matrix().reshape(5, COUNT, 3, 3)
    transforms[..., :3, 3] = rng.normal(0, 0.1, (5, COUNT, 3))
    return transforms, linear_blend_skinning(rig.rest, rig.virtual, transforms)


def fit_error(rig, posed, kind, weights=None) -> float:
    weights = rig.virtual if weights is None else weights
    found = oracle(rig.rest, weights, posed, kind)
    again = linear_blend_skinning(rig.rest, weights, found)
    return float(np.sqrt(((again - posed) ** 2).sum(axis=-1).mean()))


def test_the_oracle_finds_what_moved_the_garment(rig, moved):
    transforms, posed = moved
    assert np.abs(oracle(rig.rest, rig.virtual, posed) - transforms).max() < 1e-3
    assert fit_error(rig, posed, "affine") < 1e-5
    assert fit_error(rig, posed, "rigid") < 1e-4
    found = oracle(rig.rest, rig.virtual, posed, "rigid")[..., :3, :3]
    assert np.allclose(found @ found.swapaxes(-1, -2), np.eye(3), atol=1e-5)


def test_more_freedom_fits_better(rig, moved):
    posed = moved[1] + np.random.default_rng(2).normal(0, 0.01, moved[1].shape)
    errors = [fit_error(rig, posed, kind) for kind in ("affine", "rigid")]
    errors.append(fit_error(rig, posed, "translation"))
    # Without structure to find, noise of 10 mm remains in each coordinate.
    assert 0.014 < errors[0] < errors[1] < 0.018 < 0.03 < errors[2]
    found = oracle(rig.rest, rig.virtual, posed, "translation")
    assert np.allclose(found[..., :3, :3], np.eye(3), atol=1e-6)


def test_a_bone_that_moves_nothing_stays(rig, moved):
    weights = np.hstack([rig.virtual, np.zeros((len(rig.rest), 1), np.float32)])
    for kind in ("affine", "rigid", "translation"):
        found = oracle(rig.rest, weights, moved[1], kind)
        assert np.allclose(found[:, -1], np.eye(4), atol=1e-6)
    with pytest.raises(HeadError, match="one of affine"):
        oracle(rig.rest, weights, moved[1], "similar")
    with pytest.raises(HeadError, match="posed"):
        oracle(rig.rest, weights, moved[1] * np.nan)


# --- the frame of the root ------------------------------------------------------------


def test_in_its_own_frame_the_root_stands_as_at_rest():
    transforms = bends().transforms(SKELETON)
    local = in_root_frame(transforms)
    assert np.allclose(local[:, 0], np.eye(4), atol=1e-6)
    assert np.allclose(transforms[:, :1] @ local, transforms, atol=1e-5)
    assert np.allclose(undone(transforms) @ transforms, np.eye(4), atol=1e-5)


def test_the_nearest_rotation():
    turn = Rotation.from_rotvec([0.3, -0.2, 1]).as_matrix()
    assert np.allclose(nearest_rotation(2.5 * turn), turn)
    mirror = nearest_rotation(np.diag([1.0, 1, -0.1]))
    assert np.allclose(mirror, np.eye(3))  # never a reflection
    rng = np.random.default_rng(0)
    matrices = rng.normal(size=(20, 3, 3))
    found = nearest_rotation(matrices)
    others = Rotation.random(500, rng=rng).as_matrix()
    gap = np.linalg.norm(others - matrices[:, None], axis=(-1, -2)).min(axis=1)
    assert (np.linalg.norm(found - matrices, axis=(-1, -2)) <= gap).all()
    assert np.allclose(np.linalg.det(found), 1)


def test_carriers_go_where_blend_skinning_takes_their_points(rig):
    motion = bends()
    carrier, _ = rig.stands(motion)
    local = in_root_frame(motion.transforms(SKELETON))
    weights = rig.smooth[rig.bones]
    expected = linear_blend_skinning(rig.points, weights, local)
    assert np.abs(carrier[..., :3, 3] - expected).max() < 1e-5
    assert np.allclose(np.linalg.det(carrier[..., :3, :3]), 1, atol=1e-5)
    still = carriers(np.tile(np.eye(4), (3, 1, 1)), weights, rig.points)
    assert np.allclose(still, rig.binds[:COUNT], atol=1e-6)
    # One joint alone: it takes the bone with it as one piece.
    alone = np.eye(3)[[1] * COUNT]
    rigid = carriers(local, alone, rig.points)
    assert np.allclose(rigid, local[:, 1:2] @ rig.binds[:COUNT], atol=1e-5)


def test_features_by_hand():
    """A quarter turn to the left about Z in a second, then half a metre ahead."""
    rotations = np.zeros((3, 3, 3))
    rotations[1:, 0, 2] = np.pi / 2
    rotations[:, 1, 0] = [0, 0, np.pi / 2]
    path = [[0, 0, 0], [0, 0, 0], [0.5, 0, 0]]  # it looks along -Y, turned along +X
    motion = Motion.create(rotations, SKELETON.names, path, fps=2)
    found = features(motion, SKELETON, [1, 2])
    assert found.shape == (3, 9 * 2 + 9) and found.dtype == np.float32
    columns, places = found[:, :12].reshape(3, 2, 6), found[:, 12:18].reshape(3, 2, 3)
    velocity, turning, gravity = found[:, 18:21], found[:, 21:24], found[:, 24:]
    assert columns[0].tolist() == [[1, 0, 0, 0, 1, 0]] * 2
    assert columns[2, 0].tolist() == pytest.approx([1, 0, 0, 0, 0, 1], abs=1e-6)
    assert np.allclose(places[:2], SKELETON.joints[1:], atol=1e-6)
    assert np.allclose(places[2], [[0, 0, 0.35], [0, -0.35, 0.35]], atol=1e-6)
    assert np.allclose(velocity, [[0, 0, 0], [0, 0, 0], [0, -1, 0]], atol=1e-6)
    assert np.allclose(turning, [[0, 0, 0], [0, 0, np.pi], [0, 0, 0]], atol=1e-5)
    assert np.allclose(gravity, [[0, 0, -1]] * 3, atol=1e-6)


def test_gravity_is_seen_from_the_root():
    rotations = np.zeros((1, 3, 3))
    rotations[0, 0, 0] = np.pi / 2  # on its back: down is its own -Y
    motion = Motion.create(rotations, SKELETON.names)
    assert np.allclose(features(motion, SKELETON, [1])[0, -3:], [0, -1, 0], atol=1e-6)


@pytest.mark.parametrize("angle", [0.4, 2.0, -3.1])
def test_it_makes_no_difference_where_the_body_faces_and_stands(rig, angle):
    motion = smoothly()
    other = turned(motion, angle, [5, -3, 1])
    for one, same in zip(rig.stands(motion), rig.stands(other), strict=True):
        assert np.abs(one - same).max() < 1e-5
    gap = features(motion, SKELETON, ALL) - features(other, SKELETON, ALL)
    assert np.abs(gap).max() < 1e-3  # velocities: rounding times 30 frames a second
    leant = motion.rotations + np.array([[0.3, 0, 0]] + [[0, 0, 0]] * 2)
    leant = Motion.create(leant, motion.bone_names, motion.translations)
    gap = features(motion, SKELETON, ALL) - features(leant, SKELETON, ALL)
    assert np.abs(gap).max() > 0.1


def test_features_of_a_stream_are_those_of_the_whole():
    motion = smoothly()
    whole = features(motion, SKELETON, [0, 2])
    transforms, before = motion.transforms(SKELETON), None
    for frame in range(len(motion)):
        now = transforms[frame : frame + 1]
        found = pose_features(now, SKELETON, [0, 2], motion.fps, before)
        assert np.array_equal(found, whole[frame : frame + 1])
        before = now[0, 0]


def test_features_that_cannot_be_are_refused():
    transforms = bends(2).transforms(SKELETON)
    with pytest.raises(HeadError, match="Keep at least one"):
        pose_features(transforms, SKELETON, [], 30)
    with pytest.raises(HeadError, match="fps"):
        pose_features(transforms, SKELETON, [1], 0)
    with pytest.raises(HeadError, match="NaN"):
        pose_features(transforms * np.nan, SKELETON, [1], 30)
    other = Motion.create(np.zeros((2, 1, 3)), ["tail"])
    with pytest.raises(HeadError, match="bone_names"):
        features(other, SKELETON, [0])


# --- the network ----------------------------------------------------------------------


def network(bones: int = COUNT, seed: int = 0, trained: bool = False, **options):
    """A small one; `trained` with a last layer that is not 0."""
    torch.manual_seed(seed)
    net = VirtualBonesNet(36, bones, VirtualBonesConfig(hidden=16, **options))
    if trained:
        with torch.no_grad():
            net.decoder[-1].weight.normal_(0, 0.5)
            net.decoder[-1].bias.normal_(0, 0.5)
    return net


def sequences(rig) -> tuple[torch.Tensor, torch.Tensor]:
    """Features (2, 20, 36) and carriers (2, 20, N, 4, 4) of two motions."""
    motions = [smoothly(seed=0), smoothly(seed=1)]
    read = np.stack([features(motion, SKELETON, ALL) for motion in motions])
    carrier = np.stack([rig.stands(motion)[0] for motion in motions])
    return torch.from_numpy(read), torch.from_numpy(carrier)


@pytest.mark.parametrize("rotate", [True, False])
def test_untrained_the_bones_stand_where_they_are_carried(rig, rotate):
    read, carrier = sequences(rig)
    net = network(rotate=rotate)
    net.standardise(read)
    with torch.inference_mode():
        assert (net(read, carrier) - carrier).abs().max() < 1e-6


def test_untrained_the_garment_moves_as_by_blend_skinning(rig):
    """Of one joint for all: each virtual bone goes with it as one piece."""
    motion = smoothly()
    local = in_root_frame(motion.transforms(SKELETON))
    carrier = carriers(local, np.eye(3)[[2] * COUNT], rig.points)
    read = torch.from_numpy(features(motion, SKELETON, ALL))
    with torch.inference_mode():
        stands = network()(read[None], torch.from_numpy(carrier)[None])[0].numpy()
    found = hybrid_skinning(rig.rest, rig.virtual, stands, rig.offsets[:COUNT])
    alone = np.eye(3)[[2] * len(rig.rest)]
    expected = linear_blend_skinning(rig.rest, alone, local)
    assert np.abs(found - expected).max() < 1e-5


@pytest.mark.parametrize("rotate", [True, False])
def test_what_it_returns_is_rigid(rig, rotate):
    read, carrier = sequences(rig)
    with torch.inference_mode():
        found = network(trained=True, rotate=rotate)(read, carrier)
    assert found.shape == carrier.shape and found.dtype == torch.float32
    turns = found[..., :3, :3]
    assert (turns @ turns.mT - torch.eye(3)).abs().max() < 1e-5
    assert torch.equal(found[..., 3, :], carrier[..., 3, :])
    assert (found - carrier)[..., :3, 3].abs().max() > 0.01
    assert torch.equal(turns, carrier[..., :3, :3]) != rotate


def test_the_output_shifts_a_bone_by_metres(rig):
    read, carrier = sequences(rig)
    net = network(rotate=False)
    with torch.no_grad():
        net.decoder[-1].bias[4] = 0.25  # Y of the second bone
        moved = net(read, carrier) - carrier
    assert moved[..., 1, 1, 3].allclose(torch.tensor(0.25), atol=1e-6)
    moved[..., 1, 1, 3] = 0
    assert not moved.any()


def test_the_output_turns_a_bone_about_the_axes_of_the_root(rig):
    read, carrier = sequences(rig)
    net = network()
    quarter = torch.tensor([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    with torch.no_grad():
        net.decoder[-1].bias[3:9] = (quarter - torch.eye(3))[:, :2].T.reshape(6)
        found = net(read, carrier)[..., 0, :3, :3]
    assert (found - quarter @ carrier[..., 0, :3, :3]).abs().max() < 1e-6


def test_a_stream_equals_the_batch(rig):
    read, carrier = sequences(rig)
    net = network(trained=True)
    net.standardise(read)
    state, frames = None, []
    with torch.inference_mode():
        whole = net(read, carrier)
        for frame in range(read.shape[1]):
            stands, state = net.step(read[:, frame], carrier[:, frame], state)
            frames.append(stands)
    assert (torch.stack(frames, dim=1) - whole).abs().max() < 1e-5
    assert (whole[:, 1:] - whole[:, :-1]).abs().max() > 1e-3


def test_it_remembers_and_does_not_foresee(rig):
    read, carrier = sequences(rig)
    net, other = network(trained=True), read.clone()
    other[:, 8] += 1
    with torch.inference_mode():
        gap = (net(read, carrier) - net(other, carrier)).abs().amax(dim=(0, 2, 3, 4))
    assert not gap[:8].any() and (gap[8:12] > 1e-4).all()


def test_sequences_of_a_batch_do_not_mix(rig):
    read, carrier = sequences(rig)
    net = network(trained=True)
    with torch.inference_mode():
        both = net(read, carrier)
        for one in range(2):
            alone = net(read[one : one + 1], carrier[one : one + 1])
            assert (alone - both[one]).abs().max() < 1e-5


def test_after_one_step_gradients_reach_the_encoder(rig):
    read, carrier = sequences(rig)
    rest, weights, offsets = map(
        torch.tensor, (rig.rest, rig.virtual, rig.offsets[:COUNT])
    )
    truth = hybrid_skinning(rest, weights, carrier, offsets) - 0.02
    net = network()
    net.standardise(read)
    optimiser = torch.optim.Adam(net.parameters(), 1e-3)
    losses = []
    for _ in range(30):
        posed = hybrid_skinning(rest, weights, net(read, carrier), offsets)
        losses.append((posed - truth).square().sum(-1).mean())
        optimiser.zero_grad()
        losses[-1].backward()
        first = {name: p.grad.abs().max() for name, p in net.named_parameters()}
        assert all(p.grad.isfinite().all() for p in net.parameters())
        if len(losses) == 1:  # the last layer is 0 and lets nothing through
            assert first["decoder.2.bias"] > 0 and first["encoder.0.weight"] == 0
        if len(losses) == 2:
            assert min(first.values()) > 0
        optimiser.step()
    assert losses[-1] < 0.3 * losses[0]


def test_features_are_standardised(rig):
    read, _ = sequences(rig)
    net = network()
    net.standardise(read)
    scaled = (read - net.mean) / net.scale
    varied = read.flatten(0, 1).std(dim=0) > 1e-3
    assert scaled.mean(dim=(0, 1)).abs().max() < 1e-3
    spread = scaled.flatten(0, 1).std(dim=0, correction=0)
    assert (spread[varied] - 1).abs().max() < 1e-4 and varied.sum() > 10
    assert spread[~varied].max() < 1e-3  # the root, as it sees itself: rounding
    saved = net.state_dict()
    assert {"mean", "scale"} <= set(saved)
    for bad in (read[..., 1:], read * np.nan, read[:0]):
        with pytest.raises(HeadError, match="features"):
            net.standardise(bad)


def test_the_description_makes_the_same_network(rig):
    read, carrier = sequences(rig)
    net = network(trained=True, rotate=False)
    net.standardise(read)
    told = net.describe()
    sizes = told.pop("inputs"), told.pop("bones")
    same = VirtualBonesNet(*sizes, VirtualBonesConfig(**told))
    same.load_state_dict(net.state_dict())
    with torch.inference_mode():
        assert torch.equal(net(read, carrier), same(read, carrier))


def test_the_same_seed_is_the_same_network():
    one, same, other = (network(seed=seed).state_dict() for seed in (0, 0, 1))
    weight = "memory.weight_ih_l0"
    assert torch.equal(one[weight], same[weight])
    assert not torch.equal(one[weight], other[weight])
    for sizes in ((0, 3), (3, 0)):
        with pytest.raises(HeadError, match="1 or more"):
            VirtualBonesNet(*sizes)


def test_two_columns_make_a_rotation():
    change = torch.randn(50, 6, generator=torch.manual_seed(0))
    turns = rotation_from_columns(change)
    assert (turns @ turns.mT - torch.eye(3)).abs().max() < 1e-5
    assert (torch.linalg.det(turns) - 1).abs().max() < 1e-5
    wanted = torch.from_numpy(Rotation.from_rotvec([0.3, 1, -2]).as_matrix())
    columns = (wanted - torch.eye(3))[:, :2].T.reshape(6)
    assert (rotation_from_columns(columns) - wanted).abs().max() < 1e-7
    flat = torch.tensor([-1.0, 1, 0, 0, 0, 0], requires_grad=True)  # parallel columns
    rotation_from_columns(flat).sum().backward()
    assert flat.grad.isfinite().all()
