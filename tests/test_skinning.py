import numpy as np
import pytest
import torch
from shapes import mirrored_square

from skinlib.datasets.synthetic import synthetic_head
from skinlib.head import HeadError, Skeleton
from skinlib.skinning import (
    PRESET_POSES,
    descendants,
    find_bones,
    forward_kinematics,
    head_bone,
    linear_blend_skinning,
    mirror_pairs,
    mirror_vertices,
    preset_pose,
    upper_lids,
)

QUARTER = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # x to y


@pytest.fixture(scope="module")
def head():
    return synthetic_head(5, vertices=800, bones=14, up="y", shuffle=False)


@pytest.fixture
def arm():
    return Skeleton.from_heads_and_tails(
        [[2, 0, 0], [0, 0, 0], [1, 0, 0]], None, [2, -1, 1], ["hand", "upper", "lower"]
    )


def random_rotations(rng, *shape):
    q, _ = np.linalg.qr(rng.standard_normal((*shape, 3, 3)))
    return q * np.sign(np.linalg.det(q))[..., None, None]


# --- forward kinematics and linear blend skinning -------------------------------------


def test_identity_pose_changes_nothing(head):
    pose = np.tile(np.eye(3), (len(head.skeleton), 1, 1))
    transforms = forward_kinematics(head.skeleton, pose)
    posed = linear_blend_skinning(head.vertices, head.weights, transforms)
    np.testing.assert_allclose(posed, head.vertices, atol=1e-6 * np.abs(posed).max())


def test_children_follow_their_parents_in_any_order(arm):
    pose = np.tile(np.eye(3), (3, 1, 1))
    pose[1] = pose[2] = QUARTER  # shoulder and elbow, each by 90 degrees
    transforms = forward_kinematics(arm, pose)
    tip = transforms[0] @ [3, 0, 0, 1]
    # Upper arm points to +y, lower arm back to -x: hand at (-1, 1), its tip beyond.
    np.testing.assert_allclose(tip, [-2, 1, 0, 1], atol=1e-12)


def test_translation_moves_the_joint_and_what_hangs_on_it(arm):
    shift = np.zeros((3, 3))
    shift[2] = [0, 0, 5]
    transforms = forward_kinematics(arm, np.tile(np.eye(3), (3, 1, 1)), shift)
    assert transforms[:, 2, 3].tolist() == [5, 0, 5]
    motions = np.tile(np.eye(4), (3, 1, 1))
    motions[:, :3, 3] = shift
    np.testing.assert_array_equal(forward_kinematics(arm, motions), transforms)


def test_torch_and_numpy_agree_and_torch_has_gradients(head):
    rng = np.random.default_rng(0)
    pose = random_rotations(rng, 2, len(head.skeleton))
    posed = linear_blend_skinning(
        head.vertices, head.weights, forward_kinematics(head.skeleton, pose)
    )
    weights = torch.tensor(head.weights, dtype=torch.float64, requires_grad=True)
    vertices = torch.tensor(head.vertices, dtype=torch.float64)
    transforms = forward_kinematics(head.skeleton, torch.tensor(pose))
    tensor = linear_blend_skinning(vertices, weights, transforms)
    assert posed.shape == (2, *head.vertices.shape)
    np.testing.assert_allclose(tensor.detach(), posed, rtol=1e-5, atol=1e-5)
    tensor.sum().backward()
    assert torch.isfinite(weights.grad).all()


def test_skinning_moves_with_a_moved_skeleton(head):
    """Turning the root turns every vertex rigidly."""
    pose = np.tile(np.eye(3), (len(head.skeleton), 1, 1))
    root = int(np.flatnonzero(head.skeleton.parents < 0)[0])
    pose[root] = QUARTER
    transforms = forward_kinematics(head.skeleton, pose)
    posed = linear_blend_skinning(head.vertices, head.weights, transforms)
    joint = head.skeleton.joints[root]
    np.testing.assert_allclose(
        posed, (head.vertices - joint) @ QUARTER.T + joint, atol=1e-4
    )


def test_a_pose_of_another_skeleton_is_refused(arm):
    with pytest.raises(ValueError, match=r"\(2, 3, 3\) for 3 bones"):
        forward_kinematics(arm, np.zeros((2, 3, 3)))


# --- mirror ---------------------------------------------------------------------------


def test_pairs_of_a_real_naming_habit():
    skeleton = Skeleton.from_heads_and_tails(
        [[0, 0, 0], [0, 1, 0], [3, 4, 5], [-3, 4, 5], [3, 4, 5], [-3, 4, 5], [0, 2, 6]],
        None,
        [-1, 0, 1, 1, 1, 1, 1],
        ["Neck", "Head", "LEye", "REye", "LLid", "RLid", "Jaw"],
    )
    # Eye and lid lie at the same place: only their names tell them apart.
    assert mirror_pairs(skeleton).tolist() == [0, 1, 3, 2, 5, 4, 6]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("up", ["y", "z"])
def test_pairs_in_any_order_and_up_axis(seed, up):
    skeleton = synthetic_head(seed, vertices=600, up=up).skeleton
    pairs = mirror_pairs(skeleton)
    names = skeleton.names
    mirrored = [name.replace("_L", "_?").replace("_R", "_L") for name in names]
    mirrored = [name.replace("_?", "_R") for name in mirrored]
    assert [names[other] for other in pairs] == mirrored


