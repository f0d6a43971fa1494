import numpy as np
import pytest

from skinlib.datasets.synthetic import synthetic_head
from skinlib.evaluate import baselines
from skinlib.evaluate.baselines import (
    bone_heat,
    inverse_distance,
    match_bones,
    most_similar,
    nearest_bone,
    robust_transfer,
    similar_template_copy,
    skeleton_distance,
    template_copy,
    warped_template_copy,
)
from skinlib.evaluate.metrics import row_l1
from skinlib.head import Head, HeadError, Skeleton

GEOMETRIC = [nearest_bone, inverse_distance, bone_heat]
COPIES = [template_copy, warped_template_copy, robust_transfer]


@pytest.fixture(scope="module")
def head():
    return synthetic_head(5, vertices=800, bones=12)


@pytest.fixture(scope="module")
def template():
    return synthetic_head(6, vertices=1000, bones=12, shape=None)


def check(weights, head):
    assert weights.shape == (len(head.vertices), len(head.skeleton))
    assert weights.dtype == np.float32
    assert weights.min() >= 0
    np.testing.assert_allclose(weights.sum(axis=1), 1, atol=1e-5)


def moved(head, scale=1.0, shift=(0, 0, 0), turn=None):
    """The same head elsewhere, in another unit or with another up-axis."""

    turn = np.eye(3) if turn is None else turn

    def move(points):
        return points.astype(np.float64) @ np.transpose(turn) * scale + shift

    bones = head.skeleton
    return Head.create(
        move(head.vertices),
        head.faces,
        Skeleton.from_heads_and_tails(
            move(bones.joints), move(bones.tails), bones.parents, bones.names
        ),
        head.weights,
        head.normals @ np.transpose(turn),
        name=head.name,
    )


def renamed(head):
    bones = head.skeleton
    names = [f"bone{i}" for i in range(len(bones))]
    return head.replace(
        skeleton=Skeleton.from_heads_and_tails(
            bones.joints, bones.tails, bones.parents, names
        )
    )


@pytest.mark.parametrize("method", GEOMETRIC)
def test_a_head_alone_is_enough(method, head):
    bare = head.replace(weights=None)
    weights = method(bare)
    check(weights, head)
    assert 0 < row_l1(weights, head.weights).mean() < 2
    bigger = moved(bare, 250, (10, 20, 30))
    np.testing.assert_allclose(method(bigger), weights, atol=2e-2)


@pytest.mark.parametrize("method", COPIES)
def test_copies_speak_the_bones_of_the_target(method, head, template):
    weights = method(head.replace(weights=None), template)
    check(weights, head)
    worst = row_l1(nearest_bone(head), head.weights).mean()
    assert row_l1(weights, head.weights).mean() < worst / 2


@pytest.mark.parametrize("method", COPIES)
def test_copying_from_itself_is_exact_in_any_unit_and_axis(method, head):
    away = moved(head, 0.01, (3, 1, 2), np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]))
    error = row_l1(method(away, head), head.weights)
    # Where lips touch, the closest point may be the other lip's.
    assert np.median(error) < 1e-3 and error.mean() < 0.05


# --- by hand --------------------------------------------------------------------------


def rod(count=21):
    """A thin square rod along x with a bone in each half."""
    x = np.linspace(0, 10, count)
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1.0]])
    vertices = np.array([[a, *c] for a in x for c in corners])
    faces = []
    for ring in range(count - 1):
        for side in range(4):
            a, b = 4 * ring + side, 4 * ring + (side + 1) % 4
            faces += [[a, b, a + 4], [b, b + 4, a + 4]]
    skeleton = Skeleton.from_heads_and_tails(
        [[0, 0, 0], [5, 0, 0]], [[5, 0, 0], [10, 0, 0]], [-1, 0], ["a", "b"]
    )
    return Head.create(vertices, faces, skeleton)


def test_nearest_and_inverse_distance_by_hand():
    skeleton = Skeleton.from_heads_and_tails(
        [[0, 0, 0], [3, 0, 0]], None, [-1, -1], ["a", "b"]
    )
    head = Head.create([[1, 0, 0], [3, 0, 0]], np.zeros((0, 3), int), skeleton)
    assert nearest_bone(head).tolist() == [[1, 0], [0, 1]]
    np.testing.assert_allclose(inverse_distance(head, 2)[0], [4 / 5, 1 / 5], rtol=1e-6)
    assert inverse_distance(head)[1, 1] == pytest.approx(1)


def test_heat_of_a_rod_is_the_textbook_solution():
    """-w'' + w / d^2 = p / d^2 with no flux at the ends, d the corner's distance."""
    head = rod(81)
    weights = bone_heat(head)
    x, d = head.vertices[:, 0], np.sqrt(2)
    left = 0.5 * np.cosh(np.minimum(x, 10 - x) / d) / np.cosh(5 / d)
    expected = np.where(x <= 5, left, 1 - left)
    np.testing.assert_allclose(weights[:, 1], expected, atol=2e-3)


def test_heat_does_not_depend_on_how_seams_are_cut():
    head = rod()
    soup = Head.create(
        head.vertices[head.faces].reshape(-1, 3),
        np.arange(3 * len(head.faces)).reshape(-1, 3),
        head.skeleton,
        normals=head.normals[head.faces].reshape(-1, 3),
    )
    whole = bone_heat(head)[head.faces].reshape(-1, 2)
    np.testing.assert_allclose(bone_heat(soup), whole, atol=1e-6)


