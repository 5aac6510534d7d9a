"""Databases for the tests: SQLite and PostgreSQL."""

from __future__ import annotations

import itertools
import os
import subprocess
import uuid
from pathlib import Path

import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.metrics import Metrics
from ddakf_service.store.tables.database import Database
from ddakf_service.store.tables.session_record import SessionRecord

PATIENCE = 60.0  # seconds


@pytest.fixture(params=["sqlite", "postgresql"])
def url(request, tmp_path):
    """An empty database."""
    if request.param == "sqlite":
        return f"sqlite:///{tmp_path}/test.sqlite"
    return request.getfixturevalue("postgres").new_database(f"test-{uuid.uuid4()}")


@pytest.fixture
def metrics():
    return Metrics()


@pytest.fixture
def opened(metrics):
    """Opens databases and closes them at the end."""
    databases = []

    def open_(url: str, *, attach=lambda database: None) -> Database:
        databases.append(Database(url, metrics))
        attach(databases[-1])
        databases[-1].open()
        return databases[-1]

    yield open_
    for database in databases:
        database.close()


_times = itertools.count(1_700_000_000)


def record(session_id: str = "some-session", server_id: str = "here", **session) -> SessionRecord:
    message = pb.Session(name=f"sessions/{session_id}", state=pb.SESSION_STATE_IDLE, **session)
    message.create_time.FromSeconds(next(_times))
    return SessionRecord(server_id, message)


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 2 MiB."""
    folder = tmp_path / "small"
    folder.mkdir()
    if os.geteuid() or subprocess.run(["mount", "-t", "tmpfs", "-o", "size=2m", "tmpfs", folder], capture_output=True).returncode:
        pytest.skip("only root can make a small file system here")
    yield folder
    subprocess.run(["umount", folder], check=True)


def fill(disk: Path) -> None:
    """Fills a file system with a file "ballast"."""
    subprocess.run(["dd", "if=/dev/zero", f"of={disk}/ballast", "bs=4096"], capture_output=True)
    assert os.statvfs(disk).f_bavail == 0
