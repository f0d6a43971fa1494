"""How the notebooks were committed. That they run, and print what they say: nbval.

A notebook is committed as `make refresh` leaves it: executed 1..n, small, with nothing
in it that belongs to one machine or one run. STYLE: cells are short.
"""

import re
import subprocess
import sys
from pathlib import Path
from statistics import median

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_notebook, new_output

ROOT = Path(__file__).resolve().parents[1]
FOLDER = ROOT / "notebooks"
NOTEBOOKS = [p for p in sorted(FOLDER.rglob("*.ipynb")) if ".ipynb_" not in str(p)]

MAX_BYTES = 1_000_000
MAX_COLUMNS = 88
MAX_LINES = 60
# An absolute path of the machine that ran it, in a folder where people or jobs live.
ABSOLUTE_PATH = re.compile(r"(?<![\w.~/:])/(?:\w[\w.-]*/){2,}\w|[A-Z]:\\\\?Users")
TIMING = re.compile(r"\dit/s\b|\ds/it\b|Wall time|CPU times|\d ?[mµu]s\b|\d\.\d+ ?s\b")
CHECK = "# NBVAL_CHECK_OUTPUT"
WIDGET = "application/vnd.jupyter.widget-view+json"


def code_cells(notebook) -> list:
    return [c for c in notebook.cells if c.cell_type == "code" and c.source.strip()]


def printed(output) -> str:
    """What an output says in words."""
    if output.output_type == "error":
        return "\n".join([output.evalue, *output.traceback])
    return output.get("text") or output.get("data", {}).get("text/plain", "")


def notebook_faults(path: Path) -> list[str]:
    """Everything that keeps a notebook from being committed, in words."""
    notebook = nbformat.read(path, as_version=4)
    cells = code_cells(notebook)
    faults = []
    if path.stat().st_size >= MAX_BYTES:
        faults.append(f"{path.stat().st_size / 1e6:.1f} MB")
    if [cell.execution_count for cell in cells] != [*range(1, len(cells) + 1)]:
        faults.append("not executed 1..n in one go")
    if not any(CHECK in cell.source.splitlines() for cell in cells):
        faults.append(f"no output is compared: mark a cell {CHECK}")
    if "widgets" in notebook.metadata:
        faults.append("carries widget state")
    for number, cell in enumerate(cells, 1):
        faults += [f"cell [{number}]: {fault}" for fault in output_faults(cell)]
    return faults + length_faults([cell.source for cell in cells])


def output_faults(cell) -> list[str]:
    """What must not be in a cell's saved outputs, and markers that do nothing."""
    tags = cell.metadata.get("tags", [])
    faults = []
    # nbval passes over a marker that shares its line with code.
    marked = [line for line in cell.source.splitlines() if "NBVAL_" in line]
    if not all(line.strip().startswith("# NBVAL_") for line in marked):
        faults.append("a marker of nbval needs a line of its own")
    for output in cell.outputs:
        text = printed(output)
        if output.output_type == "error" and "raises-exception" not in tags:
            faults.append("ended in an error")
        if output.output_type == "stream" and output.name == "stderr":
            faults.append("wrote to stderr")
        if WIDGET in output.get("data", {}):
            faults.append("a widget's output without its state")
        for what, pattern in (("a path", ABSOLUTE_PATH), ("a timing", TIMING)):
            if found := pattern.search(text):
                faults.append(f"prints {what}: {found.group()}")
    return faults


def length_faults(sources: list[str]) -> list[str]:
    """STYLE: median <= 8 lines, 9 in 10 <= 25, none over 60, <= 88 columns."""
    lengths = sorted(len(source.splitlines()) for source in sources)
    columns = max((len(line) for s in sources for line in s.splitlines()), default=0)
    faults = []
    if lengths and median(lengths) > 8:
        faults.append(f"the median cell has {median(lengths):g} lines, not <= 8")
    if sum(length > 25 for length in lengths) > len(lengths) / 10:
        faults.append("more than 1 cell in 10 is longer than 25 lines")
    if lengths and lengths[-1] > MAX_LINES:
        faults.append(f"a cell has {lengths[-1]} lines, not <= {MAX_LINES}")
    if columns > MAX_COLUMNS:
        faults.append(f"a line has {columns} columns, not <= {MAX_COLUMNS}")
    return faults


