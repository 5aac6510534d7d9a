"""Permissions: what the store creates is its owner's alone, and what is wider is told."""

from __future__ import annotations

import logging
import os
import stat
from pathlib import Path

import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.settings import Settings
from ddakf_service.store.files.checkpoints import Checkpoint
from ddakf_service.store.files.permissions import FILE, exposure
from ddakf_service.store.store import Store

from ddakf.errors import InvalidConfig

from ..conftest import PATIENCE, record


@pytest.fixture(autouse=True)
def _usual_umask():
    before = os.umask(0o022)
    yield
    os.umask(before)


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def stored(settings: Settings, metrics) -> None:
    """A store that has written a session and a checkpoint."""
    store = Store(settings, metrics)
    store.registry.save(record())
    store.checkpoints.save(7, Checkpoint(pb.SessionSnapshot(data=b"state")))
    assert store.database.flush(PATIENCE)
    assert store.checkpoints.flush(PATIENCE)
    store.close()


def test_only_the_owner_may_open_what_the_store_creates(tmp_path, metrics):
    settings = Settings(
        data_dir=str(tmp_path / "state" / "data"),
        database_url=f"sqlite:///{tmp_path}/own.sqlite",
        checkpoint_url=f"file://{tmp_path}/far/checkpoints",
    )
    stored(settings, metrics)
    created = list(tmp_path.rglob("*"))
    assert any(path.suffix == ".checkpoint" for path in created)
    assert {path.name: oct(mode(path)) for path in created if mode(path) & 0o077} == {}


def test_the_log_of_an_open_database_is_its_owner_s(tmp_path, metrics):
    store = Store(Settings(data_dir=str(tmp_path / "data")), metrics)
    assert {path.name: oct(mode(path)) for path in store.database.files()} == {
        name: oct(FILE) for name in ("ddakf.sqlite", "ddakf.sqlite-wal", "ddakf.sqlite-shm")
    }
    store.close()


def test_an_empty_folder_is_closed_to_others(tmp_path, metrics):
    data = tmp_path / "data"
    data.mkdir(mode=0o755)
    stored(Settings(data_dir=str(data)), metrics)
    assert oct(mode(data)) == oct(0o700)


def test_what_others_may_open_is_told_and_left_as_it_is(tmp_path, metrics, caplog):
    data = tmp_path / "data"
    stored(Settings(data_dir=str(data)), metrics)
    data.chmod(0o755)
    (data / "ddakf.sqlite").chmod(0o644)
    with caplog.at_level(logging.WARNING):
        stored(Settings(data_dir=str(data)), metrics)
    told = "\n".join(caplog.messages)
    assert f"{data}, whose mode is 0755: chmod 700 {data}" in told
    assert f"ddakf.sqlite, whose mode is 0644: chmod 600 {data}/ddakf.sqlite" in told
    assert oct(mode(data)) == oct(0o755)
    caplog.clear()
    data.chmod(0o700)
    (data / "ddakf.sqlite").chmod(0o600)
    with caplog.at_level(logging.WARNING):
        stored(Settings(data_dir=str(data)), metrics)
    assert caplog.messages == []


@pytest.mark.parametrize("permissions", [0o600, 0o400, 0o700])
def test_a_file_of_its_owner_is_not_exposed(tmp_path, permissions):
    path = tmp_path / "file"
    path.touch()
    path.chmod(permissions)
    assert exposure(path, 0o700) == ""


def test_a_database_in_a_folder_that_does_not_exist_is_refused(tmp_path, metrics):
    url = f"sqlite:///{tmp_path}/mistyped/x.db"
    with pytest.raises(InvalidConfig, match=r"database_url.*No such file"):
        Store(Settings(data_dir="none", database_url=url), metrics)
    assert not (tmp_path / "mistyped").exists()
