"""What is written moves as the equation says: read back by hand, and by Blender.

Set SKINLIB_BLENDER to a Blender executable, or to a Python that has the `bpy` module,
for the tests that need one.
"""

import os
from pathlib import Path

import numpy as np
import pygltflib
import pytest
from scipy.spatial.transform import Rotation

from skinlib import gltf
from skinlib.animation import AnimatedMesh, write_animation, write_vertex_cache
from skinlib.blender.run import run_script
from skinlib.geometry import vertex_normals
from skinlib.head import HeadError, Skeleton
from skinlib.io import read_head
from skinlib.skinning import forward_kinematics, linear_blend_skinning

needs_blender = pytest.mark.skipif(
    not os.environ.get("SKINLIB_BLENDER"),
    reason="SKINLIB_BLENDER names no Blender, nor a Python with bpy",
)
FPS = 25.0


# --- something that moves -----------------------------------------------------------


def arm() -> Skeleton:
    """Two roots, a chain of four bones, listed child first; one never turns."""
    joints = [[0, 0, 0.9], [0, 0, 0.6], [0, 0, 0.3], [0, 0, 0], [0.4, 0, 0.1]]
    names = ["hand", "wrist", "elbow", "shoulder", "prop"]
    return Skeleton.from_heads_and_tails(joints, None, [1, 2, 3, -1, -1], names)


def sleeve(radius: float, rings: int = 21, columns: int = 10) -> tuple:
    """A tube along Z around the arm, (V, 3) and (F, 3), and (V, 5) smooth weights."""
    angle, height = np.meshgrid(
        np.arange(columns) * 2 * np.pi / columns, np.linspace(0, 1, rings)
    )
    around = [radius * np.cos(angle), radius * np.sin(angle), height]
    vertices = np.stack(around, -1).reshape(-1, 3)
    i, j = (n.ravel() for n in np.mgrid[: rings - 1, :columns])
    a, b = i * columns + j, i * columns + (j + 1) % columns
    c, d = a + columns, b + columns
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    weights = np.exp(-8 * np.abs(vertices[:, 2:] - arm().joints[:, 2]))
    return vertices, faces, weights / weights.sum(axis=1, keepdims=True)


