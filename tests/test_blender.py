"""Blender opens what we write, and we read and write what Blender does.

Set SKINLIB_BLENDER to a Blender executable, or to a Python that has the `bpy` module;
what needs neither is tested without.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest

from skinlib.blender import files
from skinlib.blender.files import glb_to_scene, npz_to_scene, scene_to_npz
from skinlib.blender.run import find_blender, run_script
from skinlib.datasets.synthetic import synthetic_head
from skinlib.head import Head, HeadError, Skeleton
from skinlib.io import read_glb, read_head, read_npz, read_vertex_mask, write_head

BLENDER = os.environ.get("SKINLIB_BLENDER", "")
needs_blender = pytest.mark.skipif(
    not BLENDER, reason="SKINLIB_BLENDER names no Blender, nor a Python with bpy"
)

# Runs inside Blender. It imports the file, bends the bone "jaw" by half a radian and
# saves what Blender sees. Blender turns +Y up into +Z up, which `np.save` turns back.
SCRIPT = """
import sys
import bpy
import numpy as np

np.bool = bool  # the importer of Blender 3 asks for it
source, target = sys.argv[-2:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=source)
meshes = [o for o in bpy.data.objects if o.type == "MESH" and o.vertex_groups]
armature = next(o for o in bpy.data.objects if o.type == "ARMATURE")
(mesh,) = meshes

def vertices():
    graph = bpy.context.evaluated_depsgraph_get()
    graph.update()
    evaluated = mesh.evaluated_get(graph)
    points = [evaluated.matrix_world @ v.co for v in evaluated.data.vertices]
    return np.array([(p.x, p.z, -p.y) for p in points])

names = [group.name for group in mesh.vertex_groups]
weights = np.zeros((len(mesh.data.vertices), len(names)))
for vertex in mesh.data.vertices:
    for group in vertex.groups:
        weights[vertex.index, group.group] = group.weight
rest = vertices()
jaw = armature.pose.bones["jaw"]
jaw.rotation_mode = "XYZ"
jaw.rotation_euler = (0.5, 0, 0)
bent = vertices()
np.savez(target, names=names, weights=weights, rest=rest, bent=bent,
         bones=[bone.name for bone in armature.data.bones])
