"""Heads in and out of files: `.npz`, skinned glTF 2.0 (`.glb`, and `.gltf` to read)
and, where Blender is at hand, `.blend` and `.fbx`.

A `.npz` holds the arrays of the data contract under the names in `NPZ_KEYS`; what is
read of the others, and how, is told in `skinlib.gltf` and `skinlib.blender.files`.
"""

import contextlib
import math
import os
import re
import tempfile
import uuid
import zipfile
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import BinaryIO

import numpy as np

from skinlib import gltf
from skinlib.blender.files import SCENES, glb_to_scene, npz_to_scene, scene_to_npz
from skinlib.blender.run import find_blender
from skinlib.head import Head, HeadError, Skeleton

NPZ_KEYS = (
    "vertices",
    "faces",
    "normals",
    "bone_names",
    "bone_parents",
    "bone_heads",
    "bone_tails",
    "weights",
)
NPZ_OPTIONAL = {"normals", "bone_tails", "weights"}
COLOURS = "colours"

LOCKED = "_LOCKED"
"""The attribute that marks vertices whose weights an artist wants to keep."""


def read_head(path: str | Path, weights: bool = True) -> Head:
    """Read a head from a `.npz`, `.glb`, `.gltf`, `.blend` or `.fbx` file.

    Its name is the file's stem.

    Args:
        weights: False passes the file's weights over, so that a head that is only
            half painted can be read too.

    Raises:
        HeadError: the file cannot be read, or what it holds is not a head.
    """
    readers = {".npz": read_npz, ".glb": read_glb, ".gltf": read_glb}
    readers |= dict.fromkeys(SCENES, read_blender)
    return _by_suffix(readers, path)(path, weights)


def read_vertex_mask(path: str | Path, name: str = LOCKED) -> np.ndarray:
    """(V,) bool: the vertices that a file marks, in the order of `read_head`.

    A .glb or .gltf has a custom attribute of that name, one number a vertex (Blender
    writes attributes whose name begins with `_` when Data > Mesh > Attributes is
    ticked); a .npz has it as a field. Capitals and leading underscores do not count:
    `_LOCKED` is the field `locked` too.

    Returns:
        True where the number is above 0.5; False on parts of the mesh that lack it.

    Raises:
        HeadError: the file cannot be read, or has no such attribute.
    """
    readers = {".npz": _npz_attribute, ".glb": gltf.read_attribute}
    readers[".gltf"] = gltf.read_attribute
    readers |= dict.fromkeys(SCENES, _blender_attribute)
    read, path = _by_suffix(readers, path), _existing_file(path)
    with _malformed(path, "write or export it again"):
        values = read(path, name)
        if not np.isfinite(values).all():
            vertex = int(np.flatnonzero(~np.isfinite(values))[0])
            raise HeadError(
                name, f"vertex {vertex} has NaN or infinity", "export it again", path
            )
        return values > 0.5


