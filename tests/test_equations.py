"""docs/equations.md and the docstrings name the same equations."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
SECTIONS = re.split(r"^### ", (ROOT / "docs/equations.md").read_text(), flags=re.M)[1:]
EQUATIONS = {section.split("`")[1]: section for section in SECTIONS}
NAMED = re.compile(r"Equation\s+`(\w+)`")


def test_every_equation_that_a_docstring_names_is_there():
    found = {
        f"{path.name}: {name}"
        for path in (ROOT / "skinlib").rglob("*.py")
        for name in NAMED.findall(path.read_text())
        if name not in EQUATIONS
    }
    assert found == set()


def test_an_equation_has_its_own_id():
    assert len(EQUATIONS) == len(SECTIONS)


@pytest.mark.parametrize("equation", EQUATIONS)
def test_the_functions_of_an_equation_name_it(equation):
    section = EQUATIONS[equation]
    assert section.count("$$") >= 2 and "- Source: " in section
    line = re.search(r"^- Function: (.+)", section, flags=re.M)[1]
    functions = re.findall(r"`(skinlib[\w.]+)`", line)
    assert functions
    for name in functions:
        module, _, attribute = name.rpartition(".")
        docstring = getattr(importlib.import_module(module), attribute).__doc__
        assert equation in NAMED.findall(docstring), name