"""


def jaw_head() -> Head:
    """A column of 40 rings; eight bones share its vertices, six to a vertex."""
    rng = np.random.default_rng(0)
    names = ["neck", "head", "jaw", "tongue", "eye.L", "eye.R", "lip/upper", "brow"]
    joints = [[0, y, 0.1 * (i % 3)] for i, y in enumerate([0, 1, 2, 2.5, 3, 3, 3.5, 4])]
    skeleton = Skeleton.from_heads_and_tails(
        joints, None, [-1, 0, 1, 2, 1, 1, 1, 1], names
    )
    angle, height = np.meshgrid(np.arange(12) * np.pi / 6, np.linspace(0, 4, 40))
    vertices = np.stack([np.cos(angle), height, np.sin(angle)], -1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(39), np.arange(12), indexing="ij")
    a, b, c, d = (
        ((i + di) * 12 + (j + dj) % 12).ravel()
        for di, dj in ((0, 0), (0, 1), (1, 0), (1, 1))
    )
    faces = np.concatenate([np.stack([a, c, b], 1), np.stack([b, c, d], 1)])
    weights = rng.random((len(vertices), 8)) ** 4
    weights[np.arange(len(vertices)), rng.integers(8, size=len(vertices))] = 0
    weights[np.arange(len(vertices)), rng.integers(8, size=len(vertices))] = 0
    weights[:100, 2:4] = 0  # the neck follows neither the jaw nor the tongue
    weights /= weights.sum(axis=1, keepdims=True)
    return Head.create(vertices, faces, skeleton, weights)


@needs_blender
def test_blender_reads_the_same_weights_and_bends_the_jaw(tmp_path):
    head = jaw_head()
    write_head(tmp_path / "head.glb", head)
    (tmp_path / "script.py").write_text(SCRIPT)
    run_script(tmp_path / "script.py", tmp_path / "head.glb", tmp_path / "seen.npz")

    seen = np.load(tmp_path / "seen.npz", allow_pickle=False)
    assert set(head.skeleton.names) <= set(seen["bones"].tolist())
    columns = [seen["names"].tolist().index(name) for name in head.skeleton.names]
    assert np.abs(seen["weights"][:, columns] - head.weights).max() < 1e-3
    assert np.abs(seen["rest"] - head.vertices).max() < 1e-5

    # Each vertex moves by its weight on the jaw and on the tongue below it.
    share = head.weights[:, 2] + head.weights[:, 3]
    moved = np.linalg.norm(seen["bent"] - seen["rest"], axis=1)
    assert moved[share == 0].max() < 1e-5
    distance = np.linalg.norm(head.vertices - head.skeleton.joints[2], axis=1)
    chord = 2 * np.sin(0.25) * distance * share  # longest way for half a radian
    assert (moved <= chord + 1e-5).all()
    assert (moved[share > 0.5] > 0.01).all()


# --- find Blender, run a script (any Python will do) ----------------------------------


def test_the_variable_names_a_program_or_a_python(tmp_path, monkeypatch):
    for name in ("blender-4.2", "python3"):
        (tmp_path / name).write_text("")
        (tmp_path / name).chmod(0o755)
    monkeypatch.setenv("SKINLIB_BLENDER", str(tmp_path / "python3"))
    assert find_blender() == [str(tmp_path / "python3")]
    binary = find_blender(str(tmp_path / "blender-4.2"))
    assert binary[0] == str(tmp_path / "blender-4.2")
    assert binary[1:3] == ["--background", "--factory-startup"]
    assert binary[-1] == "--python"


@pytest.mark.parametrize("given", [None, "no/such/blender"])
def test_no_blender_ends_in_how_to_get_one(given, tmp_path, monkeypatch):
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.delenv("SKINLIB_BLENDER", raising=False)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    with pytest.raises(HeadError, match=r"pip install bpy.*SKINLIB_BLENDER"):
        find_blender(given)


def run_here(tmp_path, source, *arguments, **options):
    script = tmp_path / "script.py"
    script.write_text(source)
    run_script(script, *arguments, blender=sys.executable, **options)


def test_a_script_gets_its_arguments(tmp_path):
    source = "import sys; open(sys.argv[-1], 'w').write('|'.join(sys.argv[1:]))"
    run_here(tmp_path, source, "a b", tmp_path / "said")
    assert (tmp_path / "said").read_text() == f"--|a b|{tmp_path / 'said'}"


def test_a_failure_is_told_in_one_line(tmp_path):
    with pytest.raises(HeadError, match="Blender: it failed with 'ValueError: lips'"):
        run_here(tmp_path, "print('noise')\nraise ValueError('lips')")
    with pytest.raises(HeadError, match="with 'exit status 4'"):
        run_here(tmp_path, "raise SystemExit(4)")
    with pytest.raises(HeadError, match="it crashed"):
        run_here(tmp_path, "import os; os.abort()")
    with pytest.raises(HeadError, match="did not end within"):
        run_here(tmp_path, "import time; time.sleep(60)", timeout=0.5)
    said = {"field": "bones", "found": "none", "fix": "add some"}
    source = f"import sys; print('skinlib: {json.dumps(said)}'); sys.exit(3)"
    with pytest.raises(HeadError, match=r"^bones: none\. Add some\.$"):
        run_here(tmp_path, source + "  # noise")


def test_a_failed_write_leaves_the_old_file_alone(tmp_path, monkeypatch):
    def fail(script, command, source, npz, part):
        part.write_bytes(b"half")
        part.with_suffix(".blend@").write_bytes(b"half")
        raise HeadError("Blender", "it crashed", "try again")

    monkeypatch.setattr(files, "run_script", fail)
    target = tmp_path / "head.blend"
    target.write_bytes(b"old")
    with pytest.raises(HeadError, match=r"head\.blend: Blender: it crashed"):
        npz_to_scene(tmp_path / "head.npz", target)
    assert [p.name for p in tmp_path.iterdir()] == ["head.blend"]
    assert target.read_bytes() == b"old"
    with pytest.raises(HeadError, match="it is a folder"):
        npz_to_scene(tmp_path / "head.npz", tmp_path)


# --- .blend and .fbx ------------------------------------------------------------------


def read_scene(path: Path, folder: Path) -> Head:
    scene_to_npz(path, folder / "read.npz")
    return read_npz(folder / "read.npz")


def write_scene(path: Path, head: Head, source: Path | None = None) -> None:
    npz = path.with_name("written.npz")
    write_head(npz, head)
    npz_to_scene(npz, path, source)


def with_other_weights(head: Head, seed: int = 1) -> Head:
    """Three random influences a vertex, some of them on bones without any before."""
    weights = np.random.default_rng(seed).random((len(head.vertices), 3)) + 0.1
    bones = np.argsort(np.random.default_rng(seed).random((len(weights), 9)), axis=1)
    full = np.zeros((len(weights), len(head.skeleton)), np.float32)
    np.put_along_axis(full, bones[:, :3] % len(head.skeleton), weights, axis=1)
    return head.replace(weights=full / full.sum(axis=1, keepdims=True))


def assert_same_head(found: Head, head: Head, tails: bool) -> None:
    order = [found.skeleton.names.index(name) for name in head.skeleton.names]
    skeleton, size = found.skeleton.reordered(order), np.ptp(head.vertices)
    assert np.abs(found.vertices - head.vertices).max() < 1e-5 * size
    assert (found.faces == head.faces).all()
    assert np.abs(found.weights[:, order] - head.weights).max() < 1e-4
    assert (skeleton.parents == head.skeleton.parents).all()
    assert np.abs(skeleton.joints - head.skeleton.joints).max() < 1e-5 * size
    if tails:
        assert np.abs(skeleton.tails - head.skeleton.tails).max() < 1e-5 * size


@needs_blender
def test_a_head_survives_blend_and_fbx(tmp_path):
    head = synthetic_head(3, vertices=700)
    lengths = head.skeleton.lengths
    assert lengths.min() > 0
    first, second = tmp_path / "first.blend", tmp_path / "second.fbx"
    write_scene(first, head)
    found = read_scene(first, tmp_path)
    assert_same_head(found, head, tails=True)

    # New weights into the scene that is there, as .fbx and back again.
    other = with_other_weights(found)
    write_scene(second, other, source=first)
    found = read_scene(second, tmp_path)
    assert_same_head(found, other, tails=False)
    leaves = [not children for children in found.skeleton.children()]
    assert (found.skeleton.lengths[leaves] == 0).all()  # FBX knows no tails

    third = with_other_weights(found, seed=2)
    write_scene(tmp_path / "third.blend", third, source=second)
    assert_same_head(read_scene(tmp_path / "third.blend", tmp_path), third, tails=True)
    write_scene(second, third, source=second)
    assert_same_head(read_scene(second, tmp_path), third, tails=False)


@needs_blender
def test_a_bone_without_tail_stays_without(tmp_path):
    head = jaw_head()
    assert head.skeleton.lengths.min() == 0
    write_scene(tmp_path / "head.blend", head)
    assert_same_head(read_scene(tmp_path / "head.blend", tmp_path), head, tails=True)
    long_name = (*head.skeleton.names[:-1], "x" * 64)
    skeleton = Skeleton.from_heads_and_tails(
        head.skeleton.joints, None, head.skeleton.parents, long_name
    )
    with pytest.raises(HeadError, match="more than 63 bytes"):
        write_scene(tmp_path / "head.blend", head.replace(skeleton=skeleton))


@needs_blender
def test_glb_to_blend_and_back_keeps_all_influences(tmp_path):
    head = jaw_head()
    glb, blend = tmp_path / "head.glb", tmp_path / "head.blend"
    write_head(glb, head)
    glb_to_scene(glb, blend)
    found = read_scene(blend, tmp_path)
    upright = head.vertices[:, [0, 2, 1]] * [1, -1, 1]  # glTF has +Y up, Blender +Z
    assert np.abs(found.vertices - upright).max() < 1e-5
    order = [found.skeleton.names.index(name) for name in head.skeleton.names]
    assert np.abs(found.weights[:, order] - head.weights).max() < 1e-4

    other = with_other_weights(found)
    write_scene(tmp_path / "back.glb", other, source=blend)
    back = read_glb(tmp_path / "back.glb")
    order = [back.skeleton.names.index(name) for name in other.skeleton.names]
    gaps = np.linalg.norm(back.vertices[:, None] - head.vertices[None], axis=-1)
    assert gaps.min(axis=1).max() < 1e-5
    nearest = gaps.argmin(axis=1)
    assert np.abs(back.weights[:, order] - other.weights[nearest]).max() < 1e-4


# Runs inside Blender and saves scenes that are hard, or wrong, into a folder.
SCENES = """
import math, sys
import bpy

