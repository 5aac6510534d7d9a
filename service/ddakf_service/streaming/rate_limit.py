"""Frame rate limit and overload detection of a stream."""

from __future__ import annotations

import math

_BURST = 0.1  # seconds' worth of frames that may come at once: a line that stutters is no offence


_ROUNDING = 1e-6  # of a frame


_SPAN = 1.0  # seconds that are judged together


_BEGUN, _OVER = 0.25, 0.05  # shares of frames that are not tracked


_REPEAT = 10.0  # seconds between two notices of the same overload


class RateLimit:
    """A token bucket: so many frames per second in the mean, and a few at once."""

    def __init__(self):
        self._tokens = 1.0
        self._filled_at = 0.0

    def wait(self, rate: float, now: float) -> float:
        """Seconds until the next frame may come, at most ``rate`` per second (0: any rate); 0 takes the token for it."""
        if rate <= 0:
            return 0.0
        self._tokens = min(max(1.0, _BURST * rate), self._tokens + rate * (now - self._filled_at))
        self._filled_at = now
        if self._tokens < 1.0 - _ROUNDING:
            return (1.0 - self._tokens) / rate
        self._tokens -= 1.0
        return 0.0


class Overload:
    """Says when a client should be told to send fewer frames, and how many; at once, then rarely for as long as it lasts.

    Spans of :data:`_SPAN` seconds are judged by the share of their frames that were not tracked. Between the share at which
    it begins and the one at which it is over nothing changes, so that nobody is told again and again at the border.
    """

    def __init__(self, now: float):
        self._since = now
        self._applied = self._missed = 0
        self._told_at = -math.inf

    def applied(self) -> None:
        """A frame was tracked."""
        self._applied += 1

    def missed(self, count: int, now: float) -> float:
        """Frames were not tracked for lack of time. The rate to tell the client, frames per second; 0: nothing to tell."""
        self._missed += count
        if now - self._since < _SPAN:
            return 0.0
        share, rate = self._missed / (self._applied + self._missed), max(self._applied, 1) / (now - self._since)
        self._since, self._applied, self._missed = now, 0, 0
        if share < _OVER:
            self._told_at = -math.inf
        return rate if share >= _BEGUN and self.may_tell(now) else 0.0

    def may_tell(self, now: float) -> bool:
        """Whether it is long enough since the client was told last; if so, this counts as telling it."""
        if now - self._told_at < _REPEAT:
            return False
        self._told_at = now
        return True
