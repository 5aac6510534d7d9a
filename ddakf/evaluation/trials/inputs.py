"""Inputs of a trial that may change under an unchanged name: a tracker from elsewhere, and a recording given by its path."""

from __future__ import annotations

import hashlib
import importlib.util
import os
import sys
from functools import lru_cache
from pathlib import Path

from ddakf.evaluation.trials.trial import Trial


def digest_of(trial: Trial) -> str | None:
    """Digest of the module of a ``MODULE:CLASS``, and of the files of a recording given by a path; None without either."""
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
        found = importlib.util.find_spec(module)
    except (ImportError, ValueError, AttributeError):  # the trial itself says so
        return None
    return _digest(Path(found.origin)) if found and found.origin else None


@lru_cache
def _recording(name: str) -> str | None:
    path = Path(name.rpartition("@")[0] or name)
    path = path if path.exists() else Path(name.partition("#")[0])
    if path.is_file():
        return _digest(path)
    if not path.is_dir():
        return None
    files = sorted(file for file in path.rglob("*") if file.is_file())
    listed = "\n".join(f"{file.relative_to(path)} {file.stat().st_size} {file.stat().st_mtime_ns}" for file in files)
    return hashlib.sha256(listed.encode()).hexdigest()[:16]


def _digest(path: Path) -> str | None:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:16] if path.is_file() else None