def put(name, data):
    item = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(item)
    return item

def prism(name="prism"):
    corners = [(math.cos(a * math.pi / 3), math.sin(a * math.pi / 3)) for a in range(6)]
    points = [(x, y, z) for z in (-1, 1) for x, y in corners]
    sides = [(i, (i + 1) % 6, 6 + (i + 1) % 6, 6 + i) for i in range(6)]
    data = bpy.data.meshes.new(name)
    data.from_pydata(points, [], [*sides, range(5, -1, -1), range(6, 12)])
    return put(name, data)

def armature(name, deforming=True):
    item = put(name, bpy.data.armatures.new(name))
    bpy.context.view_layer.objects.active = item
    bpy.ops.object.mode_set(mode="EDIT")
    above = None
    for bone, height in (("neck", -1), ("control", 0), ("jaw", 0.5), ("brow", 0.7)):
        new = item.data.edit_bones.new(bone)
        new.head, new.tail, new.parent = (0, 0, height), (0, 0, height + 0.4), above
        new.use_deform = deforming and bone != "control"
        above = new
    bpy.ops.object.mode_set(mode="OBJECT")
    return item

def bound(mesh, skeleton):
    mesh.modifiers.new("Armature", "ARMATURE").object = skeleton
    return mesh

def save(name):
    bpy.ops.wm.save_as_mainfile(filepath=f"{sys.argv[-1]}/{name}.blend", compress=True)

