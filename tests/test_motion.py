import inspect

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from skinlib.garments.body import read_body
from skinlib.garments.motion import (
    DEEPEST,
    JOINTS,
    LIMITS,
    MOTIONS,
    Motion,
    _parts,
    bend,
    held_out_motions,
    joint_axes,
    mirrored,
    random_poses,
    reach,
    read_motion,
    self_intersection,
    squat,
    training_motions,
    turn,
    walk,
    write_motion,
)
from skinlib.head import HeadError, Skeleton
from skinlib.skinning import mirror_pairs

FLIP = np.array([1, -1, -1])  # of a rotation vector, in a mirror across x = 0


@pytest.fixture(scope="module")
def body():
    return read_body()


@pytest.fixture(scope="module")
def head(body):
    return body.head


@pytest.fixture(scope="module")
def skeleton(head):
    return head.skeleton


@pytest.fixture(scope="module")
def held_out(skeleton):
    return held_out_motions(skeleton)


def posed_joint(skeleton, motion, bone):
    """(T, 3) where the joint of a bone is in each frame."""
    at = skeleton.names.index(bone)
    transforms = motion.transforms(skeleton)[:, at]
    return transforms[:, :3, :3] @ skeleton.joints[at] + transforms[:, :3, 3]


def angle_at(points):
    """Degrees between the directions from the first of three points to the others."""
    corner, *ends = points
    a, b = (end - corner for end in ends)
    return np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))


def pose(skeleton, **angles):
    """One pose; `knee_L=60` stands for 60 degrees of flexion."""
    angles = {name.replace("_", "."): [[a, 0, 0]] for name, a in angles.items()}
    return Motion.create(bend(skeleton, angles), skeleton.names)


def assert_within_limits(skeleton, motion, but=()):
    axes = joint_axes(skeleton)
    moving = np.zeros(len(skeleton), bool)
    for name, joint in JOINTS.items():
        for bone in joint.bones:
            at = skeleton.names.index(bone)
            moving[at] = True
            if bone not in but:
                angles = np.degrees(motion.rotations[:, at] @ axes[name].T)
                low, high = LIMITS[bone].T
                assert (angles >= low - 1e-3).all(), bone
                assert (angles <= high + 1e-3).all(), bone
    assert not motion.rotations[:, ~moving].any()


# --- Motion ---------------------------------------------------------------------------


def test_transforms_of_one_bone_are_those_worked_out_by_hand():
    bone = Skeleton.from_heads_and_tails([[1, 0, 0]], None, [-1], ["root"])
    quarter = Motion.create([[[0, 0, np.pi / 2]]], ["root"], [[0, 0, 5]])
    # (x, y) -> (-y, x) about (1, 0), then up by 5.
    expected = [[0, -1, 0, 1], [1, 0, 0, -1], [0, 0, 1, 5], [0, 0, 0, 1]]
    transforms = quarter.transforms(bone)
    assert transforms.shape == (1, 1, 4, 4) and transforms.dtype == np.float32
    np.testing.assert_allclose(transforms[0, 0], expected, atol=1e-6)


def test_only_the_root_is_translated_and_its_children_follow():
    chain = Skeleton.from_heads_and_tails(np.eye(3), None, [2, 0, -1], list("abc"))
    moved = Motion.create(np.zeros((2, 3, 3)), chain.names, [[1, 2, 3], [0, 0, 0]])
    shifts = moved.transforms(chain)[..., :3, 3]
    assert shifts[0].tolist() == [[1, 2, 3]] * 3
    assert not shifts[1].any()


