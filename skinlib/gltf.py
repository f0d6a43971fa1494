"""Heads in glTF 2.0 files, on top of pygltflib's tree of the JSON part.

The skinned mesh of a file is read with the joints of its skin, in the space of the
mesh, as the inverse bind matrices have them; a mesh without a skin is read in world
space, with the joint nodes beside it. glTF knows no bone tails: ours lie in the extras
of the joint nodes, and a joint without them ends at the mean of its children.

Specification: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

import base64
import dataclasses
import math
import operator
import struct
import urllib.parse
import warnings
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, make_dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
import pygltflib
from scipy.spatial.transform import Rotation

from skinlib.head import Head, HeadError, Skeleton

MAX_ELEMENTS = 2**28
"""The most numbers in one array: a million vertices times 256 bones. A small file can
claim any size; what claims more than this is refused before memory is taken for it."""

EXTRAS_KEY = "skinlib"
CONFIDENCE = "_CONFIDENCE"
"""The attribute that says how sure the weights of a vertex are: 0 to 1."""

OUR_COLOURS = "skinlib colours"
"""The name of the accessors with colours that we wrote and may write again."""


def read(path: Path, weights: bool = True) -> Head:
    """Read a head; see `skinlib.io.read_glb`."""
    document = Document(path)
    return _head_from(document, _Binding(document), weights)


def read_attribute(path: Path, name: str) -> np.ndarray:
    """(V,) values of a custom attribute; 0 on the parts of the head that lack it."""
    document = Document(path)
    blocks = _Binding(document).blocks
    parts, there = [], set()
    for block in blocks:
        custom = [key for key in block.attributes if key.startswith("_")]
        there.update(custom)
        count = len(document.array(block.attributes["POSITION"], "POSITION", "VEC3"))
        values = np.zeros(count, np.float32)
        for key in custom:
            if plain_name(key) == plain_name(name):
                values = document.array(block.attributes[key], key, "SCALAR")
        if len(values) != count:
            document.fail(
                name, f"{len(values)} values for {count} vertices", "export it again"
            )
        parts.append(values)
    fix = (
        "export it (in Blender: tick Data > Mesh > Attributes; its name begins with _)"
    )
    check_attribute(name, there, fix, path)
    return np.concatenate(parts)


def plain_name(name: str) -> str:
    """`_LOCKED`, as glTF wants it, and `locked`, as a .npz has it, are one name."""
    return name.lower().lstrip("_")


def check_attribute(name: str, there: Iterable[str], fix: str, path: Path) -> None:
    """Raise a HeadError that names the attributes `there` when `name` is not one."""
    if plain_name(name) not in map(plain_name, there):
        others = f"only {', '.join(sorted(there))}" if there else "nor any other"
        found = f"there is no such attribute of the vertices, {others}"
        raise HeadError(name, found, f"name one that is there, or {fix}", path)


# pygltflib leaves out two properties of the specification, which would be lost when a
# file is re-skinned.
Node = make_dataclass(
    "Node", [("weights", list[float] | None, None)], bases=(pygltflib.Node,)
)
_Sampler = make_dataclass(
    "_Sampler", [("name", str | None, None)], bases=(pygltflib.Sampler,)
)
_GLTF = make_dataclass(
    "_GLTF",
    [
        ("nodes", list[Node], field(default_factory=list)),
        ("samplers", list[_Sampler], field(default_factory=list)),
    ],
    bases=(pygltflib.GLTF2,),
)

COMPONENTS = {
    pygltflib.BYTE: np.dtype("i1"),
    pygltflib.UNSIGNED_BYTE: np.dtype("u1"),
    pygltflib.SHORT: np.dtype("<i2"),
    pygltflib.UNSIGNED_SHORT: np.dtype("<u2"),
    pygltflib.UNSIGNED_INT: np.dtype("<u4"),
    pygltflib.FLOAT: np.dtype("<f4"),
}
COMPONENT_TYPES = {dtype: component for component, dtype in COMPONENTS.items()}
SHAPES = {
    "SCALAR": (),
    "VEC2": (2,),
    "VEC3": (3,),
    "VEC4": (4,),
    "MAT4": (4, 4),  # column by column
}
COMPRESSIONS = ("KHR_draco_mesh_compression", "EXT_meshopt_compression")


class Document:
    """A glTF file in memory: pygltflib's tree, and the arrays in its buffers."""

    def __init__(self, path: Path | None = None):
        self.path = path
        self.tree = _GLTF()
        self.tree.asset.generator = "skinlib"
        self.buffers: list[bytes] = []
        self.free: list[int] = []  # accessors to be used again
        if path is None:
            return
        content = path.read_bytes()
        with warnings.catch_warnings(action="ignore"):
            if content[:4] == b"glTF":
                self._check_container(content)
                self.tree = _GLTF.load_from_bytes(content)
            else:
                self.tree = _GLTF.gltf_from_json(content.decode("utf-8-sig"))
        if not str(self.tree.asset.version).startswith("2."):
            self.fail(
                "asset",
                f"glTF version {self.tree.asset.version}",
                "export it as glTF 2.0",
            )
        for name in COMPRESSIONS:
            if name in self.tree.extensionsUsed:
                self.fail(
                    "extensionsUsed",
                    f"the file is compressed with {name}",
                    "export it again without compression",
                )
        self.buffers = [self._buffer(buffer) for buffer in self.tree.buffers]

    def fail(self, field: str, found: str, fix: str) -> NoReturn:
        raise HeadError(field, found, fix, self.path)

    def _check_container(self, content: bytes) -> None:
        _, version, length = struct.unpack_from("<4sII", content)
        if version != 2:
            self.fail("file", f"a .glb of version {version}", "export it as glTF 2.0")
        if length > len(content):
            self.fail(
                "file",
                f"it is cut off: {len(content)} of {length} bytes are there",
                "copy or export it again",
            )

    def _buffer(self, buffer: pygltflib.Buffer) -> bytes:
        if buffer.uri is None:
            content = self.tree.binary_blob() or b""
        elif buffer.uri.startswith("data:"):
            content = base64.b64decode(buffer.uri.partition(",")[2], validate=True)
        else:
            folder = self.path.parent.resolve()
            file = (folder / urllib.parse.unquote(buffer.uri)).resolve()
            if not file.is_relative_to(folder) or not file.is_file():
                self.fail(
                    "buffers",
                    f"{buffer.uri[:80]!r} is not a file beside this one",
                    "keep the .gltf and its .bin together, or export a .glb",
                )
            content = file.read_bytes()
        if len(content) < operator.index(buffer.byteLength):
            self.fail(
                "buffers",
                f"{len(content)} of {buffer.byteLength} bytes are there",
                "copy or export the file again",
            )
        return content

    def array(self, accessor_id: int, field: str, kind: str) -> np.ndarray:
        """The (count, ...) array of an accessor: floats when `normalized`, else as is.

        Args:
            kind: the type that `field` has to have, such as "VEC3".
        """
        accessor = self.tree.accessors[_index(accessor_id, self.tree.accessors)]
        if accessor.type != kind:
            self.fail(field, f"an accessor of {accessor.type}", f"it must be {kind}")
        count = operator.index(accessor.count)
        shape = (count, *SHAPES[kind])
        # Without a bufferView it is all zeros, and no bytes of the file bound its size.
        limit = MAX_ELEMENTS if accessor.bufferView is not None else MAX_ELEMENTS // 16
        if count < 1 or math.prod(shape) > limit:
            self.fail(
                field,
                f"an accessor with {count} elements",
                f"it must have at least 1 and at most {limit} numbers",
            )
        if accessor.bufferView is None:
            array = np.zeros(shape, COMPONENTS[accessor.componentType])
        else:
            array = self._view(accessor, accessor.componentType, shape, field)
        if accessor.sparse is not None:
            array = array.copy()
            indices, values = accessor.sparse.indices, accessor.sparse.values
            shape = (operator.index(accessor.sparse.count), *shape[1:])
            ids = self._view(indices, indices.componentType, shape[:1], field)
            array[ids] = self._view(values, accessor.componentType, shape, field)
        if accessor.normalized and array.dtype.kind in "iu":
            scaled = array / np.float32(np.iinfo(array.dtype).max)
            array = np.maximum(scaled, np.float32(-1))
        return array

    def _view(self, place, component: int, shape: tuple, field: str) -> np.ndarray:
        """The array at a bufferView + byteOffset, without a copy."""
        view = self.tree.bufferViews[_index(place.bufferView, self.tree.bufferViews)]
        buffer = self.buffers[_index(view.buffer, self.buffers)]
        dtype = COMPONENTS[component]
        size = dtype.itemsize * math.prod(shape[1:])
        stride = size if view.byteStride is None else operator.index(view.byteStride)
        start = operator.index(place.byteOffset or 0)
        begin = operator.index(view.byteOffset or 0)
        length = operator.index(view.byteLength)
        end = start + stride * (shape[0] - 1) + size
        fits = 0 <= begin and begin + length <= len(buffer) and end <= length
        if min(start, shape[0] - 1) < 0 or stride < size or not fits:
            self.fail(
                field,
                f"an accessor of {shape[0]} elements that leaves its bufferView "
                f"({length} bytes from {begin} in a buffer of {len(buffer)})",
                "copy or export the file again",
            )
        inner = np.zeros(shape[1:], dtype).strides
        return np.ndarray(
            shape, dtype, buffer, offset=begin + start, strides=(stride, *inner)
        )

    def world(self) -> tuple[np.ndarray, list[int], list[int]]:
        """World matrices (N, 4, 4), parents, and a parents-first order of the nodes."""
        nodes = self.tree.nodes
        parents = [-1] * len(nodes)
        for parent, node in enumerate(nodes):
            for child in node.children or []:
                if parents[_index(child, nodes)] != -1:
                    self.fail(
                        "nodes",
                        f"node {child} has two parents",
                        "give each node one parent",
                    )
                parents[child] = parent
        order = [node for node, parent in enumerate(parents) if parent == -1]
        for node in order:
            order.extend(nodes[node].children or [])
        if len(order) < len(nodes):
            self.fail("nodes", "the hierarchy has a cycle", "export a tree of nodes")
        world = np.stack([_local_matrix(node) for node in nodes] or [np.eye(4)])
        for node in order:
            if parents[node] != -1:
                world[node] = world[parents[node]] @ world[node]
        if not np.isfinite(world).all():
            self.fail("nodes", "a transform that is not finite", "export it again")
        return world, parents, order

    def recycle(self, accessor_ids: set[int]) -> None:
        """Let `add` overwrite these accessors and their data, if nobody uses them."""
        tree = self.tree
        # Extensions of vendors may refer to accessors in ways of their own.
        if any(not name.startswith("KHR_") for name in tree.extensionsUsed):
            return
        used = {skin.inverseBindMatrices for skin in tree.skins}
        for mesh in tree.meshes:
            for primitive in mesh.primitives:
                used.add(primitive.indices)
                for attributes in (
                    vars(primitive.attributes),
                    *(primitive.targets or []),
                ):
                    used.update(attributes.values())
        for animation in tree.animations:
            for sampler in animation.samplers:
                used.update((sampler.input, sampler.output))
        views = Counter(item.bufferView for item in (*tree.accessors, *tree.images))
        for accessor in tree.accessors:
            if accessor.sparse is not None:
                views[accessor.sparse.indices.bufferView] += 1
                views[accessor.sparse.values.bufferView] += 1
        self.free = [
            i
            for i in sorted(accessor_ids - used, reverse=True)
            if views[tree.accessors[i].bufferView] == 1
            and tree.accessors[i].bufferView is not None
            and tree.accessors[i].sparse is None
        ]

    def add(
        self,
        array: np.ndarray,
        kind: str,
        target: int | None = None,
        bounds: bool = False,
    ) -> int:
        """Append an array to the buffer; returns the id of its accessor.

        `bounds` states the smallest and largest values, as positions and times need.
        """
        tree = self.tree
        if self.free:
            accessor_id = self.free.pop()
            view_id = tree.accessors[accessor_id].bufferView
        else:
            accessor_id, view_id = len(tree.accessors), len(tree.bufferViews)
        blob = tree.binary_blob() or bytearray()
        blob += b"\0" * (-len(blob) % 4)
        view = pygltflib.BufferView(
            buffer=0, byteOffset=len(blob), byteLength=array.nbytes, target=target
        )
        accessor = pygltflib.Accessor(
            bufferView=view_id,
            componentType=COMPONENT_TYPES[array.dtype],
            count=len(array),
            type=kind,
        )
        if bounds:
            accessor.min = np.atleast_1d(array.min(axis=0)).tolist()
            accessor.max = np.atleast_1d(array.max(axis=0)).tolist()
        tree.bufferViews[view_id : view_id + 1] = [view]
        tree.accessors[accessor_id : accessor_id + 1] = [accessor]
        blob += array.tobytes()
        tree.set_binary_blob(blob)
        return accessor_id

    def to_bytes(self) -> bytes:
        tree = self.tree
        for accessor_id in self.free:
            # Taking it out would shift all ids; an element of it costs nothing.
            accessor = tree.accessors[accessor_id]
            accessor.count, accessor.byteOffset = 1, 0
            accessor.min, accessor.max = [], []
            size = COMPONENTS[accessor.componentType].itemsize
            tree.bufferViews[accessor.bufferView].byteLength = 4 * size
        tree.buffers = [pygltflib.Buffer(byteLength=len(tree.binary_blob()))]
        for accessor in tree.accessors:
            # The default 0 of pygltflib is not allowed without a bufferView.
            if accessor.bufferView is None:
                accessor.byteOffset = None
        return b"".join(tree.save_to_bytes())