def scene(name):
    def make(function):
        bpy.ops.wm.read_factory_settings(use_empty=True)
        function()
        save(name)
    return make

@scene("hard")
def _():
    rig = armature("rig")
    mesh = prism()
    mesh.data.materials.append(bpy.data.materials.new("skin"))
    mesh.parent = rig
    mesh.scale, mesh.location = (-2, 1, 1), (1, 2, 3)
    mesh.shape_key_add(name="Basis")
    smile = mesh.shape_key_add(name="smile")
    smile.data[0].co.z += 5
    smile.value = 1
    bound(mesh, rig)
    mesh.modifiers.new("Subdivision", "SUBSURF")
    for name, weight in (("mask", 0.25), ("control", 0.5), ("jaw", 0.5), ("neck", 0.3)):
        group = mesh.vertex_groups.new(name=name)
        group.add(range(12), weight, "REPLACE")
    mesh.vertex_groups["jaw"].lock_weight = True
    mesh.vertex_groups.active_index = 1
    mesh.vertex_groups.new(name="_LOCKED").add([3], 1, "REPLACE")
    put("copy", mesh.data)  # a linked duplicate that nothing deforms
    put("camera", bpy.data.cameras.new("camera"))
    rig.location = (0, 0, 1)
    rig.rotation_euler = (0, 0, math.pi / 2)
    rig.pose.bones["jaw"].location = (9, 9, 9)
    bpy.data.scenes.new("another")
    bpy.context.view_layer.objects.active = mesh
    bpy.ops.object.mode_set(mode="EDIT")

