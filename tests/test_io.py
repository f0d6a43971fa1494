import base64
import dataclasses
import json
import os
import re
import struct
import zipfile

import numpy as np
import pygltflib
import pytest
from gltf_files import (
    FACES,
    JOINTS,
    VERTICES,
    WEIGHTS,
    Builder,
    pack,
    plain_array,
    rich_builder,
    skinned_builder,
    unpack,
)
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from skinlib.blender.run import run_script
from skinlib.head import Head, HeadError, Skeleton
from skinlib.io import NPZ_KEYS, read_head, read_vertex_mask, write_head

SKELETON = Skeleton.from_heads_and_tails(
    JOINTS, JOINTS + np.array([0, 0.5, 0]), [-1, 0, 1], ["neck", "head", "jaw"]
)
HEAD = Head.create(VERTICES, FACES, SKELETON, WEIGHTS)


def many_bones(count: int, vertex_count: int = 5) -> Head:
    """A chain of `count` bones; every vertex follows all of them."""
    rng = np.random.default_rng(count)
    weights = rng.random((vertex_count, count)) + 0.1
    skeleton = Skeleton.from_heads_and_tails(
        rng.random((count, 3)),
        None,
        np.arange(count) - 1,
        [f"bone {i}" for i in range(count)],
    )
    return Head.create(
        rng.random((vertex_count, 3)),
        [[0, 1, 2]],
        skeleton,
        weights / weights.sum(axis=1, keepdims=True),
    )


def assert_same(read: Head, written: Head, tails_exact: bool = True) -> None:
    for name in ("vertices", "normals", "faces"):
        np.testing.assert_array_equal(getattr(read, name), getattr(written, name), name)
    if written.weights is None:
        assert read.weights is None
    else:
        np.testing.assert_allclose(read.weights, written.weights, rtol=0, atol=2e-6)
    ours, theirs = read.skeleton, written.skeleton
    assert ours.names == theirs.names
    np.testing.assert_array_equal(ours.parents, theirs.parents)
    np.testing.assert_array_equal(ours.joints, theirs.joints)
    if tails_exact:
        np.testing.assert_array_equal(ours.lengths, theirs.lengths)
        np.testing.assert_array_equal(ours.directions, theirs.directions)
    else:
        size = max(np.abs(theirs.joints).max(), theirs.lengths.max())
        np.testing.assert_allclose(ours.tails, theirs.tails, rtol=0, atol=1e-6 * size)


# --- round trips ---------------------------------------------------------------------

coordinates = st.floats(-1e6, 1e6, width=32)
names = st.text(
    st.characters(exclude_categories=["Cs"], exclude_characters="\0"), min_size=1
)


@st.composite
def contents(draw) -> dict:
    """What any head may hold that the contract allows, small."""
    vertex_count = draw(st.integers(1, 6))
    bone_count = draw(st.integers(1, 7))
    points = st.tuples(coordinates, coordinates, coordinates)

    def rows(count, values=points):
        return draw(st.lists(values, min_size=count, max_size=count))

    ids = st.integers(0, vertex_count - 1)
    # Parents come first in a random order, so that there is no cycle.
    order = draw(st.permutations(range(bone_count)))
    parents = [-1] * bone_count
    for place, bone in enumerate(order):
        above = draw(st.integers(-1, place - 1))
        parents[bone] = order[above] if above >= 0 else -1
    weights = None
    if draw(st.booleans()):
        shares = st.sampled_from([0.0, 0.0, 1e-6, 0.3, 1.0])
        weights = np.reshape(rows(vertex_count * bone_count, shares), (-1, bone_count))
        weights[:, draw(st.integers(0, bone_count - 1))] += 0.1
        weights = weights / weights.sum(axis=1, keepdims=True)
    return {
        "vertices": rows(vertex_count),
        "faces": draw(st.lists(st.tuples(ids, ids, ids), max_size=5)),
        "heads": rows(bone_count),
        "tails": rows(bone_count) if draw(st.booleans()) else None,
        "parents": parents,
        "names": draw(
            st.lists(names, min_size=bone_count, max_size=bone_count, unique=True)
        ),
        "weights": weights,
    }


def build(vertices, faces, heads, tails, parents, names, weights) -> Head:
    skeleton = Skeleton.from_heads_and_tails(heads, tails, parents, names)
    return Head.create(vertices, faces, skeleton, weights)