def _index(value: int, items: list) -> int:
    """`value` when it is an id of `items`; Python's negative ids are not."""
    if not 0 <= operator.index(value) < len(items):
        raise IndexError(f"id {value} with {len(items)} to choose from")
    return operator.index(value)


def _local_matrix(node: Node) -> np.ndarray:
    if node.matrix is not None:
        return np.array(node.matrix, np.float64).reshape(4, 4).T
    matrix = np.eye(4)
    if node.rotation is not None:
        matrix[:3, :3] = Rotation.from_quat(node.rotation).as_matrix()
    if node.scale is not None:
        matrix[:3, :3] *= np.array(node.scale, np.float64).reshape(3)
    if node.translation is not None:
        matrix[:3, 3] = np.array(node.translation, np.float64).reshape(3)
    return matrix


@dataclass
class _Block:
    """Vertices that share their attributes, and the primitives that use them."""

    attributes: dict[str, int]
    primitives: list[pygltflib.Primitive]


class _Binding:
    """Which nodes, primitives and joints of a glTF file make up the head."""

    def __init__(self, document: Document):
        self.document = document
        tree = document.tree
        self.world, self.parents, self.order = document.world()
        with_mesh = [i for i, node in enumerate(tree.nodes) if node.mesh is not None]
        skinned = [i for i in with_mesh if tree.nodes[i].skin is not None]
        if not with_mesh:
            document.fail("meshes", "no node has a mesh", "export the head's mesh too")
        if not skinned and len(with_mesh) > 1:
            names = ", ".join(repr(tree.nodes[i].name) for i in with_mesh[:4])
            document.fail(
                "meshes",
                f"{len(with_mesh)} meshes without a skin ({names})",
                "join the parts of the head into one mesh and export it alone",
            )
        self.nodes = skinned or with_mesh
        self.skinned = bool(skinned)
        # The mesh of a skinned node is placed by its joints, not by the node.
        self.mesh_world = np.eye(4) if skinned else self.world[with_mesh[0]]
        used_skins = {_index(tree.nodes[i].skin, tree.skins) for i in skinned}
        self.skin_ids = sorted(used_skins or range(len(tree.skins)))
        self.joints = self._joints()
        self.blocks = self._blocks()

    def _joints(self) -> list[int]:
        document, tree = self.document, self.document.tree
        if self.skin_ids:
            skins = [tree.skins[i] for i in self.skin_ids]
            for skin in skins[1:]:
                same = skin.joints == skins[0].joints and np.array_equal(
                    self._inverse_bind(skin), self._inverse_bind(skins[0])
                )
                if not same:
                    document.fail(
                        "skins",
                        f"{len(skins)} skins with different joints "
                        f"({', '.join(repr(skin.name) for skin in skins[:4])})",
                        "join the parts of the head into one mesh with one skeleton, "
                        "or export the head alone",
                    )
            joints = [_index(joint, tree.nodes) for joint in skins[0].joints]
        else:
            # Plain nodes are joints, but for those that only hold the mesh in place.
            holders = set(self.nodes)
            for node in reversed(self.order):
                if node in holders:
                    holders.add(self.parents[node])
            joints = [
                i
                for i, node in enumerate(tree.nodes)
                if i not in holders
                and node.mesh is None
                and node.camera is None
                and "KHR_lights_punctual" not in (node.extensions or {})
            ]
        if not joints:
            document.fail(
                "joints",
                "the file has a mesh but no joints",
                "export the head together with its skeleton",
            )
        if len(set(joints)) < len(joints):
            document.fail(
                "joints", "a joint is listed twice", "list each joint once in the skin"
            )
        return joints

    def _inverse_bind(self, skin: pygltflib.Skin) -> np.ndarray | None:
        if skin.inverseBindMatrices is None:
            return None
        matrices = self.document.array(
            skin.inverseBindMatrices, "inverseBindMatrices", "MAT4"
        )
        if len(matrices) < len(skin.joints):
            self.document.fail(
                "inverseBindMatrices",
                f"{len(matrices)} matrices for {len(skin.joints)} joints",
                "export one per joint",
            )
        return matrices[: len(skin.joints)].transpose(0, 2, 1).astype(np.float64)

    def _blocks(self) -> list[_Block]:
        document, tree = self.document, self.document.tree
        blocks: dict[tuple, _Block] = {}
        mesh_ids = (_index(tree.nodes[i].mesh, tree.meshes) for i in self.nodes)
        for mesh_id in dict.fromkeys(mesh_ids):
            for primitive in tree.meshes[mesh_id].primitives:
                if primitive.mode not in (pygltflib.POINTS, pygltflib.TRIANGLES):
                    document.fail(
                        "primitives",
                        f"a primitive of mode {primitive.mode}",
                        "export the mesh as triangles",
                    )
                attributes = {
                    name: _index(accessor, tree.accessors)
                    for name, accessor in vars(primitive.attributes).items()
                    if accessor is not None
                }
                if "POSITION" not in attributes:
                    document.fail(
                        "POSITION", "a primitive has none", "export the vertices"
                    )
                key = tuple(sorted(attributes.items()))
                block = blocks.setdefault(key, _Block(attributes, []))
                block.primitives.append(primitive)
        return list(blocks.values())

    def joint_positions(self) -> np.ndarray:
        """(J, 3) in the space that the vertices are read in."""
        if self.skinned:
            inverse_bind = self._inverse_bind(
                self.document.tree.skins[self.skin_ids[0]]
            )
            if inverse_bind is not None:
                if (np.linalg.det(inverse_bind[:, :3, :3]) == 0).any():
                    self.document.fail(
                        "inverseBindMatrices",
                        "one of them cannot be inverted",
                        "bind the mesh again, without a bone of scale 0",
                    )
                return -np.linalg.solve(
                    inverse_bind[:, :3, :3], inverse_bind[:, :3, 3, None]
                )[:, :, 0]
        return self.world[self.joints, :3, 3]

    def joint_parents(self) -> list[int]:
        """(J,) the nearest ancestor that is a joint, or -1."""
        place = {node: bone for bone, node in enumerate(self.joints)}
        above = [-1] * len(self.parents)  # of each node: itself or the nearest joint
        bone_parents = [-1] * len(self.joints)
        for node in self.order:
            parent = self.parents[node]
            nearest = -1 if parent == -1 else above[parent]
            above[node] = place.get(node, nearest)
            if node in place:
                bone_parents[place[node]] = nearest
        return bone_parents

    def joint_names(self) -> tuple[str, ...]:
        """Node names, made unique; a joint without a name gets its node's number."""
        names, seen = [], Counter()
        for joint in self.joints:
            name = self.document.tree.nodes[joint].name
            name = name if isinstance(name, str) else ""
            name = name.replace("\0", "").encode(errors="replace").decode()
            name = name or f"joint_{joint}"
            while seen[name]:
                seen[name] += 1
                name = f"{name}.{seen[name] - 1:03d}"
            seen[name] += 1
            names.append(name)
        return tuple(names)


