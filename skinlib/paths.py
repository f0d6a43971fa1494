"""Where the files that ship beside the package lie: samples and checkpoints."""

from contextlib import suppress
from pathlib import Path

from skinlib.head import HeadError

DEFAULT_CHECKPOINT = "heads"


def repository_file(*parts: str) -> Path:
    """Path of a file or folder that ships in the repository.

    Samples and checkpoints are not inside the package: they lie beside it in the
    clone that `pip install -e .` points to.

    Raises:
        HeadError: there is no such file, or no clone.

    >>> repository_file("data_samples", "adult.glb").suffix
    '.glb'
    """
    root = Path(__file__).resolve().parents[1]
    path = root.joinpath(*parts)
    if path.exists():
        return path
    folder = root / parts[0]
    if not folder.is_dir():
        raise HeadError(
            parts[0],
            "the folder is missing",
            "it ships in the repository: clone that and `pip install -e .` there",
            folder,
        )
    # Not README.md and SHA256SUMS.
    shipped = sorted(file.name for file in folder.iterdir() if file.stem.islower())
    raise HeadError(
        parts[0],
        f"there is no {'/'.join(parts[1:])!r} in it",
        f"choose from {', '.join(shipped)}",
        folder,
    )


def sample(name: str) -> Path:
    """Path of a file in `data_samples/`."""
    return repository_file("data_samples", name)


def checkpoint(name: str) -> Path:
    """Path of a folder in `checkpoints/`."""
    return repository_file("checkpoints", name)


def trained(name: str | Path) -> Path:
    """A folder that a training wrote; where there is none, the shipped one so called.

    It need not exist: who reads from it says what is missing.

    >>> trained("t_shirt") == checkpoint("t_shirt")
    True
    """
    folder = Path(name)
    if not folder.exists() and str(name) == folder.name:
        with suppress(HeadError):
            return checkpoint(folder.name)
    return folder
