"""Heartbeat: renewal of a gateway's leases, and news of their changes, on a connection of its own."""

from __future__ import annotations

import contextlib
import logging
import threading
from collections.abc import Callable
from time import monotonic
from typing import NamedTuple

import sqlalchemy as sa
from sqlalchemy.exc import SQLAlchemyError

from ..clock import clock
from ..condition import sentence_of
from . import leases
from .leases import Lease

log = logging.getLogger(__name__)

_BEATS = 3  # per span of a lease
_RETRY_INTERVAL = 0.5  # seconds
_STOP_PATIENCE = 3.0  # seconds
_LISTENING = 0.2  # seconds between looks at the end of the thread
_ERRORS = (SQLAlchemyError, OSError)


class Beat(NamedTuple):
    """A renewal of the leases.

    Attributes:
        began: time before it (monotonic clock, seconds).
        until: end of the leases, on the same clock.
        held: the leases of this gateway.
    """

    began: float
    until: float
    held: list[Lease]


class Heartbeat:
    """Renews the leases of a gateway in a thread, and reads them whenever another gateway has changed one.

    Args:
        engine: of autocommit connections without a pool; disposed of at the end.
        gateway, address: of this server.
        seconds: that a lease is valid without a renewal.
        may_beat: whether this server holds its name; without it another server of the name renews them.
        on_beat: called in the thread.

    Attributes:
        draining: other gateways should not send clients here.
        ready: whether this one takes sessions; without workers it does not.
    """

    def __init__(
        self,
        engine: sa.Engine,
        gateway: str,
        address: str,
        seconds: float,
        may_beat: Callable[[], bool],
        on_beat: Callable[[Beat], None],
    ):
        self._engine, self._gateway, self._address, self._seconds = engine, gateway, address, seconds
        self._may_beat, self._on_beat = may_beat, on_beat
        self.draining, self.ready = False, lambda: True
        self._begun = False
        self._closing, self._wanted = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._run, name="heartbeat", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def beat_now(self) -> None:
        """Asks for a renewal soon."""
        self._wanted.set()

    def stop(self) -> None:
        """Ends the thread, and the gateway's row with it; blocks for some seconds. The row expires where the database hangs."""
        self._closing.set()
        if self._thread.ident is not None:
            self._thread.join(_STOP_PATIENCE)
        self._engine.dispose()

    def _run(self) -> None:
        working = True
        while not self._closing.is_set():
            try:
                with self._engine.connect() as connection:
                    self._beat_and_listen(connection)
                working = True
            except _ERRORS as error:
                if working:
                    log.error("the leases of this server cannot be renewed: %s", sentence_of(error))
                working = False
                self._closing.wait(_RETRY_INTERVAL)

    def _beat_and_listen(self, connection: sa.Connection) -> None:
        connection.exec_driver_sql(f"LISTEN {leases.CHANNEL}")
        while not self._closing.is_set():
            due = monotonic() + self._seconds / _BEATS
            self._wanted.clear()
            if self._may_beat():
                self._on_beat(self._beat(connection))
            self._listen(connection, due)
        if self._begun:
            with contextlib.suppress(*_ERRORS):  # the row expires by itself
                leases.withdraw(connection, self._gateway)

    def _beat(self, connection: sa.Connection) -> Beat:
        began = monotonic()
        row = self._gateway, self._address, self._seconds, self.draining or not self.ready()
        if not (self._begun and leases.renew(connection, *row)):
            with self._engine.execution_options(isolation_level="READ COMMITTED").begin() as transaction:
                leases.reclaim(transaction, *row)
            self._begun = True
        clock.follow(lambda: leases.time_of(connection))
        return Beat(began, began + self._seconds, leases.held_by(connection, self._gateway))

    def _listen(self, connection: sa.Connection, due: float) -> None:
        """Waits until the next renewal is due, or another gateway has changed a lease of this one."""
        driver = connection.connection.driver_connection
        while not (self._closing.is_set() or self._wanted.is_set()) and (left := due - monotonic()) > 0:
            for notification in driver.notifies(timeout=min(left, _LISTENING), stop_after=1):
                if notification.payload == self._gateway:
                    return
