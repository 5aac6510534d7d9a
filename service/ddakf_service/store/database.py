"""The database: an engine, migrations, one thread that writes, and queues of rows in front of it.

Nobody waits for the database but who reads from it: writers leave rows in a :class:`RowQueue`. While the database cannot be
reached the rows wait there, up to the queue's capacity, and are written when it comes back.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import sqlite3
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from time import monotonic, sleep
from typing import TypeVar

import alembic.command
import alembic.config
import sqlalchemy as sa
from alembic.util.exc import CommandError
from ddakf_api.errors import Unavailable
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import ArgumentError, DataError, DBAPIError, IntegrityError, NoSuchModuleError, ProgrammingError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from ddakf.errors import InvalidConfig

from ..observability.metrics import Metrics
from .condition import Condition
from .row_queue import RowQueue

log = logging.getLogger(__name__)

T = TypeVar("T")

IN_MEMORY = "sqlite://"

_GATHER = 0.25  # seconds for which rows are gathered before they are written together
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 15.0  # seconds between attempts while the database does not work
_CHORE_INTERVAL = 3600.0  # seconds between runs of the chores, such as retention
_READERS = 4  # threads
_READ_PATIENCE = 5.0  # seconds that a reader waits for a connection, and a connection attempt may take
_RETRY_AFTER = 5.0  # seconds, told to who wanted to read
_WAL_PAUSE = 0.02  # seconds between attempts to have an SQLite keep a write-ahead log
_MIGRATION_LOCK = 0x6464616B66  # of PostgreSQL's advisory locks; "ddakf"
# With these PostgreSQL notices within half a minute that the host of a connection is gone, and lets go of its locks.
_KEEPALIVES = " -c tcp_keepalives_idle=10 -c tcp_keepalives_interval=5 -c tcp_keepalives_count=3"

_INSERTS = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}
_POSTGRES_ARGUMENTS = {
    "connect_timeout": int(_READ_PATIENCE),
    "tcp_user_timeout": 10_000,  # ms; a vanished host is noticed after this long rather than after a quarter of an hour
    "options": "-c statement_timeout=20000 -c lock_timeout=10000",
}


class Database:
    """SQLite (write-ahead log) or PostgreSQL behind one writing thread.

    Args:
        url: of SQLAlchemy, ``sqlite:///FILE``, ``postgresql+psycopg://...`` or :data:`IN_MEMORY`.
        metrics: where failures and dropped rows are counted.

    Attributes:
        file: of an SQLite; None: it is in memory, or a PostgreSQL.

    Raises:
        InvalidConfig: naming ``database_url``: no URL, another kind of database, or its driver is missing.
    """

    def __init__(self, url: str, metrics: Metrics):
        self._engine = _engine(url)
        self.file = _file(self._engine.url)
        self.in_memory = self._engine.dialect.name == "sqlite" and self.file is None
        self.condition = Condition("database", metrics.store_up, metrics.store_errors)
        self._dropped = metrics.store_dropped
        self._queues: list[RowQueue] = []
        self._chores: list[Callable[[sa.Connection], None]] = []
        self._changed = threading.Condition()
        self._hurry, self._closing = threading.Event(), threading.Event()
        self._hurrying = 0
        self._migrated = False
        self._chores_due = 0.0
        self._thread = threading.Thread(target=self._run, name="database", daemon=True)
        # Of its own, for who waits for an unreachable database shall not keep others from a thread.
        self._readers = ThreadPoolExecutor(_READERS, "database-reader")

    def lasting_connections(self) -> sa.Engine | None:
        """An engine for connections that are held, statement by statement, and let go of soon after their host has gone; None
        where there is no server that would notice."""
        if self._engine.dialect.name != "postgresql":
            return None
        arguments = {**_POSTGRES_ARGUMENTS, "options": _POSTGRES_ARGUMENTS["options"] + _KEEPALIVES}
        return sa.create_engine(
            self._engine.url, poolclass=sa.NullPool, isolation_level="AUTOCOMMIT", hide_parameters=True, connect_args=arguments
        )

    def queue(self, capacity: int, write: Callable[[sa.Connection, list], None]) -> RowQueue:
        """A queue whose rows ``write`` brings into the database.

        Queues are emptied in the order in which they were made. ``write`` runs in the writing thread and may be called
        again with rows that it has written already, so it has to be an :meth:`upsert`.

        Args:
            capacity: rows; the oldest is dropped, and counted, when one more comes.
        """
        queue = RowQueue(self._changed, capacity, write, self._dropped.inc, self.condition.works)
        self._queues.append(queue)
        return queue

    def chore(self, run: Callable[[sa.Connection], None]) -> None:
        """Something to do in the writing thread at the start and every hour, each in a transaction of its own."""
        self._chores.append(run)

    def upsert(self, table: sa.Table) -> sa.Insert:
        """An INSERT that replaces the row of the same primary key."""
        insert = _INSERTS[self._engine.dialect.name](table)
        others = {column.name: insert.excluded[column.name] for column in table.columns if not column.primary_key}
        return insert.on_conflict_do_update(index_elements=list(table.primary_key.columns), set_=others)

    def open(self) -> None:
        """Migrates the tables and begins to write; blocks. A database that cannot be reached now is tried later.

        Raises:
            InvalidConfig: the tables are of a newer version of this program.
        """
        try:
            self._migrate()
        except CommandError as error:
            self._engine.dispose()
            shown = self._engine.url.render_as_string(hide_password=True)
            raise InvalidConfig("database_url", "tables of this version or an older one", f"{shown}: {error}") from None
        except (DBAPIError, OSError) as error:
            self.condition.fails(error)
        self._thread.start()

    async def read(self, query: Callable[[sa.Connection], T]) -> T:
        """What ``query`` makes of a connection, in another thread.

        Raises:
            Unavailable: the database cannot be reached.
        """
        return await asyncio.get_running_loop().run_in_executor(self._readers, self.read_now, query)

    def read_now(self, query: Callable[[sa.Connection], T]) -> T:
        """As :meth:`read`, in the calling thread."""
        try:
            if not self._migrated:
                raise Unavailable("the database has not been reached yet; try again later", retry_after=_RETRY_AFTER)
            with self._engine.begin() as connection:
                return query(connection)
        except (DataError, IntegrityError, ProgrammingError):
            raise  # a defect of the query
        except (DBAPIError, PoolTimeout, OSError) as error:
            self.condition.fails(error)
            self._wake()
            raise Unavailable(f"{self.condition.problem}; try again later", retry_after=_RETRY_AFTER) from None

    def flush(self, timeout: float) -> bool:
        """Waits until everything left so far is written; False where it was not within ``timeout`` seconds."""
        with self.hurried(), self._changed:
            self._changed.notify_all()
            return self._changed.wait_for(lambda: not self.waiting(), timeout)

    @contextlib.contextmanager
    def hurried(self) -> Iterator[None]:
        """Inside, rows are written as they come rather than gathered."""
        with self._changed:
            self._hurrying += 1
            self._hurry.set()
        try:
            yield
        finally:
            with self._changed:
                self._hurrying -= 1
                if not self._hurrying:
                    self._hurry.clear()

    def waiting(self) -> int:
        """Rows that are not known to be written."""
        return sum(len(queue) for queue in self._queues)

    def close(self, timeout: float = 10.0) -> None:
        """Writes what waits, once, and ends the thread; blocks at most ``timeout`` seconds."""
        self._closing.set()
        self._wake()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        if left := self.waiting():
            log.error("%d rows could not be written to the database before the end", left)
            self._dropped.inc(left)
        self._readers.shutdown(wait=False)
        self._engine.dispose()

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _run(self) -> None:
        pause = _FIRST_PAUSE
        last = False
        while not last:
            last = self._closing.is_set()
            try:
                self._turn()
            except Exception as error:
                if not isinstance(error, (DBAPIError, OSError)):
                    log.exception("writing to the database failed")
                self.condition.fails(error)
                self._closing.wait(pause)
                pause = min(2 * pause, _LONGEST_PAUSE)
            else:
                self.condition.works()
                pause = _FIRST_PAUSE
                self._wait_for_rows()

    def _turn(self) -> None:
        if not self._migrated:
            self._migrate()
        elif self.condition.problem:
            with self._engine.begin() as connection:  # without a row to write, a reader's failure is looked into
                connection.execute(sa.select(1))
        for queue in self._queues:
            queue._flush(self._engine)
        if monotonic() >= self._chores_due:
            for run in self._chores:
                with self._engine.begin() as connection:
                    run(connection)
            self._chores_due = monotonic() + _CHORE_INTERVAL

    def _wait_for_rows(self) -> None:
        with self._changed:
            self._changed.wait_for(
                lambda: self.waiting() or self._closing.is_set() or self.condition.problem,
                max(self._chores_due - monotonic(), 0),
            )
        if not self._closing.is_set():
            self._hurry.wait(_GATHER)

    def _migrate(self) -> None:
        config = alembic.config.Config()
        config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
        with self._engine.connect().execution_options(ddakf_begin="IMMEDIATE") as connection, connection.begin():
            if connection.dialect.name == "postgresql":  # SQLite's transaction is exclusive already
                connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_MIGRATION_LOCK)))
            config.attributes["connection"] = connection
            alembic.command.upgrade(config, "head")
        self._migrated = True


def _engine(url: str) -> sa.Engine:
    expected = "sqlite:///FILE or postgresql+psycopg://USER:PASSWORD@HOST/DATABASE"
    try:
        parsed = sa.make_url(url)
    except ArgumentError:
        raise InvalidConfig("database_url", expected, "text that is no URL") from None  # it may hold a password
    shown = parsed.render_as_string(hide_password=True)
    if parsed.get_backend_name() not in _INSERTS:
        raise InvalidConfig("database_url", expected, shown)
    try:
        if parsed.get_backend_name() == "postgresql":
            return sa.create_engine(
                parsed, hide_parameters=True, pool_pre_ping=True, pool_timeout=_READ_PATIENCE, connect_args=_POSTGRES_ARGUMENTS
            )
        # One connection in memory, which all share in turn; of a file as many as wanted: readers never wait in WAL.
        pool = {"poolclass": sa.QueuePool, "pool_size": 1, "max_overflow": 0} if _file(parsed) is None else {}
        engine = sa.create_engine(
            parsed,
            hide_parameters=True,
            pool_timeout=_READ_PATIENCE,
            connect_args={"check_same_thread": False, "timeout": _READ_PATIENCE},
            **pool,
        )
    except (NoSuchModuleError, ModuleNotFoundError) as error:
        raise InvalidConfig("database_url", "a URL whose driver is installed", f"{shown}: {error}") from None
    sa.event.listen(engine, "connect", _prepare_sqlite)
    sa.event.listen(engine, "begin", _begin_sqlite)
    return engine


def _file(url: sa.URL) -> Path | None:
    """Of an SQLite that is not in memory."""
    if url.get_backend_name() != "sqlite" or url.database in (None, "", ":memory:"):
        return None
    return Path(url.database.removeprefix("file:")).absolute()


def _prepare_sqlite(connection, _) -> None:
    connection.isolation_level = None  # transactions begin where SQLAlchemy says so, DDL included
    deadline = monotonic() + _READ_PATIENCE
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            break
        except sqlite3.OperationalError:  # two that make the file at a time: SQLite itself does not wait here
            if monotonic() > deadline:
                raise
            sleep(_WAL_PAUSE)
    connection.execute("PRAGMA synchronous = NORMAL")  # with WAL: no damage, at most the last commits at a loss of power


def _begin_sqlite(connection: sa.Connection) -> None:
    connection.exec_driver_sql("BEGIN " + connection.get_execution_options().get("ddakf_begin", "DEFERRED"))