def _head_from(document: Document, binding: _Binding, weighted: bool) -> Head:
    skeleton = _skeleton_from(document, binding)
    vertices, normals, faces, weights = [], [], [], []
    weighted = weighted and binding.skinned
    start = 0
    for block in binding.blocks:
        positions = document.array(block.attributes["POSITION"], "POSITION", "VEC3")
        vertices.append(positions)
        if "NORMAL" in block.attributes:
            normals.append(document.array(block.attributes["NORMAL"], "NORMAL", "VEC3"))
        for primitive in block.primitives:
            faces.append(_faces(document, primitive, len(positions)) + start)
        if "JOINTS_0" in block.attributes and weighted:
            weights.append(_weights(document, block, len(positions), len(skeleton)))
        start += len(positions)
    if weights and len(weights) < len(vertices):
        document.fail(
            "JOINTS_0",
            f"{len(vertices) - len(weights)} of {len(vertices)} parts have no weights",
            "bind all parts of the mesh to the skeleton, or none",
        )
    vertices, normals, faces = _to_world(
        binding.mesh_world,
        np.concatenate(vertices),
        np.concatenate(normals) if len(normals) == len(vertices) else None,
        np.concatenate(faces),
    )
    return Head.create(
        vertices,
        faces,
        skeleton,
        weights=np.concatenate(weights) if weights else None,
        normals=normals,
        name=document.path.stem,
        file=document.path,
    )


