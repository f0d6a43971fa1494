"""Runs inside Blender: binds a mesh to an armature with automatic weights.

Called by `skinlib.evaluate.volumetric.blender_weights` with the files to read and to
write behind a "--". Needs nothing but `bpy` and numpy.
"""

import sys

import numpy as np


def main(given: str, found: str) -> None:
    """Read vertices, faces and bones from one .npz; write weights (V, J) to another."""
    import bpy

    bpy.ops.wm.read_factory_settings(use_empty=True)
    with np.load(given, allow_pickle=False) as head:
        arrays = {key: head[key] for key in head.files}
    mesh = bpy.data.meshes.new("head")
    mesh.from_pydata(arrays["vertices"].tolist(), [], arrays["faces"].tolist())
    mesh.validate()  # faces that lost a corner when the seams were closed
    head = bpy.data.objects.new("head", mesh)
    armature = bpy.data.objects.new("bones", bpy.data.armatures.new("bones"))
    for item in (head, armature):
        bpy.context.collection.objects.link(item)

    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    bones = [armature.data.edit_bones.new(str(i)) for i in range(len(arrays["heads"]))]
    for bone, start, end, parent in zip(
        bones,
        arrays["heads"].tolist(),
        arrays["tails"].tolist(),
        arrays["parents"].tolist(),
        strict=True,
    ):
        bone.head, bone.tail = start, end
        bone.parent = bones[parent] if parent >= 0 else None
    bpy.ops.object.mode_set(mode="OBJECT")

    head.select_set(True)
    armature.select_set(True)
    bpy.ops.object.parent_set(type="ARMATURE_AUTO")

    weights = np.zeros((len(arrays["vertices"]), len(arrays["heads"])), np.float32)
    columns = [int(group.name) for group in head.vertex_groups]
    for vertex in mesh.vertices:
        for entry in vertex.groups:
            weights[vertex.index, columns[entry.group]] = entry.weight
    np.savez(found, weights=weights)


if __name__ == "__main__":
    main(*sys.argv[-2:])