any_head = settings(
    max_examples=100,
    deadline=None,
    derandomize=True,
    # The folder is the same for all examples, which overwrite one file.
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@any_head
@given(content=contents())
def test_npz_round_trip(tmp_path, content):
    head = build(**content)
    write_head(tmp_path / "head.npz", head)
    assert_same(read_head(tmp_path / "head.npz"), head, tails_exact=False)


@any_head
@given(content=contents())
def test_glb_round_trip_is_exact(tmp_path, content):
    head = build(**content)
    write_head(tmp_path / "head.glb", head)
    assert_same(read_head(tmp_path / "head.glb"), head)


@any_head
@given(content=contents())
def test_reskinning_puts_the_new_weights_in(tmp_path, content):
    head = build(**content)
    path = tmp_path / "head.glb"
    write_head(path, head.replace(weights=None))
    if head.weights is not None:
        write_head(path, head, source=path)
        assert_same(read_head(path), head)


@pytest.mark.parametrize("name", ["head.npz", "head.glb"])
def test_bones_without_length_and_far_from_the_head_are_legal(tmp_path, name):
    joints = [[0, 0, 0], [0, 0, 0], [0, -1e4, 0]]
    skeleton = Skeleton.from_heads_and_tails(
        joints, joints, [-1, 0, 0], ["root", "face/jaw", "hips"]
    )
    head = HEAD.replace(skeleton=skeleton)
    write_head(tmp_path / name, head)
    assert_same(read_head(tmp_path / name), head)
    assert skeleton.lengths.tolist() == [0, 0, 0]


def test_name_is_the_stem_and_the_suffix_may_be_upper_case(tmp_path):
    for name in ("Old Man.GLB", "Old Man.NPZ"):
        write_head(tmp_path / name, HEAD)
        assert read_head(tmp_path / name).name == "Old Man"


def test_exact_weights_stay_exact(tmp_path):
    for name in ("head.glb", "head.npz"):
        write_head(tmp_path / name, HEAD)
        np.testing.assert_array_equal(read_head(tmp_path / name).weights, WEIGHTS)


def test_npz_holds_the_named_arrays(tmp_path):
    write_head(tmp_path / "head.npz", HEAD)
    arrays = np.load(tmp_path / "head.npz", allow_pickle=False)
    assert set(arrays.files) == set(NPZ_KEYS)
    assert arrays["bone_names"].tolist() == ["neck", "head", "jaw"]


@pytest.mark.parametrize("dtype", ["f8", "f2", ">f4"])
def test_npz_of_another_type_is_cast(tmp_path, dtype):
    np.savez(
        tmp_path / "head.npz",
        vertices=VERTICES.astype(dtype),
        faces=FACES.astype("u2"),
        bone_names=np.array([b"neck", b"head", b"jaw"]),
        bone_parents=np.array([-1, 0, 1], "i1"),
        bone_heads=JOINTS,
    )
    read = read_head(tmp_path / "head.npz")
    np.testing.assert_array_equal(read.vertices, VERTICES)
    assert (read.vertices.dtype, read.faces.dtype) == (np.float32, np.int64)
    assert read.skeleton.names == ("neck", "head", "jaw")
    assert read.weights is None
    np.testing.assert_array_equal(read.normals, np.tile([0, 0, 1], (6, 1)))


# --- what is written ------------------------------------------------------------------


@pytest.mark.parametrize(
    ("bones", "limit", "sets", "dtype"),
    [(3, None, 1, "u1"), (9, None, 3, "u1"), (9, 4, 1, "u1"), (300, 8, 2, "u2")],
)
def test_influences_come_four_to_a_set_largest_first(
    tmp_path, bones, limit, sets, dtype
):
    head = many_bones(bones)
    write_head(tmp_path / "head.glb", head, max_influences=limit)
    tree, blob = unpack(tmp_path / "head.glb")
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    assert sum(name.startswith("JOINTS_") for name in attributes) == sets
    assert plain_array(tree, blob, attributes["JOINTS_0"]).dtype == dtype
    values = np.hstack(
        [plain_array(tree, blob, attributes[f"WEIGHTS_{i}"]) for i in range(sets)]
    )
    assert (np.diff(values, axis=1) <= 0).all()
    assert (np.abs(values.sum(axis=1, dtype=float) - 1) < 1e-6).all()

    expected = head.weights.copy()
    if limit:
        least = np.sort(expected, axis=1)[:, -limit]
        expected[expected < least[:, None]] = 0
        expected /= expected.sum(axis=1, keepdims=True)
    read = read_head(tmp_path / "head.glb").weights
    np.testing.assert_allclose(read, expected, atol=1e-6)
    write_head(tmp_path / "head.npz", head, max_influences=limit)
    np.testing.assert_array_equal(read_head(tmp_path / "head.npz").weights, read)


@pytest.mark.parametrize(("count", "component"), [(65535, 5123), (65536, 5125)])
def test_vertex_ids_take_two_bytes_up_to_65534(tmp_path, count, component):
    vertices = np.random.default_rng(0).random((count, 3))
    faces = [[0, 1, count - 1]]
    head = Head.create(vertices, faces, SKELETON, np.eye(3)[np.arange(count) % 3])
    write_head(tmp_path / "head.glb", head)
    tree, _ = unpack(tmp_path / "head.glb")
    indices = tree["meshes"][0]["primitives"][0]["indices"]
    assert tree["accessors"][indices]["componentType"] == component
    assert read_head(tmp_path / "head.glb").faces.tolist() == faces


def test_a_joint_that_was_moved_in_another_program_forgets_our_tail(tmp_path):
    write_head(tmp_path / "head.glb", HEAD)
    tree, blob = unpack(tmp_path / "head.glb")
    blob = bytearray(blob)
    view = tree["bufferViews"][
        tree["accessors"][tree["skins"][0]["inverseBindMatrices"]]["bufferView"]
    ]
    struct.pack_into("<f", blob, view["byteOffset"] + 2 * 64 + 12 * 4, 7.0)
    pack(tmp_path / "moved.glb", tree, bytes(blob))
    moved = read_head(tmp_path / "moved.glb").skeleton
    assert moved.joints[2].tolist() == [-7, 1.5, 0.25]
    assert moved.lengths.tolist() == [0.5, 0.5, 0]


# --- files by another hand -----------------------------------------------------------


@pytest.mark.parametrize("name", ["head.glb", "head.gltf"])
@pytest.mark.parametrize("dtype", ["f4", "u1", "u2"])
def test_bind_pose_and_weights_of_a_foreign_file(tmp_path, name, dtype):
    head = read_head(skinned_builder(dtype).write(tmp_path / name))
    np.testing.assert_array_equal(head.vertices, VERTICES)
    np.testing.assert_array_equal(head.faces, FACES)
    np.testing.assert_allclose(head.skeleton.joints, JOINTS, atol=1e-7)
    assert head.skeleton.parents.tolist() == [-1, 0, 1]
    assert head.skeleton.names == ("neck", "head", "jaw")
    atol = {"f4": 0, "u1": 4e-3, "u2": 2e-5}[dtype]
    np.testing.assert_allclose(head.weights, WEIGHTS, rtol=0, atol=atol)
    np.testing.assert_allclose(head.weights.sum(axis=1), 1, atol=1e-6)


def test_buffer_in_a_data_uri(tmp_path):
    builder = skinned_builder()
    uri = "data:application/octet-stream;base64,"
    uri += base64.b64encode(builder.blob).decode()
    builder.tree["buffers"] = [{"byteLength": len(builder.blob), "uri": uri}]
    (tmp_path / "head.gltf").write_text(json.dumps(builder.tree))
    np.testing.assert_array_equal(read_head(tmp_path / "head.gltf").weights, WEIGHTS)


def test_joint_nodes_give_the_bind_pose_when_no_matrices_do(tmp_path):
    builder = skinned_builder()
    del builder.tree["skins"][0]["inverseBindMatrices"]
    turned = Rotation.from_euler("z", 90, degrees=True).as_quat().tolist()
    half = [0.5, 0, 0, 0, 0, 0.5, 0, 0, 0, 0, 0.5, 0, 1, 0, 0, 1]  # scale 0.5, x + 1
    builder.tree["nodes"][:3] = [
        {"name": "neck", "children": [4], "translation": [1, 2, 3], "rotation": turned},
        {"name": "head", "children": [2], "matrix": half},
        {"name": "jaw", "translation": [0, 2, 0]},
    ]
    # A node that is no joint lies between neck and head.
    builder.tree["nodes"].append({"children": [1], "scale": [3, 3, 3]})
    skeleton = read_head(builder.write(tmp_path / "head.glb")).skeleton
    # By hand: the head is 3 up from the neck, the jaw 3 * 0.5 * 2 to its left.
    expected = [[1, 2, 3], [1, 5, 3], [-2, 5, 3]]
    np.testing.assert_allclose(skeleton.joints, expected, atol=1e-6)
    assert skeleton.parents.tolist() == [-1, 0, 1]
    np.testing.assert_allclose(skeleton.lengths, [3, 3, 0], atol=1e-6)


def unskinned_builder(matrix: np.ndarray) -> Builder:
    """The mesh of `skinned_builder` without its skin, below a node that moves it."""
    builder = skinned_builder()
    tree = builder.tree
    del tree["skins"]
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    del attributes["JOINTS_0"], attributes["WEIGHTS_0"]
    attributes["NORMAL"] = builder.array(np.tile([0, 0, 1], (6, 1)))
    tree["nodes"] = [
        {"name": "neck", "children": [1], "rotation": [0, 0, 0.6, 0.8]},
        {"name": "head", "children": [2], "translation": [0, 1, 0]},
        {"name": "jaw", "translation": [0, 1, 0], "scale": [1, 2, 3]},
        {"name": "face", "mesh": 0},
        {"name": "holder", "children": [3], "matrix": matrix.T.ravel().tolist()},
        {"name": "eye", "camera": 0},
    ]
    tree["cameras"] = [
        {"type": "perspective", "perspective": {"yfov": 1.0, "znear": 0.1}}
    ]
    tree["scenes"] = [{"nodes": [0, 4, 5]}]
    return builder


def test_mesh_without_a_skin_is_read_in_world_space_with_its_joint_nodes(tmp_path):
    matrix = np.eye(4)
    matrix[:3] = [[0, 0, 2, 1], [2, 0, 0, 2], [0, -4, 0, 3]]  # mirrors: det < 0
    head = read_head(unskinned_builder(matrix).write(tmp_path / "head.glb"))
    assert head.weights is None
    x, y, z = VERTICES.T
    expected = np.stack([2 * z + 1, 2 * x + 2, 3 - 4 * y], axis=1)
    np.testing.assert_array_equal(head.vertices, expected)
    np.testing.assert_allclose(np.abs(head.normals), np.tile([1, 0, 0], (6, 1)))
    # The winding still says what the normals say.
    computed = Head.create(head.vertices, head.faces, head.skeleton).normals
    np.testing.assert_allclose(computed, head.normals, atol=1e-6)
    assert head.skeleton.names == ("neck", "head", "jaw")
    up = np.array([-0.96, 0.28, 0])  # +Y turned about z by the rotation of the neck
    np.testing.assert_allclose(head.skeleton.joints, [0 * up, up, 2 * up], atol=1e-6)


def test_binding_a_mesh_leaves_it_where_it_is(tmp_path):
    matrix = np.eye(4)
    matrix[:3] = [[0, 0, 2, 1], [2, 0, 0, 2], [0, 4, 0, 3]]
    source = unskinned_builder(matrix)
    # Three roots: the skin needs a node above them.
    source.tree["nodes"][0]["children"] = []
    source.tree["nodes"][1]["children"] = []
    source.tree["scenes"][0]["nodes"] += [1, 2]
    head = read_head(source.write(tmp_path / "in.glb"))
    head = head.replace(weights=WEIGHTS)
    write_head(tmp_path / "out.glb", head, source=tmp_path / "in.glb")

    tree, blob = unpack(tmp_path / "out.glb")
    skin = tree["skins"][tree["nodes"][3]["skin"]]
    assert skin["joints"] == [0, 1, 2]
    inverse = plain_array(tree, blob, skin["inverseBindMatrices"]).transpose(0, 2, 1)
    joints = [np.eye(4) for _ in range(3)]
    joints[0][:2, :2] = [[0.28, -0.96], [0.96, 0.28]]
    joints[1][1, 3] = joints[2][1, 3] = 1
    joints[2] = joints[2] @ np.diag([1, 2, 3, 1])
    posed = np.stack(joints) @ inverse @ np.append(VERTICES[3], 1)
    np.testing.assert_allclose(
        posed[:, :3], np.tile(head.vertices[3], (3, 1)), atol=1e-6
    )
    root = tree["nodes"][-1]
    assert sorted(root["children"]) == [0, 1, 2]
    assert sorted(tree["scenes"][0]["nodes"]) == [4, 5, 6]
    np.testing.assert_array_equal(read_head(tmp_path / "out.glb").weights, WEIGHTS)


def test_sparse_and_interleaved_accessors(tmp_path):
    builder = skinned_builder()
    attributes = builder.tree["meshes"][0]["primitives"][0]["attributes"]
    record = np.zeros(6, [("p", "<f4", 3), ("j", "u1", 4), ("w", "<f4", 4)])
    record["p"], record["j"] = VERTICES, np.tile([0, 1, 2, 0], (6, 1))
    record["w"][:, :3] = WEIGHTS
    record["p"][[1, 4]] = 99  # the sparse values replace these two
    view = builder.view(record.tobytes(), byteStride=32)
    ids = builder.view(np.array([1, 4], "<u2").tobytes())
    values = builder.view(VERTICES[[1, 4]].tobytes())
    attributes |= {
        "POSITION": builder.accessor(
            6,
            "f4",
            "VEC3",
            bufferView=view,
            sparse={
                "count": 2,
                "indices": {"bufferView": ids, "componentType": 5123},
                "values": {"bufferView": values},
            },
        ),
        "JOINTS_0": builder.accessor(6, "u1", "VEC4", bufferView=view, byteOffset=12),
        "WEIGHTS_0": builder.accessor(6, "f4", "VEC4", bufferView=view, byteOffset=16),
    }
    head = read_head(builder.write(tmp_path / "head.glb"))
    np.testing.assert_array_equal(head.vertices, VERTICES)
    np.testing.assert_array_equal(head.weights, WEIGHTS)


def test_sparse_accessor_without_a_view_starts_from_zero(tmp_path):
    builder = skinned_builder()
    ids = builder.view(np.arange(1, 6, dtype="u1").tobytes())
    values = builder.view(VERTICES[1:].tobytes())
    sparse = {
        "count": 5,
        "indices": {"bufferView": ids, "componentType": 5121},
        "values": {"bufferView": values},
    }
    attributes = builder.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["POSITION"] = builder.accessor(6, "f4", "VEC3", sparse=sparse)
    head = read_head(builder.write(tmp_path / "in.glb"))
    np.testing.assert_array_equal(head.vertices, VERTICES)
    # byteOffset is not allowed where there is no bufferView.
    write_head(tmp_path / "out.glb", head, source=tmp_path / "in.glb")
    tree, _ = unpack(tmp_path / "out.glb")
    assert "byteOffset" not in tree["accessors"][attributes["POSITION"]]
    np.testing.assert_array_equal(read_head(tmp_path / "out.glb").vertices, VERTICES)


def test_influences_on_the_same_joint_add_up(tmp_path):
    builder = skinned_builder()
    attributes = builder.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["JOINTS_0"] = builder.array(np.tile([1, 1, 0, 77], (6, 1)), "u2")
    attributes["WEIGHTS_0"] = builder.array(np.tile([0.5, 0.25, 0.25, 0], (6, 1)))
    head = read_head(builder.write(tmp_path / "head.glb"))
    np.testing.assert_array_equal(head.weights, np.tile([0.25, 0.75, 0], (6, 1)))


def test_parts_that_share_a_skin_are_one_head(tmp_path):
    """A mesh of two primitives that share vertices, and a second mesh."""
    builder = skinned_builder()
    tree = builder.tree
    first = tree["meshes"][0]["primitives"][0]
    other = {
        "attributes": first["attributes"],
        "indices": builder.array([5, 4, 3], "u1"),
    }
    tree["meshes"][0]["primitives"].append(other)
    eye = {
        "POSITION": builder.array(VERTICES[:3] + 10),
        "JOINTS_0": builder.array(np.tile([2, 0, 0, 0], (3, 1)), "u1"),
        "WEIGHTS_0": builder.array(np.tile([1, 0, 0, 0], (3, 1))),
    }
    tree["meshes"].append({"primitives": [{"attributes": eye}]})  # no indices
    tree["nodes"].append({"name": "eye", "mesh": 1, "skin": 1})
    tree["skins"].append(dict(tree["skins"][0]))  # another skin, the same joints
    tree["nodes"].append({"name": "hat", "mesh": 2})  # no skin: not of the head
    tree["meshes"].append(
        {"primitives": [{"attributes": {"POSITION": builder.array(VERTICES)}}]}
    )
    head = read_head(builder.write(tmp_path / "in.glb"))
    np.testing.assert_array_equal(head.vertices, [*VERTICES, *(VERTICES[:3] + 10)])
    assert head.faces.tolist() == [*FACES.tolist(), [5, 4, 3], [6, 7, 8]]
    assert head.weights[6:].tolist() == [[0, 0, 1]] * 3

    weights = np.roll(head.weights, 1, axis=1)
    path = tmp_path / "out.glb"
    write_head(path, head.replace(weights=weights), source=tmp_path / "in.glb")
    np.testing.assert_array_equal(read_head(path).weights, weights)
    tree, _ = unpack(path)
    assert "JOINTS_0" not in tree["meshes"][2]["primitives"][0]["attributes"]


def test_names_are_made_unique(tmp_path):
    builder = skinned_builder()
    for node, name in zip(builder.tree["nodes"], ["bone", None, "bone"], strict=False):
        node["name"] = name
    del builder.tree["nodes"][1]["name"]
    names = read_head(builder.write(tmp_path / "head.glb")).skeleton.names
    assert names == ("bone", "joint_1", "bone.001")


# --- re-skinning ---------------------------------------------------------------------


def assert_contains(new, old, where: str = "") -> None:
    """All that is in the JSON `old` is in `new`; what is a default may be added."""
    if isinstance(old, dict):
        for key, value in old.items():
            assert key in new, f"{where}/{key}"
            assert_contains(new[key], value, f"{where}/{key}")
    elif isinstance(old, list):
        assert len(new) == len(old), where
        for i, value in enumerate(old):
            assert_contains(new[i], value, f"{where}/{i}")
    else:
        assert new == old, where


def test_reskinning_keeps_everything_else(tmp_path):
    source = rich_builder().write(tmp_path / "in.glb")
    old, old_blob = unpack(source)
    head = read_head(source)
    weights = np.roll(WEIGHTS, 1, axis=1)
    write_head(tmp_path / "out.glb", head.replace(weights=weights), source=source)
    np.testing.assert_array_equal(read_head(tmp_path / "out.glb").weights, weights)

    new, new_blob = unpack(tmp_path / "out.glb")
    attributes = old["meshes"][0]["primitives"][0]["attributes"]
    kept = [
        *(id for name, id in attributes.items() if name in ("POSITION", "TEXCOORD_0")),
        old["meshes"][0]["primitives"][0]["targets"][0]["POSITION"],
        old["meshes"][1]["primitives"][0]["attributes"]["POSITION"],
        old["skins"][0]["inverseBindMatrices"],
        *old["animations"][0]["samplers"][0].values(),
    ]
    for accessor in kept:
        np.testing.assert_array_equal(
            plain_array(new, new_blob, accessor), plain_array(old, old_blob, accessor)
        )
    view = new["bufferViews"][new["images"][0]["bufferView"]]
    content = new_blob[view["byteOffset"] :][: view["byteLength"]]
    assert content == b"not really a PNG, but nobody looks inside"
    old_sets = set()
    for i in range(3):  # what was there of the old skin is gone
        old_sets |= {attributes.pop(f"JOINTS_{i}"), attributes.pop(f"WEIGHTS_{i}")}
    for key in ("accessors", "bufferViews", "buffers"):
        del old[key]
    assert_contains(new, old)
    unused = [new["accessors"][id] for id in old_sets - set(kept)]
    assert sorted(accessor["count"] for accessor in unused) == [1, 1, 1, 1, 6, 6]
    written = new["meshes"][0]["primitives"][0]["attributes"]
    assert written.keys() == {*attributes, "JOINTS_0", "WEIGHTS_0"}


def test_reskinning_again_and_again_does_not_grow_the_file(tmp_path):
    path = rich_builder().write(tmp_path / "head.glb")
    head = read_head(path)
    sizes = [path.stat().st_size]
    for _ in range(3):
        write_head(path, head, source=path)
        sizes.append(path.stat().st_size)
    # The three sets of the source become one; what pygltflib adds is under 1 kB.
    assert sizes[1] == sizes[2] == sizes[3] < sizes[0] + 1000


def test_reskinning_spares_accessors_that_others_use(tmp_path):
    builder = skinned_builder()
    tree = builder.tree
    shared = dict(tree["meshes"][0]["primitives"][0]["attributes"])
    tree["meshes"].append({"primitives": [{"attributes": shared}]})
    tree["nodes"].append({"mesh": 1})
    path = builder.write(tmp_path / "head.glb")
    head = read_head(path)
    write_head(path, head.replace(weights=np.roll(WEIGHTS, 1, axis=1)), source=path)
    new, blob = unpack(path)
    weights = plain_array(
        new, blob, new["meshes"][1]["primitives"][0]["attributes"]["WEIGHTS_0"]
    )
    np.testing.assert_array_equal(weights[:, :3], WEIGHTS)


def test_reskinning_finds_bones_by_name(tmp_path):
    source = skinned_builder().write(tmp_path / "in.glb")
    head = read_head(source)
    turned = head.replace(
        skeleton=head.skeleton.reordered([2, 0, 1]), weights=WEIGHTS[:, [2, 0, 1]]
    )
    write_head(tmp_path / "out.glb", turned, source=source)
    np.testing.assert_array_equal(read_head(tmp_path / "out.glb").weights, WEIGHTS)


def renamed(head: Head) -> Head:
    names = ("neck", "head", "chin")
    return head.replace(skeleton=dataclasses.replace(head.skeleton, names=names))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda head: head.replace(weights=None), "weights: the head has none"),
        (
            lambda head: head.replace(vertices=VERTICES + 1),
            "vertices: the source has 6",
        ),
        (lambda head: many_bones(3), "vertices: the source has 6"),
        (renamed, "bone_names: .*'chin'"),
    ],
)
def test_reskinning_another_head_is_refused(tmp_path, change, words):
    source = skinned_builder().write(tmp_path / "in.glb")
    with pytest.raises(HeadError, match=words):
        write_head(tmp_path / "out.glb", change(read_head(source)), source=source)
    assert os.listdir(tmp_path) == ["in.glb"]


