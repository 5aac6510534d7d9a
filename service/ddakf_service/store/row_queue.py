"""Row queue: rows on their way to the database, bounded."""

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
    """Rows on their way to the database, oldest first; made by :meth:`Database.queue`. Any thread may call."""

    def __init__(self, changed: threading.Condition, capacity: int, write, on_dropped, on_written):
        self._changed, self._capacity, self._write = changed, capacity, write
        self._on_dropped, self._on_written = on_dropped, on_written
        self._rows: OrderedDict[Hashable, Row] = OrderedDict()
        self._flying: OrderedDict[Hashable, Row] = OrderedDict()

    def put(self, key: Hashable, row: Row) -> None:
        """Leaves a row, in place of the one that waits under the same key; the oldest one goes when there is no room."""
        with self._changed:
            self._rows[key] = row
            self._shorten()
            self._changed.notify_all()

    def discard(self, key: Hashable) -> None:
        """Takes a row back, unless it is being written."""
        with self._changed:
            self._rows.pop(key, None)

    def pending(self) -> dict[Hashable, Row]:
        """What is not known to be written, oldest first. A reader asks this first and the database afterwards."""
        with self._changed:
            return {**self._flying, **self._rows}

    def __len__(self) -> int:
        return len(self._rows) + len(self._flying)

    def __contains__(self, key: Hashable) -> bool:
        """Whether a row of this key is not known to be written."""
        with self._changed:
            return key in self._rows or key in self._flying

    def _flush(self, engine: sa.Engine) -> None:
        """Writes everything that waits, in the calling thread."""
        while self._take():
            try:
                with engine.begin() as connection:
                    self._write(connection, list(self._flying.values()))
            except (DataError, IntegrityError):
                self._flush_singly(engine)
            except BaseException:
                self._put_back()
                raise
            self._on_written()
            with self._changed:
                self._flying.clear()
                self._changed.notify_all()

    def _flush_singly(self, engine: sa.Engine) -> None:
        """Writes the rows one by one: what the database refuses shall not keep the others."""
        while self._flying:
            key, row = next(iter(self._flying.items()))
            try:
                with engine.begin() as connection:
                    self._write(connection, [row])
            except (DataError, IntegrityError):
                log.exception("the database refused a row, which is left out", extra={"key": key})
                self._on_dropped(1)
            except BaseException:
                self._put_back()
                raise
            with self._changed:
                del self._flying[key]

    def _take(self) -> bool:
        with self._changed:
            while self._rows and len(self._flying) < _BATCH:
                key, row = self._rows.popitem(last=False)
                self._flying[key] = row
            return bool(self._flying)

    def _put_back(self) -> None:
        with self._changed:
            self._rows = OrderedDict({**self._flying, **self._rows})
            self._flying.clear()
            self._shorten()

    def _shorten(self) -> None:
        while len(self._rows) > self._capacity:
            self._rows.popitem(last=False)
            self._on_dropped(1)