@scene("several")
def _():
    rigs = armature("left"), armature("right")
    for rig in rigs:
        bound(prism(f"{rig.name}_head"), rig)

@scene("selected")
def _():
    for rig in (armature("left"), armature("right")):
        bound(prism(f"{rig.name}_head"), rig)
    bpy.data.objects["left_head"].location.x = 7
    for item in bpy.data.objects:
        item.select_set(item.name == "left_head")

@scene("two_parts")
def _():
    rig = armature("rig")
    b = bound(prism("b"), rig)
    b.location.x = 5
    b.parent, b.parent_type, b.parent_bone = rig, "BONE", "jaw"
    rig.pose.bones["jaw"].location = (0, 50, 0)  # which does not count
    bound(prism("a"), rig)

@scene("no_mesh")
def _():
    armature("rig")

@scene("no_armature")
def _():
    prism()

@scene("nothing_deforms")
def _():
    bound(prism(), armature("rig", deforming=False))

@scene("unbound")
def _():
    armature("rig"), prism()

@scene("which")
def _():
    armature("rig"), prism("a"), prism("b")
"""

# Runs inside Blender and tells what the first mesh of a .blend file is like.
LOOK = """
import json, sys
import bpy

bpy.ops.wm.open_mainfile(filepath=sys.argv[-2])
mesh = bpy.data.objects["prism"]
keys = mesh.data.shape_keys.key_blocks
held = {group.index: {} for group in mesh.vertex_groups}
for vertex in mesh.data.vertices:
    for entry in vertex.groups:
        held[entry.group][vertex.index] = entry.weight
attributes = {a.name: a.data_type for a in mesh.data.attributes if a.name[0] != "."}
seen = {
    "objects": sorted((o.name, o.type, o.data.name) for o in bpy.data.objects),
    "keys": [(k.name, k.value, k.data[0].co.z) for k in keys],
    "materials": [m.name for m in mesh.data.materials],
    "modifiers": [m.type for m in mesh.modifiers],
    "polygons": [len(p.vertices) for p in mesh.data.polygons],
    "groups": [g.name for g in mesh.vertex_groups],
    "locked": [g.name for g in mesh.vertex_groups if g.lock_weight],
    "active": mesh.vertex_groups.active_index,
    "pose": list(bpy.data.objects["rig"].pose.bones["jaw"].location),
    "rest": bpy.data.objects["rig"].data.pose_position,
    "scenes": sorted(s.name for s in bpy.data.scenes),
    "kept": [held[mesh.vertex_groups[n].index] for n in ("mask", "control", "_LOCKED")],
    "jaw": held[mesh.vertex_groups["jaw"].index],
}
extra = {
    "attributes": attributes,
    "confidence": [
        entry.value
        for name in ("_CONFIDENCE",) if name in mesh.data.attributes
        for entry in mesh.data.attributes[name].data
    ],
    "colours": [
        list(entry.color)
        for name in ("skinlib",) if name in mesh.data.attributes
        for entry in mesh.data.attributes[name].data
    ],
}
with open(sys.argv[-1], "w") as file:
    json.dump([seen, extra], file)