@pytest.mark.parametrize(
    ("source", "target", "words"),
    [
        ("in.gltf", "out.glb", "in.gltf: file: a .gltf file cannot be re-skinned"),
        ("in.glb", "out.npz", "cannot be re-skinned into a .npz file"),
        ("none.glb", "out.glb", "none.glb: file: there is no such file"),
    ],
)
def test_only_glb_is_reskinned(tmp_path, source, target, words):
    for name in ("in.glb", "in.gltf"):
        skinned_builder().write(tmp_path / name)
    with pytest.raises(HeadError, match=words):
        write_head(tmp_path / target, HEAD, source=tmp_path / source)


# --- colours, and attributes of your own ----------------------------------------------

COLOURS = np.linspace(0, 1, 18).reshape(6, 3)
SURE = np.array([1, 0.5, 0.25, 0, 0.75, 0.125])
EXTRAS = {"colours": COLOURS, "attributes": {"_CONFIDENCE": SURE}}


def floats(tree: dict, blob: bytes, name: str, mesh: int = 0, part: int = 0):
    """An attribute as numbers, normalised as its accessor says."""
    attributes = tree["meshes"][mesh]["primitives"][part]["attributes"]
    array = plain_array(tree, blob, attributes[name])
    normalized = tree["accessors"][attributes[name]].get("normalized")
    return array / np.iinfo(array.dtype).max if normalized else array


