"""The Blender add-on, installed and used as a person would, without a window.

One script does everything inside Blender and writes down what it saw; the tests look at
that. A stand-in for the program `skinlib` makes the weights predictable; the real one
is called once, at the end.
"""

import json
import os
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

import skinlib.blender
from skinlib.blender.run import run_script
from skinlib.cli import main
from skinlib.io import read_npz
from skinlib.model import ModelConfig, SkinningModel
from skinlib.training import save_model

pytestmark = pytest.mark.skipif(
    not os.environ.get("SKINLIB_BLENDER") or os.name == "nt",
    reason="SKINLIB_BLENDER names no Blender, nor a Python with bpy",
)
ADDON = Path(skinlib.blender.__file__).with_name("skinlib_addon.py")

# In place of `skinlib skin IN OUT ...`: vertex v goes half to bone v % 3 and half to
# the next. It notes how it was called.
PROGRAM = """#!{python}
import json, shutil, sys
import numpy as np

command, source, target, *options = sys.argv[1:]
checkpoint = options[options.index("--checkpoint") + 1]
shutil.copy(source, "{folder}/sent.npz")
json.dump(options, open("{folder}/options.json", "w"))
if checkpoint == "refuse":
    sys.exit(f"skinlib: {{source}}: vertices: too few of them. Add some.")
if checkpoint == "crash":
    raise MemoryError("no memory")
head = dict(np.load(source))
count, bones = len(head["vertices"]), len(head["bone_names"])
weights = np.zeros((count, bones), np.float32)
for half in (0, 1):
    weights[np.arange(count), (np.arange(count) + half) % bones] += 0.5
if checkpoint == "nan":
    weights[0] = np.nan
if checkpoint == "short":
    weights = weights[1:]
head["weights"] = weights
if "--confidence" in options:
    head["colours"] = np.full((count, 4), 51, np.uint8)
    head["confidence"] = np.linspace(0, 1, count).astype(np.float32)
np.savez(target, **head)
"""

