"""Skin weights for heads: a Blender add-on in one file.

Install it from disk in Blender's preferences. The panel is in the sidebar of the 3-D
viewport. Blender's Python need not know skinlib or torch: the add-on runs the command
`skinlib` of another environment, which the add-on's preferences name.

The functions in front of the operator are also what `skinlib` itself runs inside
Blender to read and write `.blend` and `.fbx` files.
"""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

import bpy
import numpy as np

bl_info = {
    "name": "skinlib: skin weights for heads",
    "description": "Predict the skin weights of a head for the skeleton it has",
    "author": "the skinlib authors",
    "version": (1, 0, 0),
    "blender": (3, 4, 0),
    "location": "View3D > Sidebar > skinlib",
    "category": "Rigging",
}

LOCKED = "_LOCKED"
"""A vertex group or attribute; vertices above 0.5 in it keep their weights."""
COLOURS = "skinlib"
"""The colour attribute for what the network wants to show, such as its confidence."""
HEAD = ("vertices", "faces", "normals", "weights", "locked", "colours")
NO_TAIL = "skinlib_no_tail"
"""Marks a bone whose tail is made up: Blender deletes bones of length 0."""


class SceneError(Exception):
    """What is wrong with the scene, and what to do about it."""

    def __init__(self, field, found, fix):
        self.field, self.found, self.fix = field, found, fix
        super().__init__(f"{field}: {found}. {fix[:1].upper()}{fix[1:]}.")


# --- the head of a scene --------------------------------------------------------------


def armature_of(mesh):
    """The armature object that deforms a mesh object, or None."""
    for modifier in mesh.modifiers:
        if modifier.type == "ARMATURE" and modifier.object is not None:
            return modifier.object
    return mesh.parent if mesh.parent_type == "ARMATURE" else None


def find_head(objects):
    """The mesh objects, sorted by name, and the armature object that make up the head.

    Meshes with the same armature are one head. A mesh and an armature that do not know
    each other are a head when there is nothing else to choose from.
    """
    by_name = sorted(objects, key=lambda item: item.name)
    meshes = [o for o in by_name if o.type == "MESH" and len(o.data.vertices)]
    armatures = [o for o in by_name if o.type == "ARMATURE"]
    if not meshes:
        raise SceneError("meshes", "there is no mesh", "add the mesh of the head")
    if not armatures:
        raise SceneError("bones", "there is no armature", "add the head's skeleton")
    bound = {}
    for mesh in meshes:
        if armature_of(mesh) in armatures:
            bound.setdefault(armature_of(mesh).name, []).append(mesh)
    if len(bound) > 1:
        chosen = [item for item in by_name if item.select_get()]
        owners = {(armature_of(o) if o in meshes else o) for o in chosen}
        chosen = {owner.name for owner in owners if owner} & bound.keys()
        if len(chosen) != 1:
            raise SceneError(
                "armatures",
                f"{len(bound)} armatures have meshes ({', '.join(sorted(bound)[:4])})",
                "select the head's mesh in Blender and save, or export the head alone",
            )
        bound = {name: bound[name] for name in chosen}
    for meshes in bound.values():
        return without_linked_duplicates(meshes), armature_of(meshes[0])
    if len(meshes) == len(armatures) == 1:
        return meshes, armatures[0]
    names = ", ".join(o.name for o in (meshes + armatures)[:6])
    raise SceneError(
        "meshes",
        f"{len(meshes)} meshes and {len(armatures)} armatures, none bound to another "
        f"({names})",
        "give the meshes of the head an Armature modifier, or save the head alone",
    )


def without_linked_duplicates(meshes):
    """Objects that share their mesh share its weights: the first of them counts."""
    return list({mesh.data.name: mesh for mesh in reversed(meshes)}.values())[::-1]


