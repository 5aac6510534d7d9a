"""Server name: a unique name among the servers of one PostgreSQL database, locked while the server runs."""

from __future__ import annotations

import hashlib
import logging
import threading
from time import monotonic

import sqlalchemy as sa
from prometheus_client import Counter, Gauge
from sqlalchemy.exc import SQLAlchemyError

from ddakf.errors import InvalidConfig

from ..condition import sentence_of

log = logging.getLogger(__name__)

SERVER_ID = "server_id"  # name of this part of the store
_PATIENCE = 3.0  # seconds that a start waits for the end of a predecessor's connection
_PAUSE = 0.2  # seconds between its attempts
_CHECK_INTERVAL, _RETRY_INTERVAL = 5.0, 1.0  # seconds between checks of the connection, with and without the lock
_ERRORS = (SQLAlchemyError, OSError)


class ServerName:
    """``server_id`` as a PostgreSQL advisory lock on a connection of its own.

    A second server of the same name fails at its start. A thread renews a lost connection; meanwhile another server may take
    the name.

    Args:
        engine: of autocommit connections without a pool; disposed of at the end.
        up, errors: metrics with a label for the part of the store.

    Attributes:
        problem: one sentence while the name is not locked; empty while it is.
    """

    def __init__(self, engine: sa.Engine, server_id: str, up: Gauge, errors: Counter):
        self._engine, self._server_id = engine, server_id
        self._up, self._errors = up.labels(SERVER_ID), errors.labels(SERVER_ID)
        digest = hashlib.sha256(f"ddakf server {server_id}".encode()).digest()
        self._key = int.from_bytes(digest[:8], "big", signed=True)  # PostgreSQL identifies a lock by a number
        self._connection: sa.Connection | None = None
        self.problem = f"server_id {server_id!r} is not held in the database yet"
        self._was_held = False
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._renew, name="server-id", daemon=True)

    def take(self) -> None:
        """Locks the name; blocks. An unreachable database is tried again later.

        Raises:
            InvalidConfig: another server has the name.
        """
        deadline = monotonic() + _PATIENCE
        try:
            while not self._try_lock():
                if monotonic() > deadline:
                    self._disconnect()
                    self._engine.dispose()
                    raise InvalidConfig("server_id", "a name that no other server of this database has", repr(self._server_id))
                self._closing.wait(_PAUSE)
        except _ERRORS as error:
            self._report(f"server_id {self._server_id!r} cannot be held: {sentence_of(error)}")
        self._thread.start()

    def release(self) -> None:
        """Releases the name; blocks for some seconds. Where the database hangs, the end of the process releases it."""
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join(_PATIENCE)
        if not self._thread.is_alive():  # which has the connection
            self._disconnect()
        self._engine.dispose()

    def _renew(self) -> None:
        while not self._closing.wait(_RETRY_INTERVAL if self.problem else _CHECK_INTERVAL):
            try:
                self._check()
            except _ERRORS as error:
                how = "is not held any more" if self._was_held else "cannot be held"
                self._report(f"server_id {self._server_id!r} {how}: {sentence_of(error)}")

    def _check(self) -> None:
        if not self.problem:
            self._connection.execute(sa.select(1))
        elif not self._try_lock():
            self._report(f"server_id {self._server_id!r} is held by another server of this database: give each its own")

    def _try_lock(self) -> bool:
        """Tries to lock the name; returns whether it is locked."""
        if self._connection is None:
            self._connection = self._engine.connect()
        if self._connection.execute(sa.select(sa.func.pg_try_advisory_lock(self._key))).scalar_one():
            if self._thread.ident is not None:
                log.info("server_id %r is held again", self._server_id)
            self.problem, self._was_held = "", True
            self._up.set(1)
        return not self.problem

    def _report(self, problem: str) -> None:
        self._disconnect()  # SQLAlchemy would connect again silently, without the lock
        self._up.set(0)
        self._errors.inc()
        before, self.problem = self.problem, problem
        if before != problem:
            log.error("%s; tracking continues, and the server tries again", problem)

    def _disconnect(self) -> None:
        """Closes the connection, which releases the lock."""
        if self._connection is not None:
            connection, self._connection = self._connection, None
            connection.invalidate()
            connection.close()
