"""Runs inside Blender, started by `skinlib.blender.files`.

    scene_script.py -- read SOURCE NPZ            the head of a scene, to a .npz
    scene_script.py -- write SOURCE NPZ TARGET    weights from a .npz, into the scene

SOURCE "-" is an empty scene, which the head of the .npz is put into; NPZ "-" leaves the
weights of the scene as they are.
"""

import json
import sys
from pathlib import Path

import bpy
import numpy as np

sys.dont_write_bytecode = True
sys.path.insert(0, str(Path(__file__).parent))
import skinlib_addon as addon  # noqa: E402, Blender does not look beside a script

LONGEST_NAME = 63  # bytes, of a bone or a vertex group in Blender


def main(command, *arguments):
    try:
        {"read": read, "write": write}[command](*arguments)
    except addon.SceneError as error:
        fail(error.field, error.found, error.fix)


def fail(field, found, fix):
    """End Blender with an error that `skinlib.blender.run` understands."""
    text = json.dumps({"field": field, "found": found, "fix": fix})
    sys.stderr.write(f"skinlib: {text}\n")
    sys.stderr.flush()
    sys.exit(3)


def read(source, npz):
    open_scene(source)
    head = addon.find_head(bpy.context.view_layer.objects)
    arrays = addon.head_arrays(*head, tails=not source.lower().endswith(".fbx"))
    # Blender divides by the sum when it deforms; a row that sums to 1 stays to the bit.
    weights = arrays.pop("weights")
    sums = weights.sum(axis=1, dtype=np.float64, keepdims=True)
    off = ((np.abs(sums - 1) > 1e-6) & (sums > 0))[:, 0]
    weights[off] /= sums[off]
    if sums.any():
        arrays["weights"] = weights
    if not arrays["locked"].any():
        del arrays["locked"]
    np.savez(npz, **arrays)


def write(source, npz, target):
    arrays = dict(np.load(npz, allow_pickle=False)) if npz != "-" else {}
    if source == "-":
        bpy.ops.wm.read_factory_settings(use_empty=True)
        new_head(arrays)
    else:
        open_scene(source)
    if "weights" in arrays:
        meshes, armature = addon.find_head(bpy.context.view_layer.objects)
        check_same(addon.head_arrays(meshes, armature), arrays)
        names = arrays["bone_names"].tolist()
        addon.put_weights(meshes, armature, names, arrays["weights"])
        addon.put_fields(meshes, arrays)
    compressed = False
    if source.lower().endswith(".blend"):
        with open(source, "rb") as file:
            compressed = file.read(7) != b"BLENDER"
    elif source != "-" and target.lower().endswith(".blend"):
        for armature in bpy.data.armatures:
            for bone in armature.bones:
                bone[addon.NO_TAIL] = True
    save_scene(target, compressed)


def check_same(scene, head):
    """The scene must hold the mesh and the bones of the head."""
    fix = "write into the file that the head was read from"
    found, given = scene["vertices"], head["vertices"]
    size = np.ptp(found, axis=0).max()
    if found.shape != given.shape or np.abs(found - given).max() > 1e-4 * size:
        raise addon.SceneError(
            "vertices",
            f"the scene has {len(found)} vertices, which are not the {len(given)} of "
            "the head",
            fix,
        )
    differing = set(scene["bone_names"]) ^ set(head["bone_names"])
    if differing:
        raise addon.SceneError(
            "bone_names",
            "the bones of the scene are not those of the head, for example "
            f"{str(min(differing))!r}",
            fix,
        )


