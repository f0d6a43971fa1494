"""Heads of your own: a folder of files that `skinlib.io.read_head` reads."""

import itertools
from pathlib import Path

from tqdm.auto import tqdm

from skinlib.head import Head, HeadError
from skinlib.io import read_head

SUFFIXES = {".npz", ".glb", ".gltf", ".blend", ".fbx"}


def load_folder(directory: str | Path) -> list[Head]:
    """Read all heads that lie in a folder, sorted by their names (the files' stems).

    Folders inside it and hidden files are passed over.

    Raises:
        HeadError: there is no such folder, no head in it, two with the same stem, or
            one that cannot be read.
    """
    directory = Path(directory)
    if not directory.is_dir():
        raise HeadError(
            "folder",
            "it is a file" if directory.exists() else "there is no such folder",
            "name a folder of .npz or .glb files",
            directory,
        )
    files = sorted(
        (
            file
            for file in directory.iterdir()
            if file.suffix.lower() in SUFFIXES and file.is_file()
            if not file.name.startswith(".")
        ),
        key=lambda file: (file.stem, file.suffix),
    )
    if not files:
        raise HeadError(
            "folder",
            "there is no .npz or .glb file in it",
            "put heads into it, or name another folder",
            directory,
        )
    for first, second in itertools.pairwise(files):
        if first.stem == second.stem:
            raise HeadError(
                "folder",
                f"{first.name} and {second.name} have the same stem",
                "keep one of them: a head is named after its file",
                directory,
            )
    # A bar for a folder that takes long, nothing for a handful of heads.
    progress = tqdm(files, "heads", unit="head", delay=2, leave=False)
    return [read_head(file) for file in progress]
