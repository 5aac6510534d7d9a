"""Data of earlier versions: this one opens their tables and sessions, or refuses a session in a sentence that names versions."""

from __future__ import annotations

import tarfile
import uuid
from pathlib import Path

import alembic.command
import alembic.config
import numpy as np
import pytest
import sqlalchemy as sa
from ddakf_api.errors import ServiceError
from ddakf_client import connect
from ddakf_service.store.files import checkpoints
from ddakf_service.store.tables import migrations

from ddakf import snapshot
from ddakf.commands import cli

from ..service.conftest import TIMEOUT, postgres, running  # noqa: F401
from .make import FRAMES, LABELS, SERVER_ID, SESSION_ID, frame

ARCHIVES = {path.name.removesuffix(".tar.xz"): path for path in sorted(Path(__file__).parent.glob("*.tar.xz"))}
OLDEST_TABLES, NEWEST_TABLES = "snapshot-6", "0.1.0"
# What the session of an archive meets: None, it goes on; otherwise the refusal has these words.
REFUSED = {"snapshot-6": ("WorkerLost", "could not be restored: snapshot.version: expected 11 to 28, got 6")}


def opened(path: Path, folder: Path) -> Path:
    """The data folder in an archive."""
    with tarfile.open(path) as content:
        content.extraction_filter = getattr(tarfile, "data_filter", None)  # Python 3.11.4 and later know it
        content.extractall(folder)
    return folder


def move_rows(source: str, target: str) -> None:
    """Makes the tables of a database in an empty one, in the same version of the schema, and copies the rows."""
    engines = [sa.create_engine(url, poolclass=sa.NullPool) for url in (source, target)]
    with engines[0].connect() as old, engines[1].begin() as new:
        configuration = alembic.config.Config()
        configuration.set_main_option("script_location", str(Path(migrations.__file__).parent))
        configuration.attributes["connection"] = new
        alembic.command.upgrade(configuration, old.execute(sa.text("SELECT version_num FROM alembic_version")).scalar_one())
        tables = sa.MetaData()
        tables.reflect(new)
        for table in tables.sorted_tables:
            if table.name != "alembic_version" and (rows := old.execute(sa.select(table)).mappings().all()):
                new.execute(sa.insert(table), [dict(row) for row in rows])


def version_of_snapshot(data: Path) -> int:
    """That of the newest checkpoint in a data folder."""
    newest = max(data.glob("checkpoints/*/*/*.checkpoint"))
    state = checkpoints.unpack(newest.read_bytes()).snapshot.data
    at = len(snapshot.MAGIC)
    return int.from_bytes(state[at : at + 4], "little")


def test_there_is_data_of_every_snapshot_that_is_read(tmp_path):
    """Of the present version too: a change of its content needs a new number."""
    versions = {version_of_snapshot(opened(path, tmp_path / name)) for name, path in ARCHIVES.items()}
    assert versions >= set(snapshot.READ)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "database"), [*((name, "sqlite") for name in ARCHIVES), (OLDEST_TABLES, "postgresql"), (NEWEST_TABLES, "postgresql")]
)
def test_data_of_an_earlier_version_is_opened(request, name, database, tmp_path, capsys):
    """PostgreSQL gets the rows of an archive, in tables of its version."""
    data = opened(ARCHIVES[name], tmp_path / "data")
    place = ["--data-dir", str(data)]
    if database == "postgresql":
        place += ["--database-url", request.getfixturevalue("postgres").new_database(f"upgrade-{uuid.uuid4()}")]
        move_rows(f"sqlite:///{data}/ddakf.sqlite", place[-1])
    arguments = ["--workers", "1", "--server-id", SERVER_ID, "--departure-timeout", "300", *place]
    with running(arguments, tmp_path) as service, connect(service.grpc, timeout=TIMEOUT) as client:
        history = client.history(SESSION_ID)
        assert history.applied.sum() == FRAMES
        session = client.open_session(SESSION_ID, flow="lossless")
        assert session.info().labels == LABELS
        assert session.info().applied == FRAMES
        following = (frame(number) for number in range(FRAMES + 1, FRAMES + 5))
        if name in REFUSED:
            with pytest.raises(ServiceError) as refused:
                list(session.track(following))
            said = f"{type(refused.value).__name__}: {refused.value}"
            assert all(word in said for word in REFUSED[name]), said
        else:
            results = list(session.track(following))
            assert [result.state for result in results] == ["tracking"] * 4
            assert np.abs(results[-1].vertices - frame(FRAMES + 4)[0]).max() < 0.01
    assert cli.main(["keys", "list", *place]) == 0
    assert "upgrade" in capsys.readouterr().out


def test_the_document_quotes_the_refusal():
    document = (Path(__file__).parents[2] / "docs/operations-backup.md").read_text(encoding="utf-8")
    assert REFUSED["snapshot-6"][1] in " ".join(document.split())