def head_arrays(meshes, armature, tails=True):
    """The arrays of the data contract for `numpy.savez`, weights as they are painted.

    Positions are those of world space, with the armature in its rest pose, modifiers
    off and shape keys at rest; one row per vertex of the meshes, one after the other.
    """
    pose = armature.data.pose_position
    armature.data.pose_position = "REST"
    bpy.context.view_layer.update()
    try:
        vertices, faces, start = [], [], 0
        for mesh in meshes:
            points, triangles = geometry_of(mesh)
            vertices.append(points)
            faces.append(triangles + start)
            start += len(points)
        bones = skeleton_of(armature, tails)
    finally:
        armature.data.pose_position = pose
        bpy.context.view_layer.update()
    names = bones["bone_names"].tolist()
    return {
        "vertices": np.concatenate(vertices),
        "faces": np.concatenate(faces),
        "weights": np.concatenate([weights_of(mesh, names) for mesh in meshes]),
        "locked": np.concatenate([locked_rows(mesh) for mesh in meshes]),
        **bones,
    }


def geometry_of(mesh):
    """Vertices (V, 3) in world space and triangles (F, 3) of a mesh object."""
    data = mesh.data
    rest = data.shape_keys.reference_key.data if data.shape_keys else data.vertices
    points = np.zeros(3 * len(rest), np.float32)
    rest.foreach_get("co", points)
    data.calc_loop_triangles()
    triangles = np.zeros(3 * len(data.loop_triangles), np.int32)
    data.loop_triangles.foreach_get("vertices", triangles)
    world = np.array(mesh.matrix_world, np.float64)
    faces = triangles.reshape(-1, 3).astype(np.int64)
    if np.linalg.det(world[:3, :3]) < 0:  # a mirroring turns the mesh inside out
        faces = faces[:, ::-1]
    return points.reshape(-1, 3) @ world[:3, :3].T + world[:3, 3], faces


def skeleton_of(armature, tails):
    """The bones that deform; the others are passed over, their children kept."""
    bones = [bone for bone in armature.data.bones if bone.use_deform]
    if not bones:
        raise SceneError(
            "bones",
            f"no bone of {armature.name!r} deforms",
            "switch on Deform in the properties of its bones",
        )
    place = {bone.name: i for i, bone in enumerate(bones)}
    parents = []
    for bone in bones:
        above = bone.parent
        while above is not None and above.name not in place:
            above = above.parent
        parents.append(-1 if above is None else place[above.name])
    world = np.array(armature.matrix_world, np.float64)

    def placed(points):
        return np.array(points, np.float64) @ world[:3, :3].T + world[:3, 3]

    ends = placed([bone.tail_local for bone in bones])
    ends[[not tails or NO_TAIL in bone for bone in bones]] = np.nan
    return {
        "bone_names": np.array([bone.name for bone in bones]),
        "bone_parents": np.array(parents, np.int64),
        "bone_heads": placed([bone.head_local for bone in bones]),
        "bone_tails": ends,
    }


def weights_of(mesh, names):
    """(V, J) float32, what the vertex groups with these names hold."""
    column = {name: i for i, name in enumerate(names)}
    columns = [column.get(group.name) for group in mesh.vertex_groups]
    weights = np.zeros((len(mesh.data.vertices), len(names)), np.float32)
    for vertex in mesh.data.vertices:
        for entry in vertex.groups:
            if entry.group < len(columns) and columns[entry.group] is not None:
                weights[vertex.index, columns[entry.group]] = entry.weight
    return weights


def locked_rows(mesh):
    """(V,) bool, the vertices that the group or attribute `_LOCKED` marks."""
    locked = weights_of(mesh, [LOCKED])[:, 0] > 0.5
    attribute = mesh.data.attributes.get(LOCKED)
    if attribute is not None and attribute.domain == "POINT":
        if attribute.data_type in {"FLOAT", "INT", "INT8", "BOOLEAN"}:
            values = [entry.value for entry in attribute.data]
            locked |= np.array(values, np.float64) > 0.5
    return locked