def motion(frames: int = 20, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (T, 5, 3, 3) through more than half a turn, translations (T, 3)."""
    rng = np.random.default_rng(seed)
    phase = np.linspace(0, 2 * np.pi, frames)[:, None]
    vectors = np.sin(phase + rng.random(5) * 6)[..., None] * rng.normal(size=(5, 3))
    vectors[:, 0] = phase * [0, 0, 1]  # a whole turn
    vectors[:, 1] = 0
    rotations = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    translations = np.hstack([np.sin(phase), 0.1 * phase, np.cos(phase)])
    return rotations.reshape(frames, 5, 3, 3), translations


def scene(frames: int = 20) -> tuple[Skeleton, np.ndarray, np.ndarray, list]:
    """Two sleeves: the inner one bends in 4 ways, the outer one does not."""
    skeleton, (rotations, translations) = arm(), motion(frames)
    phase = np.linspace(0, 2 * np.pi, frames)[:, None]
    inner, outer = sleeve(0.1), sleeve(0.12, rings=8)
    waves = np.random.default_rng(1).normal(size=(4, 3, 3)) * 6
    morphs = 0.03 * np.sin(np.einsum("vx,mxy->mvy", inner[0], waves))
    amounts = np.sin(phase * [1, 2, 1, 1]) * [5, 0.2, 1, 1]
    amounts[:, 2] = np.abs(amounts[:, 2])
    amounts[:, 3] = 0
    return (
        skeleton,
        rotations,
        translations,
        [
            AnimatedMesh("inner", *inner, morphs, amounts, (0.2, 0.4, 0.8, 0.5)),
            AnimatedMesh("outer", *outer),
        ],
    )


def expected(skeleton, rotations, translations, mesh: AnimatedMesh) -> np.ndarray:
    """(T, V, 3) by the package's own posing, in double precision."""
    roots = (skeleton.parents == -1)[:, None]
    moved = np.where(roots, np.asarray(translations)[:, None], 0)
    transforms = forward_kinematics(skeleton, rotations, moved)
    rest = np.asarray(mesh.vertices)[None]
    if mesh.morphs is not None:
        rest = rest + np.einsum("tm,mvx->tvx", mesh.morph_amounts, mesh.morphs)
    rest = np.broadcast_to(rest, (len(rotations), *mesh.vertices.shape))
    posed = map(linear_blend_skinning, rest, [mesh.weights] * len(rest), transforms)
    return np.stack(list(posed))


# --- a reader that knows glTF and nothing of skinlib ----------------------------------


class Player:
    """Evaluates an animated, skinned glTF file at one of its keys."""

    def __init__(self, path: Path):
        self.tree = pygltflib.GLTF2().load(str(path))
        self.blob = self.tree.binary_blob()
        self.nodes = {node.name: i for i, node in enumerate(self.tree.nodes)}
        (self.animation,) = self.tree.animations
        (self.times,) = {sampler.input for sampler in self.animation.samplers}
        self.times = self.array(self.times)

    def array(self, accessor_id: int) -> np.ndarray:
        accessor = self.tree.accessors[accessor_id]
        view = self.tree.bufferViews[accessor.bufferView]
        dtype = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
        width = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}[accessor.type]
        flat = np.frombuffer(
            self.blob,
            dtype[accessor.componentType],
            accessor.count * width,
            view.byteOffset + (accessor.byteOffset or 0),
        )
        return flat if width == 1 else flat.reshape(-1, width)

    def channel(self, node: int, path: str) -> np.ndarray | None:
        for channel in self.animation.channels:
            if (channel.target.node, channel.target.path) == (node, path):
                sampler = self.animation.samplers[channel.sampler]
                assert sampler.interpolation == "LINEAR"
                return self.array(sampler.output).reshape(len(self.times), -1)
        return None

    def world(self, frame: int | None) -> np.ndarray:
        """(N, 4, 4) of all nodes; of the file at rest when `frame` is None."""
        world = np.tile(np.eye(4), (len(self.tree.nodes), 1, 1))
        waiting = [(node, np.eye(4)) for node in self.tree.scenes[0].nodes]
        for node_id, parent in waiting:
            node, local = self.tree.nodes[node_id], np.eye(4)
            turn, shift = node.rotation, node.translation
            if frame is not None:
                turns = self.channel(node_id, "rotation")
                shifts = self.channel(node_id, "translation")
                turn = turn if turns is None else turns[frame]
                shift = shift if shifts is None else shifts[frame]
            if turn is not None:
                local[:3, :3] = Rotation.from_quat(turn).as_matrix()
            if shift is not None:
                local[:3, 3] = shift
            world[node_id] = parent @ local
            waiting += [(child, world[node_id]) for child in node.children or []]
        return world

    def primitive(self, name: str) -> pygltflib.Primitive:
        node = self.tree.nodes[self.nodes[name]]
        (primitive,) = self.tree.meshes[node.mesh].primitives
        return primitive

    def at_rest(self, name: str, frame: int | None, attribute: str) -> np.ndarray:
        """(V, 3) of POSITION or NORMAL before the skin."""
        primitive = self.primitive(name)
        values = self.array(getattr(primitive.attributes, attribute)).astype(float)
        if frame is not None and primitive.targets:
            amounts = self.channel(self.nodes[name], "weights")[frame]
            assert amounts.min() >= 0 and amounts.max() <= 1  # what Blender keeps
            targets = [self.array(t[attribute]) for t in primitive.targets]
            values += np.tensordot(amounts, np.stack(targets), 1)
        return values

    def vertices(self, name: str, frame: int | None) -> np.ndarray:
        """(V, 3) in the axes of glTF."""
        skin = self.tree.skins[self.tree.nodes[self.nodes[name]].skin]
        inverse = self.array(skin.inverseBindMatrices).reshape(-1, 4, 4).swapaxes(1, 2)
        bones = self.world(frame)[skin.joints] @ inverse
        points = self.at_rest(name, frame, "POSITION")
        points = np.hstack([points, np.ones((len(points), 1))])
        attributes, total, i = self.primitive(name).attributes, 0, 0
        while getattr(attributes, f"JOINTS_{i}", None) is not None:
            joints = self.array(getattr(attributes, f"JOINTS_{i}"))
            weights = self.array(getattr(attributes, f"WEIGHTS_{i}")).astype(float)
            total = total + np.einsum("vk,vkxy,vy->vx", weights, bones[joints], points)
            i += 1
        return total[:, :3]