def test_matrices_turn_as_the_rotation_vectors_say(skeleton):
    motion = random_poses(skeleton, 2, seed=0)
    matrices = motion.matrices()
    assert matrices.shape == (2, 36, 3, 3)
    back = Rotation.from_matrix(matrices[1]).as_rotvec()
    np.testing.assert_allclose(back, motion.rotations[1], atol=1e-5)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rotations": np.full((2, 3, 3), np.nan)}, "rotations: 2 frames hold NaN"),
        ({"rotations": np.zeros((2, 4, 3))}, r"shape \(2, 4, 3\).*or more, 3, 3"),
        ({"rotations": np.zeros((0, 3, 3))}, "1 or more"),
        ({"rotations": np.full((2, 3, 3), "a")}, "rotations: <U1 values"),
        ({"rotations": np.full((2, 3, 3), 1e300)}, "NaN or infinity"),
        (
            {"rotations": np.full((2, 3, 3), 45.0)},
            r"'a' turns by 77\.9 radians in frame 0\. Give rotation vectors in radians",
        ),
        ({"translations": np.zeros((1, 3))}, r"translations.*shape \(2, 3\)"),
        ({"translations": np.array([[0, 0, 0], [0, np.inf, 0]])}, "is frame 1"),
        ({"fps": 0.0}, "fps: it is 0"),
        ({"fps": float("nan")}, "fps"),
    ],
)
def test_bad_arrays_are_refused(changes, message):
    fields = {"rotations": np.zeros((2, 3, 3)), "bone_names": ["a", "b", "c"]}
    with pytest.raises(HeadError, match=message):
        Motion.create(**fields | changes)


def test_a_motion_of_other_bones_is_refused(skeleton):
    short = Motion.create(np.zeros((1, 35, 3)), skeleton.names[:-1])
    with pytest.raises(HeadError, match="a motion of 35 bones, a skeleton of 36"):
        short.transforms(skeleton)
    turned = Motion.create(np.zeros((1, 36, 3)), skeleton.names[::-1])
    with pytest.raises(HeadError, match="'head' where the skeleton has 'root'"):
        turned.transforms(skeleton)


# --- files ----------------------------------------------------------------------------


def test_round_trip(tmp_path, skeleton):
    motion = walk(skeleton, 1, travel=True, fps=25)
    write_motion(tmp_path / "stroll.npz", motion)
    again = read_motion(tmp_path / "stroll.npz")
    np.testing.assert_array_equal(again.rotations, motion.rotations)
    np.testing.assert_array_equal(again.translations, motion.translations)
    assert (again.bone_names, again.fps) == (motion.bone_names, 25)
    assert again.name == "stroll"
    assert [file.name for file in tmp_path.iterdir()] == ["stroll.npz"]


def test_translations_and_frame_rate_may_be_left_out(tmp_path):
    path = tmp_path / "pose.npz"
    np.savez(path, rotations=np.zeros((4, 1, 3)), bone_names=["root"])
    motion = read_motion(path)
    assert motion.fps == 30 and motion.translations.shape == (4, 3)


def test_damaged_files_and_pickles_are_refused(tmp_path, skeleton):
    path = tmp_path / "motion.npz"
    with pytest.raises(HeadError, match="cannot be read"):
        read_motion(path)
    write_motion(path, random_poses(skeleton, 3, seed=1))
    whole = path.read_bytes()
    middle = len(whole) // 2
    flipped = whole[:middle] + bytes(64) + whole[middle + 64 :]
    for damaged in (b"", b"hello", whole[:middle], flipped):
        path.write_bytes(damaged)
        with pytest.raises(HeadError, match=r"motion\.npz: motion: it cannot be read"):
            read_motion(path)
    pickled = np.array([None, "root"], object)
    np.savez(path, rotations=np.zeros((1, 2, 3)), bone_names=pickled)
    with pytest.raises(HeadError, match="without pickles"):
        read_motion(path)
    np.savez(path, bone_names=["root"])
    with pytest.raises(HeadError, match="rotations"):
        read_motion(path)
    np.savez(path, rotations=np.zeros((1, 1, 3)), bone_names=[7])
    with pytest.raises(HeadError, match="one string per bone"):
        read_motion(path)
    np.savez(path, rotations=np.full((1, 1, 3), np.nan), bone_names=["root"])
    with pytest.raises(HeadError, match=r"motion\.npz: rotations: 1 frames hold NaN"):
        read_motion(path)


# --- joints ---------------------------------------------------------------------------


