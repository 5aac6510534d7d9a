"""Recordings that do not ship with the project are found through DDAKF_DATA."""

import os
from pathlib import Path

import pytest


@pytest.fixture
def recording():
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
