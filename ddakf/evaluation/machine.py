"""Machine and versions with which numbers were measured."""

from __future__ import annotations

import contextlib
import os
import platform
import re
import subprocess
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path

import ddakf
from ddakf.errors import InvalidArgument

DIRTY = "-dirty"  # after a commit: of its changes nobody knows
WRITTEN = ("results", "benchmarks/results", "docs")  # folders of a checkout that results and their report are written to
PACKAGES = ("ddakf", "numpy", "scipy", "numba", "grpcio", "protobuf", "zstandard", "open3d-cpu", "open3d", "torch")


def describe() -> dict:
    """CPU, cores, memory, system, Python, packages, and the load average when the run began."""
    return {
        "cpu": _cpu(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gib": _memory_gib(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: _version(name) for name in PACKAGES},
        "load_average": round(os.getloadavg()[0], 2),
    }


@contextlib.contextmanager
def one_core() -> Iterator[None]:
    """Binds this process, and every thread that it starts meanwhile, to one core, if the platform can.

    Environment variables do not limit all libraries: Open3D 0.20 starts as many threads as the process has cores when it is
    first used.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def commit() -> str | None:
    """The short commit of the checkout, with ``-dirty`` if a file was changed since that is no result or document; None outside
    a checkout."""
    return revision_of(Path(__file__).parent)


def revision_of(folder: Path) -> str | None:
    """:func:`commit` of the checkout that a folder lies in."""
    head = _git(folder, "rev-parse", "--short", "HEAD")
    if head is None:
        return None
    changed = _git(folder, "diff", "--name-only", "HEAD", "--", ":(top)", *(f":(top,exclude){part}" for part in WRITTEN))
    return head.strip() + (DIRTY if changed and changed.strip() else "")


def is_traceable(revision: str) -> bool:
    """False for a revision with uncommitted changes, or one that the history of this checkout does not have. True outside one."""
    if revision.endswith(DIRTY):
        return False
    here = Path(__file__).parent
    if _git(here, "rev-parse", "HEAD") is None or not re.fullmatch(r"[0-9a-f]{6,40}", revision):
        return True
    return _git(here, "merge-base", "--is-ancestor", revision, "HEAD") is not None


def require_committed(target: Path, allowed: bool) -> None:
    """Refuses to write a result of uncommitted code into the checkout, where it would be taken for one of the project's.

    Args:
        target: file or folder of the result.
        allowed: the caller wants it all the same; the report marks it.

    Raises:
        InvalidArgument: ``target`` is in a folder of results of this checkout, and a source file has uncommitted changes.
    """
    here = Path(__file__).parent
    top, code = _git(here, "rev-parse", "--show-toplevel"), commit()
    if allowed or top is None or not code.endswith(DIRTY):
        return
    place = target.resolve()
    if any(place.is_relative_to(Path(top.strip(), part)) for part in WRITTEN):
        raise InvalidArgument("results", "committed code, or --allow-dirty", f"uncommitted changes, for results in {target}")


def _git(folder: Path, *arguments: str) -> str | None:
    """What a command of git prints; None if it fails."""
    try:
        return subprocess.run(["git", *arguments], cwd=folder, capture_output=True, text=True, check=True).stdout
    except (OSError, subprocess.CalledProcessError):
        return None


def code_version() -> str:
    """The :func:`commit`, or outside a checkout the version."""
    return commit() or f"version {ddakf.__version__}"


def _cpu() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or "unknown"
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), platform.machine())


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (ValueError, OSError):
        return None


def _version(package: str) -> str | None:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None
