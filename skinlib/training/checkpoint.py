"""Checkpoints: safetensors and a readable configuration, whole or not at all."""

import contextlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

from safetensors import SafetensorError, safe_open
from safetensors.torch import save
from torch import Tensor

from skinlib.graph import GraphConfig
from skinlib.head import HeadError
from skinlib.model import ModelConfig, SkinningModel
from skinlib.model.rivals import (
    PointTransformer,
    PointTransformerConfig,
    RigNetConfig,
    RigNetSkinning,
)
from skinlib.paths import checkpoint

STATE = "training.safetensors"
WEIGHTS = "model.safetensors"
CONFIG = "config.json"
# By the name in a checkpoint: what was saved without one is skinlib's own.
NETWORKS = {
    "skinlib": (SkinningModel, ModelConfig),
    "rignet": (RigNetSkinning, RigNetConfig),
    "point_transformer": (PointTransformer, PointTransformerConfig),
}


def save_model(model: SkinningModel, folder: str | Path, extra: dict) -> None:
    """Write `model.safetensors` and a readable `config.json` into a folder."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    tensors = {k: v.cpu().contiguous() for k, v in model.state_dict().items()}
    names = {kind: name for name, (kind, _) in NETWORKS.items()}
    own = {"network": names[type(model)], "model": model.describe()}
    config = json.dumps(own | extra, indent=1)
    # The weights carry their own configuration, so the two files cannot disagree.
    write_tensors(folder / WEIGHTS, tensors, {"config": config})
    replace_file(folder / CONFIG, f"{config}\n".encode())


def load_model(name: str | Path) -> SkinningModel:
    """The model of a shipped checkpoint, or of a folder that `train` wrote.

    Args:
        name: a folder, a `model.safetensors` file, or a name in `checkpoints/`.

    Raises:
        HeadError: there is no such checkpoint, or the file is damaged.
    """
    folder = Path(name)
    path = folder if folder.suffix == ".safetensors" else folder / WEIGHTS
    # Somebody's folder of heads may have the name of a shipped checkpoint.
    if not path.is_file() and not (folder / STATE).exists():
        if str(name) == folder.name and folder != path:
            path = checkpoint(folder.name) / WEIGHTS
    if not path.is_file():
        raise HeadError(
            "checkpoint",
            "there is no such file",
            "give a folder that `skinlib train --out` wrote (a model is there from the "
            "first validation on), or a shipped name",
            path,
        )
    tensors, metadata = read_tensors(path)
    try:
        stored = json.loads(metadata["config"])
        settings = stored["model"]
        kind, config = NETWORKS[stored.get("network", "skinlib")]
        graph = GraphConfig(**settings["graph"])
        model = kind(config(**(settings | {"graph": graph})))
        model.load_state_dict(tensors)
    except (ArithmeticError, LookupError, TypeError, ValueError, RuntimeError) as error:
        raise HeadError(
            "checkpoint",
            f"a file that is no skinlib model ({type(error).__name__})",
            "use a model.safetensors that `skinlib train` wrote",
            path,
        ) from error
    return model.eval()


@contextlib.contextmanager
def reading_finished(
    folder: Path, field: str, kind: str, command: str
) -> Iterator[tuple[dict[str, Tensor], dict[str, str]]]:
    """Tensors and metadata of what a finished run left in a folder.

    What goes wrong in the block, while something is made of them, is told as a file
    that is damaged or of another kind.

    Args:
        field: for the message. kind: "outfit". command: that writes such folders.

    Raises:
        HeadError: there is none, the run has not ended, or the file is damaged.
    """
    path = folder / WEIGHTS
    if not path.is_file():
        unfinished = (folder / STATE).is_file()
        raise HeadError(
            field,
            "its training has not ended" if unfinished else "there is no such file",
            f"run the same `{command}` again"
            if unfinished
            else f"give a folder that `{command} --out` wrote, or a shipped name",
            path,
        )
    tensors, metadata = read_tensors(path)
    try:
        yield tensors, metadata
    except (LookupError, TypeError, ValueError, RuntimeError) as error:
        raise HeadError(
            field,
            f"a file that is no {kind} ({type(error).__name__})",
            f"use a folder that `{command}` wrote",
            path,
        ) from error


def write_tensors(
    path: Path, tensors: dict[str, Tensor], metadata: dict[str, str]
) -> None:
    # As bytes: `save_file` would make a file that nobody else may read.
    replace_file(path, save(tensors, metadata))


def replace_file(path: Path, content: bytes) -> None:
    """Write a file that appears whole or not at all."""
    partial = path.with_suffix(".partial")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    except OSError as error:
        raise HeadError(
            "checkpoint",
            f"it cannot be written ({error.strerror})",
            "see to space and permissions, then run the same command again",
            path,
        ) from error
    finally:
        with contextlib.suppress(OSError):
            partial.unlink()


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, str]]:
    try:
        with safe_open(path, "pt") as file:
            return {k: file.get_tensor(k) for k in file.keys()}, file.metadata() or {}
    except (SafetensorError, OSError) as error:
        raise HeadError(
            "checkpoint",
            f"it cannot be read ({error})",
            "copy the file again, or delete it and train anew",
            path,
        ) from error
