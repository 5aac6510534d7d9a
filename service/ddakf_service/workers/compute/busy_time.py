"""Busy time of a worker: the time in which it tracks one frame or several at once."""

from __future__ import annotations

import threading
from time import perf_counter


class BusyTime:
    """Adds up the time in which at least one ``with`` block is entered, by any thread."""

    def __init__(self):
        self._lock, self._entered = threading.Lock(), 0
        self._since, self._seconds = perf_counter(), 0.0

    def __enter__(self) -> None:
        with self._lock:
            self._add()
            self._entered += 1

    def __exit__(self, *error) -> None:
        with self._lock:
            self._add()
            self._entered -= 1

    def taken(self) -> float:
        """Seconds since it was last asked."""
        with self._lock:
            self._add()
            seconds, self._seconds = self._seconds, 0.0
            return seconds

    def _add(self) -> None:
        now = perf_counter()
        if self._entered:
            self._seconds += now - self._since
        self._since = now
