"""The body that wears the clothes, and a small one that the other tests share."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from skinlib.garments.body import SHAPES, Body, read_body, write_body
from skinlib.garments.garment import Garment
from skinlib.garments.motion import Motion
from skinlib.head import Head, HeadError, Skeleton
from skinlib.io import write_head
from skinlib.paths import sample
from skinlib.skinning import forward_kinematics

NAMES = ("hips", "spine", "chest")
RADIUS, SIDES = 0.1, 24


def tube(radius: float, low: float, high: float, rings: int) -> tuple:
    """Rings round the Z axis, the lowest first: (V, 3), and (F, 3) facing outwards."""
    angle, height = np.meshgrid(
        np.arange(SIDES) * 2 * np.pi / SIDES, np.linspace(low, high, rings)
    )
    around = [radius * np.cos(angle), radius * np.sin(angle), height]
    i, j = (n.ravel() for n in np.mgrid[: rings - 1, :SIDES])
    a, b = i * SIDES + j, i * SIDES + (j + 1) % SIDES
    c, d = a + SIDES, b + SIDES
    faces = np.concatenate([np.stack([a, b, d], 1), np.stack([a, d, c], 1)])
    return np.stack(around, -1).reshape(-1, 3), faces


def small_body() -> Body:
    """A closed post of radius 0.1 and height 1 with three bones and two shapes.

    1 of the shape `wide` makes it 0.02 wider, 1 of `tall` stretches it by a tenth.
    """
    vertices, faces = tube(RADIUS, 0, 1, 21)
    last, size = len(vertices) - SIDES, len(vertices)
    vertices = np.concatenate([vertices, [[0, 0, 0], [0, 0, 1]]])
    ring = np.arange(SIDES)
    after = (ring + 1) % SIDES
    floor = np.stack([after, ring, np.full(SIDES, size)], 1)
    lid = np.stack([ring + last, after + last, np.full(SIDES, size + 1)], 1)
    joints = np.array([[0, 0, 0], [0, 0, 0.35], [0, 0, 0.7]])
    weights = np.exp(-9 * np.abs(vertices[:, 2:] - joints[:, 2] - 0.15))
    weights /= weights.sum(axis=1, keepdims=True)
    skeleton = Skeleton.from_heads_and_tails(joints, None, [-1, 0, 1], NAMES)
    head = Head.create(
        vertices, np.concatenate([faces, floor, lid]), skeleton, weights, name="body"
    )
    wide, up = head.vertices * [0.2, 0.2, 0], [0, 0, 0.1]
    return Body(
        head,
        ("wide", "tall"),
        np.stack([wide, head.vertices * up]).astype(np.float32),
        np.stack([0 * joints, joints * up]).astype(np.float32),
    )


def sleeve(radius: float, name: str = "sleeve", pinned: bool = False) -> Garment:
    """A tube round the small body, from 0.2 to 0.8."""
    vertices, faces = tube(radius, 0.2, 0.8, 13)
    return Garment.create(vertices, faces, (vertices[:, 2] > 0.79) & pinned, name)


def bends(frames: int = 12, seed: int = 0, angle: float = 0.7) -> Motion:
    """Poses of the small body: it faces anywhere, leans, and bends in two joints."""
    rng = np.random.default_rng(seed)
    rotations = rng.uniform(-angle, angle, (frames, 3, 3))
    turns = Rotation.from_rotvec(rng.uniform(-3, 3, (frames, 1)) * [0, 0, 1])
    lean = Rotation.from_rotvec(rotations[:, 0] * 0.5)
    rotations[:, 0] = (turns * lean).as_rotvec()
    return Motion.create(rotations, NAMES, rng.normal(size=(frames, 3)), name="bends")


def arrays(body: Body) -> dict[str, np.ndarray]:
    """What a file of the body holds."""
    head, skeleton = body.head, body.head.skeleton
    return {
        "vertices": head.vertices,
        "faces": head.faces,
        "bone_names": np.array(skeleton.names),
        "bone_parents": skeleton.parents,
        "bone_heads": skeleton.joints,
        "weights": head.weights,
        "shape_names": np.array(body.shape_names),
        "shape_vertices": body.shape_vertices,
        "shape_joints": body.shape_joints,
    }


@pytest.fixture(scope="module")
def shipped() -> Body:
    return read_body()


@pytest.fixture
def body() -> Body:
    return small_body()


# --- the shipped one ------------------------------------------------------------------


def test_the_shipped_body_is_what_its_description_says(shipped):
    head = shipped.head
    assert len(head.vertices) == 12_272 and len(head.faces) == 24_540
    assert len(head.skeleton) == 36 and head.skeleton.names[0] == "root"
    assert (head.skeleton.parents < 0).sum() == 1
    assert shipped.shape_names == SHAPES
    low, high = head.vertices.min(axis=0), head.vertices.max(axis=0)
    assert 1.5 < high[2] - low[2] < 1.9  # metres, Z up
    assert head.skeleton.joints[head.skeleton.names.index("wrist.L"), 0] > 0.3
    # Closed: each edge has two faces, once in each direction.
    edges = head.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    assert np.array_equal(np.unique(edges, axis=0), np.unique(edges[:, ::-1], axis=0))
    assert len(np.unique(edges, axis=0)) == len(edges)


def test_the_shapes_do_what_they_are_called(shipped):
    def size(**shape):
        head = shipped.shaped(shape)
        volume = trimesh.Trimesh(head.vertices, head.faces, process=False).volume
        return np.ptp(head.vertices[:, 2]), 1000 * volume  # metres, litres

    assert size(height=-1)[0] + 0.3 < size()[0] < size(height=1)[0] - 0.3
    assert size(weight=-1)[1] + 5 < size()[1] < size(weight=1)[1] - 5


# --- shapes ---------------------------------------------------------------------------


def test_coefficients_stand_in_the_order_of_the_names(body):
    assert body.coefficients({}).tolist() == [0, 0]
    amounts = body.coefficients({"tall": -1, "wide": 0.5})
    assert amounts.tolist() == [0.5, -1] and amounts.dtype == np.float32


@pytest.mark.parametrize(
    ("shape", "message"),
    [
        ({"thin": 0}, "no shape 'thin'. Choose from wide, tall"),
        ({"wide": 1.01}, "wide is 1.01. Give -1 to 1"),
        ({"wide": float("nan")}, "wide is nan"),
        ({"tall": float("-inf")}, "tall is -inf"),
    ],
)
def test_a_shape_that_there_is_not(body, shape, message):
    with pytest.raises(HeadError, match=message):
        body.coefficients(shape)


def test_no_shape_is_the_body_itself(body):
    head = body.shaped({})
    assert np.array_equal(head.vertices, body.head.vertices)
    assert np.array_equal(head.skeleton.joints, body.head.skeleton.joints)
    assert np.array_equal(head.weights, body.head.weights)
    assert (head.skeleton.names, head.name) == (NAMES, "body")


def test_a_shape_moves_vertices_and_joints(body):
    head = body.shaped({"wide": -0.5, "tall": 1})
    around = np.linalg.norm(head.vertices[:-2, :2], axis=1)
    assert np.allclose(around, 0.09) and np.isclose(head.vertices[-1, 2], 1.1)
    assert np.allclose(head.skeleton.joints[:, 2], [0, 0.385, 0.77])


# --- transforms -----------------------------------------------------------------------


def test_transforms_are_those_of_the_skeleton_of_the_shape(shipped):
    rng = np.random.default_rng(1)
    rotations = rng.uniform(-0.6, 0.6, (3, 36, 3))
    skeleton = shipped.head.skeleton
    motion = Motion.create(rotations, skeleton.names, rng.normal(size=(3, 3)))
    shapes = [dict(zip(SHAPES, row, strict=True)) for row in rng.uniform(-1, 1, (3, 4))]
    amounts = np.stack([shipped.coefficients(shape) for shape in shapes])
    transforms = shipped.transforms(motion, amounts)
    assert transforms.shape == (3, 36, 4, 4) and transforms.dtype == np.float32
    for frame, shape in enumerate(shapes):
        shift = np.zeros((36, 3))
        shift[0] = motion.translations[frame]
        shaped = shipped.shaped(shape).skeleton
        expected = forward_kinematics(shaped, motion.matrices()[frame], shift)
        assert np.abs(transforms[frame] - expected).max() < 1e-5
    alone = shipped.transforms(motion, amounts[0])[0]  # one shape for all frames
    assert np.abs(alone - transforms[0]).max() < 1e-6


def test_without_a_shape_transforms_are_those_of_the_motion(body):
    motion = bends()
    expected = motion.transforms(body.head.skeleton)
    assert np.abs(expected - np.eye(4)).max() > 0.5
    for amounts in (np.zeros(2), np.zeros((len(motion), 2), np.float32)):
        found = body.transforms(motion, amounts)
        assert np.abs(found - expected).max() < 1e-6


def test_a_motion_of_another_body_is_refused(body):
    motion = Motion.create(np.zeros((1, 3, 3)), ("hips", "chest", "spine"))
    with pytest.raises(HeadError, match="'chest' where the skeleton has 'spine'"):
        body.transforms(motion, np.zeros(2))


# --- files ----------------------------------------------------------------------------


def test_a_body_comes_back_from_its_file(body, tmp_path):
    write_body(tmp_path / "post.npz", body)
    found = read_body(tmp_path / "post.npz")
    assert found.head.name == "post" and found.shape_names == body.shape_names
    for key in ("vertices", "faces", "weights"):
        assert np.array_equal(getattr(found.head, key), getattr(body.head, key))
    bones = found.head.skeleton
    assert bones.names == NAMES
    assert np.array_equal(bones.parents, body.head.skeleton.parents)
    assert np.array_equal(bones.joints, body.head.skeleton.joints)
    assert np.array_equal(bones.tails, body.head.skeleton.tails)
    assert np.array_equal(found.shape_joints, body.shape_joints)
    assert np.abs(found.shape_vertices - body.shape_vertices).max() < 1e-4
    write_body(tmp_path / "again.npz", found)
    again = read_body(tmp_path / "again.npz")
    assert np.array_equal(again.shape_vertices, found.shape_vertices)


def test_a_skinned_head_is_a_body_without_shapes(body, tmp_path):
    write_head(tmp_path / "post.npz", body.head)
    found = read_body(tmp_path / "post.npz")
    assert found.shape_names == () and found.coefficients({}).shape == (0,)
    assert found.shape_vertices.shape == (0, len(body.head.vertices), 3)
    assert np.array_equal(found.shaped({}).vertices, body.head.vertices)
    motion = bends()
    transforms = found.transforms(motion, np.zeros((len(motion), 0)))
    expected = motion.transforms(body.head.skeleton)
    assert np.abs(transforms - expected).max() < 1e-6
    write_body(tmp_path / "again.npz", found)
    assert read_body(tmp_path / "again.npz").shape_names == ()
    with pytest.raises(HeadError, match="no shape 'wide'"):
        found.coefficients({"wide": 0})


@pytest.mark.parametrize(
    ("field", "change"),
    [
        ("shape_vertices", lambda a: a[:1]),
        ("shape_vertices", lambda a: a[:, 1:]),
        ("shape_vertices", lambda a: a[..., :2]),
        ("shape_vertices", lambda a: np.where(a == a.max(), np.nan, a)),
        ("shape_vertices", lambda a: a.astype(str)),
        ("shape_joints", lambda a: a[:, 1:]),
        ("shape_joints", lambda a: a + np.inf),
        ("shape_joints", lambda _: np.float32(0)),
        ("shape_names", lambda _: np.array("wide")),
        ("shape_names", lambda _: np.arange(2)),
        ("shape_names", lambda _: np.array(["wide", "wide"])),
        ("shape_names", lambda _: np.array(["wide", None])),  # a pickle
        ("shape_vertices", lambda _: None),
        ("weights", lambda _: None),
        ("weights", lambda w: w[1:]),
        ("bone_parents", lambda _: np.array([-1, -1, 1])),
        ("bone_parents", lambda _: np.array([1, -1, 1])),
    ],
)
def test_a_file_that_holds_no_body(body, tmp_path, field, change):
    stored = arrays(body)
    stored[field] = change(stored[field])
    kept = {key: value for key, value in stored.items() if value is not None}
    np.savez(tmp_path / "post.npz", **kept)
    said = "shape" if field.startswith("shape") else field
    with pytest.raises(HeadError, match=f"post.npz: {said}"):
        read_body(tmp_path / "post.npz")


@pytest.mark.parametrize("at", np.linspace(0.03, 0.97, 12))
def test_a_damaged_file_is_one_error_or_does_no_harm(tmp_path, at):
    content = bytearray(sample("body.npz").read_bytes())
    place = int(at * len(content))
    content[place : place + 64] = bytes(64)
    (tmp_path / "body.npz").write_bytes(content)
    with pytest.raises(HeadError, match=r"body\.npz: "):
        read_body(tmp_path / "body.npz")


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(HeadError, match=r"no\.npz"):
        read_body(tmp_path / "no.npz")