def put_weights(meshes, armature, names, weights, rows=None, kept=()):
    """Make the vertex groups hold `weights`, and bind the meshes to the armature.

    Args:
        names: J names of bones. weights: (V, J) for the vertices of all meshes.
        rows: (V,) bool, the vertices to change; all of them when None.
        kept: names of groups that are left alone.
    """
    for mesh in meshes:
        if mesh.data.library or mesh.library:
            raise SceneError(
                "meshes",
                f"{mesh.name!r} is linked from another file",
                "make it local, or skin it in that file",
            )
    start = 0
    for mesh in meshes:
        part = slice(start, start + len(mesh.data.vertices))
        start = part.stop
        changed = np.ones(part.stop - part.start, bool) if rows is None else rows[part]
        bind(mesh, armature)
        groups = mesh.vertex_groups
        active = groups.active_index
        for name, column in zip(names, weights[part].T, strict=True):
            used = np.flatnonzero(changed & (column > 0))
            group = groups.get(name)
            if name in kept or (group is None and not len(used)):
                continue
            if group is None:
                group = groups.new(name=name)
            group.remove(np.flatnonzero(changed).tolist())
            for vertex, weight in zip(
                used.tolist(), column[used].tolist(), strict=True
            ):
                group.add([vertex], weight, "REPLACE")
        groups.active_index = max(active, 0)


def put_fields(meshes, arrays):
    """Make attributes of what a `.npz` holds for each vertex besides the weights.

    `colours`, (V, 4) from 0 to 255, become a colour attribute; a field such as
    `confidence`, (V,), becomes the attribute `_CONFIDENCE`.
    """
    fields = {k: v for k, v in arrays.items() if k not in HEAD and v.ndim == 1}
    fields = {k: v for k, v in fields.items() if not k.startswith("bone_")}
    start = 0
    for mesh in meshes:
        data, part = mesh.data, slice(start, start + len(mesh.data.vertices))
        start = part.stop
        if "colours" in arrays:
            layer = new_attribute(data.color_attributes, COLOURS, "FLOAT_COLOR")
            colours = arrays["colours"][part].astype(np.float32) / 255
            layer.data.foreach_set("color", colours.ravel())
        for key, values in fields.items():
            layer = new_attribute(data.attributes, f"_{key.upper()}", "FLOAT")
            layer.data.foreach_set("value", values[part].astype(np.float32))
        data.update()


def new_attribute(layers, name, kind):
    if name in layers:
        layers.remove(layers[name])
    return layers.new(name, kind, "POINT")


def bind(mesh, armature):
    """Let the armature deform the mesh and carry it along, as Blender's menu does."""
    if armature_of(mesh) is not None:
        return
    modifier = mesh.modifiers.new("Armature", "ARMATURE")
    modifier.object = armature
    if mesh.parent is None:
        mesh.parent = armature
        mesh.matrix_parent_inverse = armature.matrix_world.inverted()


def completed(weights, locked):
    """Rows that sum to 1: what the locked columns leave goes to the others.

    Args:
        weights: (V, J) as painted. locked: (J,) bool, columns that stay.
    """
    taken = weights[:, locked].sum(axis=1, dtype=np.float64)
    if (taken > 1.001).any():
        raise SceneError(
            "vertex groups",
            f"the locked ones sum to {taken.max():.3f} at vertex {taken.argmax()}",
            "normalise them to 1 at most (Weights > Normalize All)",
        )
    others = np.where(locked, 0, weights.astype(np.float64))
    others[others.sum(axis=1) <= 0] = ~locked
    others *= np.clip(1 - taken, 0, None)[:, None] / others.sum(axis=1, keepdims=True)
    return np.where(locked, weights, others)


# --- the add-on -----------------------------------------------------------------------


