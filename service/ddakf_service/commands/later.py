"""Later: commands whose modules are imported when they run, so that the command line starts quickly."""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable


def later(module: str, function: str) -> Callable[[argparse.Namespace], int]:
    """A function of a module of this package, which is imported with the call."""

    def run(args: argparse.Namespace) -> int:
        return getattr(importlib.import_module(f".{module}", __package__), function)(args)

    return run
