"""Database: migrations create the declared tables; rows wait for an unreachable database up to their bounds."""

from __future__ import annotations

import asyncio
import contextlib
import sqlite3
import threading
import uuid

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext
from ddakf_api.errors import Unavailable
from ddakf_service.store.tables import database as database_module
from ddakf_service.store.tables.database import IN_MEMORY, Database, delete_some
from ddakf_service.store.tables.schema import api_keys, metadata, state_changes

from ddakf.errors import InvalidConfig

from ...conftest import eventually
from ..conftest import PATIENCE, fill


def changes_queue(database: Database, capacity: int = 100):
    def write(connection, rows):
        connection.execute(database.upsert(state_changes), rows)

    return database.queue(capacity, write)


def change(number: int, state: int = 1) -> dict:
    return {"uid": 1, "time": float(number), "state": state}


def stored(database: Database) -> dict[float, int]:
    query = sa.select(state_changes.c.time, state_changes.c.state)
    return dict(database.read_now(lambda c: [tuple(row) for row in c.execute(query)]))


def test_migrations_lead_to_the_tables_of_the_code(opened, url):
    database = opened(url)
    assert database.read_now(lambda c: compare_metadata(MigrationContext.configure(c), metadata)) == []


def test_an_opened_database_is_left_as_it_was(opened, url):
    first = opened(url)
    key = {"hash": b"h", "prefix": "dk_1", "name": "n", "scopes": "read", "max_sessions": 1, "create_time": 1.0}
    first.read_now(lambda c: c.execute(sa.insert(api_keys).values(key)))
    first.close()
    names = opened(url).read_now(lambda c: list(c.execute(sa.select(api_keys.c.name)).scalars()))
    assert names == ["n"]


def test_an_sqlite_that_another_is_making_is_waited_for(tmp_path, opened):
    """SQLite itself fails at once: its journal mode cannot change during another write."""
    with contextlib.closing(sqlite3.connect(tmp_path / "t", isolation_level=None, check_same_thread=False)) as other:
        other.execute("BEGIN IMMEDIATE")
        release = threading.Timer(0.2, other.execute, ["COMMIT"])
        release.start()
        assert opened(f"sqlite:///{tmp_path}/t").condition.problem == ""
        release.join()


def test_several_servers_may_start_at_once_on_one_database(url, metrics):
    databases = [Database(url, metrics) for _ in range(3)]
    threads = [threading.Thread(target=database.open) for database in databases[1:]]
    for thread in threads:
        thread.start()
    databases[0].open()
    for thread in threads:
        thread.join()
    assert not any(database.condition.problem for database in databases)
    for database in databases:
        database.close()


def test_tables_of_a_newer_version_are_refused(opened, url, metrics):
    database = opened(url)
    database.read_now(lambda c: c.execute(sa.text("UPDATE alembic_version SET version_num = '9999'")))
    database.close()
    with pytest.raises(InvalidConfig, match="database_url"):
        Database(url, metrics).open()


def test_tables_of_an_older_version_stay_as_they_are_where_asked(opened, url, metrics):
    """As by `ddakf keys`: servers of that version could not start again."""
    Database(url, metrics).open(upgrade=False)  # a new database has no version
    database = opened(url)
    database.read_now(lambda c: c.execute(sa.text("UPDATE alembic_version SET version_num = '0004'")))
    database.close()
    with pytest.raises(InvalidConfig, match=r"database_url: expected tables of this version, got .*tables of version 0004"):
        Database(url, metrics).open(upgrade=False)


def test_a_password_among_the_options_of_a_url_is_not_shown(postgres, metrics):
    url = sa.make_url(postgres.new_database(f"shown-{uuid.uuid4()}"))
    database = Database(url.update_query_dict({"password": "s3cret"}).render_as_string(hide_password=False), metrics)
    database.open()
    database.read_now(lambda c: c.execute(sa.text("UPDATE alembic_version SET version_num = '9999'")))
    database.close()
    with pytest.raises(InvalidConfig) as caught:
        Database(url.update_query_dict({"password": "s3cret"}).render_as_string(hide_password=False), metrics).open()
    assert "s3cret" not in str(caught.value)