def test_colours_and_attributes_of_a_new_file(tmp_path):
    path = tmp_path / "head.glb"
    write_head(path, HEAD, **EXTRAS)
    assert_same(read_head(path), HEAD)
    tree, blob = unpack(path)
    expected = np.pad(COLOURS, ((0, 0), (0, 1)), constant_values=1)
    np.testing.assert_allclose(floats(tree, blob, "COLOR_0"), expected, atol=0.002)
    np.testing.assert_array_equal(floats(tree, blob, "_CONFIDENCE"), SURE)
    # The same through pygltflib.
    document = pygltflib.GLTF2().load(path)
    attributes = document.meshes[0].primitives[0].attributes
    accessor = document.accessors[attributes.COLOR_0]
    assert (accessor.type, accessor.componentType) == ("VEC4", pygltflib.UNSIGNED_BYTE)
    assert accessor.normalized
    assert document.accessors[attributes._CONFIDENCE].type == "SCALAR"


def test_colours_and_attributes_of_a_npz(tmp_path):
    path = tmp_path / "head.npz"
    write_head(path, HEAD, colours=np.eye(6, 4), attributes={"_CONFIDENCE": SURE})
    assert_same(read_head(path), HEAD, tails_exact=False)
    arrays = np.load(path)
    np.testing.assert_array_equal(arrays["colours"], 255 * np.eye(6, 4))
    np.testing.assert_array_equal(arrays["confidence"], SURE)
    assert read_vertex_mask(path, "_CONFIDENCE").tolist() == (SURE > 0.5).tolist()