def upright(points: np.ndarray) -> np.ndarray:
    """Z up, face towards -Y, to glTF's Y up, face towards +Z."""
    return np.stack([points[..., 0], points[..., 2], -points[..., 1]], -1)


# --- the glTF file ------------------------------------------------------------------


def test_every_frame_is_posed_as_the_equation_says(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    path = tmp_path / "wave.glb"
    write_animation(path, skeleton, rotations, translations, FPS, meshes)
    player = Player(path)
    assert np.abs(player.times - np.arange(20) / FPS).max() < 1e-6
    for mesh in meshes:
        truth = upright(expected(skeleton, rotations, translations, mesh))
        assert np.abs(truth - truth[0]).max() > 0.5  # it does move
        found = [player.vertices(mesh.name, frame) for frame in range(20)]
        assert np.abs(found - truth).max() < 1e-5
        rest = player.vertices(mesh.name, None)
        assert np.abs(rest - upright(mesh.vertices)).max() < 1e-6


def test_a_quarter_turn_by_hand(tmp_path):
    # The bone at the origin turns +X into +Y and moves up by 2; the morph adds 1 along
    # X before that. In glTF our Z is Y, and our Y is -Z.
    bone = Skeleton.from_heads_and_tails([[0, 0, 0]], None, [-1], ["bone"])
    turn = np.array([[[[0, -1, 0], [1, 0, 0], [0, 0, 1]]]])
    triangle = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])
    along_x = np.broadcast_to([1.0, 0, 0], (1, 3, 3))
    mesh = AnimatedMesh(
        "t", triangle, np.array([[0, 1, 2]]), np.ones((3, 1)), along_x, np.ones((1, 1))
    )
    up_by_2 = np.array([[0, 0, 2]])
    write_animation(tmp_path / "z.glb", bone, turn, up_by_2, FPS, [mesh])
    found = Player(tmp_path / "z.glb").vertices("t", 0)
    assert np.allclose(found, [[0, 2, -2], [-1, 2, -1], [0, 3, -1]], atol=1e-6)

    write_animation(tmp_path / "y.glb", bone, turn, None, FPS, [mesh], up="Y")
    found = Player(tmp_path / "y.glb").vertices("t", 0)
    assert np.allclose(found, [[0, 2, 0], [-1, 1, 0], [0, 1, 1]], atol=1e-6)


