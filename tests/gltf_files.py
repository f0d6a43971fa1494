"""glTF files by hand, for the tests: JSON and bytes, with no help from skinlib."""

import json
import struct
from pathlib import Path

import numpy as np

COMPONENTS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
KINDS = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


class Builder:
    """A glTF document under construction: `tree` is its JSON, `blob` its buffer."""

    def __init__(self):
        self.tree = {"asset": {"version": "2.0"}, "bufferViews": [], "accessors": []}
        self.blob = b""

    def view(self, content: bytes, **properties) -> int:
        self.blob += b"\0" * (-len(self.blob) % 4)
        self.tree["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(content)}
            | properties
        )
        self.blob += content
        return len(self.tree["bufferViews"]) - 1

    def accessor(self, count, dtype, kind, **properties) -> int:
        self.tree["accessors"].append(
            {"componentType": COMPONENTS[dtype], "count": count, "type": kind}
            | properties
        )
        return len(self.tree["accessors"]) - 1

    def array(self, values, dtype="f4", **properties) -> int:
        array = np.asarray(values, f"<{dtype}")
        kind = KINDS[array.shape[1:]]
        if kind == "VEC3" and dtype == "f4":
            properties |= {
                "min": array.min(axis=0).tolist(),
                "max": array.max(axis=0).tolist(),
            }
        return self.accessor(
            len(array), dtype, kind, bufferView=self.view(array.tobytes()), **properties
        )

    def write(self, path: Path) -> Path:
        tree = dict(self.tree)
        tree["buffers"] = [{"byteLength": len(self.blob)}]
        if path.suffix == ".gltf":
            tree["buffers"][0]["uri"] = path.stem + ".bin"
            path.with_suffix(".bin").write_bytes(self.blob)
            path.write_text(json.dumps(tree))
            return path
        return pack(path, tree, self.blob)


def pack(path: Path, tree: dict, blob: bytes) -> Path:
    """Write a .glb file of its two chunks."""
    text = json.dumps(tree).encode()
    text += b" " * (-len(text) % 4)
    blob += b"\0" * (-len(blob) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(blob), b"BIN\0") + blob
    path.write_bytes(b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks)
    return path


def unpack(path: Path) -> tuple[dict, bytes]:
    """The JSON and the buffer of a .glb file."""
    content = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", content)
    assert (magic, version, length) == (b"glTF", 2, len(content))
    size = struct.unpack_from("<I", content, 12)[0]
    return json.loads(content[20 : 20 + size]), content[28 + size :]


def plain_array(tree: dict, blob: bytes, accessor_id: int) -> np.ndarray:
    """The array of an accessor that is neither sparse nor interleaved."""
    accessor = tree["accessors"][accessor_id]
    view = tree["bufferViews"][accessor["bufferView"]]
    dtype = {v: k for k, v in COMPONENTS.items()}[accessor["componentType"]]
    shape = {v: k for k, v in KINDS.items()}[accessor["type"]]
    start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
    count = accessor["count"] * int(np.prod(shape, dtype=int))
    flat = np.frombuffer(blob, f"<{dtype}", count, start)
    return flat.reshape(-1, *shape)


VERTICES = np.array(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0], [0, 2, 0], [1, 2, 0]], np.float32
)
FACES = np.array([[0, 1, 2], [1, 3, 2], [2, 3, 4], [3, 5, 4]])
JOINTS = np.array([[0, 0, 0], [0, 1, 0], [0.5, 1.5, 0.25]], np.float32)
WEIGHTS = np.array(
    [[1, 0, 0], [1, 0, 0], [0.5, 0.5, 0], [0.5, 0.25, 0.25], [0, 0, 1], [0, 1, 0]],
    np.float32,
)