"""


@pytest.fixture(scope="module")
def scenes(tmp_path_factory):
    folder = tmp_path_factory.mktemp("scenes")
    (folder / "scenes.py").write_text(SCENES)
    run_script(folder / "scenes.py", folder)
    return folder


def look(path: Path, folder: Path):
    (folder / "look.py").write_text(LOOK)
    run_script(folder / "look.py", path, folder / "seen.json")
    return json.loads((folder / "seen.json").read_text())


@needs_blender
def test_transforms_ngons_keys_and_poses_by_hand(scenes, tmp_path):
    head = read_scene(scenes / "hard.blend", tmp_path)
    # The prism: mirrored and stretched in x, moved by (1, 2, 3), turned about z by a
    # quarter with its parent, lifted by 1. Neither the smile nor the pose count.
    x, y = 1 - 2 * 1.0, 2 + 0.0
    assert np.allclose(head.vertices[0], (-y, x, -1 + 3 + 1), atol=1e-6)
    assert head.vertices.shape == (12, 3)
    assert head.faces.shape == (6 * 2 + 2 * 4, 3)  # six quads, two hexagons
    corners = head.vertices[head.faces].astype(np.float64)
    volume = np.linalg.det(corners).sum() / 6  # positive: the faces look outwards
    assert volume == pytest.approx(2 * (1.5 * np.sqrt(3) * 2), rel=1e-5)

    # The control does not deform: out of the list, out of the tree, no weights.
    assert head.skeleton.names == ("neck", "jaw", "brow")
    assert head.skeleton.parents.tolist() == [-1, 0, 1]
    heights = [0 + 1, 0.5 + 0 + 1, 0.7 + 0 + 1]
    assert np.allclose(head.skeleton.joints[:, 2], [0, 1.5, 1.7], atol=1e-6), heights
    assert np.allclose(head.skeleton.lengths, 0.4, atol=1e-6)
    # Blender divides by the sum: 0.3 and 0.5 are 3/8 and 5/8.
    assert np.allclose(head.weights, [[0.375, 0.625, 0]] * 12, atol=1e-6)
    mask = read_vertex_mask(tmp_path / "read.npz", "_LOCKED")
    assert np.flatnonzero(mask).tolist() == [3]


@needs_blender
def test_everything_else_in_a_scene_is_kept(scenes, tmp_path):
    source = scenes / "hard.blend"
    content = source.read_bytes()
    before, _ = look(source, tmp_path)
    head = read_scene(source, tmp_path)
    jaw = np.linspace(0, 1, 12)
    weights = np.stack([1 - jaw, jaw, np.zeros(12)], axis=1)
    npz = tmp_path / "written.npz"
    colours = np.full((12, 4), 0.2)
    shown = {"colours": colours, "attributes": {"_CONFIDENCE": jaw}}
    write_head(npz, head.replace(weights=weights), **shown)
    for target in (tmp_path / "new.blend", tmp_path / "again.blend"):
        npz_to_scene(npz, target, source)
        after, extra = look(target, tmp_path)
        held = [after["jaw"].get(str(vertex), 0) for vertex in range(12)]
        assert np.allclose(held, jaw, atol=1e-6)
        assert "0" not in after["jaw"]  # none, and not a weight of 0
        assert after | {"jaw": None} == before | {"jaw": None}
        assert np.allclose(extra["confidence"], jaw)
        assert np.allclose(extra["colours"], 0.2)
        assert sum(name.startswith("skinlib") for name in extra["attributes"]) == 1
        assert source.read_bytes() == content
        source, content = target, target.read_bytes()
    assert content[:7] != b"BLENDER"  # compressed, as the source was


@needs_blender
def test_which_objects_are_the_head(scenes, tmp_path):
    selected = read_scene(scenes / "selected.blend", tmp_path)
    assert selected.vertices[:, 0].min() == pytest.approx(6)
    parts = read_scene(scenes / "two_parts.blend", tmp_path)
    assert len(parts.vertices) == 24 and parts.weights is None
    assert (parts.vertices[:12, 0] < 2).all() and (parts.vertices[12:, 0] > 3).all()
    assert np.abs(parts.vertices).max() < 10
    unbound = read_scene(scenes / "unbound.blend", tmp_path)
    write_scene(tmp_path / "bound.blend", with_other_weights(unbound), source=None)
    painted = with_other_weights(unbound)
    write_scene(tmp_path / "bound.blend", painted, source=scenes / "unbound.blend")
    bound = read_scene(tmp_path / "bound.blend", tmp_path)
    assert_same_head(bound, painted, tails=True)

    other = synthetic_head(0, vertices=700)
    with pytest.raises(HeadError, match=r"which are not the .* of the head"):
        write_scene(tmp_path / "x.blend", other, source=scenes / "unbound.blend")
    assert not (tmp_path / "x.blend").exists()


@needs_blender
@pytest.mark.parametrize(
    "name, words",
    [
        ("no_mesh", "meshes: there is no mesh"),
        ("no_armature", "bones: there is no armature"),
        ("nothing_deforms", "no bone of 'rig' deforms"),
        ("several", "2 armatures have meshes .left, right.. Select the head's mesh"),
        ("which", "2 meshes and 1 armatures, none bound to another"),
        ("nonsense", "cannot open it"),
        ("cut", "cannot open it"),
    ],
)
def test_a_scene_without_a_head_is_refused(scenes, tmp_path, name, words):
    path = scenes / f"{name}.blend"
    if name == "nonsense":
        path.write_bytes(b"BLENDER-v999" + bytes(500))
    if name == "cut":
        path.write_bytes((scenes / "hard.blend").read_bytes()[:5000])
    with pytest.raises(HeadError, match=rf"{name}\.blend: .*{words}"):
        scene_to_npz(path, tmp_path / "head.npz")


@needs_blender
def test_a_damaged_fbx_is_refused(tmp_path):
    (tmp_path / "head.fbx").write_bytes(b"Kaydara FBX Binary  \0\x1a\0" + bytes(99))
    with pytest.raises(HeadError, match=r"head\.fbx: .*cannot open it"):
        scene_to_npz(tmp_path / "head.fbx", tmp_path / "head.npz")


@needs_blender
def test_read_and_write_go_by_the_ending(scenes, tmp_path):
    head = read_head(scenes / "hard.blend")
    assert head.name == "hard"
    mask = read_vertex_mask(scenes / "hard.blend", "_LOCKED")
    assert np.flatnonzero(mask).tolist() == [3]
    first, target = tmp_path / "first.blend", tmp_path / "second.fbx"
    head = synthetic_head(3, vertices=700)
    write_head(first, head)
    for source in (first, target):
        head = with_other_weights(head)
        write_head(target, head, source=source)
        assert_same_head(read_head(target), head, tails=False)
    write_head(tmp_path / "head.glb", head)
    write_head(tmp_path / "head.blend", head, source=tmp_path / "head.glb")
    assert read_head(tmp_path / "head.blend").vertices.shape == head.vertices.shape
    with pytest.raises(HeadError, match=r"head\.blend: file: there is no such file"):
        read_head(tmp_path / "none" / "head.blend")
    with pytest.raises(HeadError, match="cannot be re-skinned into a"):
        write_head(tmp_path / "head.npz", head, source=target)


@needs_blender
def test_a_half_painted_scene_is_at_fault_not_our_file(scenes, tmp_path):
    head = read_head(scenes / "unbound.blend")
    painted = with_other_weights(head)
    write_head(tmp_path / "head.npz", painted)
    arrays = dict(np.load(tmp_path / "head.npz"))
    arrays["weights"][5] = 0
    np.savez(tmp_path / "half.npz", **arrays)
    npz_to_scene(tmp_path / "half.npz", tmp_path / "half.blend")
    assert read_head(tmp_path / "half.blend", weights=False).weights is None
    with pytest.raises(HeadError, match=r"half\.blend: weights: 1 rows .* vertex 5"):
        read_head(tmp_path / "half.blend")