def test_axes_are_unit_at_right_angles_and_mirrored(body):
    for shape in ({}, {"weight": 1, "height": -1}):
        axes = joint_axes(body.shaped(shape).skeleton)
        for name, rows in axes.items():
            np.testing.assert_allclose(rows @ rows.T, np.eye(3), atol=1e-9)
            other = axes[name[:-2] + ".R"] if name.endswith(".L") else None
            if other is not None:
                np.testing.assert_allclose(other, rows * FLIP, atol=1e-3)


def test_bones_of_a_joint_share_all_of_its_angle():
    for joint in JOINTS.values():
        sums = np.sum([*joint.bones.values()], axis=0)
        used = [low < high for low, high in joint[:3]]
        np.testing.assert_allclose(sums[used], 1)
    assert LIMITS["spine03"].tolist() == pytest.approx(
        np.array([[-4, 9], [-4, 4], [-6, 6]])
    )
    assert LIMITS["upperleg01.L"].tolist() == [[-20, 90], [-12, 35], [0, 0]]


def test_the_whole_spine_turns_by_the_joint_s_angle(skeleton):
    pose = Motion.create(bend(skeleton, {"spine": [[0, 0, 30]]}), skeleton.names)
    chest = pose.transforms(skeleton)[0, skeleton.names.index("spine01")]
    # To the left: the front, -Y, goes towards +X.
    expected = [np.sin(np.pi / 6), -np.cos(np.pi / 6), 0]
    np.testing.assert_allclose(chest[:3, :3] @ [0, -1, 0], expected, atol=1e-5)


@pytest.mark.parametrize("side", ["L", "R"])
def test_elbows_and_knees_bend_the_right_way(skeleton, side):
    bent = pose(skeleton, **{f"elbow_{side}": 60.0, f"knee_{side}": 90.0})
    rest = pose(skeleton, spine=0.0)

    def moved(bone):
        return posed_joint(skeleton, bent, f"{bone}.{side}")[0]

    def still(bone):
        return posed_joint(skeleton, rest, f"{bone}.{side}")[0]

    shoulder, wrist = still("upperarm01"), still("wrist")
    assert np.linalg.norm(moved("wrist") - shoulder) < 0.8 * np.linalg.norm(
        wrist - shoulder
    )
    assert moved("wrist")[1] < wrist[1]  # to the front
    assert moved("foot")[1] > still("foot")[1] + 0.3  # to the back
    assert moved("foot")[2] > still("foot")[2] + 0.2
    elbow = [
        angle_at(f(b) for b in ("lowerarm01", "upperarm01", "wrist"))
        for f in (still, moved)
    ]
    # The upper arm is not quite straight from the shoulder to the elbow.
    assert elbow[0] - elbow[1] == pytest.approx(60, abs=1)


def test_limbs_swing_forward_and_lift_sideways(skeleton):
    angles = {
        f"{limb}.{s}": [[60, 0, 0], [0, 30, 0]]
        for limb in ("shoulder", "hip")
        for s in "LR"
    }
    motion = Motion.create(bend(skeleton, angles), skeleton.names)
    for side, outward in (("L", 1), ("R", -1)):
        for bone in ("wrist", "foot"):
            rest = skeleton.joints[skeleton.names.index(f"{bone}.{side}")]
            forward, lifted = posed_joint(skeleton, motion, f"{bone}.{side}")
            assert forward[1] < rest[1] - 0.2
            assert (lifted - rest)[0] * outward > 0.05
            assert lifted[2] > rest[2] + 0.05


def test_bend_refuses_what_a_joint_cannot_do(skeleton):
    with pytest.raises(HeadError, match=r"flexion of knee.L is -5 deg.*Keep.*0 to 120"):
        bend(skeleton, {"knee.L": [-5, 0, 0]})
    with pytest.raises(HeadError, match="twist of neck is nan"):
        bend(skeleton, {"neck": [[0, 0, 0], [0, 0, np.nan]]})
    with pytest.raises(HeadError, match=r"no joint 'tail'\. Choose from root, spine"):
        bend(skeleton, {"tail": [0, 0, 0]})
    bone = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["root"])
    with pytest.raises(HeadError, match="bone_names: the skeleton has no clavicle"):
        random_poses(bone, 1, seed=0)