def selected_head(context):
    """The selected meshes and the one selected armature."""
    if context.mode not in {"OBJECT", "PAINT_WEIGHT", "POSE"}:
        raise SceneError("mode", "this does not work in Edit Mode", "go to Object Mode")
    chosen = sorted(context.selected_objects, key=lambda item: item.name)
    meshes = [o for o in chosen if o.type == "MESH" and len(o.data.vertices)]
    armatures = [o for o in chosen if o.type == "ARMATURE"]
    if not meshes:
        raise SceneError("selection", "no mesh is selected", "select the head's mesh")
    if len(armatures) != 1:
        found = f"{len(armatures)} armatures are selected" if armatures else None
        raise SceneError(
            "selection",
            found or "no armature is selected",
            "select the head's mesh and, with Shift, its armature",
        )
    for mesh in meshes:
        if armature_of(mesh) not in (None, armatures[0]):
            raise SceneError(
                "selection",
                f"{mesh.name!r} has another armature, {armature_of(mesh).name!r}",
                "select that one, or remove its Armature modifier",
            )
    return without_linked_duplicates(meshes), armatures[0]


def selected_rows(mesh):
    """(V,) bool, the selected vertices."""
    selected = np.zeros(len(mesh.data.vertices), bool)
    mesh.data.vertices.foreach_get("select", selected)
    return selected


def executable(context):
    """The `skinlib` command of the preferences, else of the PATH."""
    entry = context.preferences.addons.get(__name__)
    given = bpy.path.abspath(entry.preferences.executable) if entry else ""
    found = shutil.which(given or "skinlib")
    if found is None:
        raise SceneError(
            "skinlib",
            f"there is no program {given!r}" if given else "it is not on the PATH",
            "name the program skinlib of its environment in this add-on's preferences",
        )
    return found


