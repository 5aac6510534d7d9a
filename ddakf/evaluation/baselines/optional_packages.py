"""Optional packages: imports that only some baselines need, refused with a reason where they are missing."""

from __future__ import annotations

import importlib
from types import ModuleType

from ddakf.errors import NotApplicable


def package(name: str, pip: str) -> ModuleType:
    """A package by the name of its import.

    Args:
        name: as in ``import name``.
        pip: as in ``pip install pip``.

    Raises:
        NotApplicable: the package or one of its dependencies cannot be imported.
    """
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as error:
        raise NotApplicable(f"needs {name}, which cannot be imported here ({error}): pip install {pip}") from error
