"""Blender opens what we write: same weights, and a jaw that moves the right vertices.

Set SKINLIB_BLENDER to a Blender executable, or to a Python that has the `bpy` module.
"""

import os
import subprocess
from pathlib import Path

import numpy as np
import pytest

from skinlib.head import Head, Skeleton
from skinlib.io import write_head

BLENDER = os.environ.get("SKINLIB_BLENDER", "")

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


@pytest.mark.skipif(
    not BLENDER, reason="SKINLIB_BLENDER names no Blender, nor a Python with bpy"
)
def test_blender_reads_the_same_weights_and_bends_the_jaw(tmp_path):
    head = jaw_head()
    write_head(tmp_path / "head.glb", head)
    (tmp_path / "script.py").write_text(SCRIPT)
    files = [tmp_path / "script.py", tmp_path / "head.glb", tmp_path / "seen.npz"]
    if "blender" in Path(BLENDER).name.lower():
        options = ["--background", "--python-exit-code", "3", "--python"]
        command = [BLENDER, *options, files[0], "--", *files[1:]]
    else:
        command = [BLENDER, *files]
    run = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert run.returncode == 0, run.stdout + run.stderr

    seen = np.load(files[2], allow_pickle=False)
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