class Job:
    """A run of `skinlib skin` on the selected head, in a process of its own.

    Objects are kept by name: whatever the user does meanwhile, a pointer may dangle.
    """

    def __init__(self, context):
        settings = context.scene.skinlib
        meshes, armature = selected_head(context)
        program = executable(context)
        arrays = head_arrays(meshes, armature)
        names, painted = arrays["bone_names"].tolist(), arrays.pop("weights")
        locked_rows = arrays["locked"]
        self.meshes = [mesh.name for mesh in meshes]
        self.armature = armature.name
        self.count, self.names = len(painted), names
        self.kept = set()
        if settings.keep_locked:
            groups = [group for mesh in meshes for group in mesh.vertex_groups]
            self.kept = {g.name for g in groups if g.lock_weight and g.name in names}
        if len(self.kept) == len(names):
            raise SceneError(
                "vertex groups", "all of them are locked", "unlock some of them"
            )
        self.rows = ~locked_rows
        if settings.only_selected:
            self.rows &= np.concatenate([selected_rows(mesh) for mesh in meshes])
        if not self.rows.any():
            raise SceneError(
                "vertices", "all of them keep their weights", "select or unlock some"
            )
        # Names are the user's: one that begins with a dash is no option.
        sent = [f" {name}" if name.startswith("-") else name for name in names]
        arrays["bone_names"] = np.array(sent)
        locked = np.array([name in self.kept for name in names])
        # A vertex without weights is left alone, but nothing goes by it.
        arrays["locked"] = locked_rows & (painted.sum(axis=1) > 0)
        if locked.any() or arrays["locked"].any():
            arrays["weights"] = completed(painted, locked)

        self.folder = tempfile.TemporaryDirectory(prefix="skinlib_")
        self.source = Path(self.folder.name, "head.npz")
        self.target = Path(self.folder.name, "skinned.npz")
        self.log = Path(self.folder.name, "log.txt")
        np.savez(self.source, **arrays)
        command = [program, "skin", str(self.source), str(self.target)]
        command += ["--checkpoint", bpy.path.abspath(settings.checkpoint)]
        if settings.max_influences:
            command += ["--max-influences", str(settings.max_influences)]
        if settings.symmetric:
            command += ["--symmetric"]
        if settings.smooth:
            command += ["--smooth", str(settings.smooth)]
        if settings.confidence:
            command += ["--confidence"]
        if arrays["locked"].any():
            command += ["--lock-vertices", LOCKED]
        if locked.any():
            command += ["--lock", *np.array(sent)[locked].tolist()]
        # Blender's own Python must not be found by the other one.
        foreign = {"PYTHONHOME", "PYTHONPATH"}
        try:
            with self.log.open("wb") as log:
                self.process = subprocess.Popen(
                    command,
                    stdin=subprocess.DEVNULL,
                    stdout=log,
                    stderr=log,
                    env={k: v for k, v in os.environ.items() if k not in foreign},
                    creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
                )
        except OSError as error:
            self.folder.cleanup()
            raise SceneError(
                "skinlib",
                f"{program} does not start ({error.strerror})",
                "correct the path in this add-on's preferences",
            ) from error

    def stop(self):
        """End the process and leave everything as it was."""
        self.process.kill()
        self.process.wait()
        self.folder.cleanup()

    def finish(self):
        """Wait for the end, and write the vertex groups when all is well."""
        try:
            status = self.process.wait()
            if status:
                raise SceneError(*self._complaint(status))
            with np.load(self.target, allow_pickle=False) as skinned:
                arrays = dict(skinned)
            weights = arrays["weights"]
            wanted = (self.count, len(self.names))
            if weights.shape != wanted or not np.isfinite(weights).all():
                raise SceneError(
                    "skinlib",
                    f"weights of shape {weights.shape} for {wanted}",
                    "update skinlib",
                )
        finally:
            self.folder.cleanup()
        meshes, armature = self._objects()
        put_weights(meshes, armature, self.names, weights, self.rows, self.kept)
        put_fields(meshes, arrays)
        bones = np.count_nonzero(weights[self.rows].any(axis=0))
        return f"{self.rows.sum():,} vertices skinned to {bones} bones"

    def _complaint(self, status):
        """What the command said last, without the name of our temporary file."""
        text = self.log.read_text(errors="replace").replace(f"{self.source}: ", "")
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        for line in reversed(lines):
            if line.startswith("skinlib: "):
                found, _, fix = line[len("skinlib: ") :].rstrip(".").partition(". ")
                return "skinlib", found, fix or "see the command's help"
        last = next((s for s in reversed(lines) if any(map(str.isalpha, s))), "")
        return "skinlib", f"it ended with status {status} {last}", "try it in a shell"

    def _objects(self):
        """The objects of then, if they are still what they were."""
        meshes = [bpy.data.objects.get(name) for name in self.meshes]
        armature = bpy.data.objects.get(self.armature)
        try:
            count = sum(len(mesh.data.vertices) for mesh in meshes)
            bones = {bone.name for bone in armature.data.bones}
            editing = any(mesh.mode == "EDIT" for mesh in meshes)
        except AttributeError:  # one of them is gone
            count, bones, editing = 0, set(), False
        if count != self.count or not bones.issuperset(self.names) or editing:
            raise SceneError(
                "scene", "the head was changed meanwhile", "press the button again"
            )
        return meshes, armature


class SKINLIB_OT_skin(bpy.types.Operator):
    """Predict the weights of the selected mesh for the selected armature"""

    bl_idname = "object.skinlib_skin"
    bl_label = "Skin the head"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012, Blender wants a set here

    @classmethod
    def poll(cls, context):
        try:
            selected_head(context)
        except SceneError as error:
            cls.poll_message_set(str(error))
            return False
        return True

    def execute(self, context):
        try:
            return self.done(Job(context).finish())
        except SceneError as error:
            return self.failed(error)

    def invoke(self, context, event):
        if bpy.app.background:
            return self.execute(context)
        try:
            self.job = Job(context)
        except SceneError as error:
            return self.failed(error)
        manager = context.window_manager
        self.timer = manager.event_timer_add(0.2, window=context.window)
        manager.modal_handler_add(self)
        context.workspace.status_text_set("skinlib computes the weights; Esc: stop")
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "ESC":
            self.cancel(context)
            self.report({"INFO"}, "skinlib: stopped")
            return {"CANCELLED"}
        if event.type != "TIMER" or self.job.process.poll() is None:
            return {"PASS_THROUGH"}
        self.quiet(context)
        try:
            return self.done(self.job.finish())
        except SceneError as error:
            return self.failed(error)

    def cancel(self, context):
        self.quiet(context)
        self.job.stop()

    def quiet(self, context):
        context.window_manager.event_timer_remove(self.timer)
        context.workspace.status_text_set(None)

    def done(self, message):
        self.report({"INFO"}, message)
        return {"FINISHED"}

    def failed(self, error):
        self.report({"ERROR"}, str(error))
        return {"CANCELLED"}