SCRIPT = """
import json, math, sys
from pathlib import Path
import bpy

addon, program, real, network, folder = sys.argv[-5:]
seen = {}

def prism(name):
    corners = [(math.cos(a * math.pi / 3), math.sin(a * math.pi / 3)) for a in range(6)]
    points = [(x, y, z) for z in (-1, 1) for x, y in corners]
    sides = [(i, (i + 1) % 6, 6 + (i + 1) % 6, 6 + i) for i in range(6)]
    data = bpy.data.meshes.new(name)
    data.from_pydata(points, [], [*sides, range(5, -1, -1), range(6, 12)])
    item = bpy.data.objects.new(name, data)
    bpy.context.scene.collection.objects.link(item)
    return item

def armature(name):
    item = bpy.data.objects.new(name, bpy.data.armatures.new(name))
    bpy.context.scene.collection.objects.link(item)
    bpy.context.view_layer.objects.active = item
    bpy.ops.object.mode_set(mode="EDIT")
    above = None
    for bone, height in (("neck", -1), ("-jaw", 0.5), ("brow", 0.7)):
        new = item.data.edit_bones.new(bone)
        new.head, new.tail, new.parent = (0, 0, height), (0, 0, height + 0.4), above
        above = new
    bpy.ops.object.mode_set(mode="OBJECT")
    return item

def scene():
    for item in list(bpy.data.objects):
        bpy.data.objects.remove(item)
    rig, mesh = armature("rig"), prism("head")
    mesh.scale, mesh.location = (-2, 1, 1), (1, 2, 3)
    for key, value in dict(
        checkpoint="any", max_influences=0, smooth=0, symmetric=False,
        keep_locked=True, only_selected=False, confidence=False,
    ).items():
        setattr(bpy.context.scene.skinlib, key, value)
    select(rig, mesh)
    return rig, mesh

def select(*items):
    bpy.context.view_layer.update()
    for item in bpy.context.view_layer.objects:
        item.select_set(item in items)
    bpy.context.view_layer.objects.active = items[-1] if items else None

def press(*how):
    try:
        return sorted(bpy.ops.object.skinlib_skin(*how))
    except RuntimeError as error:
        return str(error)

def groups(mesh):
    held = {g.name: [0.0] * len(mesh.data.vertices) for g in mesh.vertex_groups}
    for vertex in mesh.data.vertices:
        for entry in vertex.groups:
            held[mesh.vertex_groups[entry.group].name][vertex.index] = entry.weight
    return held

def options():
    return json.loads(Path(folder, "options.json").read_text())

bpy.ops.preferences.addon_install(filepath=addon, overwrite=True)
bpy.ops.preferences.addon_enable(module="skinlib_addon")
preferences = bpy.context.preferences.addons["skinlib_addon"].preferences

# Nothing to run yet, and nothing to run it on.
rig, mesh = scene()
seen["not on the path"] = press()
preferences.executable = "/no/such/skinlib"
seen["no program"] = press()
preferences.executable = addon
seen["no executable"] = press()
preferences.executable = program
chosen = {"no selection": [], "no armature": [mesh], "no mesh": [rig]}
for case in chosen:
    select(*chosen[case])
    seen[case] = press()
other = armature("other")
select(mesh, rig, other)
seen["two armatures"] = press()
mesh.modifiers.new("Armature", "ARMATURE").object = other
select(mesh, rig)
seen["another armature"] = press()
bpy.ops.object.mode_set(mode="EDIT")
seen["edit mode"] = press()
bpy.ops.object.mode_set(mode="OBJECT")
seen["untouched"] = groups(mesh)

rig, mesh = scene()
place = [list(row) for row in mesh.matrix_world]
seen["pressed"] = press("INVOKE_DEFAULT")
seen["groups"], seen["options"] = groups(mesh), options()
bpy.context.view_layer.update()
seen["place"] = place, [list(row) for row in mesh.matrix_world]
seen["bound"] = [mesh.parent.name, [(m.type, m.object.name) for m in mesh.modifiers]]
Path(folder, "sent.npz").rename(Path(folder, "first.npz"))
seen["again"] = press()
seen["bound again"] = len(mesh.modifiers), sorted(groups(mesh))

rig, mesh = scene()
settings = bpy.context.scene.skinlib
settings.max_influences, settings.smooth, settings.symmetric = 4, 2, True
mesh.vertex_groups.new(name="mask").add(range(12), 0.7, "REPLACE")
jaw = mesh.vertex_groups.new(name="-jaw")
for vertex in range(12):
    jaw.add([vertex], vertex / 37, "REPLACE")
jaw.lock_weight = True
neck = mesh.vertex_groups.new(name="neck")
neck.add([3, 4], 0.1, "REPLACE")
mesh.vertex_groups.new(name="_LOCKED").add([3], 1, "REPLACE")
mesh.vertex_groups.active_index = 1
seen["before locks"] = groups(mesh)
seen["locks"] = press()
seen["after locks"], seen["lock options"] = groups(mesh), options()
seen["flags"] = [(g.name, g.lock_weight) for g in mesh.vertex_groups]
seen["active"] = mesh.vertex_groups.active_index
settings.keep_locked = False
press()
seen["locks ignored"] = groups(mesh), options()
settings.keep_locked = True
for name in ("neck", "brow"):
    mesh.vertex_groups[name].lock_weight = True
seen["all locked"] = press()
neck.lock_weight = False
jaw.add([5], 0.9, "REPLACE")
mesh.vertex_groups["brow"].add([5], 0.9, "REPLACE")
seen["too much locked"] = press()

rig, mesh = scene()
mesh.data.attributes.new("_LOCKED", "BOOLEAN", "POINT").data[1].value = True
bpy.context.scene.skinlib.only_selected = True
for vertex in mesh.data.vertices:
    vertex.select = vertex.index < 4
bpy.ops.object.mode_set(mode="WEIGHT_PAINT")
seen["selected"] = press()
bpy.ops.object.mode_set(mode="OBJECT")
seen["selected groups"] = groups(mesh)
for vertex in mesh.data.vertices:
    vertex.select = False
seen["none selected"] = press()

rig, mesh = scene()
press()
before = groups(mesh)
for case in ("refuse", "crash", "nan", "short"):
    bpy.context.scene.skinlib.checkpoint = case
    seen[case] = press(), groups(mesh) == before
bpy.context.scene.skinlib.checkpoint = "any"
bpy.context.scene.skinlib.confidence = True
press()
layer = mesh.data.color_attributes["skinlib"]
seen["colours"] = [list(entry.color) for entry in layer.data]
seen["confidence"] = [entry.value for entry in mesh.data.attributes["_CONFIDENCE"].data]

# Two meshes of one head, and a linked duplicate of the first.
rig, mesh = scene()
eye = prism("eye")
eye.location.x = 9
copy = bpy.data.objects.new("copy", mesh.data)
bpy.context.scene.collection.objects.link(copy)
select(mesh, eye, copy, rig)
seen["parts"] = press(), groups(mesh), groups(eye)

rig, mesh = scene()
bpy.ops.ed.undo_push(message="before")
press()
bpy.ops.ed.undo_push(message="after")
skinned = sorted(groups(bpy.data.objects["head"]))
bpy.ops.ed.undo()
mesh = bpy.data.objects["head"]
seen["undone"] = skinned, sorted(groups(mesh)), len(mesh.modifiers)

rig, mesh = scene()
preferences = bpy.context.preferences.addons["skinlib_addon"].preferences
preferences.executable = real
bpy.context.scene.skinlib.checkpoint = network
bpy.context.scene.skinlib.max_influences = 2
seen["real"] = press(), groups(mesh)
jaw = mesh.vertex_groups.get("-jaw") or mesh.vertex_groups.new(name="-jaw")
jaw.add([0], 0.3, "REPLACE")
jaw.lock_weight = True
seen["real locked"] = groups(mesh), press(), groups(mesh)
bpy.context.scene.skinlib.checkpoint = folder + "/nothing"
seen["no network"] = press()

bpy.ops.preferences.addon_disable(module="skinlib_addon")
seen["gone"] = [
    hasattr(bpy.types.Scene, "skinlib"), "skinlib_skin" in dir(bpy.ops.object)
]
bpy.ops.preferences.addon_enable(module="skinlib_addon")
seen["back"] = bpy.context.scene.skinlib.checkpoint

with open(folder + "/seen.json", "w") as file:
    json.dump(seen, file)
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """The folder of the session in Blender, and what was seen there."""
    folder = tmp_path_factory.mktemp("addon")
    program = folder / "skinlib"
    program.write_text(PROGRAM.format(python=sys.executable, folder=folder))
    program.chmod(0o755)
    real = folder / "real"
    real.write_text(f'#!/bin/sh\nexec "{sys.executable}" -m skinlib "$@"\n')
    real.chmod(0o755)
    small = ModelConfig(mesh_width=8, bone_width=8, blocks=1, points=2, tree_layers=1)
    torch.manual_seed(0)
    save_model(SkinningModel(small), folder / "network", {})
    (folder / "script.py").write_text(SCRIPT)
    with pytest.MonkeyPatch.context() as patch:
        # Where the add-on gets installed, instead of the user's own settings.
        patch.setenv("BLENDER_USER_RESOURCES", str(folder / "user"))
        patch.setenv("BLENDER_USER_SCRIPTS", str(folder / "user" / "scripts"))
        patch.setenv("SKINLIB_BLENDER", os.environ["SKINLIB_BLENDER"])
        patch.setenv("PATH", os.defpath)
        files = (ADDON, program, real, folder / "network", folder)
        run_script(folder / "script.py", *files)
    return folder, json.loads((folder / "seen.json").read_text())


def expected(count: int = 12) -> np.ndarray:
    """(V, 3) what the stand-in predicts for neck, -jaw and brow."""
    eye = np.eye(3)
    return np.array([(eye[v % 3] + eye[(v + 1) % 3]) / 2 for v in range(count)])


def columns(groups: dict) -> np.ndarray:
    none = [0.0] * len(next(iter(groups.values())))  # no weights, no group
    return np.array([groups.get(name, none) for name in ("neck", "-jaw", "brow")]).T


@pytest.mark.parametrize(
    "case, words",
    [
        ("not on the path", "skinlib: it is not on the PATH. Name the program"),
        ("no program", "there is no program '/no/such/skinlib'"),
        ("no executable", "there is no program"),
        ("no selection", "no mesh is selected"),
        ("no armature", "no armature is selected. Select the head's mesh and"),
        ("no mesh", "no mesh is selected"),
        ("two armatures", "2 armatures are selected"),
        ("another armature", "'head' has another armature, 'other'"),
        ("edit mode", "this does not work in Edit Mode"),
        ("all locked", "all of them are locked"),
        ("too much locked", "the locked ones sum to 1.800 at vertex 5"),
        ("none selected", "all of them keep their weights"),
        ("no network", "nothing/model.safetensors: checkpoint: there is no such file"),
    ],
)
def test_what_is_missing_is_told(session, case, words):
    assert words in session[1][case]


def test_nothing_is_touched_when_something_is_missing(session):
    assert session[1]["untouched"] == {}


def test_the_button_skins_binds_and_moves_nothing(session):
    folder, seen = session
    assert seen["pressed"] == seen["again"] == ["FINISHED"]
    assert np.allclose(columns(seen["groups"]), expected())
    assert seen["options"] == ["--checkpoint", "any"]
    before, after = seen["place"]
    assert np.allclose(before, after)
    assert seen["bound"] == ["rig", [["ARMATURE", "rig"]]]
    assert seen["bound again"] == [1, ["-jaw", "brow", "neck"]]

    sent = read_npz(folder / "first.npz")
    assert sent.weights is None
    assert sent.skeleton.names == ("neck", " -jaw", "brow")
    assert np.allclose(sent.vertices[0], (1 - 2, 2, 3 - 1))
    corners = sent.vertices[sent.faces].astype(np.float64)
    assert np.linalg.det(corners).sum() > 0  # mirrored, and still the right side out


def test_locked_groups_and_vertices_keep_every_bit(session):
    _, seen = session
    assert seen["locks"] == ["FINISHED"]
    before, after = seen["before locks"], seen["after locks"]
    for name in ("mask", "-jaw", "_LOCKED"):
        assert after[name] == before[name]
    assert after["neck"][3] == before["neck"][3]
    assert after["brow"][3] == 0
    free = [v for v in range(12) if v != 3]
    assert np.allclose(columns(after)[free][:, [0, 2]], expected()[free][:, [0, 2]])
    assert seen["flags"] == [
        ["mask", False],
        ["-jaw", True],
        ["neck", False],
        ["_LOCKED", False],
        ["brow", False],
    ]
    assert seen["active"] == 1
    assert seen["lock options"] == [
        *("--checkpoint", "any", "--max-influences", "4", "--symmetric"),
        *("--smooth", "2", "--lock-vertices", "_LOCKED", "--lock", " -jaw"),
    ]
    groups, options = seen["locks ignored"]
    assert np.allclose(columns(groups)[free], expected()[free])
    assert "--lock" not in options


def test_selected_vertices_only(session):
    _, seen = session
    assert seen["selected"] == ["FINISHED"]
    changed = np.array([v in (0, 2, 3) for v in range(12)])  # 1 is locked
    assert np.allclose(
        columns(seen["selected groups"]), np.where(changed[:, None], expected(), 0)
    )


@pytest.mark.parametrize(
    "case, words",
    [
        ("refuse", "vertices: too few of them. Add some."),
        ("crash", "no memory"),
        ("nan", "update skinlib"),
        ("short", "weights of shape (11, 3) for (12, 3)"),
    ],
)
def test_a_failed_run_changes_no_group(session, case, words):
    told, unchanged = session[1][case]
    assert words in told.replace("Update", "update")
    assert str(session[0]) not in told
    assert unchanged


def test_confidence_becomes_attributes(session):
    assert np.allclose(session[1]["confidence"], np.linspace(0, 1, 12))
    assert np.allclose(session[1]["colours"], [[0.2] * 4] * 12)


def test_several_meshes_are_one_head(session):
    state, head, eye = session[1]["parts"]
    assert state == ["FINISHED"]
    assert np.allclose(columns(eye), expected(24)[12:])  # "copy" comes before "eye"
    assert np.allclose(columns(head), expected(24)[:12])


def test_undo_takes_it_back(session):
    skinned, undone, modifiers = session[1]["undone"]
    assert skinned == ["-jaw", "brow", "neck"]
    assert (undone, modifiers) == ([], 0)


def test_the_program_itself_gives_the_same_weights(session, tmp_path):
    folder, seen = session
    state, groups = seen["real"]
    assert state == ["FINISHED"], state
    options = ["--checkpoint", str(folder / "network"), "--max-influences", "2"]
    main(["skin", str(folder / "first.npz"), str(tmp_path / "skinned.npz"), *options])
    skinned = read_npz(tmp_path / "skinned.npz")
    assert np.allclose(columns(groups), skinned.weights, atol=1e-6)
    before, state, again = seen["real locked"]
    assert state == ["FINISHED"], state
    assert again["-jaw"] == before["-jaw"]
    assert again["-jaw"][0] == np.float32(0.3)
    assert np.allclose(columns(again).sum(axis=1), 1, atol=1e-6)


def test_it_can_be_switched_off_and_on(session):
    assert session[1]["gone"] == [False, False]
    assert session[1]["back"].endswith("nothing")  # settings live in the scene