# --- random poses ---------------------------------------------------------------------


def test_random_poses_depend_on_the_seed_and_their_number_alone(skeleton):
    long, short = random_poses(skeleton, 20, 3), random_poses(skeleton, 10, 3)
    assert long.rotations.shape == (20, 36, 3)
    np.testing.assert_array_equal(long.rotations[:10], short.rotations)
    assert not np.allclose(random_poses(skeleton, 10, 4).rotations, short.rotations)
    assert len(np.unique(long.rotations.reshape(20, -1), axis=0)) == 20


def test_random_poses_fill_the_limits_and_keep_them(skeleton):
    poses = random_poses(skeleton, 200, seed=0)
    assert_within_limits(skeleton, poses)
    knee = poses.rotations[:, skeleton.names.index("lowerleg01.L")]
    wide, moderate = np.degrees(np.linalg.norm(knee, axis=1)).reshape(-1, 2).T
    assert wide.max() > 110 and 50 < moderate.max() <= 60


def test_left_and_right_are_drawn_alike_but_on_their_own(skeleton):
    rotations = random_poses(skeleton, 400, seed=1).rotations
    left = rotations[:, skeleton.names.index("upperarm01.L")]
    right = rotations[:, skeleton.names.index("upperarm01.R")] * FLIP
    np.testing.assert_allclose(left.mean(axis=0), right.mean(axis=0), atol=0.15)
    assert abs(np.corrcoef(left[:, 1], right[:, 1])[0, 1]) < 0.2


def test_poses_with_a_limb_in_another_are_drawn_again(skeleton, head):
    free, kept = random_poses(skeleton, 12, 0), random_poses(skeleton, 12, 0, head)
    was = self_intersection(head, free.transforms(skeleton)) > DEEPEST
    assert was.any()  # else this seed tests nothing
    assert (self_intersection(head, kept.transforms(skeleton)) <= DEEPEST).all()
    np.testing.assert_array_equal(kept.rotations[~was], free.rotations[~was])
    first = random_poses(skeleton, 1 + int(was.argmax()), 0, head)
    np.testing.assert_array_equal(first.rotations, kept.rotations[: len(first)])
    assert_within_limits(skeleton, kept)


def test_no_poses_or_a_negative_seed_are_refused(skeleton):
    with pytest.raises(HeadError, match="0 poses with seed 1"):
        random_poses(skeleton, 0, 1)
    with pytest.raises(HeadError, match="2 poses with seed -1"):
        random_poses(skeleton, 2, -1)


# --- self-intersection ----------------------------------------------------------------


def test_a_body_at_rest_is_clear_and_a_hand_in_the_belly_is_not(skeleton, head):
    bones = len(skeleton)
    transforms = np.tile(np.eye(4, dtype=np.float32), (3, bones, 1, 1))
    wrist = skeleton.names.index("wrist.L")
    hand = head.vertices[head.weights[:, wrist] > 0.99].mean(axis=0)
    torso = head.vertices[np.abs(head.vertices[:, 2] - 0.3) < 0.02]
    torso = torso[np.abs(torso[:, 0]) < 0.2]
    belly = np.array([0, (torso[:, 1].min() + torso[:, 1].max()) / 2, 0.3])
    arm = ["upperarm01.L", "upperarm02.L", "lowerarm01.L", "lowerarm02.L", "wrist.L"]
    for bone in arm:
        transforms[1, skeleton.names.index(bone), :3, 3] = belly - hand
        transforms[2, skeleton.names.index(bone), :3, 3] = [1, 0, 0]
    depth = self_intersection(head, transforms)
    half = np.ptp(torso[:, 1]) / 2
    assert depth[0] == 0 and depth[2] == 0
    assert 0.6 * half < depth[1] < 1.2 * half


