"""Clock: the wall clock of a server's sessions; where servers share sessions, that of their database, so that all agree."""

from __future__ import annotations

import time
from collections.abc import Callable


class Clock:
    """The clock of this machine, set by another one. Any thread may call."""

    def __init__(self):
        self._ahead = 0.0  # seconds, of the other clock

    def now(self) -> float:
        """Seconds since 1970."""
        return time.time() + self._ahead

    def follow(self, read: Callable[[], float]) -> None:
        """Sets the clock by another one.

        Args:
            read: returns the seconds since 1970 of the other clock.
        """
        before = time.time()
        there = read()
        # Whatever lies between these bounds may be right. The clock stays if it does: it has no jitter, and time goes on.
        self._ahead = min(max(self._ahead, there - time.time()), there - before)


clock = Clock()