def test_a_piece_that_sees_no_bone_follows_the_nearest_as_a_whole():
    head = rod()
    shell = head.vertices * 0.2 + [9, 10, 0]  # a small rod far above the second bone
    plate = np.array([[-9, 3, -9], [30, 3, -9], [30, 3, 9], [-9, 3, 9.0]])
    both = Head.create(
        np.concatenate([head.vertices, shell, plate]),
        np.concatenate(
            [head.faces, head.faces + 84, [[168, 169, 170], [168, 170, 171]]]
        ),
        head.skeleton,
    )
    weights = bone_heat(both)
    check(weights, both)
    assert weights[84:168].tolist() == [[0, 1]] * 84
    np.testing.assert_allclose(weights[:84], bone_heat(head), atol=1e-5)


@pytest.mark.parametrize("method", GEOMETRIC)
def test_flat_empty_and_single_meshes(method):
    skeleton = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["head"])
    point = Head.create([[0, 0, 0]], np.zeros((0, 3), int), skeleton)
    flat = Head.create(np.zeros((3, 3)), [[0, 1, 2]], skeleton)
    needle = Head.create([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], skeleton)
    for head in (point, flat, needle):
        assert method(head).tolist() == [[1]] * len(head.vertices)


@pytest.mark.parametrize("method", COPIES)
def test_copies_of_tiny_heads(method):
    skeleton = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["head"])
    cloud = Head.create(np.eye(3), np.zeros((0, 3), int), skeleton, np.ones((3, 1)))
    square = Head.create(
        [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]], skeleton
    )
    assert method(square, cloud).tolist() == [[1]] * 4


def test_inpainting_continues_a_linear_ramp():
    """Minimisers of the Laplacian energy reproduce what is linear along the rod."""
    head = rod()
    ramp = head.vertices[:, :1] / 10
    weights = np.concatenate([1 - ramp, ramp], axis=1).astype(np.float32)
    known = (head.vertices[:, 0] < 2.6) | (head.vertices[:, 0] > 7.4)
    broken = np.where(known[:, None], weights, [1, 0])
    np.testing.assert_allclose(
        baselines._inpaint(head, broken, known), weights, atol=2e-2
    )


def test_robust_transfer_inpaints_where_the_template_has_no_surface(head):
    """Without the front of the face there is no match; the weights stay smooth."""
    template = moved(head)
    kept = template.vertices[template.faces].mean(axis=1)
    forward = kept @ [0, 0, 1] if np.ptp(kept[:, 1]) > 0 else kept[:, 0]
    template = template.replace(
        faces=template.faces[forward < np.quantile(forward, 0.9)]
    )
    check(robust_transfer(head, template), head)


# --- matching bones -------------------------------------------------------------------


def test_bones_match_by_name_in_any_order_and_case(head):
    order = np.random.default_rng(0).permutation(12)
    bones = head.skeleton.reordered(order)
    loud = Skeleton.from_heads_and_tails(
        bones.joints,
        bones.tails,
        bones.parents,
        ["Rig:" + n.upper() for n in bones.names],
    )
    match = match_bones(head.replace(skeleton=loud, weights=None), head)
    assert match.target.tolist() == order.tolist()
    assert match.paired.all()


def test_bones_match_by_place_when_names_say_nothing(head):
    order = np.random.default_rng(1).permutation(12)
    other = renamed(moved(head, 3, (1, 2, 3)))
    shuffled = other.replace(skeleton=other.skeleton.reordered(order), weights=None)
    match = match_bones(shuffled, head)
    assert match.paired.all()
    np.testing.assert_allclose(
        head.skeleton.joints[match.target], head.skeleton.joints[order], atol=1e-4
    )


def test_a_bone_left_over_gives_its_weight_to_its_ancestor(head):
    bones = head.skeleton
    extra = Skeleton.from_heads_and_tails(
        np.concatenate([bones.joints, bones.joints[:1] + 1]),
        None,
        [*bones.parents, bones.names.index("jaw")],
        [*bones.names, "beard"],
    )
    weights = np.zeros((len(head.vertices), 13))
    weights[:, 12] = 1
    template = Head.create(head.vertices, head.faces, extra, weights)
    copied = template_copy(head, template)
    assert (copied.argmax(axis=1) == bones.names.index("jaw")).all()


def test_the_most_similar_skeleton_is_chosen(head):
    own = renamed(moved(head, 100))
    others = [synthetic_head(seed, vertices=600, bones=12) for seed in (11, 12)]
    assert most_similar(renamed(head), [others[0], own, others[1]]) is own
    assert skeleton_distance(own, renamed(head)) < 1e-4
    np.testing.assert_array_equal(
        similar_template_copy(renamed(head), [*others, own]),
        warped_template_copy(renamed(head), own),
    )


def test_templates_need_weights_and_there_must_be_one(head, template):
    with pytest.raises(HeadError, match="template"):
        template_copy(head, template.replace(weights=None))
    with pytest.raises(HeadError, match="there are none"):
        most_similar(head, [])


@pytest.mark.filterwarnings("error")
def test_a_template_that_shares_no_bone_is_copied_without_a_warp(head, template):
    one = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["elsewhere"])
    alone = head.replace(skeleton=one, weights=np.ones((len(head.vertices), 1)))
    np.testing.assert_allclose(warped_template_copy(alone, template), 1)