def test_the_artists_colours_stay_and_ours_are_written_anew(tmp_path):
    builder = rich_builder()
    primitive = builder.tree["meshes"][0]["primitives"][0]
    painted = np.full((6, 3), 0.25)
    primitive["attributes"]["COLOR_0"] = builder.array(painted)
    source = builder.write(tmp_path / "in.glb")
    path = tmp_path / "out.glb"
    head = read_head(source)
    write_head(path, head, source=source, **EXTRAS)
    size = path.stat().st_size
    for _ in range(2):  # again, onto itself
        write_head(
            path,
            head,
            source=path,
            colours=1 - COLOURS,
            attributes={"_CONFIDENCE": 1 - SURE},
        )
    assert path.stat().st_size == size
    tree, blob = unpack(path)
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    assert sorted(name for name in attributes if "COLOR" in name) == [
        "COLOR_0",
        "COLOR_1",
    ]
    np.testing.assert_array_equal(floats(tree, blob, "COLOR_0"), painted)
    ours = floats(tree, blob, "COLOR_1")[:, :3]
    np.testing.assert_allclose(ours, 1 - COLOURS, atol=0.002)
    np.testing.assert_array_equal(floats(tree, blob, "_CONFIDENCE"), 1 - SURE)
    # Without new ones they go: they told of other weights.
    write_head(path, head, source=path)
    tree, blob = unpack(path)
    attributes = tree["meshes"][0]["primitives"][0]["attributes"]
    assert "COLOR_1" not in attributes and "_CONFIDENCE" not in attributes
    np.testing.assert_array_equal(floats(tree, blob, "COLOR_0"), painted)


def two_parts(**second) -> Builder:
    """The first and the last four vertices of the strip, as parts of one mesh."""
    builder = skinned_builder()
    first = builder.tree["meshes"][0]["primitives"][0]
    attributes = {
        "POSITION": builder.array(VERTICES[2:] + 1),
        "JOINTS_0": builder.array(np.zeros((4, 4)), "u1"),
        "WEIGHTS_0": builder.array(np.eye(4)[[0, 0, 0, 0]]),
    }
    parts = [first, {"attributes": attributes | second}]
    parts[1]["indices"] = builder.array([0, 1, 2], "u2")
    builder.tree["meshes"][0]["primitives"] = parts
    return builder


def test_parts_without_colours_become_white_before_ours(tmp_path):
    builder = two_parts()
    second = builder.tree["meshes"][0]["primitives"][1]
    second["attributes"]["COLOR_0"] = builder.array(np.zeros((4, 3)))
    source = builder.write(tmp_path / "in.glb")
    head = read_head(source)
    colours = np.tile([[0.0, 0.2, 1.0]], (10, 1))
    write_head(tmp_path / "out.glb", head, source=source, colours=colours)
    tree, blob = unpack(tmp_path / "out.glb")
    assert (floats(tree, blob, "COLOR_0", part=0) == 1).all()
    assert (floats(tree, blob, "COLOR_0", part=1) == 0).all()
    for part, count in ((0, 6), (1, 4)):
        ours = floats(tree, blob, "COLOR_1", part=part)
        np.testing.assert_allclose(ours, [[0, 0.2, 1, 1]] * count)


@pytest.mark.parametrize(
    ("extras", "words"),
    [
        ({"colours": np.zeros((5, 3))}, r"colours: an array of shape \(5, 3\)"),
        ({"colours": np.full((6, 3), 255.0)}, "colours: values from 255 to 255"),
        ({"colours": np.full((6, 4), np.nan)}, "colours: values from nan"),
        ({"attributes": {"SURE": SURE}}, "SURE: a name that is not free"),
        ({"attributes": {"_WEIGHTS": SURE}}, "_WEIGHTS: a name that is not free"),
        ({"attributes": {"_A/B": SURE}}, "_A/B: a name that is not free"),
        ({"attributes": {"_SURE": SURE[1:]}}, r"_SURE: float64 values of shape \(5,\)"),
        ({"attributes": {"_SURE": SURE + np.inf}}, "_SURE: NaN or infinity"),
    ],
)
@pytest.mark.parametrize("name", ["out.glb", "out.npz"])
def test_bad_colours_and_attributes(tmp_path, name, extras, words):
    with pytest.raises(HeadError, match=f"{name}: {words}"):
        write_head(tmp_path / name, HEAD, **extras)
    assert os.listdir(tmp_path) == []