def old_changes(count: int):
    """Fills a table, and tells a database to delete all of it, in parts; the deletions, with what waits to be written by then."""
    deletions = []

    def attach(database: Database) -> None:
        queue = changes_queue(database)

        def forget(connection) -> bool:
            deletions.append((connection.execute(sa.select(sa.func.count()).select_from(state_changes)).scalar_one(), len(queue)))
            queue.put(-len(deletions), change(-len(deletions)))
            return delete_some(connection, state_changes, state_changes.c.time > 0.0)

        database.periodic_task(forget)

    def fill_with(database: Database) -> None:
        rows = [change(number) for number in range(1, count + 1)]
        database.read_now(lambda c: c.execute(sa.insert(state_changes), rows))

    return fill_with, attach, deletions


def test_many_old_rows_go_in_parts_and_new_ones_are_written_in_between(opened, url, monkeypatch):
    monkeypatch.setattr(database_module, "_DELETED", 1000)
    fill_with, attach, deletions = old_changes(3500)
    first = opened(url)
    fill_with(first)
    first.close()
    database = opened(url, attach=attach)
    eventually(lambda: len(deletions) == 4)
    assert database.flush(PATIENCE)
    assert deletions == [(3500, 0), (2501, 0), (1502, 0), (503, 0)], "the row that each run puts is written before the next"
    assert sorted(stored(database)) == [-4.0, -3.0, -2.0, -1.0]


def test_old_rows_that_cannot_be_deleted_are_no_fault_of_the_database(opened, url, monkeypatch):
    monkeypatch.setattr(database_module, "_PERIODIC_RETRY", 0.2)
    calls = []

    def fails_twice(connection) -> bool:
        calls.append(connection)
        if len(calls) < 3:
            raise sa.exc.OperationalError("DELETE", {}, sqlite3.OperationalError("canceling statement due to statement timeout"))
        return False

    database = opened(url, attach=lambda database: database.periodic_task(fails_twice))
    eventually(lambda: len(calls) == 1 or database.condition.problem)
    assert database.condition.problem == ""
    eventually(lambda: len(calls) == 3)
    assert database.condition.problem == ""


@pytest.mark.slow
def test_the_log_of_sqlite_stays_small_while_many_rows_go(tmp_path, opened):
    """Rows are often deleted because the disk is full: in one transaction the log would be as large as the table."""
    path = tmp_path / "test.sqlite"
    first = opened(f"sqlite:///{path}")
    rows = [change(number) for number in range(500_000)]
    first.read_now(lambda c: c.execute(sa.insert(state_changes), rows))
    first.close()
    assert path.stat().st_size > 9e6
    done = []

    def forget(connection) -> bool:
        done.append(delete_some(connection, state_changes, state_changes.c.time >= 0.0))
        return done[-1]

    database = opened(f"sqlite:///{path}", attach=lambda database: database.periodic_task(forget))
    eventually(lambda: done and not done[-1])
    assert database.flush(PATIENCE)
    eventually(lambda: stored(database) == {})
    assert database.files()[1].stat().st_size < 6e6


@pytest.mark.parametrize("url", ["mysql://u:secret@h/d", "postgresql+nothing://u:secret@h/d", "u:secret", ""])
def test_other_urls_are_refused_without_their_password(url, metrics):
    with pytest.raises(InvalidConfig, match="database_url") as caught:
        Database(url, metrics)
    assert "secret" not in str(caught.value)


def test_the_newest_row_of_a_key_is_written(opened, url):
    database = opened(url)
    queue = changes_queue(database)
    queue.put("a", change(1, state=1))
    queue.put("a", change(1, state=2))
    queue.put("b", change(2))
    assert database.flush(PATIENCE)
    queue.put("a", change(1, state=3))
    assert database.flush(PATIENCE)
    assert stored(database) == {1.0: 3, 2.0: 1}
    assert queue.pending() == {}