@pytest.mark.parametrize("seed", [2, 3])
def test_pairs_need_no_names_where_bones_differ_in_place(seed):
    skeleton = synthetic_head(seed, vertices=600).skeleton
    assert (skeleton.lengths > 0).all()
    blank = Skeleton.from_heads_and_tails(
        skeleton.joints,
        skeleton.tails,
        skeleton.parents,
        [f"bone{i}" for i in range(len(skeleton))],
    )
    assert (mirror_pairs(blank) == mirror_pairs(skeleton)).all()


@pytest.mark.parametrize(
    "joints", [[[1, 2, 3]], [[0, 0, 0], [0, 1, 0]], np.zeros((3, 3))]
)
def test_pairs_of_a_tiny_skeleton_are_a_permutation(joints):
    count = len(joints)
    skeleton = Skeleton.from_heads_and_tails(
        joints, None, range(-1, count - 1), [f"b{i}" for i in range(count)]
    )
    pairs = mirror_pairs(skeleton)
    assert (pairs[pairs] == np.arange(count)).all()


def test_a_vertex_without_a_partner():
    head = mirrored_square()
    assert mirror_vertices(head).tolist() == [2, 1, 0, 5, 4, 3]
    vertices = np.array(head.vertices)
    vertices[0] = [1.4, -0.3, 0]
    partner = mirror_vertices(head.replace(vertices=vertices))
    assert partner.tolist() == [-1, 1, -1, 5, 4, 3]


def test_the_mirror_image_lies_on_the_mirrored_piece(head):
    partner = mirror_vertices(head)
    found = partner >= 0
    mirrored = head.vertices * [-1, 1, 1]
    gap = np.linalg.norm(head.vertices[partner[found]] - mirrored[found], axis=1)
    assert gap.max() < 0.02 * np.ptp(head.vertices, axis=0).max()
    assert (
        (head.normals[partner] * head.normals * [-1, 1, 1]).sum(axis=1)[found] > 0
    ).all()


# --- bones by name, preset poses ------------------------------------------------------


@pytest.mark.parametrize(
    ("part", "names", "found"),
    [
        ("jaw", ["head", "MJaw", "jaw_end", "nose"], [1]),
        ("head", ["Bip01 Neck", "Bip01 Head", "LForehead", "HeadNub"], [1]),
        ("head", ["mNeck", "mHead", "HEAD", "mSkull"], [1]),
        ("eye", ["h", "LEye", "LEyeBlinkTop", "l_underEye"], [1]),
        ("eye", ["h", "eye.L", "LInnerEyebrow", "eyelid_L"], [1]),
        ("lid", ["h", "orbicularis03.L", "oris01", "def_l_upperLid1"], [1]),
        ("mouth corner", ["h", "LMouthCorner", "mFaceEyecornerInner", "c"], [1]),
    ],
)
def test_hints_know_the_habits_of_rigs(part, names, found):
    skeleton = Skeleton.from_heads_and_tails(
        np.arange(12).reshape(4, 3), None, [-1, 0, 1, 1], names
    )
    assert find_bones(skeleton, part) == found


def test_the_head_bone_of_a_nameless_rig_has_most_children():
    skeleton = Skeleton.from_heads_and_tails(
        np.arange(15).reshape(5, 3), None, [-1, 0, 1, 1, 1], list("abcde")
    )
    assert head_bone(skeleton) == 1
    assert descendants(skeleton, [1]).tolist() == [False, True, True, True, True]


@pytest.mark.parametrize("up", ["y", "z"])
def test_presets_move_the_right_way(up):
    head = synthetic_head(5, vertices=800, bones=14, up=up, unit="cm")
    rise, front = (1, 2) if up == "y" else (2, 1)
    facing = 1 if up == "y" else -1

    def moved(name, part):
        transforms = forward_kinematics(head.skeleton, preset_pose(head, name))
        posed = linear_blend_skinning(head.vertices, head.weights, transforms)
        return (posed - head.vertices)[
            head.weights[:, find_bones(head.skeleton, part)[0]] > 0.7
        ]

    assert moved("jaw_open", "jaw")[:, rise].mean() < 0
    turn = preset_pose(head, "head_turn")[head_bone(head.skeleton), :3, :3]
    nose = np.zeros(3)
    nose[front] = facing
    assert (turn @ nose)[0] == pytest.approx(0.5)  # 30 degrees to the person's left
    upper = upper_lids(head)
    assert {head.skeleton.names[bone] for bone in upper} == {
        "lid_upper_L",
        "lid_upper_R",
    }
    blink = forward_kinematics(head.skeleton, preset_pose(head, "blink"))
    posed = linear_blend_skinning(head.vertices, head.weights, blink)
    lids = head.weights[:, upper].sum(axis=1) > 0.7
    assert (posed - head.vertices)[lids, rise].mean() < 0


@pytest.mark.parametrize("name", PRESET_POSES)
def test_amount_zero_is_rest_and_motions_are_rigid(head, name):
    np.testing.assert_allclose(
        preset_pose(head, name, 0.0), np.tile(np.eye(4), (14, 1, 1)), atol=1e-12
    )
    turn = preset_pose(head, name)[:, :3, :3]
    np.testing.assert_allclose(
        turn @ turn.transpose(0, 2, 1), np.tile(np.eye(3), (14, 1, 1)), atol=1e-12
    )


def test_a_pose_without_its_bones_is_one_clear_error():
    with pytest.raises(HeadError, match="no bone is named like a jaw"):
        preset_pose(mirrored_square(), "jaw_open")
    with pytest.raises(ValueError, match="no pose 'wink'; there are jaw_open"):
        preset_pose(mirrored_square(), "wink")
