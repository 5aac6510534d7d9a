"""Rate limit: a token bucket of frames per stream, and a detector of overload."""

from __future__ import annotations

import math

_BURST = 0.1  # seconds of frames that may arrive at once: network jitter is allowed
_ROUNDING = 1e-6  # of a frame
_JUDGED_SPAN = 1.0  # seconds per decision
_OVERLOAD_BEGINS, _OVERLOAD_ENDS = 0.25, 0.05  # shares of missed frames
_NOTICE_INTERVAL = 10.0  # seconds between two notices of the same overload


class RateLimit:
    """A token bucket: a mean frame rate and a small burst."""

    def __init__(self):
        self._tokens = 1.0
        self._filled_at = 0.0

    def wait(self, rate: float, now: float) -> float:
        """Seconds until the next frame is allowed. A return of 0 takes a token.

        Args:
            rate: frames per second; 0: not limited.
            now: monotonic clock, seconds.
        """
        if rate <= 0:
            return 0.0
        self._tokens = min(max(1.0, _BURST * rate), self._tokens + rate * (now - self._filled_at))
        self._filled_at = now
        if self._tokens < 1.0 - _ROUNDING:
            return (1.0 - self._tokens) / rate
        self._tokens -= 1.0
        return 0.0


class Overload:
    """Decides when to notify a client of overload, and of which frame rate: at once, then every ten seconds.

    Each span of :data:`_JUDGED_SPAN` seconds is judged by its share of missed frames. The overload begins at a larger share
    than it ends at: this hysteresis prevents repeated notices at the border.
    """

    def __init__(self, now: float):
        self._since = now
        self._applied = self._missed = 0
        self._notified_at = -math.inf

    def applied(self) -> None:
        """Counts a tracked frame."""
        self._applied += 1

    def missed(self, count: int, now: float) -> float:
        """Counts frames that were not tracked for lack of time. Returns the frame rate for a notice; 0: no notice."""
        self._missed += count
        if now - self._since < _JUDGED_SPAN:
            return 0.0
        share, rate = self._missed / (self._applied + self._missed), max(self._applied, 1) / (now - self._since)
        self._since, self._applied, self._missed = now, 0, 0
        if share < _OVERLOAD_ENDS:
            self._notified_at = -math.inf
        return rate if share >= _OVERLOAD_BEGINS and self.may_notify(now) else 0.0

    def may_notify(self, now: float) -> bool:
        """Whether a notice is due since the last one; True counts as a notice."""
        if now - self._notified_at < _NOTICE_INTERVAL:
            return False
        self._notified_at = now
        return True
