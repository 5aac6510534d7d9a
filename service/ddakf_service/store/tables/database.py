"""Database: engine, migrations, and one writing thread behind queues of rows.

Only readers wait for the database. Writers append rows to a :class:`RowQueue`. While the database cannot be reached, the rows
stay there, up to the queue's capacity, and are written later.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import re
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
from alembic.runtime.migration import MigrationContext
from alembic.script import ScriptDirectory
from alembic.util.exc import CommandError
from ddakf_api.errors import Unavailable
from sqlalchemy.dialects import postgresql, sqlite
from sqlalchemy.exc import ArgumentError, DataError, DBAPIError, IntegrityError, NoSuchModuleError, ProgrammingError
from sqlalchemy.exc import TimeoutError as PoolTimeout

from ddakf.errors import InvalidConfig

from ...observability.metrics import Metrics
from ..condition import Condition, sentence_of
from ..files.permissions import make_file
from .row_queue import RowQueue

log = logging.getLogger(__name__)

T = TypeVar("T")

IN_MEMORY = "sqlite://"
_SECRET = re.compile("password|secret|token|key", re.IGNORECASE)  # in the name of an option of a URL

_GATHER = 0.25  # seconds of rows per write
_FIRST_PAUSE, _LONGEST_PAUSE = 0.5, 15.0  # seconds between attempts while the database fails
_PERIODIC_INTERVAL = 3600.0  # seconds between runs of the periodic tasks, such as retention
_PERIODIC_RETRY = 60.0  # seconds after a run that failed
_DELETED = 5000  # rows of one transaction; more would fill the write-ahead log, or last longer than a statement may
_LARGEST_LOG = 1 << 24  # bytes that SQLite's write-ahead log keeps when all of it is in the database
_READERS = 4  # threads
_READ_PATIENCE = 5.0  # seconds that a reader waits for a connection; also the timeout of a connection attempt
_RETRY_AFTER = 5.0  # seconds, for callers that could not read
_WAL_PAUSE = 0.02  # seconds between attempts to enable SQLite's write-ahead log
_MIGRATION_LOCK = 0x6464616B66  # PostgreSQL advisory lock; "ddakf"
# With these PostgreSQL detects a vanished client host within half a minute and releases its locks.
_KEEPALIVES = " -c tcp_keepalives_idle=10 -c tcp_keepalives_interval=5 -c tcp_keepalives_count=3"

_INSERTS = {"sqlite": sqlite.insert, "postgresql": postgresql.insert}
_POSTGRES_ARGUMENTS = {
    "connect_timeout": int(_READ_PATIENCE),
    "client_encoding": "utf8",  # of a database with the encoding SQL_ASCII the driver would give bytes
    "tcp_user_timeout": 10_000,  # ms; by default a vanished host is detected after a quarter of an hour
    "options": "-c statement_timeout=20000 -c lock_timeout=10000",
}


class Database:
    """SQLite (write-ahead log) or PostgreSQL behind one writing thread.

    Args:
        url: for SQLAlchemy: ``sqlite:///FILE``, ``postgresql+psycopg://...`` or :data:`IN_MEMORY`.
        metrics: counts failures and dropped rows.

    Attributes:
        file: of a SQLite database; None: in memory, or PostgreSQL.

    Raises:
        InvalidConfig: names ``database_url``: invalid, another kind of database, or the driver is missing.
    """

    def __init__(self, url: str, metrics: Metrics):
        self._engine = _engine(url)
        self.file = _file(self._engine.url)
        self.in_memory = self._engine.dialect.name == "sqlite" and self.file is None
        self.condition = Condition("database", metrics.store_up, metrics.store_errors)
        self._dropped = metrics.store_dropped
        self._queues: list[RowQueue] = []
        self._periodic_tasks: list[Callable[[sa.Connection], bool]] = []
        self._changed = threading.Condition()
        self._immediate, self._closing = threading.Event(), threading.Event()
        self._immediate_users = 0
        self._migrated, self._may_upgrade = False, True
        self._periodic_due = 0.0
        self._thread = threading.Thread(target=self._run, name="database", daemon=True)
        # A pool of its own: readers of an unreachable database must not occupy the shared threads.
        self._readers = ThreadPoolExecutor(_READERS, "database-reader")

    def files(self) -> list[Path]:
        """The files of a SQLite database: itself, its write-ahead log and the log's index."""
        return [] if self.file is None else [self.file.with_name(self.file.name + end) for end in ("", "-wal", "-shm")]

    def lasting_connections(self) -> sa.Engine | None:
        """An engine of lasting autocommit connections, whose locks PostgreSQL releases soon after their host vanishes. None
        for SQLite."""
        if self._engine.dialect.name != "postgresql":
            return None
        arguments = {**_POSTGRES_ARGUMENTS, "options": _POSTGRES_ARGUMENTS["options"] + _KEEPALIVES}
        return sa.create_engine(
            self._engine.url, poolclass=sa.NullPool, isolation_level="AUTOCOMMIT", hide_parameters=True, connect_args=arguments
        )

    def queue(self, capacity: int, write: Callable[[sa.Connection, list], None]) -> RowQueue:
        """Creates a queue whose rows ``write`` writes to the database.

        Queues are emptied in the order of their creation. ``write`` runs in the writing thread and may get rows again that
        it has already written, so it must use :meth:`upsert`.

        Args:
            capacity: rows; beyond it the oldest row is dropped and counted.
        """
        queue = RowQueue(self._changed, capacity, write, self._dropped.inc, self.condition.works)
        self._queues.append(queue)
        return queue

    def periodic_task(self, run: Callable[[sa.Connection], bool]) -> None:
        """Registers a task of the writing thread, at the start and every hour, in transactions of its own.

        It is repeated for as long as it returns that there is more to do; queued rows are written in between.
        """
        self._periodic_tasks.append(run)

    def upsert(self, table: sa.Table, *, fence: str | None = None) -> sa.Insert:
        """An INSERT that replaces a row with the same primary key.

        Args:
            fence: column; a row with a larger value in it stays as it is.
        """
        insert = _INSERTS[self._engine.dialect.name](table)
        others = {column.name: insert.excluded[column.name] for column in table.columns if not column.primary_key}
        keeps_order = None if fence is None else table.c[fence] <= insert.excluded[fence]
        return insert.on_conflict_do_update(index_elements=list(table.primary_key.columns), set_=others, where=keeps_order)

    def open(self, *, upgrade: bool = True) -> None:
        """Migrates the tables and starts the writing thread; blocks. An unreachable database is tried again later.

        Args:
            upgrade: tables of an older version too; servers of that version could not start again.

        Raises:
            InvalidConfig: a newer version of this program created the tables, or an older one without ``upgrade``.
        """
        self._may_upgrade = upgrade
        try:
            self._migrate()
        except CommandError as error:
            self._engine.dispose()
            expected = "tables of this version or an older one" if upgrade else "tables of this version"
            raise InvalidConfig("database_url", expected, f"{_shown(self._engine.url)}: {error}") from None
        except (DBAPIError, OSError) as error:
            self.condition.fails(error)
        self._thread.start()

    async def read(self, query: Callable[[sa.Connection], T]) -> T:
        """Runs ``query`` on a connection in another thread and returns its result.

        Raises:
            Unavailable: the database cannot be reached.
        """
        return await asyncio.get_running_loop().run_in_executor(self._readers, self.read_now, query)

    def read_now(self, query: Callable[[sa.Connection], T]) -> T:
        """:meth:`read` in the calling thread."""
        try:
            if not self._migrated:
                problem = self.condition.problem or "the database has not been reached yet"
                raise Unavailable(f"{problem}; try again later", retry_after=_RETRY_AFTER)
            with self._engine.begin() as connection:
                return query(connection)
        except (DataError, IntegrityError, ProgrammingError):
            raise  # the query itself is wrong
        except (DBAPIError, PoolTimeout, OSError) as error:
            self.condition.fails(error)
            self._wake()
            raise Unavailable(f"{self.condition.problem}; try again later", retry_after=_RETRY_AFTER) from None

    def flush(self, timeout: float) -> bool:
        """Waits until all queued rows are written; False after ``timeout`` seconds."""
        with self.immediate_writes(), self._changed:
            self._changed.notify_all()
            return self._changed.wait_for(lambda: not self.waiting(), timeout)

    @contextlib.contextmanager
    def immediate_writes(self) -> Iterator[None]:
        """Context in which rows are written at once instead of gathered."""
        with self._changed:
            self._immediate_users += 1
            self._immediate.set()
        try:
            yield
        finally:
            with self._changed:
                self._immediate_users -= 1
                if not self._immediate_users:
                    self._immediate.clear()

    def waiting(self) -> int:
        """Number of rows that may not be in the database yet."""
        return sum(len(queue) for queue in self._queues)

    def close(self, timeout: float = 10.0) -> None:
        """Tries once to write all queued rows and ends the thread; blocks at most ``timeout`` seconds."""
        self._closing.set()
        self._wake()
        if self._thread.ident is not None:
            self._thread.join(timeout)
        if unwritten := self.waiting():
            log.error("%d rows could not be written to the database before the end", unwritten)
            self._dropped.inc(unwritten)
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
            with self._engine.begin() as connection:  # after a reader's failure, without a row to write
                connection.execute(sa.select(1))
        for queue in self._queues:
            queue._flush(self._engine)
        if monotonic() >= self._periodic_due:
            self._periodic_due = monotonic() + (_PERIODIC_INTERVAL if self._clean_up() else _PERIODIC_RETRY)

    def _clean_up(self) -> bool:
        """Runs the periodic tasks; whether none failed. That rows stay longer is no failure of the database."""
        for run in self._periodic_tasks:
            more = True
            while more and not self._closing.is_set():
                try:
                    with self._engine.begin() as connection:
                        more = run(connection)
                except (DBAPIError, OSError) as error:
                    log.warning("old rows could not be deleted: %s; tried again in a minute", sentence_of(error))
                    return False
                for queue in self._queues:
                    queue._flush(self._engine)
        return True

    def _wait_for_rows(self) -> None:
        with self._changed:
            self._changed.wait_for(
                lambda: self.waiting() or self._closing.is_set() or self.condition.problem,
                max(self._periodic_due - monotonic(), 0),
            )
        if not self._closing.is_set():
            self._immediate.wait(_GATHER)

    def _migrate(self) -> None:
        if self.file is not None:
            make_file(self.file)
        config = alembic.config.Config()
        config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
        with self._engine.connect().execution_options(ddakf_begin="IMMEDIATE") as connection, connection.begin():
            if connection.dialect.name == "postgresql":  # SQLite's transaction is exclusive
                connection.execute(sa.select(sa.func.pg_advisory_xact_lock(_MIGRATION_LOCK)))
            config.attributes["connection"] = connection
            now = MigrationContext.configure(connection).get_current_revision()
            newest = ScriptDirectory.from_config(config).get_current_head()
            if not self._may_upgrade and now not in (None, newest):
                raise CommandError(f"tables of version {now} of another release, whose own command is needed")
            alembic.command.upgrade(config, "head")
        self._migrated = True


