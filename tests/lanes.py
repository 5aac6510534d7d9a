"""Lanes of parametrized tests: some of the values in every run, all of them in the slow one."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import pytest


def every(step: int, values: Iterable[Any]) -> list[Any]:
    """Parameters of a test: the first value and every ``step``-th after it in every run, the others in the slow lane."""
    return [value if k % step == 0 else pytest.param(value, marks=pytest.mark.slow) for k, value in enumerate(values)]