def write_head(
    path: str | Path,
    head: Head,
    source: str | Path | None = None,
    max_influences: int | None = None,
    colours: np.ndarray | None = None,
    attributes: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write a head to a `.npz`, `.glb`, `.blend` or `.fbx` file, whole or not at all.

    Args:
        path: where to; a file that is there already is replaced.
        head: what to write.
        source: a `.glb`, `.blend` or `.fbx` file to re-skin: everything in it is kept
            (materials, morph targets, animations, other meshes, ...) and the weights
            of `head` are put on its mesh. `head` must have its vertices and its bones.
        max_influences: keep this many of a vertex's largest weights; None keeps all.
        colours: (V, 3) or (V, 4), from 0 to 1, linear RGB or RGBA: COLOR_0 of a `.glb`,
            or the next COLOR_n where the artist has painted; the field `colours` of a
            `.npz`. What an earlier call wrote so, and `_CONFIDENCE`, goes in any case.
        attributes: (V,) numbers by name, such as `_CONFIDENCE`, which Blender shows
            under that name; the field `confidence` of a `.npz`.

    Raises:
        HeadError: the file cannot be written, or `head` does not fit `source`.
    """
    write = _by_suffix(WRITERS, path)
    options = (max_influences, colours, attributes)
    if source is None:
        write(path, head, *options)
    elif write is not write_npz:
        if Path(source).suffix.lower() in SCENES:
            write = write_blender
        write(path, head, *options, source=source)
    else:
        raise HeadError(
            "file",
            f"the source {source} cannot be re-skinned into a .npz file",
            "give the output the ending of the source, or leave the source out",
            path,
        )


def check_target(path: str | Path) -> None:
    """Tell before long work what would keep `write_head` from writing.

    Raises:
        HeadError: a wrong ending, a folder that cannot be written to, or no Blender
            where one is needed.
    """
    if _by_suffix(WRITERS, path) is write_blender:
        find_blender()
    folder = Path(path).parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise HeadError(
            "file",
            f"the folder {str(folder)!r} does not exist or is read-only",
            "choose a folder that exists and may be written to",
            path,
        )


def _by_suffix(functions: dict[str, Callable], path: str | Path) -> Callable:
    suffix = Path(path).suffix.lower()
    if suffix not in functions:
        raise HeadError(
            "file",
            f"the name ends in {suffix!r}" if suffix else "the name has no ending",
            f"use one of {', '.join(functions)}",
            path,
        )
    return functions[suffix]


# --- .npz ---------------------------------------------------------------------------


def read_npz(path: str | Path, weights: bool = True) -> Head:
    """Read a head from a `.npz` file with the arrays `NPZ_KEYS`; pickles are refused.

    `normals`, `bone_tails` and `weights` may be absent.

    Raises:
        HeadError: the file cannot be read, or what it holds is not a head.
    """
    path = _existing_file(path)
    if not zipfile.is_zipfile(path):
        raise HeadError(
            "file",
            "it is not a .npz archive",
            "write it again with numpy.savez, it may be cut off or a renamed pickle",
            path,
        )
    with _malformed(path, "write the file again with numpy.savez_compressed"):
        with zipfile.ZipFile(path) as archive:
            arrays = {key: _npz_array(archive, key, path) for key in NPZ_KEYS}
        names, heads = arrays["bone_names"], arrays["bone_heads"]
        if names.shape != heads.shape[:1] or names.dtype.kind not in "US":
            raise HeadError(
                "bone_names",
                f"{names.dtype} values of shape {names.shape}",
                "store one string per row of bone_heads",
                path,
            )
        if names.dtype.kind == "S":
            names = np.char.decode(names, "utf-8")
        return Head.create(
            arrays["vertices"],
            arrays["faces"],
            Skeleton.from_heads_and_tails(
                heads,
                arrays["bone_tails"],
                arrays["bone_parents"],
                _checked_names(names.tolist(), path),
                file=path,
            ),
            weights=arrays["weights"] if weights else None,
            normals=arrays["normals"],
            name=path.stem,
            file=path,
        )


def _npz_array(archive: zipfile.ZipFile, key: str, path: Path) -> np.ndarray | None:
    """One array of the archive; its header is judged before memory is taken."""
    try:
        member = archive.getinfo(f"{key}.npy")
    except KeyError:
        if key in NPZ_OPTIONAL:
            return None
        raise HeadError(
            key, "it is missing", f"save the arrays {', '.join(NPZ_KEYS)}", path
        ) from None
    with archive.open(member) as file:
        version = np.lib.format.read_magic(file)
        if version == (1, 0):
            shape, _, dtype = np.lib.format.read_array_header_1_0(file)
        else:
            shape, _, dtype = np.lib.format.read_array_header_2_0(file)
    if dtype.hasobject:
        raise HeadError(
            key,
            "it holds pickled Python objects, which can run code when they are read",
            "save numbers and strings only: dtype=object is refused",
            path,
        )
    elements = math.prod(shape)
    if elements > gltf.MAX_ELEMENTS or elements * dtype.itemsize > member.file_size:
        raise HeadError(
            key,
            f"it claims the shape {shape}",
            f"store at most {gltf.MAX_ELEMENTS} numbers, and no fewer than it claims",
            path,
        )
    with archive.open(member) as file:
        return np.lib.format.read_array(file, allow_pickle=False)


def _npz_attribute(path: Path, name: str) -> np.ndarray:
    """(V,) values of a field that is none of `NPZ_KEYS`."""
    with zipfile.ZipFile(path) as archive:
        fields = {name.removesuffix(".npy") for name in archive.namelist()}
        fields -= {*NPZ_KEYS, COLOURS}
        gltf.check_attribute(name, fields, "save it as a field", path)
        key = next(f for f in fields if gltf.plain_name(f) == gltf.plain_name(name))
        values = _npz_array(archive, key, path)
        count = len(_npz_array(archive, "vertices", path))
    if values.shape != (count,) or values.dtype.kind not in "biuf":
        raise HeadError(
            key,
            f"{values.dtype} values of shape {values.shape} for {count} vertices",
            "store one number or truth value per vertex",
            path,
        )
    return values


def write_npz(
    path: str | Path,
    head: Head,
    max_influences: int | None = None,
    colours: np.ndarray | None = None,
    attributes: Mapping[str, np.ndarray] | None = None,
) -> None:
    """Write a head to a compressed `.npz` file with the arrays `NPZ_KEYS`.

    `colours` is (V, 4) uint8; `attributes` are float32 fields, see `write_head`.

    Raises:
        HeadError: the file cannot be written.
    """
    skeleton = head.skeleton
    colours = _checked_colours(colours, len(head.vertices), path)
    attributes = _checked_attributes(attributes, len(head.vertices), path)
    arrays = {
        "vertices": head.vertices,
        "faces": head.faces,
        "normals": head.normals,
        "bone_names": np.array(_checked_names(skeleton.names, path)),
        "bone_parents": skeleton.parents,
        "bone_heads": skeleton.joints,
        "bone_tails": skeleton.tails,
    }
    if head.weights is not None:
        bones, values = gltf.sorted_influences(head.weights, max_influences)
        weights = np.zeros_like(head.weights)
        np.add.at(weights, (np.arange(len(weights))[:, None], bones), values)
        arrays["weights"] = weights
    if colours is not None:
        arrays[COLOURS] = colours
    arrays |= {gltf.plain_name(name): values for name, values in attributes.items()}
    with atomic(path) as file:
        np.savez_compressed(file, **arrays)


# --- glTF ---------------------------------------------------------------------------


def read_glb(path: str | Path, weights: bool = True) -> Head:
    """Read a head from a `.glb` file, or from a `.gltf` file and what lies beside it.

    All meshes bound to the same skin become one head; its vertices are those of their
    primitives, one after the other. Meshes without a skin are passed over when there is
    one with a skin. `weights` is None when no vertex has any.

    Raises:
        HeadError: the file cannot be read, or does not hold one head with joints.
    """
    path = _existing_file(path)
    with _malformed(path, "export it again as binary glTF 2.0"):
        return gltf.read(path, weights)


def write_glb(
    path: str | Path,
    head: Head,
    max_influences: int | None = None,
    colours: np.ndarray | None = None,
    attributes: Mapping[str, np.ndarray] | None = None,
    source: str | Path | None = None,
) -> None:
    """Write a head to a `.glb` file; see `write_head`.

    Influences are sorted, largest first, four to a JOINTS_n/WEIGHTS_n pair.

    Raises:
        HeadError: the file cannot be written, or `head` does not fit `source`.
    """
    _checked_names(head.skeleton.names, path)
    colours = _checked_colours(colours, len(head.vertices), path)
    attributes = _checked_attributes(attributes, len(head.vertices), path)
    if source is None:
        content = gltf.new_file(head, max_influences, colours, attributes)
    else:
        source = _existing_file(source)
        with _malformed(source, "export it again as binary glTF 2.0"):
            content = gltf.reskinned(source, head, max_influences, colours, attributes)
    with atomic(path) as file:
        file.write(content)


# --- .blend and .fbx ----------------------------------------------------------------


def read_blender(path: str | Path, weights: bool = True) -> Head:
    """Read a head from a `.blend` or `.fbx` file, as `scene_to_npz` says.

    Raises:
        HeadError: no Blender, or a file that it cannot open or that holds no head.
    """
    path = _existing_file(path)
    with _exchange(path) as npz:
        scene_to_npz(path, npz)
        return read_npz(npz, weights).replace(name=path.stem)


def _blender_attribute(path: Path, name: str) -> np.ndarray:
    """(V,) bool: what the vertex group or attribute `_LOCKED` marks."""
    with _exchange(path) as npz:
        scene_to_npz(path, npz)
        return _npz_attribute(npz, name)


def write_blender(
    path: str | Path,
    head: Head,
    max_influences: int | None = None,
    colours: np.ndarray | None = None,
    attributes: Mapping[str, np.ndarray] | None = None,
    source: str | Path | None = None,
) -> None:
    """Write a head to a `.blend` or `.fbx` file, or into a scene; see `write_head`.

    Raises:
        HeadError: no Blender, the head does not fit `source`, or the file cannot be
            written.
    """
    path = Path(path)
    options = (max_influences, colours, attributes)
    source = None if source is None else _existing_file(source)
    with _exchange(path) as npz:
        if source is not None and source.suffix.lower() not in SCENES:
            write_glb(npz.with_suffix(".glb"), head, *options, source=source)
            glb_to_scene(npz.with_suffix(".glb"), path)
        else:
            write_npz(npz, head, *options)
            npz_to_scene(npz, path, source)


@contextlib.contextmanager
def _exchange(path: Path) -> Iterator[Path]:
    """A `.npz` to hand over to Blender; what is wrong with it is wrong with `path`."""
    with tempfile.TemporaryDirectory(prefix="skinlib_") as folder:
        npz = Path(folder, "head.npz")
        try:
            yield npz
        except HeadError as error:
            if error.file != str(npz):
                raise
            raise HeadError(error.field, error.found, error.fix, path) from error


WRITERS = {".npz": write_npz, ".glb": write_glb}
WRITERS |= dict.fromkeys(SCENES, write_blender)


# --- files --------------------------------------------------------------------------


def _existing_file(path: str | Path) -> Path:
    path = Path(path)
    try:
        if path.is_dir():
            found, fix = "it is a folder", "give the name of a file in it"
        elif not path.is_file():
            found, fix = "there is no such file", "check the name and the folder"
        else:
            with path.open("rb"):
                return path
    except OSError as error:
        found, fix = f"it cannot be read ({error.strerror})", "check its permissions"
    raise HeadError("file", found, fix, path)


@contextlib.contextmanager
def _malformed(path: Path, fix: str) -> Iterator[None]:
    """Make a HeadError of whatever the libraries raise on a malformed file."""
    try:
        with np.errstate(all="ignore"):
            yield
    except HeadError:
        raise
    except Exception as error:
        found = f"its content is malformed ({type(error).__name__}: {str(error)[:200]})"
        raise HeadError("file", found, fix, path) from error


@contextlib.contextmanager
def atomic(path: str | Path) -> Iterator[BinaryIO]:
    """A file to write to, which becomes `path` when all went well."""
    path = Path(path)
    if path.is_dir():
        raise HeadError("file", "it is a folder", "give the name of a file", path)
    part = path.parent / f".{uuid.uuid4().hex}.part"
    try:
        with part.open("xb") as file:
            yield file
        os.replace(part, path)
    except OSError as error:
        raise HeadError(
            "file",
            f"it cannot be written ({error.strerror})",
            "choose a folder that exists, may be written to and has space",
            path,
        ) from error
    finally:
        with contextlib.suppress(OSError):
            part.unlink()


def _checked_names(names, path: str | Path) -> list[str]:
    """Names that every format can hold."""
    for name in names:
        try:
            name.encode()
        except UnicodeEncodeError:
            sound = False
        else:
            sound = "\0" not in name
        if not sound:
            raise HeadError(
                "bone_names",
                f"{name!r} is not Unicode text",
                "rename the bone without NUL characters and lone surrogates",
                path,
            )
    return list(names)


def _checked_colours(
    colours: np.ndarray | None, count: int, path: str | Path
) -> np.ndarray | None:
    """(V, 4) uint8, opaque where no alpha is given."""
    if colours is None:
        return None
    colours = np.asarray(colours, np.float64)
    if colours.shape not in ((count, 3), (count, 4)):
        found = f"an array of shape {colours.shape}"
    elif not ((colours >= 0) & (colours <= 1)).all():
        found = f"values from {colours.min():.4g} to {colours.max():.4g}"
    else:
        padded = np.ones((count, 4))
        padded[:, : colours.shape[1]] = colours
        return np.round(255 * padded).astype(np.uint8)
    fix = f"give RGB or RGBA from 0 to 1 for each of the {count} vertices"
    raise HeadError(COLOURS, found, fix, path)


def _checked_attributes(
    attributes: Mapping[str, np.ndarray] | None, count: int, path: str | Path
) -> dict[str, np.ndarray]:
    """(V,) float32 by name."""
    checked = {}
    for name, values in (attributes or {}).items():
        values = np.asarray(values)
        taken = gltf.plain_name(name) in {*NPZ_KEYS, COLOURS}
        if not re.fullmatch(r"_\w*[^\W_]", name, re.ASCII) or taken:
            found, fix = "a name that is not free", "name it like _CONFIDENCE"
        elif values.shape != (count,) or values.dtype.kind not in "biuf":
            found = f"{values.dtype} values of shape {values.shape}"
            fix = f"give a number for each of the {count} vertices"
        elif not np.isfinite(values).all():
            found, fix = "NaN or infinity", "give finite numbers"
        else:
            checked[name] = values.astype(np.float32)
            continue
        raise HeadError(name, found, fix, path)
    return checked
