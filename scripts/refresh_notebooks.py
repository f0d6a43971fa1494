"""Execute the notebooks and write them back in one normal form.

    python scripts/refresh_notebooks.py                              # all of them
    python scripts/refresh_notebooks.py notebooks/02_hybrid_graph.ipynb

A notebook is written only when it ran through, said nothing on stderr and stayed in
its time. What differs from run to run, or from machine to machine, is taken out: widget
state, timings, kernel and editor metadata, cell ids. A widget's output goes too: saved
without its state it would be an empty line; the static picture after it stays.
"""

import argparse
import hashlib
import sys
import time
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbclient.exceptions import CellExecutionError, CellTimeoutError, DeadKernelError
from nbformat import NotebookNode
from tqdm import tqdm

NOTEBOOKS = Path(__file__).resolve().parents[1] / "notebooks"
BUDGET_SECONDS = 90
WIDGET = "application/vnd.jupyter.widget-view+json"
METADATA = {
    "kernelspec": {
        "display_name": "Python 3 (ipykernel)",
        "language": "python",
        "name": "python3",
    },
    "language_info": {"name": "python", "pygments_lexer": "ipython3"},
}


class NotebookFault(Exception):
    """Why a notebook must not be committed as it ran."""


def execute(notebook: NotebookNode, folder: Path) -> float:
    """Run all cells in a fresh kernel that stands in `folder`; return the seconds.

    Raises:
        NotebookFault: a cell or a slider's callback fails, a cell hangs, or the kernel
            dies.
    """
    client = NotebookClient(
        notebook,
        timeout=3 * BUDGET_SECONDS,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
        record_timing=False,
        # Else each kernel remarks that it talks to us without encryption.
        extra_arguments=["--log-level=ERROR"],
    )
    start = time.perf_counter()
    try:
        client.execute()
    except (CellExecutionError, CellTimeoutError, DeadKernelError) as error:
        raise NotebookFault(str(error)) from error
    for widget in client.widget_state.values():
        for output in widget.get("outputs", []):
            if output["output_type"] == "error":
                raise NotebookFault("in a callback:\n" + "\n".join(output["traceback"]))
    return time.perf_counter() - start


def normalise(notebook: NotebookNode) -> None:
    """Take out, in place, whatever is not the same in every run.

    Raises:
        NotebookFault: a cell wrote to stderr.
    """
    notebook.metadata = nbformat.from_dict(METADATA)
    notebook.nbformat, notebook.nbformat_minor = 4, 5
    seen: dict[str, int] = {}
    for cell in notebook.cells:
        tags = cell.metadata.get("tags")
        cell.metadata = NotebookNode({"tags": tags} if tags else {})
        digest = hashlib.sha256(cell.source.encode()).hexdigest()[:8]
        seen[digest] = seen.get(digest, 0) + 1
        cell.id = digest if seen[digest] == 1 else f"{digest}-{seen[digest]}"
        if cell.cell_type == "code":
            cell.outputs = normal_outputs(cell)


def normal_outputs(cell: NotebookNode) -> list[NotebookNode]:
    """The outputs of a code cell without widgets, neighbouring prints joined."""
    kept: list[NotebookNode] = []
    for output in cell.outputs:
        if output.output_type == "stream" and output.name == "stderr":
            raise NotebookFault(f"stderr: {output.text.strip()}\nfrom: {cell.source}")
        if WIDGET in output.get("data", {}):
            continue
        if output.output_type == "stream" and kept and "text" in kept[-1]:
            kept[-1].text += output.text
            continue
        kept.append(output)
    return kept


def refresh(path: Path) -> float:
    """Execute and normalise one notebook in place; return the seconds it ran.

    Raises:
        NotebookFault: it may not be committed; the file is left as it was.
    """
    notebook = nbformat.read(path, as_version=4)
    seconds = execute(notebook, path.parent)
    normalise(notebook)
    nbformat.validate(notebook)
    if seconds > BUDGET_SECONDS:
        raise NotebookFault(f"took {seconds:.0f} s of the {BUDGET_SECONDS} s it has")
    nbformat.write(notebook, path)
    return seconds


def notebooks() -> list[Path]:
    """All notebooks, solutions included, in reading order."""
    found = sorted(NOTEBOOKS.rglob("*.ipynb"))
    return [path for path in found if ".ipynb_checkpoints" not in path.parts]


def main() -> int:
    """Refresh what is asked for; 1 when any notebook has a fault."""
    parser = argparse.ArgumentParser(description="Execute and normalise notebooks.")
    parser.add_argument("paths", nargs="*", type=Path, help="default: all of them")
    faults = 0
    for path in tqdm(parser.parse_args().paths or notebooks(), unit="notebook"):
        try:
            seconds = refresh(path)
            tqdm.write(f"{path.name}: {seconds:.0f} s of {BUDGET_SECONDS} s")
        except NotebookFault as fault:
            faults += 1
            tqdm.write(f"{path.name}: NOT WRITTEN\n{fault}")
    return min(faults, 1)


if __name__ == "__main__":
    sys.exit(main())