def _to_world(matrix, vertices, normals, faces):
    if np.array_equal(matrix, np.eye(4)):
        return vertices, normals, faces
    linear = matrix[:3, :3]
    vertices = vertices @ linear.T + matrix[:3, 3]
    # Normals go with the cofactors, which exist even when the inverse does not.
    cofactors = np.stack([np.cross(linear[i - 2], linear[i - 1]) for i in range(3)])
    if np.linalg.det(linear) < 0:  # a mirroring turns the mesh inside out
        cofactors, faces = -cofactors, faces[:, ::-1]
    return vertices, None if normals is None else normals @ cofactors.T, faces


def _faces(document, primitive: pygltflib.Primitive, vertex_count: int) -> np.ndarray:
    """(F, 3) ids into the block's own vertices."""
    if primitive.mode == pygltflib.POINTS:
        return np.zeros((0, 3), np.int64)
    if primitive.indices is None:
        ids = np.arange(vertex_count)
    else:
        ids = document.array(primitive.indices, "indices", "SCALAR")
    if len(ids) % 3 or ids.dtype.kind not in "iu":
        document.fail(
            "faces",
            f"{len(ids)} vertex ids of type {ids.dtype}",
            "export triangles: integers, three per face",
        )
    if ids.min() < 0 or ids.max() >= vertex_count:
        document.fail(
            "faces",
            f"vertex id {ids.max()} with {vertex_count} vertices",
            f"use ids from 0 to {vertex_count - 1}",
        )
    return ids.astype(np.int64).reshape(-1, 3)


