"""The state of a run on the disk: whole or not at all, and of that run alone."""

import contextlib
import json
import signal
import threading
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

from torch import Tensor, nn

from skinlib.head import HeadError
from skinlib.training.checkpoint import STATE, read_tensors, replace_file, write_tensors

HISTORY = "history.json"

Memory = Iterable[tuple[nn.Parameter, dict]]
"""What an optimizer remembers of each parameter, always in the same order."""


def write_state(
    out: Path, networks: Mapping[str, nn.Module], memory: Memory, progress: dict
) -> None:
    """Write all that `read_state` needs; a crash meanwhile leaves the older one.

    Args:
        progress: plain values, with `run`, what makes it the same run, and `history`.
    """
    out.mkdir(parents=True, exist_ok=True)
    tensors = {
        f"{name}.{key}": value
        for name, network in networks.items()
        for key, value in network.state_dict().items()
    }
    for i, (_, moments) in enumerate(memory):
        for key, value in moments.items():
            tensors[f"optimizer.{i}.{key}"] = value
    tensors = {k: v.detach().cpu().contiguous() for k, v in tensors.items()}
    write_tensors(out / STATE, tensors, {"progress": json.dumps(progress)})
    history = json.dumps(progress["history"], indent=1)
    replace_file(out / HISTORY, history.encode())


def read_state(
    out: Path, networks: Mapping[str, nn.Module], memory: Memory, run: dict
) -> dict:
    """Put networks and memory back where they were; returns the progress.

    Raises:
        HeadError: the file is damaged, or of another run.
    """
    tensors, metadata = read_tensors(out / STATE)
    try:
        progress = json.loads(metadata["progress"])
        differs = [key for key in run if progress["run"].get(key) != run[key]]
        if differs:
            raise HeadError(
                ", ".join(differs),
                "another run, with other settings or data, was begun here",
                "continue it with the arguments it was begun with, or choose a new "
                "folder for this one",
                out,
            )
        for name, network in networks.items():
            network.load_state_dict(_part(tensors, f"{name}."))
        for i, (parameter, moments) in enumerate(memory):
            for key, value in _part(tensors, f"optimizer.{i}.").items():
                # The count of steps stays where the optimizer counts.
                device = "cpu" if key == "step" else parameter.device
                moments[key] = value.to(device)
        return progress
    except HeadError:
        raise
    except (KeyError, TypeError, ValueError, RuntimeError) as error:
        raise HeadError(
            "checkpoint",
            f"a file that is no state of a run ({type(error).__name__})",
            "copy the file again, or delete it and train anew",
            out / STATE,
        ) from error


def _part(tensors: dict[str, Tensor], prefix: str) -> dict[str, Tensor]:
    return {
        key.removeprefix(prefix): value
        for key, value in tensors.items()
        if key.startswith(prefix)
    }


@contextlib.contextmanager
def uninterrupted() -> Iterator[None]:
    """Ctrl-C waits for the end of the block: nobody can go on from half an update."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    waiting: list[int] = []
    usual = {
        number: signal.signal(number, lambda number, _: waiting.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield
    finally:
        for number, handler in usual.items():
            signal.signal(number, handler)
        for number in waiting:
            signal.raise_signal(number)