def test_only_what_moves_has_channels_and_rotations_never_jump(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    path = tmp_path / "wave.glb"
    write_animation(path, skeleton, rotations, translations, FPS, meshes)
    player = Player(path)
    channels = {(c.target.node, c.target.path) for c in player.animation.channels}
    turning = {(bone, "rotation") for bone in (0, 2, 3, 4)}  # the wrist never does
    roots = {(3, "translation"), (4, "translation")}
    assert channels == turning | roots | {(player.nodes["inner"], "weights")}
    hand = player.channel(0, "rotation")
    assert ((hand[1:] * hand[:-1]).sum(axis=1) > 0.9).all()
    assert np.allclose(hand[-1], -hand[0], atol=1e-6)  # a whole turn changes the sign


def test_every_bone_may_move_besides(tmp_path):
    skeleton, rotations, _, meshes = scene()
    shifts = np.random.default_rng(2).normal(size=(len(rotations), 5, 3))
    shifts[:, 1] = 0  # the wrist stays where the elbow takes it
    path = tmp_path / "a.glb"
    write_animation(path, skeleton, rotations, shifts, FPS, meshes)
    player, mesh = Player(path), meshes[0]
    transforms = forward_kinematics(skeleton, rotations, shifts)
    for frame, (bones, amounts) in enumerate(
        zip(transforms, mesh.morph_amounts, strict=True)
    ):
        rest = mesh.vertices + np.tensordot(amounts, mesh.morphs, 1)
        posed = linear_blend_skinning(rest, mesh.weights, bones)
        found = player.vertices("inner", frame)
        assert np.abs(found - upright(posed)).max() < 1e-4
    assert player.channel(player.nodes["wrist"], "translation") is None
    assert player.channel(player.nodes["elbow"], "translation") is not None


def test_shifts_of_the_roots_are_those_of_all_where_only_roots_move(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    shifts = np.zeros((len(rotations), 5, 3))
    shifts[:, skeleton.parents == -1] = translations[:, None]
    for name, moved in (("a", translations), ("b", shifts)):
        folder = tmp_path / name
        folder.mkdir()
        path = folder / "wave.glb"
        write_animation(path, skeleton, rotations, moved, FPS, meshes)
    files = [(tmp_path / name / "wave.glb").read_bytes() for name in "ab"]
    assert files[0] == files[1]


def test_targets_are_split_by_sign_and_those_that_never_move_are_left_out(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    path = tmp_path / "wave.glb"
    write_animation(path, skeleton, rotations, translations, FPS, meshes)
    player = Player(path)
    mesh = player.tree.meshes[player.tree.nodes[player.nodes["inner"]].mesh]
    kept = ["morph 0 +", "morph 1 +", "morph 2 +", "morph 0 -", "morph 1 -"]
    assert mesh.extras["targetNames"] == kept
    amounts = player.channel(player.nodes["inner"], "weights")
    assert amounts.max(axis=0).tolist() == [1] * 5
    assert not player.primitive("outer").targets

    # What is linear between two frames in ours is linear in the file too.
    halfway = (amounts[3] + amounts[4]) / 2
    targets = [player.array(t["POSITION"]) for t in player.primitive("inner").targets]
    ours = (meshes[0].morph_amounts[3] + meshes[0].morph_amounts[4]) / 2
    bent = upright(np.tensordot(ours, meshes[0].morphs, 1))
    assert np.abs(np.tensordot(halfway, np.stack(targets), 1) - bent).max() < 1e-6


def test_each_mesh_looks_like_cloth_of_its_colour(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    path = tmp_path / "wave.glb"
    write_animation(path, skeleton, rotations, translations, FPS, meshes)
    first, second = Player(path).tree.materials
    assert first.pbrMetallicRoughness.baseColorFactor == [0.2, 0.4, 0.8, 0.5]
    assert first.pbrMetallicRoughness.metallicFactor == 0
    assert first.doubleSided
    assert (first.alphaMode, second.alphaMode) == ("BLEND", "OPAQUE")


def test_normals_follow_the_folds(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    path = tmp_path / "wave.glb"
    write_animation(path, skeleton, rotations, translations, FPS, meshes)
    player, worse, better = Player(path), 0, 0
    plain = player.at_rest("inner", None, "NORMAL")
    for frame in range(1, 19):
        bent = player.at_rest("inner", frame, "POSITION")
        truth = vertex_normals(bent, meshes[0].faces)
        found = player.at_rest("inner", frame, "NORMAL")
        found /= np.linalg.norm(found, axis=1, keepdims=True)
        worse += np.linalg.norm(plain - truth, axis=1).mean()
        better += np.linalg.norm(found - truth, axis=1).mean()
    assert better < 0.5 * worse


def test_the_file_is_a_head_at_rest_too(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    path = tmp_path / "wave.glb"
    write_animation(path, skeleton, rotations, translations, FPS, meshes[:1])
    head = read_head(path)
    assert head.skeleton.names == skeleton.names
    assert (head.skeleton.parents == skeleton.parents).all()
    assert np.abs(head.skeleton.joints - upright(skeleton.joints)).max() < 1e-6
    assert np.abs(head.skeleton.tails - upright(skeleton.tails)).max() < 1e-6
    assert np.abs(head.vertices - upright(meshes[0].vertices)).max() < 1e-6
    assert np.abs(head.weights - meshes[0].weights).max() < 1e-6


def test_influences_may_be_limited(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    path, options = tmp_path / "wave.glb", {"up": "Y", "max_influences": 2}
    write_animation(path, skeleton, rotations, translations, FPS, meshes, **options)
    largest = -np.sort(-meshes[0].weights, axis=1)[:, :2]
    kept = np.where(meshes[0].weights >= largest[:, 1:], meshes[0].weights, 0)
    kept /= kept.sum(axis=1, keepdims=True)
    assert np.abs(read_head(path).weights[: len(kept)] - kept).max() < 1e-6


@pytest.mark.parametrize("frames", [1, 2])
def test_few_frames_and_nothing_that_turns(tmp_path, frames):
    skeleton, *_, meshes = scene()
    still = np.broadcast_to(np.eye(3), (frames, 5, 3, 3))
    write_animation(tmp_path / "still.glb", skeleton, still, None, 1, meshes[1:])
    found = Player(tmp_path / "still.glb").vertices("outer", frames - 1)
    assert np.abs(found - upright(meshes[1].vertices)).max() < 1e-6


# --- bad input ----------------------------------------------------------------------


def spoilt(values: np.ndarray, bad: float) -> np.ndarray:
    values = np.array(values)
    values.flat[3] = bad
    return values


@pytest.mark.parametrize(
    "field, change",
    [
        ("rotations", lambda r: r[:0]),
        ("rotations", lambda r: r[:, :4]),
        ("rotations", lambda r: spoilt(r, np.nan)),
        ("rotations", lambda r: 1.1 * r),
        ("rotations", lambda r: -r),
        ("rotations", lambda r: r.astype(str)),
        ("translations", lambda t: t[:-1]),
        ("translations", lambda t: spoilt(t, np.inf)),
        ("translations", lambda t: np.zeros((len(t), 4, 3))),
        ("translations", lambda t: spoilt(np.zeros((len(t), 5, 3)), np.nan)),
        ("fps", lambda _: 0.0),
        ("fps", lambda _: -30.0),
        ("fps", lambda _: float("nan")),
        ("fps", lambda _: float("inf")),
        ("fps", lambda _: 1e-40),
        ("up", lambda _: "X"),
        ("meshes", lambda _: []),
        ("path", lambda path: path.with_suffix(".gltf")),
        ("path", lambda path: path.parent / "no" / "wave.glb"),
    ],
)
def test_bad_motion_ends_in_one_error_and_no_file(tmp_path, field, change):
    skeleton, rotations, translations, meshes = scene()
    good = {
        "path": tmp_path / "wave.glb",
        "rotations": rotations,
        "translations": translations,
        "fps": FPS,
        "meshes": meshes,
        "up": "Z",
    }
    said = "file" if field == "path" else field
    with pytest.raises(HeadError, match=f"wave.*: {said}: "):
        write_animation(skeleton=skeleton, **good | {field: change(good[field])})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "field, change",
    [
        ("vertices", lambda v: v[:0]),
        ("vertices", lambda v: spoilt(v, np.nan)),
        ("faces", lambda f: f + 500),
        ("weights", lambda w: w[:, :4]),
        ("weights", lambda w: spoilt(w, 5)),
        ("morphs", lambda m: m[:, 1:]),
        ("morphs", lambda m: spoilt(m, np.nan)),
        ("morphs", lambda m: 1e20 * m),
        ("morph_amounts", lambda a: a[:, 1:]),
        ("morph_amounts", lambda a: a[1:]),
        ("morph_amounts", lambda a: spoilt(a, np.nan)),
        ("morph_amounts", lambda _: None),
        ("colour", lambda _: (1.0, 0.0, 0.0)),
        ("colour", lambda _: (1.0, 0.0, 0.0, 1.5)),
    ],
)
def test_a_bad_mesh_is_named_and_an_old_file_stays(tmp_path, field, change):
    skeleton, rotations, translations, meshes = scene()
    path = tmp_path / "wave.glb"
    path.write_bytes(b"old")
    bad = vars(meshes[0]) | {field: change(getattr(meshes[0], field))}
    meshes = [meshes[1], AnimatedMesh(**bad)]
    with pytest.raises(HeadError, match=f"wave.glb: {field} of 'inner': "):
        write_animation(path, skeleton, rotations, translations, FPS, meshes)
    assert [p.name for p in tmp_path.iterdir()] == ["wave.glb"]
    assert path.read_bytes() == b"old"


def test_names_that_no_file_holds(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    names = (*skeleton.names[:4], "pr\ud800p")
    broken = Skeleton.from_heads_and_tails(
        skeleton.joints, None, skeleton.parents, names
    )
    path = tmp_path / "wave.glb"
    with pytest.raises(HeadError, match=r"wave.glb: bone_names: .*not Unicode"):
        write_animation(path, broken, rotations, translations, FPS, meshes)
    mesh = AnimatedMesh("sl\ud800eve", *sleeve(0.1))
    write_animation(path, skeleton, rotations, translations, FPS, [mesh])
    assert "sl?eve" in Player(path).nodes


def test_too_much_is_refused_before_memory_is_taken(tmp_path, monkeypatch):
    skeleton, rotations, translations, meshes = scene()
    monkeypatch.setattr(gltf, "MAX_ELEMENTS", 10_000)
    path = tmp_path / "wave.glb"
    with pytest.raises(HeadError, match="at most 10000: fewer frames"):
        write_animation(path, skeleton, rotations, translations, FPS, meshes)
    huge = np.broadcast_to(np.float32(0), (10_000, 1, 3))
    with pytest.raises(HeadError, match="at most 10000"):
        write_vertex_cache(tmp_path / "a.npz", huge, meshes[1].faces, FPS)


# --- plain positions ----------------------------------------------------------------


def test_a_vertex_cache_keeps_every_position(tmp_path):
    skeleton, rotations, translations, meshes = scene()
    positions = expected(skeleton, rotations, translations, meshes[0])
    write_vertex_cache(tmp_path / "a.npz", positions, meshes[0].faces, FPS)
    with np.load(tmp_path / "a.npz", allow_pickle=False) as file:
        assert set(file) == {"vertices", "faces", "fps"}
        assert (file["vertices"] == positions.astype(np.float32)).all()
        assert (file["faces"] == meshes[0].faces).all()
        assert file["fps"] == FPS


@pytest.mark.parametrize(
    "field, change",
    [
        ("vertices", lambda v: v[0]),
        ("vertices", lambda v: v[:0]),
        ("vertices", lambda v: spoilt(v, np.nan)),
        ("faces", lambda f: f + 500),
        ("faces", lambda f: f - 1),
        ("faces", lambda f: f[:, :2]),
        ("faces", lambda f: f / 2),
        ("fps", lambda _: 0.0),
        ("fps", lambda _: 1e-40),
        ("path", lambda path: path.with_suffix(".npy")),
    ],
)
def test_a_bad_vertex_cache_is_refused(tmp_path, field, change):
    skeleton, rotations, translations, meshes = scene(2)
    good = {
        "path": tmp_path / "a.npz",
        "vertices": expected(skeleton, rotations, translations, meshes[1]),
        "faces": meshes[1].faces,
        "fps": FPS,
    }
    said = "file" if field == "path" else field
    with pytest.raises(HeadError, match=f"np.: {said}: "):
        write_vertex_cache(**good | {field: change(good[field])})
    assert not list(tmp_path.iterdir())


# --- Blender ------------------------------------------------------------------------

# Runs inside Blender: plays the file, and saves each mesh as it is seen in some frames.
SCRIPT = """
import sys
import bpy
import numpy as np

np.bool = bool  # the importer of Blender 3 asks for it
source, target, fps, frames = sys.argv[-4:]
bpy.ops.wm.read_factory_settings(use_empty=True)
scene = bpy.context.scene
scene.render.fps = int(fps)
bpy.ops.import_scene.gltf(filepath=source)
seen = {}
for thing in [o for o in bpy.data.objects if o.type == "MESH" and o.vertex_groups]:
    seen[thing.name] = []
    for frame in map(int, frames.split(",")):
        scene.frame_set(frame)
        evaluated = thing.evaluated_get(bpy.context.evaluated_depsgraph_get())
        points = np.empty(3 * len(evaluated.data.vertices), np.float32)
        evaluated.data.vertices.foreach_get("co", points)
        place = np.array(evaluated.matrix_world)
        seen[thing.name].append(points.reshape(-1, 3) @ place[:3, :3].T + place[:3, 3])
np.savez(target, **seen)
"""


@needs_blender
def test_blender_plays_what_we_meant_in_our_axes(tmp_path):
    skeleton, rotations, translations, meshes = scene(40)
    path, frames = tmp_path / "wave.glb", [0, 7, 13, 26, 39]
    write_animation(path, skeleton, rotations, translations, FPS, meshes)
    (tmp_path / "script.py").write_text(SCRIPT)
    listed = ",".join(map(str, frames))
    arguments = (path, tmp_path / "seen.npz", str(int(FPS)), listed)
    run_script(tmp_path / "script.py", *arguments)
    with np.load(tmp_path / "seen.npz", allow_pickle=False) as seen:
        for mesh in meshes:
            truth = expected(skeleton, rotations, translations, mesh)[frames]
            assert np.abs(seen[mesh.name] - truth).max() < 1e-4  # a tenth of a mm
