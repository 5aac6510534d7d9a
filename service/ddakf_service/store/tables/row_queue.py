"""Row queue: a bounded queue of rows in front of the database."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Hashable
from typing import Generic, TypeVar

import sqlalchemy as sa
from sqlalchemy.exc import DataError, IntegrityError

log = logging.getLogger(__name__)

Row = TypeVar("Row")


_BATCH = 1000  # rows per transaction


class RowQueue(Generic[Row]):
    """Rows to write, oldest first; created by :meth:`Database.queue`. Any thread may call."""

    def __init__(self, changed: threading.Condition, capacity: int, write, on_dropped, on_written):
        self._changed, self._capacity, self._write = changed, capacity, write
        self._on_dropped, self._on_written = on_dropped, on_written
        self._rows: OrderedDict[Hashable, Row] = OrderedDict()
        self._in_flight: OrderedDict[Hashable, Row] = OrderedDict()

    def put(self, key: Hashable, row: Row) -> None:
        """Queues a row, in place of a queued row of the same key. A full queue drops its oldest row."""
        with self._changed:
            self._rows[key] = row
            self._shorten()
            self._changed.notify_all()

    def discard(self, key: Hashable) -> None:
        """Removes a queued row, unless it is being written."""
        with self._changed:
            self._rows.pop(key, None)

    def pending(self) -> dict[Hashable, Row]:
        """Rows that may not be in the database yet, oldest first. A reader must call this before it reads the database."""
        with self._changed:
            return {**self._in_flight, **self._rows}

    def __len__(self) -> int:
        return len(self._rows) + len(self._in_flight)

    def __contains__(self, key: Hashable) -> bool:
        """Whether the row of this key may not be in the database yet."""
        with self._changed:
            return key in self._rows or key in self._in_flight

    def _flush(self, engine: sa.Engine) -> None:
        """Writes all queued rows in the calling thread."""
        while self._take():
            try:
                with engine.begin() as connection:
                    self._write(connection, list(self._in_flight.values()))
            except (DataError, IntegrityError):
                self._flush_singly(engine)
            except BaseException:
                self._put_back()
                raise
            self._on_written()
            with self._changed:
                self._in_flight.clear()
                self._changed.notify_all()

    def _flush_singly(self, engine: sa.Engine) -> None:
        """Writes the rows one by one, so that a rejected row does not block the others."""
        while self._in_flight:
            key, row = next(iter(self._in_flight.items()))
            try:
                with engine.begin() as connection:
                    self._write(connection, [row])
            except (DataError, IntegrityError):
                log.exception("the database rejected a row, which is dropped", extra={"key": key})
                self._on_dropped(1)
            except BaseException:
                self._put_back()
                raise
            with self._changed:
                del self._in_flight[key]

    def _take(self) -> bool:
        with self._changed:
            while self._rows and len(self._in_flight) < _BATCH:
                key, row = self._rows.popitem(last=False)
                self._in_flight[key] = row
            return bool(self._in_flight)

    def _put_back(self) -> None:
        with self._changed:
            self._rows = OrderedDict({**self._in_flight, **self._rows})
            self._in_flight.clear()
            self._shorten()

    def _shorten(self) -> None:
        while len(self._rows) > self._capacity:
            self._rows.popitem(last=False)
            self._on_dropped(1)