def test_depth_grows_by_no_more_than_a_limb_goes_in(skeleton, head):
    """The right leg is moved into the left one, 5 mm further each time."""
    transforms = np.tile(np.eye(4, dtype=np.float32), (12, len(skeleton), 1, 1))
    leg = ["upperleg01", "upperleg02", "lowerleg01", "lowerleg02", "foot"]
    bones = [skeleton.names.index(bone + ".R") for bone in leg]
    transforms[:, bones, 0, 3] = 0.005 * np.arange(12)[:, None] + 0.06
    depth = self_intersection(head, transforms)
    inside = np.flatnonzero(depth > 0)
    assert len(inside) > 4
    steps = np.diff(depth[inside])
    assert (steps > 0.002).all() and (steps < 0.0065).all()


def test_self_intersection_does_not_depend_on_where_the_body_stands(skeleton, head):
    poses = random_poses(skeleton, 8, seed=0)
    turn = np.eye(4)
    turn[:3, :3] = Rotation.from_rotvec([0.3, -0.5, 2]).as_matrix()
    turn[:3, 3] = [3, -2, 1]
    transforms = poses.transforms(skeleton)
    depth = self_intersection(head, transforms)
    assert depth.max() > 0
    moved = self_intersection(head, (turn @ transforms).astype(np.float32))
    np.testing.assert_allclose(moved, depth, atol=1e-4)


def test_parts_are_closed_and_together_nearly_the_whole_body(head):
    parts, volumes = _parts(head), []
    for part in parts:
        faces = np.concatenate([part.skin, part.caps])
        points = part.closed(head.vertices[part.ids].astype(np.float64))
        mesh = trimesh.Trimesh(points, faces, process=False)
        assert mesh.is_watertight and mesh.is_winding_consistent
        volumes.append(mesh.volume)
    assert sum(len(part.ids) for part in parts) == len(head.vertices)
    whole = trimesh.Trimesh(head.vertices, head.faces, process=False).volume
    assert min(volumes) > 0 and 0.85 * whole < sum(volumes) < whole


def test_self_intersection_asks_for_weights_and_limbs(head):
    bone = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["root"])
    with pytest.raises(HeadError, match="weights: the body has none"):
        self_intersection(head.replace(weights=None), np.zeros((1, 36, 4, 4)))
    other = head.replace(skeleton=bone, weights=np.ones((len(head.vertices), 1)))
    with pytest.raises(HeadError, match=r"no upperarm01\.L"):
        self_intersection(other, np.zeros((1, 1, 4, 4)))


# --- procedural motions ---------------------------------------------------------------


@pytest.mark.parametrize("name", MOTIONS)
def test_motions_loop_exactly_within_limits(skeleton, name):
    motion = MOTIONS[name](skeleton, seconds=4, speed=0.75)  # 40 frames a cycle
    assert (len(motion), motion.fps, motion.name) == (120, 30, name)
    np.testing.assert_array_equal(motion.rotations[:80], motion.rotations[40:])
    np.testing.assert_array_equal(motion.translations[:80], motion.translations[40:])
    assert_within_limits(skeleton, motion)
    # No jump, at the seam of the loop either: 40 frames change no bone by 180 degrees.
    steps = np.diff(motion.rotations[:41], axis=0)
    assert 0.01 < np.abs(steps).max() < 0.35


def test_the_right_side_does_half_a_cycle_later_what_the_left_did(skeleton):
    rotations = walk(skeleton, 1, speed=1.0).rotations
    mirrored = (rotations * FLIP)[:, mirror_pairs(skeleton)]
    np.testing.assert_allclose(np.roll(mirrored, 15, axis=0), rotations, atol=2e-3)


@pytest.mark.parametrize("crouch", [0.0, 35.0])
def test_the_lower_ankle_keeps_its_height(skeleton, crouch):
    motion = walk(skeleton, 1, speed=1.0, crouch=crouch)
    feet = [posed_joint(skeleton, motion, f"foot.{side}")[:, 2] for side in "LR"]
    rest = skeleton.joints[skeleton.names.index("foot.L"), 2]
    np.testing.assert_allclose(np.min(feet, axis=0), rest, atol=1e-5)
    assert np.max(feet) > rest + 0.05
    # The root bobs twice a cycle, lowest when the legs are apart, never above rest.
    height = motion.translations[:, 2]
    assert (height < 1e-3).all() and np.ptp(height) > 0.02
    np.testing.assert_allclose(height[:15], height[15:], atol=1e-3)
    assert not motion.translations[:, :2].any()


