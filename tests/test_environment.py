"""pyproject.toml, environment.yml and constraints.txt say the same."""

import ast
import re
import sys
import tomllib
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.specifiers import SpecifierSet
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = PROJECT["optional-dependencies"]
CONDA = yaml.safe_load((ROOT / "environment.yml").read_text())["dependencies"]
CONSTRAINTS = (ROOT / "constraints.txt").read_text().splitlines()


def ranges(requirements: list[str]) -> dict[str, SpecifierSet]:
    parsed = map(Requirement, requirements)
    return {canonicalize_name(one.name): one.specifier for one in parsed}


def direct_dependencies() -> dict[str, SpecifierSet]:
    return ranges(PROJECT["dependencies"] + EXTRAS["notebooks"] + EXTRAS["test"])


def test_environment_yml_lists_the_direct_dependencies_and_no_other():
    pip = next(entry["pip"] for entry in CONDA if isinstance(entry, dict))
    assert pip[0] == "-e ."
    assert ranges(pip[1:]) == direct_dependencies()


def test_environment_yml_asks_for_the_same_python():
    python = Requirement(next(e for e in CONDA if str(e).startswith("python")))
    assert python.specifier == SpecifierSet(PROJECT["requires-python"])


def test_each_dependency_in_environment_yml_has_its_reason():
    lines = (ROOT / "environment.yml").read_text().splitlines()
    bare = [line for line in lines if re.match(r" {6}- ", line) and " # " not in line]
    assert bare == []


def test_each_cap_in_environment_yml_says_why():
    lines = (ROOT / "environment.yml").read_text().splitlines()
    assert [line for line in lines if "<" in line and "capped" not in line] == []


def test_constraints_are_plain_and_exact():
    plain = re.compile(r"[A-Za-z0-9._-]+==[0-9][A-Za-z0-9.]*")
    assert [line for line in CONSTRAINTS if not plain.fullmatch(line)] == []


def test_constraints_pin_each_direct_dependency_within_its_range():
    pins = {canonicalize_name(n): v for n, v in (c.split("==") for c in CONSTRAINTS)}
    for name, allowed in direct_dependencies().items():
        assert name in pins, f"{name} has no pin in constraints.txt"
        assert pins[name] in allowed, f"{name}=={pins[name]} is outside {allowed}"


def imported_modules(path: Path) -> set[str]:
    """Top-level names of all absolute imports in a Python file."""
    names = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names.add(node.module)
    return {name.split(".")[0] for name in names}


SOURCES = sorted(ROOT.glob("skinlib/**/*.py"))
# What Blender's own Python has, for the scripts that run in it.
IN_BLENDER = {"bpy", "bpy_extras", "mathutils", "skinlib_addon"}


@pytest.mark.parametrize("path", SOURCES, ids=lambda p: str(p.relative_to(ROOT)))
def test_the_package_imports_only_what_it_declares(path):
    declared = ranges(PROJECT["dependencies"] + EXTRAS["notebooks"])
    distributions = packages_distributions()
    known = {"skinlib"} | IN_BLENDER | sys.stdlib_module_names
    for module in imported_modules(path) - known:
        names = map(canonicalize_name, distributions.get(module, [module]))
        assert declared.keys() & set(names), f"{module} is in no dependency list"