def delete_some(connection: sa.Connection, table: sa.Table, condition: sa.ColumnElement[bool]) -> bool:
    """Deletes some rows of a condition, and returns whether there may be more. Servers that do so together share the rows."""
    keys = list(table.primary_key.columns)
    chosen = sa.select(*keys).where(condition).limit(_DELETED).with_for_update(skip_locked=True)
    among = keys[0] if len(keys) == 1 else sa.tuple_(*keys)
    return connection.execute(sa.delete(table).where(among.in_(chosen))).rowcount >= _DELETED


def _engine(url: str) -> sa.Engine:
    expected = "sqlite:///FILE or postgresql+psycopg://USER:PASSWORD@HOST/DATABASE"
    try:
        parsed = sa.make_url(url)
    except ArgumentError:
        raise InvalidConfig("database_url", expected, "text that is no URL") from None  # without the text: it may hold a password
    shown = _shown(parsed)
    if parsed.get_backend_name() not in _INSERTS:
        raise InvalidConfig("database_url", expected, shown)
    try:
        if parsed.get_backend_name() == "postgresql":
            return sa.create_engine(
                parsed, hide_parameters=True, pool_pre_ping=True, pool_timeout=_READ_PATIENCE, connect_args=_POSTGRES_ARGUMENTS
            )
        # In memory: one connection, shared in turn. A file: any number, because WAL readers never wait.
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


