"""`.blend` and `.fbx` files in and out, through a Blender in a process of its own.

What is exchanged with Blender is a `.npz` file with the arrays of the data contract
(`skinlib.io.NPZ_KEYS`), in the world space of the scene: one row per vertex of
Blender's mesh, so that weights find their way back into the scene that the head came
from, and everything else in that scene stays as it is.
"""

import contextlib
import os
import uuid
from pathlib import Path

from skinlib.blender.run import run_script
from skinlib.head import HeadError

SCENES = (".blend", ".fbx")
"""What Blender reads and writes for us."""

SCRIPT = Path(__file__).with_name("scene_script.py")


def scene_to_npz(source: Path, npz: Path) -> None:
    """Write the head of a `.blend` or `.fbx` file to a `.npz` file.

    All meshes with an Armature modifier to the same armature become one head; without
    any such mesh the file must hold one mesh and one armature. Where several armatures
    have meshes, the objects that were selected when the file was saved decide.

    The mesh is the one that was modelled (modifiers off, shape keys at rest, the
    armature in its rest pose), faces cut into triangles; the bones are those that
    deform. Weights are scaled to sum 1, as Blender does, and absent when no vertex has
    any. FBX knows no tails of bones, they are NaN then.

    Raises:
        HeadError: no Blender, or a file that it cannot open or that holds no head.
    """
    with _told_of(source):
        run_script(SCRIPT, "read", source.resolve(), npz.resolve())


def npz_to_scene(npz: Path, target: Path, source: Path | None = None) -> None:
    """Write a head to a `.blend` or `.fbx` file; it appears whole or not at all.

    Args:
        npz: the head, in the data contract.
        target: ends in `.blend` or `.fbx`, or in `.glb` when there is a `source`.
        source: a `.blend` or `.fbx` file that the head was read from: the weights
            become the vertex groups of its mesh, everything else in it is kept. Else
            the file holds the head alone.

    Raises:
        HeadError: no Blender, the head does not fit the source, or a file that cannot
            be written.
    """
    _write(target, source, npz)


def glb_to_scene(glb: Path, target: Path) -> None:
    """Convert a `.glb` file, with everything in it, to `.blend` or `.fbx`.

    Raises:
        HeadError: no Blender, or a file that it cannot read or write.
    """
    _write(target, glb, None)


def _write(target: Path, source: Path | None, npz: Path | None) -> None:
    """Let Blender open `source`, put the weights on its head and save it."""
    if target.is_dir():
        raise HeadError("file", "it is a folder", "give the name of a file", target)
    # Beside the target, so that it can take its place and relative paths stay right.
    part = target.resolve().with_name(f".{uuid.uuid4().hex}{target.suffix.lower()}")
    given = [path.resolve() if path else "-" for path in (source, npz)]
    try:
        with _told_of(source or target):
            run_script(SCRIPT, "write", *given, part)
        os.replace(part, target)
    except OSError as error:
        raise HeadError(
            "file",
            f"it cannot be written ({error.strerror})",
            "choose a folder that exists, may be written to and has space",
            target,
        ) from error
    finally:
        for rest in part.parent.glob(f"{part.stem}*"):
            with contextlib.suppress(OSError):
                rest.unlink()


@contextlib.contextmanager
def _told_of(path: Path):
    """Name the file in the errors of the script."""
    try:
        yield
    except HeadError as error:
        raise HeadError(error.field, error.found, error.fix, path) from error
