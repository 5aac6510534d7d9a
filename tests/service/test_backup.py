"""``ddakf backup`` and ``ddakf restore``: a session goes on from the copy of a running service's data."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import sqlite3
import stat
import subprocess
import tarfile
import tracemalloc
import uuid
from pathlib import Path

import numpy as np
import pytest
from ddakf_client import Client, Session, connect
from ddakf_service.observability.metrics import Metrics
from ddakf_service.settings import Settings
from ddakf_service.store.files.checkpoints import unpack
from ddakf_service.store.store import Store

from ddakf.commands import cli

from .conftest import TIMEOUT, eventually, make_sheet, running

SHEET = make_sheet()


def cloud(number: int) -> tuple[np.ndarray, float]:
    return SHEET.vertices + [0.002 * number, 0, 0], number / 30


def stored_frames(data: Path) -> int:
    """Frames of the only session in its newest checkpoint."""
    files = sorted((data / "checkpoints").rglob("*.checkpoint"))
    with contextlib.suppress(FileNotFoundError, IndexError):  # the service replaces it
        return unpack(files[-1].read_bytes()).snapshot.session.statistics.frames_applied
    return 0


def begun(client: Client, data: Path) -> tuple[str, Session]:
    """An uploaded mesh, and a labelled session with ten frames in its checkpoint."""
    mesh = client.upload_mesh(*SHEET)
    session = client.create_session(mesh, flow="lossless", labels={"take": "7"})
    list(session.track(cloud(k) for k in range(1, 11)))
    eventually(lambda: stored_frames(data) == 10)
    return mesh, session


def gone_on(client: Client, session_id: str) -> Session:
    """The same session after a restore, which has tracked four frames more."""
    session = client.open_session(session_id, flow="lossless")
    assert session.info().labels == {"take": "7"}
    results = list(session.track(cloud(k) for k in range(11, 15)))
    assert [result.state for result in results] == ["tracking"] * 4
    assert np.abs(results[-1].vertices - cloud(14)[0]).max() < 0.01
    return session


@pytest.mark.slow
def test_a_session_goes_on_from_the_backup_of_a_running_service(tmp_path, capsys):
    data, archive, again = tmp_path / "data", tmp_path / "backup.tar", tmp_path / "again"
    arguments = ["--workers", "1", "--server-id", "one", "--checkpoint-every", "1"]
    with running([*arguments, "--data-dir", str(data)], tmp_path) as service, connect(service.grpc, timeout=TIMEOUT) as client:
        mesh, session = begun(client, data)
        assert cli.main(["backup", str(archive), "--data-dir", str(data)]) == 0
        list(session.track(cloud(k) for k in range(11, 15)))
    assert stat.S_IMODE(archive.stat().st_mode) == 0o600
    assert cli.main(["restore", str(archive), "--data-dir", str(again)]) == 0
    assert {stat.S_IMODE(path.stat().st_mode) for path in again.rglob("*") if path.is_file()} == {0o600}
    capsys.readouterr()
    with running([*arguments, "--data-dir", str(again)], tmp_path) as service, connect(service.grpc, timeout=TIMEOUT) as client:
        session = gone_on(client, session.session_id)
        assert session.info().recoveries == 1
        assert [found.name for found in client.meshes()] == [mesh]


@pytest.mark.slow
def test_a_session_goes_on_from_copies_of_postgresql_and_of_the_checkpoints(postgres, tmp_path):
    """The commands of docs/operations-backup.md, while the service runs."""
    first, second = (postgres.new_database(f"backup-{uuid.uuid4()}") for _ in range(2))
    dump, data, again = tmp_path / "dump", tmp_path / "data", tmp_path / "again"
    again.mkdir(mode=0o700)

    def arguments(url: str, folder: Path) -> list[str]:
        stored = ["--database-url", url, "--checkpoint-url", (folder / "checkpoints").as_uri(), "--data-dir", str(folder)]
        shared = ["--share-sessions", "--server-id", "one", "--lease-seconds", "1"]
        return ["--workers", "1", "--checkpoint-every", "1", *shared, *stored]

    def program(name: str, url: str, *options: str | Path) -> None:
        subprocess.run([postgres.programs / name, "--dbname", url.replace("+psycopg", ""), *options], check=True)

    with running(arguments(first, data), tmp_path) as service, connect(service.grpc, timeout=TIMEOUT) as client:
        mesh, session = begun(client, data)
        program("pg_dump", first, "--format=custom", "--file", dump)
        shutil.copytree(data / "checkpoints", again / "checkpoints")
        list(session.track(cloud(k) for k in range(11, 15)))
    program("pg_restore", second, "--exit-on-error", dump)
    with running(arguments(second, again), tmp_path) as service, connect(service.grpc, timeout=TIMEOUT) as client:
        session = gone_on(client, session.session_id)
        assert session.info().applied == 14
        assert [found.name for found in client.meshes()] == [mesh]


def test_a_large_database_is_copied_through_little_memory(tmp_path):
    size, data, archive = 32 << 20, tmp_path / "data", tmp_path / "x.tar"
    cli.main(["keys", "--data-dir", str(data), "create", "x", "--scope", "read"])
    with contextlib.closing(sqlite3.connect(data / "ddakf.sqlite")) as database:
        database.execute("CREATE TABLE large AS SELECT zeroblob(?) AS content", (size,))
        database.commit()
    tracemalloc.start()
    try:
        assert cli.main(["backup", str(archive), "--data-dir", str(data)]) == 0
        assert cli.main(["restore", str(archive), "--data-dir", str(tmp_path / "again")]) == 0
        assert tracemalloc.get_traced_memory()[1] < size / 4
    finally:
        tracemalloc.stop()
    assert {path.name for path in tmp_path.iterdir()} == {"data", "x.tar", "again"}
    with contextlib.closing(sqlite3.connect(tmp_path / "again/ddakf.sqlite")) as database:
        assert database.execute("SELECT length(content) FROM large").fetchone() == (size,)


def test_the_lock_of_a_running_server_is_no_checkpoint(tmp_path, capsys):
    data, archive = tmp_path / "data", tmp_path / "x.tar"
    store = Store(Settings(data_dir=str(data), server_id="vm"), Metrics())
    try:
        assert (data / "checkpoints/vm.lock").is_file()
        assert cli.main(["backup", str(archive), "--data-dir", str(data)]) == 0
    finally:
        store.close()
    assert "0 checkpoints" in capsys.readouterr().err
    with tarfile.open(archive) as content:
        assert set(content.getnames()) == {"backup.json", "ddakf.sqlite"}


def test_what_is_no_data_folder_is_refused(tmp_path, capsys):
    assert cli.main(["backup", str(tmp_path / "x.tar"), "--data-dir", str(tmp_path / "none")]) == 2
    assert "has no ddakf.sqlite" in capsys.readouterr().err
    assert not (tmp_path / "none").exists()


def test_a_folder_with_content_is_left_alone(tmp_path, capsys):
    (tmp_path / "data").mkdir()
    (tmp_path / "data/own").write_text("mine")
    assert cli.main(["restore", str(tmp_path / "x.tar"), "--data-dir", str(tmp_path / "data")]) == 2
    assert "data_dir: expected an empty folder" in capsys.readouterr().err


@pytest.mark.parametrize("name", ["../outside", "/outside"])
def test_an_archive_cannot_write_elsewhere(tmp_path, capsys, name):
    cli.main(["keys", "--data-dir", str(tmp_path / "data"), "create", "x", "--scope", "read"])
    assert cli.main(["backup", str(tmp_path / "x.tar"), "--data-dir", str(tmp_path / "data")]) == 0
    with tarfile.open(tmp_path / "x.tar", "a") as archive:
        archive.addfile(tarfile.TarInfo(name))
    assert cli.main(["restore", str(tmp_path / "x.tar"), "--data-dir", str(tmp_path / "again")]) == 2
    assert "files of a data folder" in capsys.readouterr().err
    assert not (tmp_path / "outside").exists()


@pytest.mark.parametrize("content", [b"", b"no archive", "other"])
def test_other_files_are_refused(tmp_path, capsys, content):
    file = tmp_path / "x.tar"
    if content == "other":
        with tarfile.open(file, "w") as archive:
            archive.addfile(tarfile.TarInfo("something"))
    else:
        file.write_bytes(content)
    assert cli.main(["restore", str(file), "--data-dir", str(tmp_path / "data")]) == 2
    assert "archive of `ddakf backup`" in capsys.readouterr().err
    assert not (tmp_path / "data").exists()


def test_a_damaged_database_is_refused_and_the_folder_stays_empty(tmp_path, capsys):
    good, bad, data = tmp_path / "x.tar", tmp_path / "bad.tar", tmp_path / "data"
    cli.main(["keys", "--data-dir", str(tmp_path / "first"), "create", "x", "--scope", "read"])
    cli.main(["backup", str(good), "--data-dir", str(tmp_path / "first")])
    with tarfile.open(good) as source, tarfile.open(bad, "w") as target:
        for member in source:
            content = source.extractfile(member).read()
            content = b"x" * len(content) if member.name == "ddakf.sqlite" else content
            target.addfile(member, io.BytesIO(content))
    data.mkdir()
    capsys.readouterr()
    assert cli.main(["restore", str(bad), "--data-dir", str(data)]) == 2
    assert "a whole database, got file is not a database" in capsys.readouterr().err
    assert not any(data.iterdir())
    assert cli.main(["restore", str(good), "--data-dir", str(data)]) == 0
    assert (data / "ddakf.sqlite").is_file()


def test_keys_outlive_a_backup(tmp_path, capsys):
    place = ["--data-dir", str(tmp_path / "data")]
    cli.main(["keys", *place, "create", "x", "--scope", "read"])
    cli.main(["backup", str(tmp_path / "x.tar"), *place])
    cli.main(["restore", str(tmp_path / "x.tar"), "--data-dir", str(tmp_path / "again")])
    capsys.readouterr()
    cli.main(["keys", "--data-dir", str(tmp_path / "again"), "list", "--json"])
    assert [row["name"] for row in json.loads(capsys.readouterr().out)] == ["x"]


def test_a_service_that_stores_elsewhere_is_told_how(tmp_path, capsys, monkeypatch):
    monkeypatch.setenv("DDAKF_DATABASE_URL", "postgresql+psycopg://ddakf:secret@db/ddakf")
    assert cli.main(["backup", str(tmp_path / "x.tar"), "--data-dir", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "its own tools" in said
    assert "secret" not in said


def test_an_archive_goes_where_a_link_leads_and_over_no_device(tmp_path, capsys):
    data, elsewhere = tmp_path / "data", tmp_path / "disk"
    data.mkdir()
    elsewhere.mkdir()
    with contextlib.closing(sqlite3.connect(data / "ddakf.sqlite")) as database:
        database.execute("CREATE TABLE t (x)")
    link, pipe = tmp_path / "b.tar", tmp_path / "pipe"
    link.symlink_to(elsewhere / "b.tar")
    os.mkfifo(pipe)
    assert cli.main(["backup", str(link), "--data-dir", str(data)]) == 0
    assert link.is_symlink()
    assert tarfile.is_tarfile(elsewhere / "b.tar")
    capsys.readouterr()
    assert cli.main(["backup", str(pipe), "--data-dir", str(data)]) == 2
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert capsys.readouterr().err == f"ddakf: file: expected a file in a folder that exists, got {pipe}\n"
