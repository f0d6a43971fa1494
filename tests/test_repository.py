"""What can be said about the files without running them.

Style (ruff), who may import whom, how the notebooks were committed, what no file may
hold, and whether the samples are the ones that were shipped.
"""

import ast
import hashlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "skinlib"

# Top to bottom: a file imports only from its own room and from rooms above it.
ROOMS = (
    "geometry",
    "head",
    "paths",
    "blender",
    "graph",
    "voxels",
    "skinning",
    "painting",
    "gltf",
    "io",
    "animation",
    "datasets",
    "model",
    "losses",
    "evaluate",
    "training",
    "headbench",
    "garments",
    "pose_transfer",
    "views",
    "exercises",
    "check",
    "demo",
    "cli",
    "__main__",
)
DRAWING = {"matplotlib", "pyvista", "vtk", "ipywidgets", "IPython"}


def repository_files() -> list[Path]:
    """Files that git tracks or would track; all files where there is no git."""
    command = ["git", "ls-files", "--cached", "--others", "--exclude-standard", "-z"]
    try:
        listing = subprocess.run(command, cwd=ROOT, capture_output=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return [path for path in ROOT.rglob("*") if path.is_file()]
    names = sorted(filter(None, listing.stdout.decode().split("\0")))
    return [ROOT / name for name in names if (ROOT / name).is_file()]


FILES = repository_files()


def named(paths: list[Path]) -> dict:
    return {"argvalues": paths, "ids": [str(p.relative_to(ROOT)) for p in paths]}


@pytest.mark.parametrize("command", [["check"], ["format", "--check"]])
def test_ruff_has_nothing_to_say(command):
    ruff = [sys.executable, "-m", "ruff", *command, "--no-cache"]
    result = subprocess.run(ruff, cwd=ROOT, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


# ---------------------------------------------------------------- who imports whom


def imports(source: str) -> set[str]:
    """Dotted names of everything a module imports, inside functions too."""
    found = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert not node.level, "relative import: write `from skinlib...`"
            found |= {f"{node.module}.{alias.name}" for alias in node.names}
    return found


def room_faults(room: str, source: str) -> list[str]:
    """Imports in a module of `room` that come from a room below, or draw."""
    faults = []
    for name in sorted(imports(source)):
        top, _, rest = name.partition(".")
        if top in DRAWING and room != "views":
            faults.append(f"{name}: only skinlib/views draws")
        other = rest.partition(".")[0]
        if top == "skinlib" and other in ROOMS:
            if ROOMS.index(other) > ROOMS.index(room):
                faults.append(f"{name}: {other} is below {room}")
    return faults


MODULES = [
    path
    for path in FILES
    if path.suffix == ".py" and PACKAGE in path.parents and path.parent != PACKAGE
] + [path for path in FILES if path.suffix == ".py" and path.parent == PACKAGE]


@pytest.mark.parametrize("path", **named(MODULES))
def test_a_file_imports_only_from_rooms_above_it(path):
    room = path.relative_to(PACKAGE).parts[0].removesuffix(".py")
    if room == "__init__":
        allowed = {"skinlib.head.Head", "skinlib.head.HeadError"}
        allowed |= {"skinlib.head.Skeleton"}
        assert imports(path.read_text()) <= allowed
        return
    assert room in ROOMS, f"give {room} its place in ROOMS"
    assert room_faults(room, path.read_text()) == []


def test_the_room_rule_can_fail():
    assert room_faults("head", "from skinlib.io import read_head")
    assert room_faults("io", "def f():\n    import matplotlib.pyplot as plt")
    assert room_faults("io", "from skinlib import head, views")
    assert not room_faults("views", "import pyvista\nfrom skinlib.head import Head")


# ---------------------------------------------------------------- what no file holds

TEXT = {".py", ".md", ".ipynb", ".toml", ".yml", ".yaml", ".txt", ".json", ".sh", ""}
# A home, temporary or mounted folder of whoever wrote the file.
MACHINE_PATH = re.compile(
    r"(?<![\w.~/])/(?:root|home|Users|tmp|work|mnt)/\w|\b[A-Z]:\\{1,2}Users"
)
# The brackets keep this line from finding itself.
UNFINISHED = re.compile(r"\bTO[D]O\b|\bFIX[M]E\b|\bXX[X]\b")


@pytest.mark.parametrize("path", **named([p for p in FILES if p.suffix in TEXT]))
def test_no_machine_path_and_nothing_unfinished(path):
    text = path.read_text(encoding="utf-8")
    for pattern in (MACHINE_PATH, UNFINISHED):
        found = pattern.search(text)
        assert not found, f"line {text.count(chr(10), 0, found.start()) + 1}: {found}"


def test_machine_paths_are_recognised():
    assert MACHINE_PATH.search("/".join(["see ", "home", "ada", "heads"]))
    assert not MACHINE_PATH.search("see data/home/ada and https://a.org/tmp/x")


@pytest.mark.parametrize("path", **named(FILES))
def test_no_file_is_too_big_to_clone(path):
    assert path.stat().st_size < 10_000_000


# ---------------------------------------------------------------- samples and weights


def checksum_files() -> list[Path]:
    return [path for path in FILES if path.name == "SHA256SUMS"]


@pytest.mark.parametrize("path", **named(checksum_files()))
def test_shipped_files_have_their_checksum(path):
    for line in path.read_text().splitlines():
        digest, name = line.split(maxsplit=1)
        content = (path.parent / name.lstrip("*")).read_bytes()
        assert hashlib.sha256(content).hexdigest() == digest, f"{name} has changed"


@pytest.mark.parametrize("folder", ["data_samples", "checkpoints"])
def test_each_shipped_file_is_listed(folder):
    root = ROOT / folder
    if not root.is_dir():
        pytest.skip(f"no {folder}/")
    lines = (root / "SHA256SUMS").read_text().splitlines()
    listed = {root / line.split(maxsplit=1)[1].lstrip("*") for line in lines}
    binary = {".npz", ".glb", ".safetensors"}
    assert {p for p in FILES if root in p.parents and p.suffix in binary} <= listed
