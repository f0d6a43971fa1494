"""Find a Blender, and run a script inside it."""

import contextlib
import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

from skinlib.head import HeadError

VARIABLE = "SKINLIB_BLENDER"
INSTALL = (
    f"install Blender from blender.org, or `pip install bpy` into an environment of "
    f"its own, and let {VARIABLE} name the program `blender` or that Python"
)
# Nothing but the script; its errors end Blender instead of being printed only.
BINARY_OPTIONS = ["--background", "--factory-startup", "--python-exit-code", "3"]


def find_blender(given: str | None = None) -> list[str]:
    """The command that a script's path is appended to, to run it inside Blender.

    Args:
        given: a `blender` program, or a Python that has the module `bpy`; else what
            the environment variable SKINLIB_BLENDER names, this Python if it has
            `bpy`, or the `blender` on the PATH.

    Raises:
        HeadError: there is none; it says how to get one.
    """
    given = given or os.environ.get(VARIABLE)
    if not given and importlib.util.find_spec("bpy"):
        return [sys.executable]
    program = shutil.which(given or "blender")
    if program is None:
        found = f"there is no program {given!r}" if given else "it was not found"
        raise HeadError("Blender", found, INSTALL)
    if Path(program).name.lower().startswith("blender"):
        return [program, *BINARY_OPTIONS, "--python"]
    return [program]


def run_script(
    script: str | Path,
    *arguments: str | Path,
    blender: str | None = None,
    timeout: float = 600,
) -> None:
    """Run a Python script inside Blender and wait for its end.

    The script finds `arguments` in `sys.argv` behind a "--". What it prints is not
    shown. To fail with an error of its own it ends with a status other than 0, after a
    line "skinlib: " and a JSON object with the field, found and fix of a HeadError.

    Args:
        blender: see `find_blender`.
        timeout: seconds after which Blender is stopped.

    Raises:
        HeadError: no Blender; or the script failed, crashed or took too long.
    """
    command = [*find_blender(blender), str(script), "--", *map(str, arguments)]
    try:
        child = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            timeout=timeout,
            text=True,
            errors="replace",
        )
    except subprocess.TimeoutExpired:
        raise HeadError(
            "Blender",
            f"it did not end within {timeout:g} seconds",
            "try a smaller file",
        ) from None
    except OSError as error:
        raise HeadError(
            "Blender", f"{command[0]} does not start ({error.strerror})", INSTALL
        ) from error
    if child.returncode:
        raise _failure(child)


def _failure(child: subprocess.CompletedProcess) -> HeadError:
    """What a script that failed said last, as an error."""
    lines = [
        line.strip()
        for line in (child.stdout + "\n" + child.stderr).splitlines()
        if line.strip()
    ]
    for line in reversed(lines):
        with contextlib.suppress(ValueError, TypeError):
            return HeadError(**json.loads(line.removeprefix("skinlib: ")))
    if child.returncode < 0 or child.returncode > 128:
        found = f"it crashed (exit status {child.returncode})"
    else:
        errors = [line for line in lines if "Error: " in line]
        last = (errors or lines or [f"exit status {child.returncode}"])[-1]
        found = f"it failed with {last[:300]!r}"
    return HeadError(
        "Blender", found, "see whether the file opens in Blender, and what it says"
    )