def _weights(document, block: _Block, vertex_count: int, bone_count: int) -> np.ndarray:
    """(V, J) from all JOINTS_n and WEIGHTS_n of a block; rows sum to 1."""
    if vertex_count * bone_count > MAX_ELEMENTS:
        document.fail(
            "weights",
            f"{vertex_count} vertices times {bone_count} joints",
            f"at most {MAX_ELEMENTS} weights are read: export fewer joints or vertices",
        )
    weights = np.zeros((vertex_count, bone_count), np.float32)
    rows = np.arange(vertex_count)[:, None]
    sets = 0
    while f"JOINTS_{sets}" in block.attributes:
        bones = document.array(block.attributes[f"JOINTS_{sets}"], "JOINTS", "VEC4")
        values = document.array(block.attributes[f"WEIGHTS_{sets}"], "WEIGHTS", "VEC4")
        if bones.shape != values.shape or len(bones) != vertex_count:
            document.fail(
                f"JOINTS_{sets}",
                f"{len(bones)} joints and {len(values)} weights for {vertex_count} "
                "vertices",
                "export one of each per vertex",
            )
        if bones.dtype.kind != "u" or values.dtype.kind != "f":
            document.fail(
                f"JOINTS_{sets}",
                f"joints of type {bones.dtype}, weights of type {values.dtype}",
                "joints are unsigned, weights are floats or normalized integers",
            )
        used = values != 0
        if (bones[used] >= bone_count).any():
            document.fail(
                f"JOINTS_{sets}",
                f"joint {bones[used].max()} in a skin of {bone_count}",
                f"use joints from 0 to {bone_count - 1}",
            )
        np.add.at(weights, (rows, np.where(used, bones, 0)), values)
        sets += 1
    # Integer weights, and what exporters round, miss 1 by up to a few per cent.
    sums = weights.sum(axis=1, dtype=np.float64)
    near = (np.abs(sums - 1) > 1e-6) & (np.abs(sums - 1) < 0.1)
    weights[near] /= sums[near, None]
    return weights


