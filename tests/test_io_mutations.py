"""Files that were damaged by chance: each is read into a sound head, or is refused."""

import copy
import io
import json
import struct
import time
from collections import Counter
from collections.abc import Iterator

import numpy as np
import pytest
from gltf_files import (
    FACES,
    JOINTS,
    VERTICES,
    WEIGHTS,
    rich_builder,
    skinned_builder,
    unpack,
)

from skinlib.head import Head, HeadError, Skeleton
from skinlib.io import read_head, write_head

SKELETON = Skeleton.from_heads_and_tails(JOINTS, None, [-1, 0, 1], ["a", "b", "c"])
HEAD = Head.create(VERTICES, FACES, SKELETON, WEIGHTS)

LEAVES = [
    *(None, True, "", "VEC3", "\ud800", "x" * 1000, [], {}, [[]], [None], {"": 0}),
    *(-1, 0, 1, 2, 3, 7, 255, 5121, 5125, 5126, 65536, 2**31, 2**63, 10**30),
    *(0.5, -0.0, 1e-30, 1e30, 3e38, 1e308, float("nan"), float("inf")),
]


def damage_bytes(content: bytes, rng: np.random.Generator) -> bytes:
    """Flip bits, overwrite, cut out, repeat or cut off."""
    content = bytearray(content)
    start = int(rng.integers(len(content)))
    length = int(rng.integers(1, 64))
    match rng.integers(6):
        case 0:
            for place in rng.integers(len(content), size=rng.integers(1, 9)):
                content[place] ^= 1 << int(rng.integers(8))
        case 1:
            content[start : start + length] = rng.bytes(length)
        case 2:
            fill = [b"\0", b"\xff", b"\x7f"][rng.integers(3)]
            content[start : start + 4] = fill * len(content[start : start + 4])
        case 3:
            del content[start : start + length]
        case 4:
            content[start:start] = content[start : start + length]
        case 5:
            del content[start:]
    return bytes(content)


