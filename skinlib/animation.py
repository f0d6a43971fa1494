"""Moving meshes in files: glTF that engines and Blender play, and plain positions.

Symbols: T frames, V vertices, F faces, J bones, M morph targets.

What a file shows is v = sum_j w_vj G_j (t_v + sum_m a_m d_mv): the morph targets bend
the mesh at rest, then the bones pose it. glTF 2.0 prescribes this order, so corrections
that are made before the bones, as in PBNS, come back as they are.

Specification: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pygltflib
from scipy.spatial.transform import Rotation

from skinlib import gltf
from skinlib.geometry import vertex_normals
from skinlib.head import LARGEST_COORDINATE, Head, HeadError, Skeleton
from skinlib.io import _checked_names, atomic

TO_GLTF = {
    "Z": np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "Y": np.eye(3),
}
"""What turns our axes into those of glTF, by our axis that points up. Blender turns
them back from +Y up to +Z up, so that its coordinates are those of "Z" again."""


@dataclass(frozen=True, eq=False)
class AnimatedMesh:
    """A mesh at rest, and how it follows the bones and changes shape by itself.

    Attributes:
        name: shown to people.
        vertices: (V, 3) rest positions t_v.
        faces: (F, 3) vertex ids of triangles.
        weights: (V, J) skin weights w_vj, rows >= 0 with sum 1.
        morphs: (M, V, 3) offsets d_mv, what an amount of 1 adds to the rest positions;
            None for a mesh that only follows its bones.
        morph_amounts: (T, M) amounts a_m in each frame, of any size and sign.
        colour: red, green, blue and opacity from 0 to 1, linear.
    """

    name: str
    vertices: np.ndarray
    faces: np.ndarray
    weights: np.ndarray
    morphs: np.ndarray | None = None
    morph_amounts: np.ndarray | None = None
    colour: Sequence[float] = (0.8, 0.8, 0.8, 1.0)


def write_animation(
    path: str | Path,
    skeleton: Skeleton,
    rotations: np.ndarray,
    translations: np.ndarray | None,
    fps: float,
    meshes: Sequence[AnimatedMesh],
    up: str = "Z",
    max_influences: int | None = None,
) -> None:
    """Write meshes that move together to a `.glb` file, whole or not at all.

    All meshes share one skin and one animation; between two frames rotations turn the
    shorter way and all else changes linearly. At rest, the file shows the rest pose.

    Blender clamps amounts of morph targets to 0..1. So each target is scaled to reach
    1, one with amounts of both signs becomes two, and one that never moves is left out,
    which leaves the motion as it is. Targets also turn the normals, to first order.
    Blender shows frame i at its own frame i when `fps` is the scene's frame rate before
    the import.

    Args:
        path: where to; a file that is there already is replaced.
        rotations: (T, J, 3, 3) of each bone about its own joint, in the axes of the
            vertices; children follow, as in `skinlib.skinning.forward_kinematics`.
        translations: how far joints move besides, as in `forward_kinematics`: (T, 3)
            for the roots alone, or (T, J, 3) for all; None for not at all.
        fps: frames per second.
        up: the axis of our data that points up: "Z" with the face towards -Y, or "Y"
            with the face towards +Z, which are the axes of glTF.
        max_influences: keep this many of a vertex's largest weights; None keeps all.

    Raises:
        HeadError: no frame or no mesh, shapes that disagree, NaN, rotations that are
            none, more than `skinlib.gltf.MAX_ELEMENTS` numbers, or a file that cannot
            be written.
    """
    _check_suffix(path, ".glb")
    if up not in TO_GLTF:
        raise HeadError("up", f"{up!r}", f"choose from {', '.join(TO_GLTF)}", path)
    if not meshes:
        raise HeadError("meshes", "there are none", "give at least one mesh", path)
    _checked_names(skeleton.names, path)
    # Targets hold normals too, and one may become two.
    sizes = [
        np.size(mesh.weights) + np.size(mesh.morph_amounts) + 4 * np.size(mesh.morphs)
        for mesh in meshes
    ]
    _check_size(np.size(rotations) + sum(sizes), path)
    rotations = _checked_rotations(rotations, skeleton, path)
    frames, axes = len(rotations), TO_GLTF[up]
    translations = _checked_translations(translations, skeleton, frames, path)
    times = _times(frames, fps, path)

    document = gltf.Document()
    tree = document.tree
    skeleton = dataclasses.replace(
        skeleton,
        joints=(skeleton.joints @ axes.T).astype(np.float32),
        directions=(skeleton.directions @ axes.T).astype(np.float32),
    )
    gltf.add_skeleton(document, skeleton)
    tree.scenes, tree.scene = [pygltflib.Scene(nodes=[len(skeleton)])], 0
    tree.animations = [pygltflib.Animation(name=gltf.encodable(Path(path).stem))]
    times = document.add(times, "SCALAR", bounds=True)
    _animate_bones(document, times, skeleton, rotations, translations, axes)
    for mesh in meshes:
        try:
            head, targets = _checked_mesh(mesh, skeleton, frames, axes)
        except HeadError as error:
            field = f"{error.field} of {mesh.name!r}"
            raise HeadError(field, error.found, error.fix, path) from error
        tree.scenes[0].nodes.append(len(tree.nodes))
        _add_mesh(document, head, targets, mesh.colour, max_influences)
        if targets.names:
            amounts = targets.amounts.ravel()
            _animate(document, times, len(tree.nodes) - 1, "weights", amounts, "SCALAR")
    content = document.to_bytes()
    with atomic(path) as file:
        file.write(content)


def write_vertex_cache(
    path: str | Path, vertices: np.ndarray, faces: np.ndarray, fps: float
) -> None:
    """Write the positions of a mesh in every frame to a compressed `.npz` file.

    The file holds `vertices` (T, V, 3) float32, `faces` (F, 3) int64 and `fps`.

    Raises:
        HeadError: no frame, shapes that disagree, NaN, more than
            `skinlib.gltf.MAX_ELEMENTS` numbers, or a file that cannot be written.
    """
    _check_suffix(path, ".npz")
    _check_size(np.size(vertices) + np.size(faces), path)
    vertices = _checked(vertices, (None, None, 3), "vertices", path)
    _check_frames(len(vertices), "vertices", path)
    _times(len(vertices), fps, path)
    faces = np.asarray(faces)
    ids_fit = faces.dtype.kind in "iu" and faces.ndim == 2 and faces.shape[1] == 3
    count = vertices.shape[1]
    if not ids_fit or (faces.size and not 0 <= faces.min() <= faces.max() < count):
        raise HeadError(
            "faces",
            f"{faces.dtype} values of shape {faces.shape}"
            + (f" from {faces.min()} to {faces.max()}" if faces.size else ""),
            f"give (F, 3) vertex ids from 0 to {count - 1}",
            path,
        )
    with atomic(path) as file:
        np.savez_compressed(
            file, vertices=vertices, faces=faces.astype(np.int64), fps=np.float64(fps)
        )


# --- what goes into the glTF file ---------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Targets:
    """K morph targets as they are written: amounts from 0 to 1, each reaching 1."""

    names: list[str]
    offsets: np.ndarray  # (K, V, 3) float32
    amounts: np.ndarray  # (T, K) float32


def _checked_mesh(
    mesh: AnimatedMesh, skeleton: Skeleton, frames: int, axes: np.ndarray
) -> tuple[Head, _Targets]:
    """The mesh at rest and its targets, in the axes of glTF."""
    head = Head.create(
        mesh.vertices, mesh.faces, skeleton, mesh.weights, name=mesh.name
    )
    head = head.replace(vertices=head.vertices @ axes.T)
    colour = _checked(np.asarray(mesh.colour), (4,), "colour")
    if not ((colour >= 0) & (colour <= 1)).all():
        raise HeadError("colour", f"{colour.tolist()}", "give RGBA from 0 to 1")
    morphs, amounts = mesh.morphs, mesh.morph_amounts
    if morphs is None:
        morphs = np.zeros((0, *head.vertices.shape))
    if amounts is None:
        amounts = np.zeros((frames, 0))
    morphs = _checked(morphs, (None, *head.vertices.shape), "morphs")
    amounts = _checked(amounts, (frames, len(morphs)), "morph_amounts")
    return head, _targets(morphs.astype(np.float64) @ axes.T, amounts)


def _targets(morphs: np.ndarray, amounts: np.ndarray) -> _Targets:
    names, offsets, shares = [], [], []
    amounts = amounts.astype(np.float64)
    for sign, mark in ((1, "+"), (-1, "-")):
        share = np.maximum(sign * amounts, 0)
        largest = share.max(axis=0)
        scaled = sign * largest[:, None, None] * morphs
        _check_extent(scaled)
        scaled = scaled.astype(np.float32)
        used = np.flatnonzero(scaled.any(axis=(1, 2)))
        names += [f"morph {m} {mark}" for m in used]
        offsets.append(scaled[used])
        shares.append(share[:, used] / largest[used])
    shares = np.concatenate(shares, axis=1)
    return _Targets(names, np.concatenate(offsets), shares.astype(np.float32))


def _check_extent(offsets: np.ndarray) -> None:
    farthest = np.abs(offsets).max(initial=0)
    if farthest > LARGEST_COORDINATE:
        raise HeadError(
            "morphs",
            f"one moves a vertex by {farthest:.3g}",
            f"keep morphs times amounts below {LARGEST_COORDINATE:g}",
        )


def _normal_changes(head: Head, offsets: np.ndarray) -> np.ndarray:
    """(V, 3) float32: the derivative of the normals along the offsets of a target.

    A target alone may turn a face over where all of them together do not; the
    derivatives add up.
    """
    size = np.ptp(head.vertices, axis=0).max() or 1
    step = 1e-3 * size / np.abs(offsets).max()
    there, back = (
        vertex_normals(head.vertices + sign * step * offsets.astype(float), head.faces)
        for sign in (1, -1)
    )
    return ((there.astype(float) - back) / (2 * step)).astype(np.float32)


def _add_mesh(
    document: gltf.Document,
    head: Head,
    targets: _Targets,
    colour: Sequence[float],
    max_influences: int | None,
) -> None:
    """Append a node with the mesh, bound to skin 0."""
    tree, buffer = document.tree, pygltflib.ARRAY_BUFFER
    primitive = gltf.add_primitive(document, head, max_influences)
    for offsets in targets.offsets:
        changes = _normal_changes(head, offsets)
        primitive.targets.append(
            pygltflib.Attributes(
                POSITION=document.add(offsets, "VEC3", buffer, bounds=True),
                NORMAL=document.add(changes, "VEC3", buffer),
            )
        )
    name = gltf.encodable(head.name) or "mesh"
    primitive.material = len(tree.materials)
    tree.materials.append(
        pygltflib.Material(
            name=name,
            pbrMetallicRoughness=pygltflib.PbrMetallicRoughness(
                baseColorFactor=[float(value) for value in colour],
                metallicFactor=0.0,
                roughnessFactor=0.8,
            ),
            alphaMode=pygltflib.OPAQUE if colour[3] == 1 else pygltflib.BLEND,
            doubleSided=True,  # of cloth both sides are seen
        )
    )
    # The names are a convention that Blender, three.js and others follow.
    extras = {"targetNames": targets.names} if targets.names else {}
    tree.nodes.append(gltf.Node(name=name, mesh=len(tree.meshes), skin=0))
    tree.meshes.append(pygltflib.Mesh(primitives=[primitive], name=name, extras=extras))


def _animate_bones(
    document: gltf.Document,
    times: int,
    skeleton: Skeleton,
    rotations: np.ndarray,
    translations: np.ndarray,
    axes: np.ndarray,
) -> None:
    """Channels for each bone that turns or moves, and for where the roots are."""
    moving = (translations != 0).any(axis=(0, 2)) | (skeleton.parents == -1)
    for bone in np.flatnonzero(moving).tolist():
        parent = skeleton.parents[bone]
        # float64, as in the node: what does not move stays exactly where it was.
        place = skeleton.joints[bone].astype(np.float64)
        place -= skeleton.joints[parent] if parent >= 0 else 0
        places = place + translations[:, bone] @ axes.T
        _animate(document, times, bone, "translation", places, "VEC3")
    turning = (rotations != np.eye(3)).any(axis=(0, 2, 3))
    for bone in np.flatnonzero(turning).tolist():
        # A rotation in other axes keeps its angle, only its axis turns.
        quaternions = Rotation.from_matrix(rotations[:, bone]).as_quat(canonical=True)
        quaternions[:, :3] = quaternions[:, :3] @ axes.T
        # q and -q are one rotation, but what lies between two frames is not.
        jumps = (quaternions[1:] * quaternions[:-1]).sum(axis=1) < 0
        quaternions[1:] *= np.cumprod(np.where(jumps, -1, 1))[:, None]
        _animate(document, times, bone, "rotation", quaternions, "VEC4")


def _animate(
    document: gltf.Document,
    times: int,
    node: int,
    path: str,
    values: np.ndarray,
    kind: str,
) -> None:
    """Let a property of a node change linearly between the frames."""
    (animation,) = document.tree.animations
    target = pygltflib.AnimationChannelTarget(node=node, path=path)
    channel = pygltflib.AnimationChannel(sampler=len(animation.samplers), target=target)
    output = document.add(values.astype(np.float32), kind)
    sampler = pygltflib.AnimationSampler(
        input=times, output=output, interpolation=pygltflib.ANIM_LINEAR
    )
    animation.channels.append(channel)
    animation.samplers.append(sampler)


# --- what is asked for --------------------------------------------------------------


def _checked(
    array: np.ndarray,
    shape: tuple[int | None, ...],
    field: str,
    path: str | Path | None = None,
) -> np.ndarray:
    """Finite float32 numbers of this shape; None stands for any length."""
    wanted = "(" + ", ".join("any" if n is None else str(n) for n in shape) + ")"
    fits = array.ndim == len(shape) and all(
        n is None or n == m for n, m in zip(shape, array.shape, strict=True)
    )
    if not fits or array.dtype.kind not in "iuf":
        found = f"{array.dtype} values of shape {array.shape}"
        raise HeadError(field, found, f"give numbers of shape {wanted}", path)
    with np.errstate(over="ignore"):
        array = array.astype(np.float32)
    bad = np.argwhere(~np.isfinite(array))
    if len(bad):
        place = ", ".join(map(str, bad[0]))
        found = f"{len(bad)} values are NaN or infinite, the first is [{place}]"
        raise HeadError(field, found, "give finite float32 numbers", path)
    return array


def _checked_rotations(
    values: np.ndarray, skeleton: Skeleton, path: str | Path
) -> np.ndarray:
    """(T, J, 3, 3) float64."""
    rotations = _checked(values, (None, len(skeleton), 3, 3), "rotations", path)
    _check_frames(len(rotations), "rotations", path)
    rotations = rotations.astype(np.float64)
    off = np.abs(rotations @ rotations.swapaxes(2, 3) - np.eye(3)).max(axis=(2, 3))
    wrong = np.argwhere((off > 1e-3) | (np.linalg.det(rotations) < 0))
    if len(wrong):
        frame, bone = wrong[0]
        raise HeadError(
            "rotations",
            f"that of {skeleton.names[bone]!r} in frame {frame} scales or mirrors",
            "give orthonormal matrices with determinant 1",
            path,
        )
    return rotations


def _checked_translations(
    values: np.ndarray | None, skeleton: Skeleton, frames: int, path: str | Path
) -> np.ndarray:
    """(T, J, 3)."""
    shape = (frames, len(skeleton), 3)
    if values is not None and values.ndim == 3:
        return _checked(values, shape, "translations", path)
    moved = np.zeros(shape, np.float32)
    if values is not None:
        values = _checked(values, (frames, 3), "translations", path)
        moved[:, skeleton.parents == -1] = values[:, None]
    return moved


def _times(frames: int, fps: float, path: str | Path) -> np.ndarray:
    """(T,) float32 seconds at which the frames are shown."""
    with np.errstate(all="ignore"):
        times = (np.arange(frames) / np.float64(fps)).astype(np.float32)
        rising = np.isfinite(times).all() and (np.diff(times) > 0).all()
    if not (0 < fps < math.inf and rising):
        raise HeadError("fps", f"{fps}", "give the frames per second, such as 30", path)
    return times


def _check_frames(frames: int, field: str, path: str | Path) -> None:
    if frames == 0:
        raise HeadError(field, "there is no frame", "give at least one", path)


def _check_size(numbers: int, path: str | Path) -> None:
    if numbers > gltf.MAX_ELEMENTS:
        raise HeadError(
            "file",
            f"it would hold {numbers} numbers",
            f"write at most {gltf.MAX_ELEMENTS}: fewer frames, targets or vertices",
            path,
        )


def _check_suffix(path: str | Path, suffix: str) -> None:
    if Path(path).suffix.lower() != suffix:
        found = f"the name ends in {Path(path).suffix!r}"
        raise HeadError("file", found, f"let it end in {suffix}", path)
