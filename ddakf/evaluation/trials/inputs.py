"""Inputs of a trial that may change under an unchanged name: a tracker from elsewhere, and a recording of one's own."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import re
import sys
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path

from ddakf.evaluation.trials.recordings import location
from ddakf.evaluation.trials.trial import Trial

IMPORT = re.compile(r"^\s*(?:from|import)\s+(\w+)", re.MULTILINE)


def digest_of(trial: Trial) -> str | None:
    """Digest of the code of a ``MODULE:CLASS``, and of the files of a recording; None where both are the project's own.

    The code is that of the module's package, or of a module alone and of what it imports from the folder beside it.
    """
    sources = [_module(trial.variant), _recording(trial.sequence)]
    return "-".join(filter(None, sources)) or None


@lru_cache
def _module(variant: str) -> str | None:
    module, colon, _ = variant.partition(":")
    if not colon or "=" in variant:
        return None
    if (here := os.getcwd()) not in sys.path:
        sys.path.append(here)
    try:
        found = importlib.util.find_spec(module.partition(".")[0])
    except (ImportError, ValueError, AttributeError):  # the trial itself says so
        return None
    if not found or not found.origin or not Path(found.origin).is_file():
        return None
    return _digest(_sources(Path(found.origin)))


def _sources(origin: Path) -> set[Path]:
    """The files of a package, by its ``__init__.py``, or a module's and those beside it that it imports, directly or not."""
    if origin.name == "__init__.py":
        return set(origin.parent.rglob("*.py"))
    known, waiting = {origin}, [origin]
    while waiting:
        for name in IMPORT.findall(waiting.pop().read_text(encoding="utf-8", errors="replace")):
            module, package = origin.with_name(f"{name}.py"), origin.parent / name / "__init__.py"
            if package.is_file():
                known |= _sources(package)
            elif module.is_file() and module not in known:
                known.add(module)
                waiting.append(module)
    return known


@lru_cache
def _recording(name: str) -> str | None:
    path = location(name)
    if path is None:
        return None
    return _digest([path] if path.is_file() else (file for file in path.rglob("*") if file.is_file()))


def _digest(files: Iterable[Path]) -> str:
    """Of the names and contents of files, wherever they lie."""
    digest = hashlib.sha256()
    for path in sorted(files):
        digest.update(f"{path.name}\0".encode())
        with path.open("rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()[:16]