MARKED = np.array([0, 1, 1, 0, 0, 1])


@pytest.mark.parametrize("suffix", ["glb", "gltf"])
@pytest.mark.parametrize(
    ("values", "dtype", "options"),
    [
        (MARKED, "f4", {}),
        (MARKED, "u1", {}),
        (MARKED * 255, "u1", {"normalized": True}),
        (MARKED * 0.2 + 0.4, "f4", {}),
    ],
)
def test_a_mask_of_a_gltf_file(tmp_path, suffix, values, dtype, options):
    builder = skinned_builder()
    attributes = builder.tree["meshes"][0]["primitives"][0]["attributes"]
    attributes["_LOCKED"] = builder.array(values, dtype, **options)
    path = builder.write(tmp_path / f"head.{suffix}")
    for name in ("_LOCKED", "locked"):
        mask = read_vertex_mask(path, name)
        assert mask.dtype == bool
        assert mask.tolist() == MARKED.astype(bool).tolist()


def test_a_part_that_lacks_the_attribute_is_not_marked(tmp_path):
    builder = two_parts()
    first = builder.tree["meshes"][0]["primitives"][0]
    first["attributes"]["_LOCKED"] = builder.array(np.ones(6))
    path = builder.write(tmp_path / "head.glb")
    assert len(read_head(path).vertices) == 10
    assert read_vertex_mask(path).tolist() == [True] * 6 + [False] * 4


@pytest.mark.parametrize("values", [MARKED, MARKED > 0, MARKED * 0.7])
def test_a_mask_of_a_npz(tmp_path, values):
    np.savez(tmp_path / "head.npz", **npz_arrays(locked=values))
    for name in ("_LOCKED", "locked"):
        mask = read_vertex_mask(tmp_path / "head.npz", name)
        assert mask.tolist() == MARKED.astype(bool).tolist()


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (MARKED[1:], r"locked: int64 values of shape \(5,\) for 6 vertices"),
        (MARKED.astype(str), "locked: <U.* values"),
        (np.where(MARKED, 1, np.nan), "_LOCKED: vertex 0 has NaN"),
        (MARKED.astype(object), "locked: it holds pickled"),
    ],
)
def test_a_bad_mask(tmp_path, values, words):
    np.savez(tmp_path / "head.npz", **npz_arrays(locked=values))
    with pytest.raises(HeadError, match=f"head.npz: {words}"):
        read_vertex_mask(tmp_path / "head.npz")


def test_a_mask_that_is_no_number_or_too_short(tmp_path):
    for values, words in ((VERTICES, "an accessor of VEC3"), (MARKED[1:], "5 values")):
        builder = skinned_builder()
        attributes = builder.tree["meshes"][0]["primitives"][0]["attributes"]
        attributes["_LOCKED"] = builder.array(values)
        path = builder.write(tmp_path / "head.glb")
        with pytest.raises(HeadError, match=f"head.glb: _LOCKED: {words}"):
            read_vertex_mask(path)


@pytest.mark.parametrize("suffix", ["glb", "npz"])
def test_a_missing_attribute_is_told_with_those_that_are_there(tmp_path, suffix):
    path = tmp_path / f"head.{suffix}"
    write_head(path, HEAD)
    with pytest.raises(HeadError, match=r"_LOCKED: there is no .*, nor any other\."):
        read_vertex_mask(path)
    write_head(path, HEAD, attributes={"_SURE": SURE, "_EDGE": SURE})
    there = "_EDGE, _SURE" if suffix == "glb" else "edge, sure"
    with pytest.raises(HeadError, match=f"vertices, only {there}. Name one"):
        read_vertex_mask(path)


def test_weights_that_sum_to_1_in_a_head_stay_to_the_bit(tmp_path):
    weights = WEIGHTS.copy()
    weights[3] = [0.5, 0.25, 0.2500006]
    head = HEAD.replace(weights=weights)
    np.testing.assert_array_equal(head.weights, weights)
    for name in ("head.glb", "head.npz"):
        write_head(tmp_path / name, head)
        np.testing.assert_array_equal(read_head(tmp_path / name).weights, weights)


BLENDER_SCRIPT = """
import sys
import bpy
import numpy as np

source, target = sys.argv[-2:]
bpy.ops.wm.read_factory_settings(use_empty=True)
bpy.ops.import_scene.gltf(filepath=source)
(mesh,) = [o.data for o in bpy.data.objects if o.type == "MESH" and o.vertex_groups]
sure = [entry.value for entry in mesh.attributes["_CONFIDENCE"].data]
layers = {layer.name: [entry.color[:] for entry in layer.data]
          for layer in mesh.color_attributes}
corners = [loop.vertex_index for loop in mesh.loops]
mesh.attributes.new("_locked", "BOOLEAN", "POINT").data[2].value = True
bpy.ops.export_scene.gltf(filepath=target + ".glb", export_attributes=True)
np.savez(target, sure=sure, corners=corners, **layers)
"""


@pytest.mark.skipif(
    "SKINLIB_BLENDER" not in os.environ,
    reason="SKINLIB_BLENDER names no Blender, nor a Python with bpy",
)
def test_blender_sees_our_colours_and_we_its_attributes(tmp_path):
    builder = skinned_builder()
    primitive = builder.tree["meshes"][0]["primitives"][0]
    primitive["attributes"]["COLOR_0"] = builder.array(np.full((6, 3), 0.25))
    source = builder.write(tmp_path / "in.glb")
    write_head(tmp_path / "out.glb", read_head(source), source=source, **EXTRAS)
    (tmp_path / "script.py").write_text(BLENDER_SCRIPT)
    run_script(
        tmp_path / "script.py", tmp_path / "out.glb", tmp_path / "seen.npz", timeout=300
    )
    seen = np.load(tmp_path / "seen.npz")
    np.testing.assert_allclose(seen["sure"], SURE)
    # Blender keeps 8 bits of a colour, spaced for the eye.
    painted, ours = seen["Color"][:, :3], seen["Color.001"][:, :3]
    np.testing.assert_allclose(painted, 0.25, atol=0.01)
    np.testing.assert_allclose(ours, COLOURS[seen["corners"]], atol=0.01)
    # An attribute `_locked` of Blender's own; its export may split vertices.
    path = tmp_path / "seen.npz.glb"
    mask = read_vertex_mask(path)
    locked = read_head(path).vertices[mask]
    assert len(locked) and np.ptp(locked, axis=0).max() == 0