def new_head(arrays):
    """A mesh and an armature in the open scene."""
    names = arrays["bone_names"].tolist()
    for name in names:
        if len(name.encode()) > LONGEST_NAME:
            raise addon.SceneError(
                "bone_names",
                f"{name!r} has more than {LONGEST_NAME} bytes",
                "shorten it, Blender cannot hold it",
            )
    data = bpy.data.meshes.new("head")
    data.from_pydata(arrays["vertices"].tolist(), [], arrays["faces"].tolist())
    data.validate()
    data.polygons.foreach_set("use_smooth", [True] * len(data.polygons))
    mesh = bpy.data.objects.new("head", data)
    armature = bpy.data.objects.new("skeleton", bpy.data.armatures.new("skeleton"))
    for item in (mesh, armature):
        bpy.context.scene.collection.objects.link(item)

    bpy.context.view_layer.objects.active = armature
    bpy.ops.object.mode_set(mode="EDIT")
    heads = arrays["bone_heads"].astype(np.float64)
    tails = arrays["bone_tails"].astype(np.float64)
    size = np.ptp(np.concatenate([arrays["vertices"], heads]), axis=0).max()
    bones = [armature.data.edit_bones.new(name) for name in names]
    without = np.abs(tails - heads).max(axis=1) <= 1e-6 * size
    tails[without] += (0, 0, 0.03 * size)
    for bone, head, tail, parent in zip(
        bones, heads, tails, arrays["bone_parents"].tolist(), strict=True
    ):
        bone.head, bone.tail = head, tail
        if parent >= 0:
            bone.parent = bones[parent]
    bpy.ops.object.mode_set(mode="OBJECT")
    if len(armature.data.bones) < len(names):
        raise addon.SceneError(
            "bone_heads",
            "some bones are too short for Blender",
            "scale the head up: Blender thinks in metres",
        )
    for name in np.array(names)[without].tolist():
        armature.data.bones[name][addon.NO_TAIL] = True
    addon.bind(mesh, armature)


# --- files ----------------------------------------------------------------------------


def open_scene(source):
    suffix = Path(source).suffix.lower()
    if suffix == ".blend":
        # Nothing of what a file brings along is run.
        attempt(
            bpy.ops.wm.open_mainfile, filepath=source, load_ui=False, use_scripts=False
        )
    else:
        bpy.ops.wm.read_factory_settings(use_empty=True)
        if suffix == ".fbx":
            attempt(bpy.ops.import_scene.fbx, filepath=source)
        else:
            if bpy.app.version < (4, 0):
                np.bool = bool  # its importer is older than its numpy
            attempt(bpy.ops.import_scene.gltf, filepath=source)
    active = bpy.context.view_layer.objects.active
    if active is not None and active.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")


def save_scene(target, compressed):
    suffix = Path(target).suffix.lower()
    if suffix == ".blend":
        bpy.ops.wm.save_as_mainfile(
            filepath=target,
            check_existing=False,
            compress=compressed,
            relative_remap=True,
            copy=True,
        )
    elif suffix == ".fbx":
        bpy.ops.export_scene.fbx(
            filepath=target,
            use_mesh_modifiers=False,  # they would cost the shape keys
            use_armature_deform_only=True,
            add_leaf_bones=False,
            use_custom_props=True,
            bake_anim=bool(bpy.data.actions),
            path_mode="COPY" if packed_images() else "AUTO",
            embed_textures=packed_images(),
        )
    else:
        bpy.ops.export_scene.gltf(
            filepath=target,
            export_format="GLB",
            export_all_influences=True,
            export_def_bones=True,
            export_yup=True,
            export_extras=True,
        )
    if not Path(target).is_file():
        fail("file", f"Blender wrote no {suffix} file", "try another format")


def packed_images():
    return any(image.packed_file for image in bpy.data.images)


def attempt(operator, **options):
    """Open a file with one of Blender's operators."""
    try:
        done = operator(**options) == {"FINISHED"}
        reason = "it was cancelled"
    except RuntimeError as error:
        lines = [line.strip() for line in str(error).splitlines() if line.strip()]
        done, reason = False, lines[-1].removeprefix("Error: ")[:200] if lines else ""
    if not done:
        fail(
            "file",
            f"Blender {bpy.app.version_string} cannot open it ({reason})",
            "open it in Blender: it may be damaged, or written by a newer version",
        )


if __name__ == "__main__":
    main(*sys.argv[sys.argv.index("--") + 1 :])