def test_walking_travels_by_its_steps_where_it_faces(skeleton):
    straight = walk(skeleton, 2, speed=1.0, travel=True)
    foot, hip = (skeleton.names.index(n) for n in ("foot.L", "upperleg01.L"))
    leg = np.linalg.norm(skeleton.joints[foot] - skeleton.joints[hip])
    cycle = 2 * leg * (np.sin(np.radians(25)) + np.sin(np.radians(20)))
    way = straight.translations[30] - straight.translations[0]
    np.testing.assert_allclose(way, [0, -cycle, 0], atol=1e-5)

    circle = walk(skeleton, 4, speed=1.0, turn_rate=90, travel=True)
    assert_within_limits(skeleton, circle, but=("root",))
    # A quarter turn to the left after a second: it then faces +X, and goes there.
    front = circle.matrices()[30, skeleton.names.index("root")] @ [0, -1, 0]
    np.testing.assert_allclose(front, [1, 0, 0], atol=1e-5)
    step = np.diff(circle.translations, axis=0)[30]
    assert step[0] > 0.01 and abs(step[1]) < 1e-5
    # After all four seconds it is back, but for the last step.
    assert np.linalg.norm(circle.translations[-1, :2] + step[1]) < 0.05


def test_squatting_keeps_the_feet_level_and_lowers_the_hips(skeleton):
    motion = squat(skeleton, 2, speed=0.5, depth=80)
    transforms = motion.transforms(skeleton)
    foot = transforms[:, skeleton.names.index("foot.L"), :3, :3]
    np.testing.assert_allclose(foot @ [0, -1, 0], [[0, -1, 0]] * 60, atol=0.08)
    assert motion.translations[:, 2].argmin() == 30
    assert motion.translations[30, 2] < -0.2
    knee = posed_joint(skeleton, motion, "lowerleg01.L")[30]
    assert knee[1] < skeleton.joints[skeleton.names.index("lowerleg01.L"), 1] - 0.15


def test_reaching_goes_forward_then_aside_then_up(skeleton):
    motion = reach(skeleton, 4, speed=0.25, lean=0)
    forward, aside, up = posed_joint(skeleton, motion, "wrist.R")[[20, 60, 100]]
    shoulder = skeleton.joints[skeleton.names.index("upperarm01.R")]
    assert forward[1] < -0.4 and abs(forward[2] - shoulder[2]) < 0.15
    assert aside[0] < -0.6 and abs(aside[2] - shoulder[2]) < 0.15
    assert up[2] > shoulder[2] + 0.2


def test_the_trunk_leans_after_the_arms(skeleton):
    motion = reach(skeleton, 4, speed=0.25, lag=1 / 3)
    neck = posed_joint(skeleton, motion, "neck01")
    assert neck[60, 0] > 0.02 and neck[100, 0] < -0.02  # left arm, then right arm aside
    assert neck[20, 1] < neck[0, 1] - 0.02


def test_turning_turns_the_head_ahead_of_the_trunk(skeleton):
    motion = turn(skeleton, 4, speed=0.25, trunk=20, head=40)
    matrices = motion.transforms(skeleton)[..., :3, :3]
    chest, head = (
        matrices[:, skeleton.names.index(bone)] @ [0, -1, 0]
        for bone in ("spine01", "head")
    )
    assert chest[30, 0] == pytest.approx(np.sin(np.radians(20)), abs=1e-3)
    assert head[30, 0] > 0.8 and head[90, 0] < -0.8
    assert head[:, 0].argmax() < chest[:, 0].argmax()