def _shown(url: sa.URL) -> str:
    """The URL without the password, wherever that stands."""
    hidden = dict.fromkeys((name for name in url.query if _SECRET.search(name)), "***")
    return url.update_query_dict(hidden).render_as_string(hide_password=True)


def _file(url: sa.URL) -> Path | None:
    """The file of a SQLite URL; None for memory or another database."""
    if url.get_backend_name() != "sqlite" or url.database in (None, "", ":memory:"):
        return None
    return Path(url.database.removeprefix("file:")).absolute()


def _prepare_sqlite(connection, _) -> None:
    connection.isolation_level = None  # SQLAlchemy begins transactions, also around DDL
    deadline = monotonic() + _READ_PATIENCE
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            break
        except sqlite3.OperationalError:  # another connection creates the file: SQLite does not wait here
            if monotonic() > deadline:
                raise
            sleep(_WAL_PAUSE)
    connection.execute(f"PRAGMA journal_size_limit = {_LARGEST_LOG}")
    connection.execute("PRAGMA synchronous = NORMAL")  # with WAL a power cut loses at most the last commits and damages nothing


def _begin_sqlite(connection: sa.Connection) -> None:
    connection.exec_driver_sql("BEGIN " + connection.get_execution_options().get("ddakf_begin", "DEFERRED"))
