"""Server name: unique among the servers of one PostgreSQL while the server runs."""

from __future__ import annotations

import math
import subprocess
import sys
import threading
import time
import uuid

import pytest
import sqlalchemy as sa
from ddakf_api.errors import Unavailable
from ddakf_service.observability.metrics import Metrics
from ddakf_service.sessions.recovery.persistence import Persistence
from ddakf_service.sessions.recovery.tenure import Tenure
from ddakf_service.settings import Settings
from ddakf_service.store import store as store_module
from ddakf_service.store.store import Store
from ddakf_service.store.tables import server_name

from ddakf.errors import InvalidConfig

from ...conftest import TIMEOUT, eventually

LOCKS = (
    "FROM pg_locks WHERE locktype = 'advisory' AND granted "
    "AND database = (SELECT oid FROM pg_database WHERE datname = current_database())"
)


def persistence_of(store: Store) -> Persistence:
    return Persistence(store.registry, store.history, store.checkpoints, store.server_id, store.require_name, Tenure())


@pytest.fixture
def url(postgres):
    return postgres.new_database(f"name-{uuid.uuid4()}")


@pytest.fixture
def admin(url):
    engine = sa.create_engine(url, poolclass=sa.NullPool, isolation_level="AUTOCOMMIT")
    with engine.connect() as connection:
        yield connection


@pytest.fixture
def store(url, tmp_path, monkeypatch):
    """Opens the store of a server with a folder of its own."""
    monkeypatch.setattr(server_name, "_CHECK_INTERVAL", 0.05)
    monkeypatch.setattr(server_name, "_RETRY_INTERVAL", 0.05)
    stores, metrics = [], {}

    def open_(server_id: str) -> Store:
        folder, counted = tmp_path / str(uuid.uuid4()), Metrics()
        stores.append(Store(Settings(server_id=server_id, database_url=url, data_dir=str(folder)), counted))
        metrics[stores[-1]] = counted
        return stores[-1]

    open_.up = lambda opened: metrics[opened].registry.get_sample_value("ddakf_store_up", {"part": "server_id"})
    yield open_
    for opened in stores:
        opened.close()


def cut(admin: sa.Connection) -> None:
    """Ends the connection that holds a name."""
    admin.execute(sa.text(f"SELECT pg_terminate_backend(pid) {LOCKS}"))


def held(admin: sa.Connection) -> list[int]:
    """The processes of the database that hold a name."""
    return list(admin.execute(sa.text(f"SELECT pid {LOCKS}")).scalars())


def test_a_second_server_of_a_name_is_refused_until_the_first_has_ended(store, monkeypatch):
    monkeypatch.setattr(server_name, "_PATIENCE", 0.3)
    first = store("stage-a")
    store("stage-b")
    with pytest.raises(InvalidConfig, match=r"server_id.*'stage-a'"):
        store("stage-a")
    assert first.problems() == {}
    first.close()
    assert store("stage-a").problems() == {}


def test_the_command_says_so_in_one_sentence(store, url, tmp_path):
    store("stage-a")
    command = [sys.executable, "-m", "ddakf_service", "--data-dir", str(tmp_path / "other"), "--database-url", url]
    command += ["--server-id", "stage-a", "--grpc-port", "0", "--http-port", "0", "--log-level", "error"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert "server_id" in line
    assert "'stage-a'" in line


def test_a_connection_that_is_cut_is_made_again_and_holds_the_name(store, admin):
    opened = store("stage-a")
    before = held(admin)
    cut(admin)
    eventually(lambda: held(admin) not in ([], before))
    eventually(lambda: opened.problems() == {})


def test_a_database_that_hangs_holds_no_release_up(store, monkeypatch):
    monkeypatch.setattr(server_name, "_PATIENCE", 0.5)
    opened, hanging, released = store("stage-a"), threading.Event(), threading.Event()

    def hang(*_):
        hanging.set()
        released.wait(TIMEOUT)

    monkeypatch.setattr(opened._name, "_check", hang)
    assert hanging.wait(TIMEOUT)
    begun = time.monotonic()
    opened._name.release()
    assert time.monotonic() - begun < 3
    released.set()


async def test_a_disk_that_does_not_answer_holds_no_metrics_up(store, monkeypatch):
    opened, answers = store("stage-a"), threading.Event()
    measured = Metrics()
    free = lambda: measured.registry.get_sample_value("ddakf_store_free_bytes")  # noqa: E731
    await opened.measure(measured)
    assert free() > 0
    monkeypatch.setattr(store_module, "_MEASURING", 0.1)
    asked = []

    def hang(folder):
        asked.append(folder)
        return answers.wait(TIMEOUT) and 5.0

    monkeypatch.setattr(store_module, "_free_bytes", hang)
    for _ in range(3):
        await opened.measure(measured)
        assert math.isnan(free())
    assert len(asked) == 1, "one question at a time"
    answers.set()
    eventually(lambda: opened._measuring.done())
    await opened.measure(measured)
    assert free() == 5.0


async def test_a_name_that_another_server_took_meanwhile_is_a_problem_and_its_sessions_are_left_alone(store, admin):
    opened = store("stage-a")
    (key,) = admin.execute(sa.text(f"SELECT (classid::bigint << 32) | objid::bigint {LOCKS}")).scalars()

    def taken() -> bool:
        cut(admin)
        return admin.execute(sa.select(sa.func.pg_try_advisory_lock(key))).scalar_one()

    eventually(taken)
    eventually(lambda: any("another server" in problem for problem in opened.problems().values()))
    assert store.up(opened) == 0
    with pytest.raises(Unavailable, match="server_id"):
        await persistence_of(opened).live_sessions()
    admin.execute(sa.select(sa.func.pg_advisory_unlock(key)))
    eventually(lambda: opened.problems() == {})
    assert await persistence_of(opened).live_sessions() == []
    assert store.up(opened) == 1


def test_a_database_that_is_away_at_the_start_gives_the_name_later(store, postgres, admin):
    admin.close()
    postgres.stop()
    try:
        opened = store("stage-a")
        assert any("server_id" in problem for problem in opened.problems().values())
        assert store.up(opened) == 0
    finally:
        postgres.start()
    eventually(lambda: opened.problems() == {})