def _skeleton_from(document: Document, binding: _Binding) -> Skeleton:
    """The joints with the tails that our own files keep in the extras."""
    joints = binding.joint_positions().astype(np.float32)
    names, parents = binding.joint_names(), binding.joint_parents()
    kept = {}
    tails = np.full_like(joints, np.nan)
    for bone, node in enumerate(binding.joints):
        bone_shape = _kept_bone(document.tree.nodes[node].extras, joints[bone])
        if bone_shape is not None:
            kept[bone] = bone_shape
            joints[bone], length, direction = bone_shape
            tails[bone] = joints[bone] + length * direction
    skeleton = Skeleton.from_heads_and_tails(
        joints, tails, parents, names, file=document.path
    )
    lengths, directions = skeleton.lengths.copy(), skeleton.directions.copy()
    for bone, (_, length, direction) in kept.items():
        lengths[bone], directions[bone] = length, direction
    lengths.flags.writeable = directions.flags.writeable = False
    return dataclasses.replace(skeleton, lengths=lengths, directions=directions)


def _kept_bone(extras, joint: np.ndarray):
    """Head, length and direction from a node's extras, unless they are stale."""
    try:
        values = extras[EXTRAS_KEY]
        head = np.array(values["head"], np.float32).reshape(3)
        length = np.float32(values["length"])
        direction = np.array(values["direction"], np.float32).reshape(3)
    except (KeyError, TypeError, ValueError, OverflowError):
        return None
    norm = np.linalg.norm(direction)
    # Whoever moved or scaled the joint since then has not told the extras.
    fresh = np.abs(head - joint).max() <= 1e-5 * max(np.abs(joint).max(), length)
    sound = 0 <= length < 1e15 and abs(norm - (length > 0)) < 1e-3
    return (head, length, direction) if fresh and sound else None


def encodable(text: str) -> str:
    """`text` with what UTF-8 cannot hold, lone surrogates, replaced."""
    return text.encode(errors="replace").decode()


def new_file(
    head: Head,
    max_influences: int | None,
    colours: np.ndarray | None = None,
    attributes: Mapping[str, np.ndarray] | None = None,
) -> bytes:
    """A .glb file with the head and nothing else; see `skinlib.io.write_head`."""
    document = Document()
    tree = document.tree
    add_skeleton(document, head.skeleton)
    primitive = add_primitive(document, head, max_influences)
    name = encodable(head.name) or "head"
    tree.meshes = [pygltflib.Mesh(primitives=[primitive], name=name)]
    skin = None if head.weights is None else 0
    tree.nodes.append(Node(name=name, mesh=0, skin=skin))
    tree.scenes = [pygltflib.Scene(nodes=[len(tree.nodes) - 2, len(tree.nodes) - 1])]
    tree.scene = 0
    block = _Block({"POSITION": primitive.attributes.POSITION}, [primitive])
    _add_attributes(document, [block], colours, attributes or {})
    return document.to_bytes()


def add_skeleton(document: Document, skeleton: Skeleton) -> None:
    """Put J joints into an empty document: nodes 0 to J - 1, and skin 0.

    Node J stands above the roots: a skin must have a common root.
    """
    tree = document.tree
    joints = skeleton.joints.astype(np.float64)
    for bone, parent in enumerate(skeleton.parents):
        local = joints[bone] - (joints[parent] if parent >= 0 else 0)
        shape = {
            "head": skeleton.joints[bone].tolist(),
            "length": skeleton.lengths[bone].item(),
            "direction": skeleton.directions[bone].tolist(),
        }
        node = Node(
            name=skeleton.names[bone],
            translation=local.tolist(),
            extras={EXTRAS_KEY: shape},
        )
        tree.nodes.append(node)
    for bone, children in enumerate(skeleton.children()):
        tree.nodes[bone].children = children
    roots = np.flatnonzero(skeleton.parents == -1).tolist()
    tree.nodes.append(Node(name="skeleton", children=roots))
    inverse_bind = np.tile(np.eye(4, dtype=np.float32), (len(skeleton), 1, 1))
    inverse_bind[:, 3, :3] = -skeleton.joints  # column by column
    tree.skins = [
        pygltflib.Skin(
            joints=list(range(len(skeleton))),
            skeleton=len(skeleton),
            inverseBindMatrices=document.add(inverse_bind, "MAT4"),
        )
    ]