NAMES = [str(path.relative_to(FOLDER)) for path in NOTEBOOKS]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_notebook_is_committed_as_refresh_leaves_it(path):
    assert notebook_faults(path) == []


# ------------------------------------------------------------------ the checks can fail


def cell(source=f"{CHECK}\n1 + 1", count=1, tags=(), outputs=()):
    return new_code_cell(
        source,
        execution_count=count,
        metadata={"tags": list(tags)},
        outputs=list(outputs),
    )


def stream(text, name="stdout"):
    return new_output("stream", name=name, text=text)


def faults_of(tmp_path, *cells, **metadata) -> str:
    path = tmp_path / "some.ipynb"
    nbformat.write(new_notebook(cells=list(cells), metadata=metadata), path)
    return "; ".join(notebook_faults(path))


def test_a_good_notebook_has_no_fault(tmp_path):
    good = cell(outputs=[stream("2 bones, 3 vertices in data_samples/head.npz")])
    assert faults_of(tmp_path, good) == ""


ERROR = new_output("error", ename="ValueError", evalue="no", traceback=[])
SLIDER = new_output("display_data", data={WIDGET: {"model_id": "1"}})


@pytest.mark.parametrize(
    "bad, expected",
    [
        (cell(count=None), "not executed"),
        (cell(count=2), "not executed"),
        (cell("1 + 1"), "no output is compared"),
        (cell(f"1 + 1  {CHECK}"), "a line of its own"),
        (cell(outputs=[ERROR]), "ended in an error"),
        (cell(outputs=[stream("careful", "stderr")]), "stderr"),
        (cell(outputs=[SLIDER]), "without its state"),
        (cell(outputs=[stream("wrote /some/where/head.npz")]), "a path"),
        (cell(outputs=[stream("100/100, 12.5it/s")]), "a timing"),
        (cell(outputs=[stream("took 0.31 s")]), "a timing"),
        (cell(outputs=[stream("a" * MAX_BYTES)]), "1.0 MB"),
        (cell("x = 1\n" * 9), "median"),
        (cell("x = 1\n" * 61), "61 lines"),
        (cell("x = 1  " + "#" * 90), "columns"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_a_fault_is_found(tmp_path, bad, expected):
    assert expected in faults_of(tmp_path, bad)


def test_widget_state_is_found(tmp_path):
    assert "widget state" in faults_of(tmp_path, cell(), widgets={"state": {}})


def test_an_expected_error_is_no_fault(tmp_path):
    assert faults_of(tmp_path, cell(tags=["raises-exception"], outputs=[ERROR])) == ""


def test_one_long_cell_in_ten_is_allowed(tmp_path):
    short = [cell(count=number) for number in range(1, 10)]
    long = cell("x = 1\n" * 40, count=10)
    assert faults_of(tmp_path, *short, long) == ""
    assert "1 cell in 10" in faults_of(tmp_path, *short[:8], cell("x = 1\n" * 40, 9))


@pytest.mark.parametrize("printed, status", [("2", 0), ("3", 1)])
def test_nbval_compares_what_a_marked_cell_prints(tmp_path, printed, status):
    output = new_output("execute_result", {"text/plain": printed}, execution_count=1)
    path = tmp_path / "some.ipynb"
    nbformat.write(new_notebook(cells=[cell(outputs=[output])]), path)
    options = ["-c", ROOT / "pyproject.toml", "--rootdir", tmp_path, "-p", "no:xdist"]
    command = [sys.executable, "-m", "pytest", *map(str, options), str(path)]
    result = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert result.returncode == status, result.stdout