# --- bad files -----------------------------------------------------------------------


def npz_arrays(**changes) -> dict:
    arrays = {
        "vertices": VERTICES,
        "faces": FACES,
        "bone_names": np.array(["neck", "head", "jaw"]),
        "bone_parents": np.array([-1, 0, 1]),
        "bone_heads": JOINTS,
        "weights": WEIGHTS,
    }
    return {k: v for k, v in (arrays | changes).items() if v is not None}


NAN = VERTICES * np.where(np.arange(6) == 4, np.nan, 1)[:, None]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"bone_parents": np.array([2, 0, 1])}, "bone_parents: .*ancestor"),
        ({"bone_parents": np.array([-1, 0, 3])}, "bone_parents: bone 2 has parent 3"),
        ({"bone_heads": None}, "bone_heads: it is missing"),
        ({"vertices": None}, "vertices: it is missing"),
        ({"vertices": NAN}, "vertices: 1 rows hold NaN.* row 4"),
        ({"bone_heads": JOINTS + np.inf}, "bone_heads: "),
        ({"weights": WEIGHTS * np.nan}, "weights: "),
        ({"weights": WEIGHTS * 0}, "weights: 6 rows do not sum to 1"),
        ({"weights": -WEIGHTS}, "weights: "),
        ({"weights": WEIGHTS[:5]}, r"weights: an array of shape \(5, 3\)"),
        ({"faces": FACES + 1}, "faces: vertex id 6 with 6 vertices"),
        ({"faces": FACES - 1}, "faces: vertex id -1"),
        ({"faces": FACES + 0.5}, "faces: values of type float64"),
        ({"faces": np.zeros((2, 4), int)}, r"faces: an array of shape \(2, 4\)"),
        ({"vertices": VERTICES + 1j}, "vertices: values of type complex64"),
        ({"vertices": VERTICES[:0]}, "vertices: there are none"),
        ({"bone_names": np.array(["neck", "head"])}, "bone_names: "),
        ({"bone_names": np.array(["neck", "head", "neck"])}, "bone_names: 'neck'"),
        ({"bone_names": np.array(["neck", "head", "\ud800"])}, "bone_names: .*Unicode"),
        ({"bone_names": np.arange(3)}, "bone_names: int64"),
        (
            {
                "bone_heads": JOINTS[:0],
                "bone_names": np.array([], str),
                "bone_parents": np.array([], int),
            },
            "bone_heads: there are no bones",
        ),
    ],
)
def test_bad_npz(tmp_path, changes, words):
    np.savez(tmp_path / "bad.npz", **npz_arrays(**changes))
    with pytest.raises(HeadError, match=rf"bad\.npz: {words}"):
        read_head(tmp_path / "bad.npz")


def test_objects_in_npz_are_refused_and_not_unpickled(tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "sprung"),)

    trapped = np.array([Trap(), None, None], dtype=object)
    np.savez(tmp_path / "bad.npz", **npz_arrays(bone_names=trapped))
    with pytest.raises(HeadError, match="bone_names: it holds pickled Python objects"):
        read_head(tmp_path / "bad.npz")
    np.save(tmp_path / "bad.npy", trapped, allow_pickle=True)
    os.replace(tmp_path / "bad.npy", tmp_path / "bad.npz")
    with pytest.raises(HeadError, match=r"file: it is not a \.npz archive"):
        read_head(tmp_path / "bad.npz")
    (tmp_path / "bad.npz").write_bytes(trapped.dumps())
    with pytest.raises(HeadError, match=r"file: it is not a \.npz archive"):
        read_head(tmp_path / "bad.npz")
    assert not (tmp_path / "sprung").exists()


@pytest.mark.parametrize("shape", [(10**9, 3), (10**30, 3), (1000, 3), (-5, 3)])
def test_claimed_shape_is_checked_before_memory_is_taken(tmp_path, shape):
    np.savez(tmp_path / "bad.npz", **npz_arrays(vertices=None))
    with zipfile.ZipFile(tmp_path / "bad.npz", "a") as archive:
        with archive.open("vertices.npy", "w") as file:
            np.lib.format.write_array_header_1_0(
                file, {"descr": "<f4", "fortran_order": False, "shape": shape}
            )
            file.write(b"\0" * 72)
    with pytest.raises(HeadError, match=r"vertices: it claims|malformed"):
        read_head(tmp_path / "bad.npz")


def test_zip_bomb(tmp_path):
    """Zeros without end in a small file: refused before they are unpacked."""
    np.savez(tmp_path / "bad.npz", **npz_arrays(vertices=None))
    with zipfile.ZipFile(tmp_path / "bad.npz", "a", zipfile.ZIP_DEFLATED) as archive:
        with archive.open("vertices.npy", "w", force_zip64=True) as file:
            header = {"descr": "|i1", "fortran_order": False, "shape": (10**8 * 3, 3)}
            np.lib.format.write_array_header_1_0(file, header)
            for _ in range(3):
                file.write(bytes(10**8))
    with pytest.raises(HeadError, match="vertices: it claims the shape"):
        read_head(tmp_path / "bad.npz")


def edit(**changes):
    """An edit of a glTF tree: `nodes__0__name=...` sets tree["nodes"][0]["name"]."""

    def apply(builder: Builder) -> None:
        for place, value in changes.items():
            *way, last = (int(k) if k.isdigit() else k for k in place.split("__"))
            item = builder.tree
            for key in way:
                item = item[key]
            if value is None:
                del item[last]
            else:
                item[last] = value

    return apply


def two_skins(builder: Builder) -> None:
    tree = builder.tree
    tree["skins"] += [{"joints": [0, 1], "name": "eye"}]
    tree["nodes"] += [{"mesh": 0, "skin": 1}]


def no_joints(builder: Builder) -> None:
    builder.tree["nodes"] = [{"mesh": 0}]
    del builder.tree["skins"]


def two_meshes(builder: Builder) -> None:
    no_joints(builder)
    builder.tree["nodes"] += [{"mesh": 0, "name": "hat"}, {"name": "neck"}]


def weights_of(values):
    def apply(builder: Builder) -> None:
        attributes = builder.tree["meshes"][0]["primitives"][0]["attributes"]
        attributes["WEIGHTS_0"] = builder.array(np.tile(values, (6, 1)))

    return apply


def face_ids(values, dtype):
    def apply(builder: Builder) -> None:
        primitive = builder.tree["meshes"][0]["primitives"][0]
        primitive["indices"] = builder.array(values, dtype)

    return apply


