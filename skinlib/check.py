"""`skinlib check`: what works on this machine, in lines for a bug report."""

import hashlib
import importlib
import platform
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import packages_distributions, requires, version

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from skinlib.head import HeadError
from skinlib.paths import DEFAULT_CHECKPOINT, repository_file


@dataclass(frozen=True)
class Finding:
    """One line of the report; NOTE is something that skinlib can do without.

    >>> print(Finding("OK", "numpy", "2.4.6"))
    OK    numpy                 2.4.6
    """

    status: str
    what: str
    detail: str

    def __str__(self) -> str:
        return f"{self.status:4}  {self.what:20}  {self.detail}"


def run_checks() -> list[Finding]:
    """Look at Python, packages, 3-D pictures, samples and the shipped checkpoint."""
    return [
        Finding(
            "OK", "python", f"{platform.python_version()} on {platform.platform()}"
        ),
        *package_findings(),
        _guarded("torch devices", _devices),
        _guarded("3-D pictures", _pictures),
        _guarded("samples", lambda: _checksums("data_samples")),
        _guarded("checkpoint", _checkpoint),
    ]


def package_findings() -> Iterator[Finding]:
    """One finding for each package in pyproject.toml, but for those of the tests."""
    modules = {}
    for module, distributions in packages_distributions().items():
        if not module.startswith("_"):
            for distribution in distributions:
                modules.setdefault(canonicalize_name(distribution), []).append(module)
    needed = [Requirement(line) for line in requires("skinlib") or []]
    for extra, missing in (("", "FAIL"), ("notebooks", "NOTE")):
        for requirement in needed:
            name = canonicalize_name(requirement.name)
            marker = str(requirement.marker or "")
            if name == "skinlib" or ("extra" in marker) != bool(extra):
                continue
            if extra and not requirement.marker.evaluate({"extra": extra}):
                continue
            if name not in modules:
                yield Finding(missing, name, f"missing; pip install '{name}'")
            else:
                yield _package(requirement, sorted(modules[name], key=len)[0])


def _package(requirement: Requirement, module: str) -> Finding:
    found = version(requirement.name)
    if found not in requirement.specifier:
        return Finding(
            "FAIL", requirement.name, f"{found}, not {requirement.specifier}"
        )
    try:
        importlib.import_module(module)
    # A broken installation raises anything: OSError, RuntimeError, ...
    except Exception as error:
        return Finding("FAIL", requirement.name, f"{found}: {error!r}")
    return Finding("OK", requirement.name, found)


def _guarded(what: str, look: Callable[[], Finding]) -> Finding:
    try:
        return look()
    except (HeadError, ImportError, OSError) as error:
        return Finding("FAIL", what, str(error))


def _devices() -> Finding:
    import torch

    devices = ["cpu"]
    devices += [torch.cuda.get_device_name(i) for i in range(torch.cuda.device_count())]
    return Finding("OK", "torch devices", ", ".join(devices))


def _pictures() -> Finding:
    try:
        from skinlib.views.scenes import backend
    except ImportError as error:
        return Finding("NOTE", "3-D pictures", f"none: {error}")
    if backend() == "matplotlib":
        return Finding(
            "NOTE",
            "3-D pictures",
            "no off-screen OpenGL, matplotlib draws instead; on Debian or Ubuntu "
            "`apt install libosmesa6` gives smoother ones",
        )
    return Finding("OK", "3-D pictures", "off-screen OpenGL")


def _checksums(folder: str) -> Finding:
    """Whether the files listed in a folder's SHA256SUMS are those that were shipped."""
    root = repository_file(folder)
    listing = repository_file(folder, "SHA256SUMS").read_text().splitlines()
    for line in listing:
        digest, name = line.split(maxsplit=1)
        file = root / name
        if not file.is_file():
            return Finding(
                "FAIL", "samples", f"{name} is missing; git checkout {folder}"
            )
        if hashlib.sha256(file.read_bytes()).hexdigest() != digest:
            return Finding("FAIL", "samples", f"{name} changed; git checkout {folder}")
    return Finding("OK", "samples", f"{len(listing)} files as shipped")


def _checkpoint() -> Finding:
    from skinlib.training import load_model

    parameters = load_model(DEFAULT_CHECKPOINT).parameters()
    count = sum(parameter.numel() for parameter in parameters)
    return Finding("OK", "checkpoint", f"{DEFAULT_CHECKPOINT}, {count:,} parameters")
