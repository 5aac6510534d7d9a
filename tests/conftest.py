"""Fixtures and lanes of all tests. Recordings that do not ship with the project are found through DDAKF_DATA."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# the same examples in every run, however long one takes on a busy machine
settings.register_profile("project", deadline=None, derandomize=True)
settings.load_profile("project")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Runs the files with slow tests first, so that parallel workers end at about the same time."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: item.path not in slow)


@pytest.fixture(scope="session")
def recording() -> Callable[[str], Path]:
    """Path of a recording by its name inside the folder DDAKF_DATA; skips with a reason where there is none."""

    def find(name: str) -> Path:
        root = os.environ.get("DDAKF_DATA")
        if not root:
            pytest.skip("DDAKF_DATA does not name the folder of the recordings")
        path = Path(root) / name
        if not path.exists():
            pytest.skip(f"the recording {name} is not in DDAKF_DATA")
        return path

    return find