def skinned_builder(weights_dtype: str = "f4") -> Builder:
    """Six vertices, four faces, the bones neck, head and jaw; written by another hand.

    The joints are turned and scaled, the mesh's node is moved (which counts for
    nothing), and the bind pose is in the inverse bind matrices alone.
    """
    builder = Builder()
    scale = {"f4": 1, "u1": 255, "u2": 65535}[weights_dtype]
    weights = np.pad(WEIGHTS, ((0, 0), (0, 1))) * scale
    bind = np.tile(np.eye(4), (3, 1, 1))
    turn = np.array([[0, -2, 0], [2, 0, 0], [0, 0, 2]])  # 90 degrees about z, times 2
    bind[:, :3, :3], bind[:, :3, 3] = turn, JOINTS
    inverse = np.linalg.inv(bind)
    attributes = {
        "POSITION": builder.array(VERTICES),
        "JOINTS_0": builder.array(np.tile([0, 1, 2, 0], (6, 1)), "u1"),
        "WEIGHTS_0": builder.array(
            np.round(weights) if scale > 1 else weights,
            weights_dtype,
            normalized=scale > 1,
        ),
    }
    primitive = {
        "attributes": attributes,
        "indices": builder.array(FACES.ravel(), "u2"),
    }
    builder.tree |= {
        "scene": 0,
        "scenes": [{"nodes": [0, 3]}],
        "nodes": [
            {"name": "neck", "children": [1], "rotation": [0, 0, 0.6, 0.8]},
            {"name": "head", "children": [2], "scale": [2, 2, 2]},
            {"name": "jaw", "translation": [9, 9, 9]},
            {"name": "face", "mesh": 0, "skin": 0, "translation": [5, 5, 5]},
        ],
        "skins": [
            {
                "joints": [0, 1, 2],
                "inverseBindMatrices": builder.array(inverse.transpose(0, 2, 1)),
            }
        ],
        "meshes": [{"primitives": [primitive]}],
    }
    return builder


def rich_builder() -> Builder:
    """A file with one of everything that has to survive."""
    builder = skinned_builder()
    tree = builder.tree
    image = builder.view(b"not really a PNG, but nobody looks inside")
    primitive = tree["meshes"][0]["primitives"][0]
    primitive["material"] = 0
    primitive["attributes"]["TEXCOORD_0"] = builder.array(VERTICES[:, :2])
    primitive["targets"] = [{"POSITION": builder.array(VERTICES / 10)}]
    # The second set is not used by the first: it has to go all the same.
    for i in (1, 2):
        primitive["attributes"][f"JOINTS_{i}"] = builder.array(np.zeros((6, 4)), "u1")
        primitive["attributes"][f"WEIGHTS_{i}"] = builder.array(np.zeros((6, 4)))
    tree["meshes"][0] |= {"weights": [0.5], "extras": {"targetNames": ["smile"]}}
    tree["nodes"][3]["weights"] = [0.25]
    tree["nodes"].append({"name": "hat", "mesh": 1, "extras": {"colour": "red"}})
    tree["scenes"][0]["nodes"].append(4)
    tree["meshes"].append(
        {"primitives": [{"attributes": {"POSITION": builder.array(VERTICES + 5)}}]}
    )
    times = builder.array([0, 1], min=[0], max=[1])
    turns = builder.array([[0, 0, 0, 1], [0, 0, 0.6, 0.8]])
    tree |= {
        "asset": {"version": "2.0", "copyright": "somebody", "generator": "by hand"},
        "extensionsUsed": ["KHR_materials_unlit"],
        "images": [{"bufferView": image, "mimeType": "image/png", "name": "skin"}],
        "samplers": [{"name": "smooth", "magFilter": 9729}],
        "textures": [{"source": 0, "sampler": 0}],
        "materials": [
            {
                "name": "skin",
                "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}},
                "extensions": {"KHR_materials_unlit": {}},
            }
        ],
        "animations": [
            {
                "name": "nod",
                "channels": [{"sampler": 0, "target": {"node": 1, "path": "rotation"}}],
                "samplers": [{"input": times, "output": turns}],
            }
        ],
    }
    return builder