def test_held_out_motions_are_fixed_varied_and_keep_limbs_apart(
    skeleton, head, held_out
):
    assert len(held_out) == 8 and {m.name for m in held_out} == set(MOTIONS)
    for motion, again in zip(held_out, held_out_motions(skeleton), strict=True):
        np.testing.assert_array_equal(motion.rotations, again.rotations)
        assert 60 <= len(motion) <= 120 and motion.fps == 30
        assert_within_limits(skeleton, motion, but=("root",))
        some = motion.transforms(skeleton)[:: len(motion) // 4]
        assert (self_intersection(head, some) <= DEEPEST).all()


def test_training_motions_are_seeded_and_none_is_held_out(skeleton, held_out):
    motions = training_motions(skeleton, seed=2)
    again = training_motions(skeleton, seed=2, count=4)
    for motion, same in zip(motions, again, strict=False):
        np.testing.assert_array_equal(motion.rotations, same.rotations)
    held = np.concatenate([m.rotations for m in held_out]).reshape(-1, 108)
    for motion in motions:
        assert_within_limits(skeleton, motion)
        frames = motion.rotations.reshape(len(motion), 1, -1)
        assert np.abs(frames - held).max(axis=2).min() > 1e-3


def test_amounts_out_of_range_are_refused(skeleton):
    with pytest.raises(HeadError, match=r"stride: it is 50\. Give 0 to 40"):
        walk(skeleton, stride=50)
    with pytest.raises(HeadError, match="seconds: it is 0"):
        turn(skeleton, seconds=0)
    with pytest.raises(HeadError, match="speed: it is nan"):
        squat(skeleton, speed=float("nan"))
    with pytest.raises(HeadError, match="twist of spine"):
        turn(skeleton, trunk=40)


@pytest.mark.parametrize(
    ("name", "amounts"),
    [
        ("walk", {"stride": 40, "crouch": 40, "arm_swing": 60, "arm_raise": 65}),
        ("walk", {"stride": 0, "crouch": 0, "arm_swing": 0, "arm_raise": -35}),
        ("turn", {"trunk": 30, "head": 50, "arm_raise": 65, "elbow": 95}),
        ("squat", {"depth": 85, "lean": 25, "arms": 95, "stance": 20}),
        ("squat", {"depth": 0, "lean": 25, "arms": -30, "stance": -5}),
        ("reach", {"amount": 1, "lag": 1, "lean": 20}),
    ],
)
def test_both_ends_of_every_documented_range_work(skeleton, name, amounts):
    assert set(amounts) < set(inspect.signature(MOTIONS[name]).parameters)
    assert_within_limits(skeleton, MOTIONS[name](skeleton, **amounts))


def test_a_mirrored_pose_puts_the_body_where_a_mirror_shows_it(skeleton):
    motion = random_poses(skeleton, 5, seed=3)
    motion = Motion.create(
        motion.rotations, motion.bone_names, np.arange(15).reshape(5, 3)
    )
    other = mirrored(motion)
    names = [name.replace(".L", ".?") for name in skeleton.names]
    names = [name.replace(".R", ".L").replace(".?", ".R") for name in names]
    swapped = [skeleton.names.index(name) for name in names]

    def joints(motion):
        homogeneous = np.append(skeleton.joints, np.ones((36, 1)), 1)[..., None]
        return (motion.transforms(skeleton) @ homogeneous)[..., :3, 0]

    # The shipped skeleton itself is even to 2 mm.
    assert np.abs(joints(other) - joints(motion)[:, swapped] * [-1, 1, 1]).max() < 0.006
    np.testing.assert_array_equal(mirrored(other).rotations, motion.rotations)
    np.testing.assert_array_equal(mirrored(other).translations, motion.translations)


def test_a_mirror_leaves_bones_without_a_partner_in_place():
    names = ["spine", "spine01", "ax.L", ".R", "hand.R"]
    turns = np.arange(15.0).reshape(1, 5, 3) / 10
    found = mirrored(Motion.create(turns, names)).rotations[0]
    np.testing.assert_allclose(found, turns[0] * [1, -1, -1], atol=1e-6)