def add_primitive(
    document: Document, head: Head, max_influences: int | None
) -> pygltflib.Primitive:
    """Put the vertices, faces and, when it has any, weights of a head into the file."""
    buffer = pygltflib.ARRAY_BUFFER
    sets = {
        "POSITION": document.add(head.vertices, "VEC3", buffer, bounds=True),
        "NORMAL": document.add(head.normals, "VEC3", buffer),
    }
    primitive = pygltflib.Primitive(
        attributes=pygltflib.Attributes(**sets), mode=pygltflib.POINTS
    )
    if len(head.faces):
        # The largest id of a type is reserved, it restarts a primitive.
        dtype = np.uint16 if len(head.vertices) <= 65535 else np.uint32
        ids = head.faces.astype(dtype).ravel()
        primitive.mode = pygltflib.TRIANGLES
        primitive.indices = document.add(ids, "SCALAR", pygltflib.ELEMENT_ARRAY_BUFFER)
    if head.weights is not None:
        bones, values = sorted_influences(head.weights, max_influences)
        influences = _add_influences(document, bones, values, len(head.skeleton))
        vars(primitive.attributes).update(influences)
    return primitive


def reskinned(
    source: Path,
    head: Head,
    max_influences: int | None,
    colours: np.ndarray | None = None,
    attributes: Mapping[str, np.ndarray] | None = None,
) -> bytes:
    """The source file with the weights of `head` on its mesh."""
    attributes = attributes or {}
    if source.suffix.lower() != ".glb":
        raise HeadError(
            "file",
            f"a {source.suffix} file cannot be re-skinned",
            "export the source as one .glb file",
            source,
        )
    if head.weights is None:
        raise HeadError("weights", "the head has none", "predict or paint them first")
    document = Document(source)
    binding = _Binding(document)
    columns = _matching_bones(_head_from(document, binding, False), head, source)
    _one_buffer(document)
    if not binding.skinned:
        _bind(document, binding)
    document.recycle(_without_old(document, binding, attributes))
    bones, values = sorted_influences(head.weights[:, columns], max_influences)
    start = 0
    for block in binding.blocks:
        count = document.tree.accessors[block.attributes["POSITION"]].count
        part = slice(start, start + count)
        influences = _add_influences(document, bones[part], values[part], len(columns))
        for primitive in block.primitives:
            vars(primitive.attributes).update(influences)
        start += count
    _add_attributes(document, binding.blocks, colours, attributes)
    return document.to_bytes()


def _without_old(
    document: Document, binding: _Binding, replaced: Iterable[str]
) -> set[int]:
    """Take off the head what is no longer true; returns the accessors it had."""
    accessors = set()
    replaced = {plain_name(name) for name in (*replaced, CONFIDENCE)}
    for block in binding.blocks:
        for name, accessor_id in list(block.attributes.items()):
            ours = document.tree.accessors[accessor_id].name == OUR_COLOURS
            if (
                name.startswith(("JOINTS_", "WEIGHTS_"))
                or (name.startswith("_") and plain_name(name) in replaced)
                or (name.startswith("COLOR_") and ours)
            ):
                accessors.add(block.attributes.pop(name))
                for primitive in block.primitives:
                    delattr(primitive.attributes, name)
    return accessors


def _matching_bones(theirs: Head, head: Head, source: Path) -> list[int]:
    """For each joint of the source the bone of `head` with its name."""
    size = np.ptp(theirs.vertices, axis=0).max()
    if theirs.vertices.shape != head.vertices.shape or not np.allclose(
        theirs.vertices, head.vertices, rtol=0, atol=1e-4 * size
    ):
        raise HeadError(
            "vertices",
            f"the source has {len(theirs.vertices)} vertices, which are not the "
            f"{len(head.vertices)} of the head",
            "re-skin the file that the head was read from",
            source,
        )
    place = {name: bone for bone, name in enumerate(head.skeleton.names)}
    if place.keys() != set(theirs.skeleton.names):
        raise HeadError(
            "bone_names",
            "the bones of the source are not those of the head, for example "
            f"{sorted(place.keys() ^ set(theirs.skeleton.names))[0]!r}",
            "re-skin the file that the head was read from",
            source,
        )
    return [place[name] for name in theirs.skeleton.names]


def _one_buffer(document: Document) -> None:
    """Lay all bufferViews into one buffer, so that `add` can append to it."""
    tree = document.tree
    if sum(view.byteLength for view in tree.bufferViews) > 8 * MAX_ELEMENTS:
        document.fail("bufferViews", "they overlap many times", "export the file again")
    blob = bytearray()
    for view in tree.bufferViews:
        begin, buffer = view.byteOffset or 0, document.buffers[view.buffer]
        content = buffer[begin : begin + view.byteLength]
        if begin < 0 or len(content) != view.byteLength:
            document.fail(
                "bufferViews", "one leaves its buffer", "copy or export the file again"
            )
        blob += b"\0" * (-len(blob) % 4)
        view.buffer, view.byteOffset = 0, len(blob)
        blob += content
    tree.set_binary_blob(blob)
    tree.buffers = [pygltflib.Buffer(byteLength=len(blob))]