def test_a_full_queue_drops_the_oldest_and_counts_them(metrics, tmp_path):
    database = Database(f"sqlite:///{tmp_path}/nowhere/test.sqlite", metrics)  # in a folder that does not exist
    queue = changes_queue(database, capacity=5)
    database.open()
    for number in range(8):
        queue.put(number, change(number))
    assert list(queue.pending()) == [3, 4, 5, 6, 7]
    assert not database.flush(0.0)
    with pytest.raises(Unavailable):
        stored(database)
    assert metrics.registry.get_sample_value("ddakf_store_dropped_total") == 3
    assert metrics.registry.get_sample_value("ddakf_store_up", {"part": "database"}) == 0
    (tmp_path / "nowhere").mkdir()
    assert database.flush(PATIENCE)
    assert sorted(stored(database)) == [3, 4, 5, 6, 7]
    assert metrics.registry.get_sample_value("ddakf_store_up", {"part": "database"}) == 1
    database.close()


def test_a_row_that_is_refused_does_not_keep_the_others(opened, url, metrics):
    database = opened(url)
    queue = changes_queue(database)
    for number, state in ((1, 1), (2, None), (3, 1)):
        queue.put(number, change(number, state))
    assert database.flush(PATIENCE)
    assert stored(database) == {1.0: 1, 3.0: 1}
    assert metrics.registry.get_sample_value("ddakf_store_dropped_total") == 1


def test_rows_wait_while_postgresql_is_away(opened, postgres, metrics):
    database = opened(postgres.new_database("away"))
    queue = changes_queue(database)
    queue.put(0, change(0))
    assert database.flush(PATIENCE)
    postgres.stop()
    try:
        for number in range(1, 50):
            queue.put(number, change(number))
        while not database.condition.problem:
            assert not database.flush(0.05)
        with pytest.raises(Unavailable, match="database"):
            stored(database)
        assert "database" in database.condition.problem
    finally:
        postgres.start()
    assert database.flush(PATIENCE)
    assert sorted(stored(database)) == list(range(50))
    assert database.condition.problem == ""
    assert metrics.registry.get_sample_value("ddakf_store_dropped_total") == 0
    assert metrics.registry.get_sample_value("ddakf_store_errors_total", {"part": "database"}) >= 1


def test_in_memory_readers_and_the_writer_share_one_database(opened):
    database = opened(IN_MEMORY)
    queue = changes_queue(database)
    for number in range(30):
        queue.put(number, change(number))
        stored(database)
    assert database.flush(PATIENCE)
    assert len(stored(database)) == 30


def test_closing_writes_what_waits(opened, url):
    database = opened(url)
    changes_queue(database).put(1, change(1))
    database.close()
    assert stored(opened(url)) == {1.0: 1}


def test_rows_wait_while_the_disk_of_sqlite_is_full(small_disk, opened, metrics):
    database = opened(f"sqlite:///{small_disk}/test.sqlite")
    queue = changes_queue(database, capacity=20_000)
    fill(small_disk)
    for number in range(20_000):  # more than fits into what the database has already
        queue.put(number, change(number))
    while not database.condition.problem:
        assert not database.flush(0.05)
    assert "full" in database.condition.problem
    (small_disk / "ballast").unlink()
    assert database.flush(PATIENCE)
    assert len(stored(database)) == 20_000
    assert metrics.registry.get_sample_value("ddakf_store_dropped_total") == 0


async def test_who_waits_for_the_database_keeps_nobody_else_from_a_thread(opened):
    database, answered = opened(IN_MEMORY), threading.Event()
    reads = [asyncio.create_task(database.read(lambda _: answered.wait(PATIENCE))) for _ in range(64)]
    await asyncio.sleep(0)  # they begin
    await asyncio.to_thread(answered.set)
    assert all(await asyncio.gather(*reads))