def damage_numbers(content: bytes, rng: np.random.Generator) -> bytes:
    """Put a strange float or integer where four bytes were."""
    content = bytearray(content)
    place = 4 * int(rng.integers(len(content) // 4))
    floats = [np.nan, np.inf, -np.inf, 3e38, -1e30, 1e-45, -1, 0.1, 2]
    integers = [-1, 0, 1, 5, 6, 7, 255, 65535, 2**31 - 1, -(2**31)]
    if rng.random() < 0.5:
        struct.pack_into("<f", content, place, floats[rng.integers(len(floats))])
    else:
        struct.pack_into("<i", content, place, integers[rng.integers(len(integers))])
    return bytes(content)


def places(item, way=()) -> Iterator[tuple]:
    """The ways to all parts of a JSON document."""
    parts = item.items() if isinstance(item, dict) else enumerate(item)
    for key, value in parts:
        yield (*way, key)
        if isinstance(value, dict | list):
            yield from places(value, (*way, key))


def damage_tree(tree: dict, rng: np.random.Generator) -> dict:
    """Replace, delete, move or repeat one to three parts of a JSON document."""
    tree = copy.deepcopy(tree)
    for _ in range(rng.integers(1, 4)):
        ways = list(places(tree))
        *way, last = ways[rng.integers(len(ways))]
        item = tree
        for key in way:
            item = item[key]
        match rng.integers(5):
            case 0 | 1:
                item[last] = LEAVES[rng.integers(len(LEAVES))]
            case 2:
                del item[last]
            case 3:
                if type(item[last]) in (int, float):
                    item[last] += int(rng.choice([-4, -1, 1, 4, 1000]))
            case 4:
                if isinstance(item, list):
                    item.append(item[last])
        if not tree:
            break
    return tree


def damage_arrays(arrays: dict, rng: np.random.Generator) -> bytes:
    """Change the type, the shape or the values of one array, and save them."""
    arrays = dict(arrays)
    key = list(arrays)[rng.integers(len(arrays))]
    array = arrays[key]
    match rng.integers(6):
        case 0:
            kinds = ["U3", "S2", "f2", "f8", "c8", "i1", "?"]
            array = array.astype(
                rng.choice(kinds[: 2 if array.dtype.kind == "U" else 7])
            )
        case 1:
            array = array[: rng.integers(len(array))]
        case 2:
            array = array.reshape(-1) if array.ndim > 1 else array[:, None]
        case 3:
            array = np.roll(array, 1, axis=-1)
        case 4:
            del arrays[key]
            array = None
        case 5:
            values = np.array([-2, 3, 6, np.nan, np.inf, 3e38, 1e16, 1e-30])
            array = array.astype("U32" if array.dtype.kind == "U" else "f8")
            array.flat[rng.integers(array.size)] = rng.choice(values)
            if rng.random() < 0.5 and array.dtype.kind == "f":
                array = array.astype("i8")
    if array is not None:
        arrays[key] = array
    file = io.BytesIO()
    np.savez(file, **arrays)
    return file.getvalue()


def glb(text: bytes, blob: bytes) -> bytes:
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(blob), b"BIN\0") + blob
    return b"glTF" + struct.pack("<II", 2, 12 + len(chunks)) + chunks


@pytest.fixture(scope="module")
def originals(tmp_path_factory):
    """Sound files: ours, another hand's, and an archive that is not compressed."""
    folder = tmp_path_factory.mktemp("originals")
    write_head(folder / "ours.glb", HEAD)
    write_head(folder / "ours.npz", HEAD)
    skinned_builder().write(folder / "foreign.glb")
    with np.load(folder / "ours.npz") as arrays:
        np.savez(folder / "plain.npz", **arrays)
    return folder


def mutations(originals, seed: int) -> Iterator[tuple[str, bytes]]:
    """(suffix, content) of 2,400 damaged files."""
    rng = np.random.default_rng(seed)
    for name in ("ours.npz", "plain.npz"):
        content = (originals / name).read_bytes()
        for _ in range(300):
            yield ".npz", damage_bytes(content, rng)
    for _ in range(200):
        yield ".npz", damage_numbers(content, rng)
    with np.load(originals / "plain.npz") as archive:
        arrays = dict(archive)
    for _ in range(300):
        with np.errstate(all="ignore"):
            yield ".npz", damage_arrays(arrays, rng)
    for name in ("ours.glb", "foreign.glb"):
        content = (originals / name).read_bytes()
        tree, blob = unpack(originals / name)
        text = json.dumps(tree).encode()
        for _ in range(150):
            yield ".glb", damage_bytes(content, rng)
            yield ".glb", glb(damage_bytes(text, rng), blob)
            yield ".glb", glb(text, damage_numbers(blob, rng))
        for _ in range(200):
            yield ".glb", glb(json.dumps(damage_tree(tree, rng)).encode(), blob)


def assert_sound(head: Head) -> None:
    skeleton = head.skeleton
    for array in (head.vertices, head.normals, skeleton.joints, skeleton.tails):
        assert np.isfinite(array).all()
    assert np.isfinite(skeleton.lengths).all() and (skeleton.lengths >= 0).all()
    assert np.isfinite(skeleton.directions).all()
    assert skeleton.depths.max() < len(skeleton)
    # Passing through the door again changes nothing.
    again = head.replace(name="again")
    np.testing.assert_array_equal(again.vertices, head.vertices)
    if head.weights is not None:
        assert (head.weights >= 0).all()
        np.testing.assert_allclose(head.weights.sum(axis=1), 1, atol=1e-5)


def test_damaged_files_are_read_or_refused(tmp_path, originals):
    outcomes = Counter()
    for number, (suffix, content) in enumerate(mutations(originals, seed=0)):
        path = tmp_path / f"damaged{suffix}"
        path.write_bytes(content)
        start = time.perf_counter()
        try:
            assert_sound(read_head(path))
            outcomes[suffix, "read"] += 1
        except HeadError as error:
            assert error.file == str(path), error
            assert error.field and error.found and error.fix
            outcomes[suffix, "refused"] += 1
        except Exception as error:
            pytest.fail(f"file {number}{suffix}: {type(error).__name__}: {error}")
        assert time.perf_counter() - start < 5, f"file {number}{suffix} took too long"
    assert sum(outcomes.values()) >= 2000
    # Neither all refused nor all accepted: the damage was of both kinds.
    assert min(outcomes.values()) > 100, outcomes


def test_a_damaged_source_is_reskinned_or_refused(tmp_path):
    tree, blob = unpack(rich_builder().write(tmp_path / "rich.glb"))
    source, target = tmp_path / "source.glb", tmp_path / "target.glb"
    rng = np.random.default_rng(0)
    outcomes = Counter()
    for _ in range(300):
        source.write_bytes(glb(json.dumps(damage_tree(tree, rng)).encode(), blob))
        target.unlink(missing_ok=True)
        try:
            head = read_head(source)
            weights = np.eye(len(head.skeleton))[np.full(len(head.vertices), -1)]
            write_head(target, head.replace(weights=weights), source=source)
        except HeadError:
            outcomes["refused"] += 1
            assert not target.exists()
        else:
            outcomes["written"] += 1
            np.testing.assert_array_equal(read_head(target).weights, weights)
        assert {path.suffix for path in tmp_path.iterdir()} == {".glb"}
    assert min(outcomes.values()) > 50, outcomes