def _bind(document: Document, binding: _Binding) -> None:
    """Give the mesh a skin that leaves it where it is."""
    tree = document.tree
    inverse_bind = np.linalg.inv(binding.world[binding.joints]) @ binding.mesh_world
    matrices = inverse_bind.transpose(0, 2, 1).astype(np.float32)
    matrices[:, :, 3] = (0, 0, 0, 1)
    skin = pygltflib.Skin(
        joints=binding.joints, inverseBindMatrices=document.add(matrices, "MAT4")
    )
    skin_id = binding.skin_ids[0] if binding.skin_ids else len(tree.skins)
    tree.skins[skin_id : skin_id + 1] = [skin]
    for node in binding.nodes:
        tree.nodes[node].skin = skin_id
    # A skin must have a common root.
    tops = set()
    for node in binding.joints:
        while binding.parents[node] != -1:
            node = binding.parents[node]
        tops.add(node)
    if len(tops) > 1:
        for scene in tree.scenes:
            others = [node for node in scene.nodes or [] if node not in tops]
            scene.nodes = [*others, len(tree.nodes)]
        tree.nodes.append(Node(name="skeleton", children=sorted(tops)))


def sorted_influences(
    weights: np.ndarray, count: int | None
) -> tuple[np.ndarray, np.ndarray]:
    """Bones (V, K) and weights (V, K), largest first, padded with bone 0, weight 0."""
    if count is not None and count < 1:
        raise HeadError(
            "max_influences", f"{count}", "keep at least 1 influence per vertex"
        )
    rows, bones = np.nonzero(weights)
    values = weights[rows, bones].astype(np.float64)
    order = np.lexsort((bones, -values, rows))
    bones, values = bones[order], values[order]
    ranks = np.arange(len(rows)) - np.searchsorted(rows, rows)
    width = int(ranks.max()) + 1
    kept = ranks < (width if count is None else count)
    shape = (len(weights), width if count is None else min(count, width))
    padded_bones, padded_values = np.zeros(shape, np.int64), np.zeros(shape)
    padded_bones[rows[kept], ranks[kept]] = bones[kept]
    padded_values[rows[kept], ranks[kept]] = values[kept]
    # Rows that sum to 1 as those of a head do stay as they are, to the bit.
    sums = padded_values.sum(axis=1)
    off = np.abs(sums - 1) > 1e-6
    padded_values[off] /= sums[off, None]
    return padded_bones, padded_values.astype(np.float32)


def _add_influences(
    document: Document, bones: np.ndarray, values: np.ndarray, bone_count: int
) -> dict[str, int]:
    """Put influences into the file, four to a set; returns the new attributes."""
    dtype = np.uint8 if bone_count <= 256 else np.uint16
    padding = ((0, 0), (0, -bones.shape[1] % 4))
    bones = np.pad(bones, padding).astype(dtype)
    values = np.pad(values, padding)
    attributes = {}
    for i in range(bones.shape[1] // 4):
        part = slice(4 * i, 4 * i + 4)
        for name, array in (("JOINTS", bones), ("WEIGHTS", values)):
            accessor = document.add(array[:, part], "VEC4", pygltflib.ARRAY_BUFFER)
            attributes[f"{name}_{i}"] = accessor
    return attributes


def _add_attributes(
    document: Document,
    blocks: list[_Block],
    colours: np.ndarray | None,
    attributes: Mapping[str, np.ndarray],
) -> None:
    """Put colours (V, 4) uint8 and custom attributes (V,) float32 on the head's parts.

    The colours come after those that the file has: COLOR_0 is what every viewer
    shows, and may be the artist's.
    """
    taken = max(sum(name.startswith("COLOR_") for name in b.attributes) for b in blocks)
    start = 0
    for block in blocks:
        count = document.tree.accessors[block.attributes["POSITION"]].count
        part = slice(start, start + count)
        start += count
        added = {
            name: document.add(values[part], "SCALAR", pygltflib.ARRAY_BUFFER)
            for name, values in attributes.items()
        }
        for i in range(0 if colours is None else taken + 1):
            if f"COLOR_{i}" not in block.attributes:
                # White leaves a part as it is that has fewer colours than another.
                values = colours[part] if i == taken else np.full((count, 4), 255, "u1")
                added[f"COLOR_{i}"] = document.add(
                    values, "VEC4", pygltflib.ARRAY_BUFFER
                )
                accessor = document.tree.accessors[added[f"COLOR_{i}"]]
                accessor.normalized, accessor.name = True, OUR_COLOURS
        for primitive in block.primitives:
            vars(primitive.attributes).update(added)
