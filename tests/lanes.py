"""Lanes of parametrized tests: some of the values in every run, all of them in the slow one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def every(step: int, values: Iterable[Any]) -> list[Any]:
    """Parameters of a test: the first and every ``step``-th after it in every run, the others in the slow lane.

    A tuple is of several arguments.
    """
    rows = [value if isinstance(value, tuple) else (value,) for value in values]
    return [pytest.param(*row, marks=[pytest.mark.slow] if k % step else []) for k, row in enumerate(rows)]
