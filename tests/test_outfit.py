"""What somebody wears, in folders and in files that an engine plays."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import save_file
from test_animation import Player, upright
from test_body import SIDES, bends, sleeve, small_body, tube
from test_pbns import learnt

from skinlib.garments.body import write_body
from skinlib.garments.collision import NEAR, near
from skinlib.garments.garment import Garment, write_garment
from skinlib.garments.motion import Motion
from skinlib.garments.outfit import INFLUENCES, Outfit, load_outfit, save_outfit
from skinlib.garments.pbns import PBNSConfig
from skinlib.head import HeadError
from skinlib.model import ModelConfig, SkinningModel
from skinlib.skinning import linear_blend_skinning
from skinlib.training import save_model
from skinlib.training.checkpoint import read_tensors, write_tensors

SMALL = PBNSConfig(hidden=8, embedding=6, layers=3)


def band(radius: float = 0.14) -> Garment:
    """A shorter tube over the sleeve, with its upper hem pinned."""
    vertices, faces = tube(radius, 0.4, 0.7, 7)
    return Garment.create(vertices, faces, vertices[:, 2] > 0.69, "band")


@pytest.fixture(scope="module")
def outfit() -> Outfit:
    return Outfit.create(small_body(), [sleeve(0.115), band()])


@pytest.fixture(scope="module")
def network(outfit):
    return learnt(outfit.network(SMALL, smoothing=2, shapes=True, seed=0)).eval()


@pytest.fixture
def folder(outfit, network, tmp_path):
    save_outfit(tmp_path / "run", outfit, network, {"training": {"steps": 7}})
    return tmp_path / "run"


# --- what it consists of --------------------------------------------------------------


def test_vertices_and_faces_stand_one_garment_after_the_other(outfit):
    inner, outer = outfit.garments
    first, second = len(inner.vertices), len(outer.vertices)
    assert outfit.parts == [slice(0, first), slice(first, first + second)]
    assert np.array_equal(outfit.vertices[outfit.parts[1]], outer.vertices)
    faces = outfit.faces
    assert np.array_equal(faces[: len(inner.faces)], inner.faces)
    assert np.array_equal(faces[len(inner.faces) :], outer.faces + first)
    assert outfit.pinned.sum() == SIDES and outfit.pinned[-SIDES:].all()
    assert len(outfit.cloth.edges) == sum(
        len(Outfit(outfit.body, (one,)).cloth.edges) for one in outfit.garments
    )


def test_overlaps_are_all_pairs_the_inner_one_first(outfit):
    layers = Outfit(outfit.body, (*outfit.garments, sleeve(0.16)))
    first, second, third = layers.parts
    pairs = [(inner, outer) for inner, outer, _ in layers.overlaps]
    assert pairs == [(first, second), (first, third), (second, third)]
    assert layers.overlaps[2][2] is layers.garments[1].faces
    assert Outfit(outfit.body, outfit.garments[:1]).overlaps == []


def test_blend_weights_are_those_of_the_skin_below(outfit):
    head = outfit.body.head
    weights = outfit.blend_weights(0)
    assert weights.dtype == np.float32
    assert np.allclose(weights.sum(axis=1), 1, atol=1e-6)
    # Each ring of the sleeve lies over a ring of the body, 4 rings further up.
    below = head.weights[4 * SIDES : 17 * SIDES]
    assert np.abs(weights[: 13 * SIDES] - below).max() < 1e-5
    calm, rough = outfit.blend_weights(30), weights
    edges = outfit.cloth.edges.numpy()
    step = [np.abs(np.diff(w[edges], axis=1)).max() for w in (calm, rough)]
    assert step[0] < 0.8 * step[1]


def test_at_most_eight_bones_a_vertex(outfit):
    rng = np.random.default_rng(0)
    head, count = outfit.body.head, 12
    joints = np.column_stack([np.zeros((count, 2)), np.linspace(0, 0.9, count)])
    bones = head.skeleton.from_heads_and_tails(
        joints, None, np.arange(count) - 1, [f"bone {i}" for i in range(count)]
    )
    weights = rng.dirichlet(np.ones(count), len(head.vertices))
    many = replace(outfit.body, head=head.replace(skeleton=bones, weights=weights))
    found = Outfit(many, outfit.garments).blend_weights(3)
    assert ((found > 0).sum(axis=1) == INFLUENCES).all()
    assert np.allclose(found.sum(axis=1), 1, atol=1e-6)


def test_the_network_reads_the_bones_that_move_cloth_or_what_it_lies_on(outfit):
    # The first bone is the root: what the network reads of it is which way is up.
    assert outfit.network(SMALL, 0, False, 0).bones.tolist() == [1, 2]

    def bones(bone_of: np.ndarray) -> list[int]:
        """Those that are read when each vertex of the body has one bone."""
        head = outfit.body.head.replace(weights=np.eye(3)[bone_of])
        worn = Outfit(replace(outfit.body, head=head), outfit.garments)
        network = worn.network(SMALL, 0, False, 0)
        assert network.inputs(bends().rotations).shape == (
            12,
            3 * len(network.bones) + 3,
        )
        return network.bones.tolist()

    height = outfit.body.head.vertices[:, 2]
    assert bones(0 * height.astype(int)) == []
    # The sleeve ends at 0.8, but can touch what is a little higher.
    assert bones(np.where(height > 0.82, 2, 0)) == [2]


# --- what is refused ------------------------------------------------------------------


def moved(garment: Garment, by) -> Garment:
    return Garment.create(garment.vertices + np.float32(by), garment.faces)


@pytest.mark.parametrize(
    ("garments", "message"),
    [
        ([], "garments: there are none"),
        ([moved(sleeve(0.115), (0, 0, 5))], "away from the body"),
        ([moved(sleeve(0.115), (0.9, 0, 0))], "away from the body"),
        ([sleeve(0.09)], "inside the body"),
        ([sleeve(0.115), sleeve(0.09)], "inside the body"),
        ([sleeve(0.13), sleeve(0.115)], "lie inside sleeve"),
        ([sleeve(0.115), sleeve(0.15), sleeve(0.13)], "lie inside sleeve"),
    ],
)
def test_what_does_not_fit_is_refused(garments, message):
    with pytest.raises(HeadError, match=message):
        Outfit.create(small_body(), garments)


def test_a_wide_hoop_needs_no_body_below():
    """Nothing of the body is within its reach: it collides with nothing."""
    hoop = sleeve(0.375)
    outfit = Outfit.create(small_body(), [hoop])
    network = outfit.network(SMALL, 0, False, 0)
    assert outfit.pose(network, bends(2)).shape == (2, len(hoop.vertices), 3)


# --- poses ----------------------------------------------------------------------------


def test_a_pose_is_what_the_network_says(outfit, network):
    motion = bends(150)  # more than are posed at once
    posed = outfit.pose(network, motion)
    assert posed.shape == (150, len(outfit.vertices), 3) and posed.dtype == np.float32
    transforms = motion.transforms(outfit.body.head.skeleton)
    with torch.no_grad():
        inputs = network.inputs(motion.rotations)
        rest = outfit.vertices + network.offsets(inputs).numpy()
        weights = network.blend_weights.numpy()
    for frame in (0, 63, 64, 149):
        expected = linear_blend_skinning(rest[frame], weights, transforms[frame])
        assert np.abs(posed[frame] - expected).max() < 1e-5


def test_a_shape_changes_body_and_cut(outfit):
    network = outfit.network(SMALL, 2, True, 0)  # no offsets
    still = Motion.create(np.zeros((1, 3, 3)), outfit.body.head.skeleton.names)
    (posed,) = outfit.pose(network, still, {"wide": 1}, ease=0.05)
    cut = network.graded(torch.tensor([1.0, 0])).numpy()
    assert np.abs(posed - cut).max() < 1e-5
    assert np.abs(posed - outfit.vertices).max() > 0.01
    # With offsets the network knows of it, too.
    learnt(network)
    wide, eased, usual = (
        outfit.pose(network, still, shape, ease)
        for shape, ease in (({"wide": 1}, 0.0), ({}, 0.1), ({}, 0.0))
    )
    assert np.abs(eased - usual).max() > 1e-4
    assert np.abs(wide - usual - (cut - outfit.vertices)).max() > 1e-4


def test_a_network_for_one_body_has_no_shapes(outfit, tmp_path):
    network = outfit.network(SMALL, 2, False, 0)
    for options in ({"shape": {"wide": 0.5}}, {"ease": 0.1}):
        with pytest.raises(HeadError, match="made for one body"):
            outfit.pose(network, bends(), **options)
        with pytest.raises(HeadError, match="made for one body"):
            outfit.export(tmp_path / "a.glb", network, bends(), **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("ease", [0.11, -0.06, float("nan")])
def test_an_ease_that_was_never_learnt_is_refused(outfit, network, tmp_path, ease):
    still = Motion.create(np.zeros((1, 3, 3)), outfit.body.head.skeleton.names)
    with pytest.raises(HeadError, match=r"ease: it is .*Give -0\.05 to 0\.1"):
        outfit.pose(network, still, ease=ease)
    with pytest.raises(HeadError, match="ease"):
        outfit.export(tmp_path / "a.glb", network, still, ease=ease)
    assert not list(tmp_path.iterdir())


def test_a_motion_of_other_bones_is_refused(outfit, network, tmp_path):
    motion = Motion.create(np.zeros((1, 2, 3)), ("hips", "spine"))
    with pytest.raises(HeadError, match="a motion of 2 bones"):
        outfit.pose(network, motion)
    with pytest.raises(HeadError, match="a motion of 2 bones"):
        outfit.export(tmp_path / "a.glb", network, motion)
    with pytest.raises(HeadError, match="no shape 'thin'"):
        outfit.pose(network, bends(), {"thin": 1})


# --- what it can touch ----------------------------------------------------------------


def waving() -> Outfit:
    """A ring low on a post of which the upper half folds down, beside the ring."""
    body = small_body()
    height = body.head.vertices[:, 2]
    head = body.head.replace(weights=np.eye(3)[np.where(height > 0.52, 1, 0)])
    vertices, faces = tube(0.115, 0.1, 0.2, 3)
    ring = Garment.create(vertices, faces, name="ring")
    return Outfit(replace(body, head=head), (ring,))


def test_what_comes_near_in_a_pose_is_an_obstacle():
    """As a hand is to a shirt, when somebody reaches across the chest."""
    worn = waving()
    height = worn.body.head.vertices[:, 2]
    folded = np.zeros((2, 3, 3))
    folded[1, 1, 0] = np.pi  # bone 1 begins at 0.35: what was at 0.6 comes to 0.1
    motion = Motion.create(folded, worn.body.head.skeleton.names)
    at_rest = worn.collider.vertices
    assert height[at_rest].max() < 0.46
    close = near(worn.body.head, worn.vertices, NEAR)
    assert worn.collider_in(motion, 0, 0.0) is worn.collider
    assert worn.network(SMALL, 0, False, 0).bones.tolist() == []
    collider = worn.collider_in(motion, smoothing=0, touch=0.03)
    assert np.isin(close, collider.vertices).all()
    others = height[np.setdiff1d(collider.vertices, close)]
    # The ring is at 0.1 to 0.2, and 3 cm are a touch: between 0.47 and 0.63 at rest.
    assert 0.52 < others.min() and others.max() < 0.64 and len(others) >= 2 * SIDES
    network = worn.network(SMALL, 0, False, 0, collider)
    assert network.bones.tolist() == [1]
    still = Motion.create(folded[:1], motion.bone_names)
    assert np.array_equal(worn.collider_in(still, 0, 0.03).vertices, close)


# --- folders --------------------------------------------------------------------------


@pytest.mark.parametrize("shapes", [False, True])
def test_a_folder_holds_all_of_it(outfit, tmp_path, shapes):
    network = learnt(outfit.network(SMALL, 2, shapes, 0)).eval()
    save_outfit(tmp_path / "run", outfit, network, {"training": {"steps": 7}})
    found, same = load_outfit(tmp_path / "run")
    assert [garment.name for garment in found.garments] == ["sleeve", "band"]
    assert np.array_equal(found.pinned, outfit.pinned)
    assert np.array_equal(found.faces, outfit.faces)
    assert found.body.shape_names == ("wide", "tall")
    shape = {"wide": 0.5, "tall": -0.3} if shapes else {}
    poses = [o.pose(n, bends(), shape) for o, n in ((outfit, network), (found, same))]
    assert np.array_equal(*poses)
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert config["training"] == {"steps": 7} and config["names"] == ["sleeve", "band"]
    save_outfit(tmp_path / "again", found, same, {})
    last = load_outfit(tmp_path / "again")
    assert np.array_equal(last[0].pose(last[1], bends(), shape), poses[0])


def test_the_shipped_shirt_is_found_by_its_name():
    outfit, network = load_outfit("t_shirt")
    still = Motion.create(
        np.zeros((1, len(outfit.body.head.skeleton), 3)),
        outfit.body.head.skeleton.names,
    )
    slim, heavy = (
        outfit.pose(network, still, {"weight": amount})[0] for amount in (-1.0, 1.0)
    )
    waist = np.abs(slim[:, 2] - slim[:, 2].mean()) < 0.1
    depth = [np.ptp(cloth[waist, 1]) for cloth in (slim, heavy)]
    assert depth[1] > depth[0] + 0.005


def test_a_network_of_an_older_version_has_the_units_of_then(outfit, tmp_path):
    plain = replace(SMALL, slope=0.0, rounding=0.0)
    network = learnt(outfit.network(plain, 2, False, 0)).eval()
    save_outfit(tmp_path / "run", outfit, network, {})
    weights = tmp_path / "run" / "model.safetensors"
    tensors, metadata = read_tensors(weights)
    config = json.loads(metadata["config"])
    del config["network"]["slope"], config["network"]["rounding"]
    write_tensors(weights, tensors, {"config": json.dumps(config)})
    found, same = load_outfit(tmp_path / "run")
    assert (same.config.slope, same.config.rounding) == (0, 0)
    assert np.array_equal(found.pose(same, bends()), outfit.pose(network, bends()))


def spoil(folder, kind: str) -> None:
    weights = folder / "model.safetensors"
    content = weights.read_bytes()
    if kind == "missing":
        shutil.rmtree(folder)
    elif kind == "a file":
        shutil.rmtree(folder)
        folder.write_text("no folder")
    elif kind == "unfinished":
        weights.rename(folder / "training.safetensors")
    elif kind == "cut off":
        weights.write_bytes(content[: len(content) // 2])
    elif kind == "a head's":
        small = ModelConfig(
            mesh_width=8, bone_width=8, blocks=1, points=2, tree_layers=1
        )
        save_model(SkinningModel(small), folder, {})
    elif kind == "no configuration":
        save_file({"a": torch.zeros(1)}, weights)
    elif kind == "other tensors":
        config = (folder / "config.json").read_text()
        save_file({"a": torch.zeros(1)}, weights, {"config": config})
    elif kind in ("no names", "few names"):
        config = json.loads((folder / "config.json").read_text())
        few = {"names": config.pop("names")[:1]} if kind == "few names" else {}
        config.pop("names", None)
        tensors, _ = read_tensors(weights)
        write_tensors(weights, tensors, {"config": json.dumps(config | few)})
    elif kind == "no garment":
        (folder / "garment_1.npz").unlink()
    elif kind == "cut garment":
        (folder / "garment_1.npz").write_bytes(b"PK")
    elif kind == "another garment":
        write_garment(folder / "garment_1.npz", band(0.15))
    elif kind == "no body":
        (folder / "body.npz").unlink()
    elif kind == "another body":
        body = small_body()
        bones = body.head.skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["b"])
        ones = np.ones((len(body.head.vertices), 1))
        head = body.head.replace(skeleton=bones, weights=ones)
        write_body(
            folder / "body.npz",
            replace(body, head=head, shape_joints=body.shape_joints[:, :1]),
        )


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("missing", "model.safetensors: outfit: there is no such file"),
        ("a file", "outfit: there is no such file"),
        ("unfinished", "its training has not ended. Run the same `skinlib garment tr"),
        ("cut off", "model.safetensors: checkpoint: it cannot be read"),
        ("a head's", "outfit: a file that is no outfit"),
        ("no configuration", "outfit: a file that is no outfit"),
        ("other tensors", "outfit: a file that is no outfit"),
        ("no names", "outfit: a file that is no outfit"),
        ("few names", "outfit: a file that is no outfit"),
        ("no garment", "garment_1.npz: file: there is no such file"),
        ("cut garment", "garment_1.npz: file: it cannot be read"),
        ("another garment", "outfit: .* do not belong together"),
        ("no body", "body.npz"),
        ("another body", "outfit: .* do not belong together"),
    ],
)
def test_a_folder_that_holds_no_outfit_is_one_error(folder, kind, message):
    spoil(folder, kind)
    with pytest.raises(HeadError, match=message):
        load_outfit(folder)


# --- files that engines play ----------------------------------------------------------


@pytest.mark.parametrize("shape", [{}, {"wide": 0.6, "tall": -1}])
def test_a_glb_moves_as_the_network_says(outfit, network, tmp_path, shape):
    motion = bends(9, seed=3)
    ease = 0.05 if shape else 0.0
    outfit.export(tmp_path / "a.glb", network, motion, shape, ease)
    posed = outfit.pose(network, motion, shape, ease)
    plain = outfit.pose(outfit.network(SMALL, 2, True, 0), motion, shape)
    assert np.abs(posed - plain).max() > 0.02  # offsets and weights do something
    player = Player(tmp_path / "a.glb")
    for garment, part in zip(outfit.garments, outfit.parts, strict=True):
        for frame in range(9):
            found = player.vertices(garment.name, frame)
            assert np.abs(found - upright(posed[frame, part])).max() < 1e-4
    head = outfit.body.shaped(shape)
    transforms = outfit.body.transforms(motion, outfit.body.coefficients(shape))
    skin = linear_blend_skinning(head.vertices, head.weights, transforms)
    found = np.stack([player.vertices("body", frame) for frame in range(9)])
    assert np.abs(found - upright(skin)).max() < 1e-4


def test_a_file_that_cannot_be_written(outfit, network, tmp_path):
    with pytest.raises(HeadError, match=r"no.a\.glb"):
        outfit.export(tmp_path / "no" / "a.glb", network, bends())
    assert not list(tmp_path.iterdir())