def zero_matrices(builder: Builder) -> None:
    matrices = builder.array(np.zeros((3, 4, 4)))
    builder.tree["skins"][0]["inverseBindMatrices"] = matrices


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (two_skins, "skins: 2 skins with different joints .*'eye'.*Join the parts"),
        (two_meshes, "meshes: 2 meshes without a skin .*'hat'.*Join the parts"),
        (no_joints, "joints: the file has a mesh but no joints"),
        (edit(nodes__3__mesh=None), "meshes: no node has a mesh"),
        (edit(nodes__3__mesh=7), "malformed"),
        (edit(nodes__3__skin=-1), "malformed"),
        (edit(skins__0__joints=[0, 1, 1]), "joints: a joint is listed twice"),
        (edit(skins__0__joints=[]), "joints: "),
        (edit(nodes__2__children=[0]), "nodes: the hierarchy has a cycle"),
        (edit(nodes__0__children=[1, 2]), "nodes: node 2 has two parents"),
        (edit(nodes__0__translation=[0, np.inf, 0]), "nodes: a transform that is not"),
        (edit(nodes__0__rotation=[0, 0, 0, 0]), "malformed"),
        (edit(accessors__0__count=10**7), "POSITION: .* leaves its bufferView"),
        (edit(accessors__0__count=10**12), "POSITION: .* at most"),
        (edit(accessors__0__count=0), "POSITION: an accessor with 0 elements"),
        (edit(accessors__0__byteOffset=4), "POSITION: .* leaves its bufferView"),
        (edit(accessors__0__byteOffset=-4), "POSITION: .* leaves its bufferView"),
        (edit(accessors__0__type="VEC2"), "POSITION: an accessor of VEC2"),
        (edit(bufferViews__0__byteStride=0), "POSITION: .* leaves its bufferView"),
        (edit(bufferViews__0__byteLength=10**6), "POSITION: .* leaves its bufferView"),
        (edit(asset__version="1.0"), "asset: glTF version 1.0"),
        (
            edit(extensionsUsed=["KHR_draco_mesh_compression"]),
            "extensionsUsed: the file is compressed with KHR_draco",
        ),
        (edit(meshes__0__primitives__0__mode=1), "primitives: a primitive of mode 1"),
        (
            edit(meshes__0__primitives__0__attributes__POSITION=None),
            "POSITION: a primitive has none",
        ),
        (weights_of([0, 0, 0, 0]), "weights: 6 rows do not sum to 1"),
        (weights_of([3, 0, 0, 0]), "weights: 6 rows do not sum to 1"),
        (weights_of([0.5, 0.5, np.nan, 0]), "weights: 6 rows hold NaN"),
        (weights_of([0.5, 0.25, 0, 0.25]), None),
        (face_ids([0, 1, 6], "u1"), "faces: vertex id 6 with 6 vertices"),
        (face_ids([0, 1, 2, 3], "u1"), "faces: 4 vertex ids"),
        (face_ids([0, 1, 2], "f4"), "faces: 3 vertex ids of type float32"),
        (zero_matrices, "inverseBindMatrices: one of them cannot be inverted"),
    ],
)
def test_bad_glb(tmp_path, change, words):
    builder = skinned_builder()
    change(builder)
    path = builder.write(tmp_path / "bad.glb")
    if words is None:
        assert read_head(path).weights is not None
        return
    with pytest.raises(HeadError, match=rf"bad\.glb: (file: its content is )?{words}"):
        read_head(path)


def test_cut_off_glb_says_so(tmp_path):
    path = skinned_builder().write(tmp_path / "head.glb")
    content = path.read_bytes()
    path.write_bytes(content[:-100])
    found = f"it is cut off: {len(content) - 100} of {len(content)} bytes"
    with pytest.raises(HeadError, match=found):
        read_head(path)


@pytest.mark.parametrize("uri", ["../secret.bin", "/etc/hostname", "none.bin", "."])
def test_buffers_lie_beside_the_gltf(tmp_path, uri):
    builder = skinned_builder()
    (tmp_path / "secret.bin").write_bytes(builder.blob)
    (tmp_path / "in").mkdir()
    builder.tree["buffers"] = [{"byteLength": len(builder.blob), "uri": uri}]
    path = tmp_path / "in" / "head.gltf"
    path.write_text(json.dumps(builder.tree))
    with pytest.raises(HeadError, match=f"buffers: '{re.escape(uri)}' is not a file"):
        read_head(path)


def test_files_that_are_not_there_or_not_ours(tmp_path):
    (tmp_path / "folder.glb").mkdir()
    (tmp_path / "empty.glb").touch()
    (tmp_path / "empty.npz").touch()
    for name, words in {
        "none.glb": "there is no such file",
        "folder.glb": "it is a folder",
        "head.obj": r"ends in '\.obj'\. Use one of \.npz, \.glb",
        "head": "the name has no ending",
        "empty.glb": "malformed",
        "empty.npz": "not a .npz archive",
        "n" * 300 + ".glb": "cannot be read",
        "nul\0.npz": "there is no such file",
    }.items():
        with pytest.raises(HeadError, match=words) as error:
            read_head(tmp_path / name)
        assert error.value.file == str(tmp_path / name)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_unreadable_file(tmp_path):
    write_head(tmp_path / "head.npz", HEAD)
    (tmp_path / "head.npz").chmod(0)
    with pytest.raises(HeadError, match="it cannot be read"):
        read_head(tmp_path / "head.npz")


# --- whole or not at all -------------------------------------------------------------


@pytest.mark.parametrize("name", ["head.npz", "head.glb"])
def test_failed_write_leaves_the_old_file_and_nothing_else(tmp_path, name, monkeypatch):
    write_head(tmp_path / name, HEAD)
    before = (tmp_path / name).read_bytes()

    def full_disk(*args):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "replace", full_disk)
    with pytest.raises(HeadError, match=r"cannot be written .No space left"):
        write_head(tmp_path / name, HEAD.replace(weights=None))
    assert (tmp_path / name).read_bytes() == before
    assert os.listdir(tmp_path) == [name]


def test_places_that_cannot_be_written(tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "folder.glb").mkdir()
    for name, words in {
        "none/head.glb": "cannot be written",
        "file/head.npz": "cannot be written",
        "folder.glb": "it is a folder",
        "head.obj": "ends in '.obj'",
        "head.gltf": "ends in '.gltf'",
    }.items():
        with pytest.raises(HeadError, match=words):
            write_head(tmp_path / name, HEAD)
    assert sorted(os.listdir(tmp_path)) == ["file", "folder.glb"]


@pytest.mark.parametrize("name", ["head.npz", "head.glb"])
def test_what_cannot_be_stored_is_refused(tmp_path, name):
    for bad in ("a\0", "\ud800"):
        skeleton = dataclasses.replace(SKELETON, names=("neck", "head", bad))
        with pytest.raises(HeadError, match=r"bone_names: .* is not Unicode text"):
            write_head(tmp_path / name, HEAD.replace(skeleton=skeleton))
    with pytest.raises(HeadError, match="max_influences: 0"):
        write_head(tmp_path / name, HEAD, max_influences=0)
    assert os.listdir(tmp_path) == []