class SKINLIB_PG_settings(bpy.types.PropertyGroup):
    checkpoint: bpy.props.StringProperty(
        name="Network",
        description="A network that ships with skinlib, or a folder that "
        "`skinlib train` wrote",
        default="heads",
    )
    max_influences: bpy.props.IntProperty(
        name="Max influences",
        description="Bones a vertex at most; 0: as many as matter",
        default=0,
        min=0,
        max=64,
    )
    smooth: bpy.props.IntProperty(
        name="Smooth",
        description="How often to smooth along the surface, never from lip to lip",
        default=0,
        min=0,
        max=100,
    )
    symmetric: bpy.props.BoolProperty(
        name="Symmetric",
        description="Same weights on the left and on the right",
        default=False,
    )
    confidence: bpy.props.BoolProperty(
        name="Show confidence",
        description=f"Paint where to look twice, as the colour attribute {COLOURS!r}",
        default=False,
    )
    keep_locked: bpy.props.BoolProperty(
        name="Keep locked groups",
        description="Vertex groups with a closed lock keep their weights",
        default=True,
    )
    only_selected: bpy.props.BoolProperty(
        name="Selected vertices only",
        description="All other vertices keep their weights, as in Weight Paint with "
        f"the vertex mask on; those in a group or attribute {LOCKED} always do",
        default=False,
    )


class SKINLIB_PT_panel(bpy.types.Panel):
    bl_label = "skinlib"
    bl_idname = "SKINLIB_PT_panel"
    bl_space_type = "VIEW_3D"
    bl_region_type = "UI"
    bl_category = "skinlib"

    def draw(self, context):
        settings = context.scene.skinlib
        for name in SKINLIB_PG_settings.__annotations__:
            self.layout.prop(settings, name)
        self.layout.operator(SKINLIB_OT_skin.bl_idname, icon="MOD_ARMATURE")
        try:
            selected_head(context)
        except SceneError as error:
            self.layout.label(text=error.fix, icon="INFO")


class SKINLIB_AP_preferences(bpy.types.AddonPreferences):
    bl_idname = __name__

    executable: bpy.props.StringProperty(
        name="skinlib",
        description="The program skinlib in the bin (Windows: Scripts) folder of the "
        "environment that it is installed in; empty: the one on the PATH",
        subtype="FILE_PATH",
    )

    def draw(self, context):
        self.layout.prop(self, "executable")
        try:
            text, icon = f"runs {executable(context)}", "CHECKMARK"
        except SceneError as error:
            text, icon = str(error), "ERROR"
        self.layout.label(text=text, icon=icon)


CLASSES = (
    SKINLIB_PG_settings,
    SKINLIB_AP_preferences,
    SKINLIB_OT_skin,
    SKINLIB_PT_panel,
)


def register():
    for item in CLASSES:
        bpy.utils.register_class(item)
    bpy.types.Scene.skinlib = bpy.props.PointerProperty(type=SKINLIB_PG_settings)


def unregister():
    del bpy.types.Scene.skinlib
    for item in reversed(CLASSES):
        bpy.utils.unregister_class(item)
