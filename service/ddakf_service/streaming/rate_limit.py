"""Rate limit: frame rates of a session and of a key, the rate at which frames arrive, and a detector of overload."""

from __future__ import annotations

import math

from ..token_bucket import TokenBucket

_BURST = 0.1  # seconds of frames that may arrive at once: network jitter is allowed
_RATE_GAIN = 0.1  # of the running mean of the intervals between frames
_LEAST_INTERVAL = 1e-3  # seconds
_JUDGED_SPAN = 1.0  # seconds per decision
_PAUSE = 3.0  # seconds without a frame after which a client counts as having paused
_OVERLOAD_BEGINS, _OVERLOAD_ENDS = 0.25, 0.05  # shares of missed frames
_NOTICE_INTERVAL = 10.0  # seconds between two notices of the same overload


class RateLimit:
    """The frame rate of a session, and of the key that sends, which all its streams share.

    Args:
        of_key: the key's bucket. key_rate: frames per second; 0: not limited.
    """

    def __init__(self, of_key: TokenBucket, key_rate: float):
        self._of_session, self._of_key, self.key_rate = frame_bucket(), of_key, key_rate

    def wait(self, rate: float, now: float) -> tuple[float, float]:
        """Seconds until the next frame is allowed, and the rate that it exceeds. Without a wait it takes a token of each.

        Args:
            rate: of the session, frames per second; 0: not limited.
            now: monotonic clock, seconds.
        """
        if (pause := self._of_key.wait(self.key_rate, now)) > 0:
            return pause, self.key_rate
        if (pause := self._of_session.wait(rate, now)) > 0:
            self._of_key.give_back()
        return pause, rate


class ArrivalRate:
    """Frames per second that arrive; 0 before the second one, and after a pause."""

    def __init__(self):
        self._last, self._interval = -math.inf, math.nan

    def arrived(self, now: float) -> None:
        """Counts a frame."""
        interval, self._last = now - self._last, now
        if interval > _PAUSE:
            self._interval = math.nan
        elif math.isnan(self._interval):
            self._interval = interval
        else:
            self._interval += _RATE_GAIN * (interval - self._interval)

    @property
    def value(self) -> float:
        return 1.0 / max(self._interval, _LEAST_INTERVAL) if self._interval > 0 else 0.0


def frame_bucket() -> TokenBucket:
    """A bucket of frames."""
    return TokenBucket(_BURST)


class Overload:
    """Decides when to notify a client of overload, and of which frame rate: at once, then every ten seconds.

    Each span of :data:`_JUDGED_SPAN` seconds is judged by its share of missed frames, once two frames in it were tracked: their
    rate is that of the notice. The overload begins at a larger share than it ends at: this hysteresis prevents repeated notices
    at the border.
    """

    def __init__(self):
        self._notified_at = self._last_event = -math.inf
        self._begin(0.0)

    def applied(self, now: float) -> None:
        """Counts a tracked frame."""
        self._follow(now)
        if not self._applied:
            self._first_applied = now
        self._applied, self._last_applied = self._applied + 1, now

    def missed(self, count: int, now: float) -> float:
        """Counts frames that were not tracked for lack of time. Returns the frame rate for a notice; 0: no notice."""
        self._follow(now)
        self._missed += count
        if now - self._since < _JUDGED_SPAN or self._last_applied == self._first_applied:
            return 0.0
        share, rate = self._missed / (self._applied + self._missed), self._rate()
        self._begin(now)
        if share < _OVERLOAD_ENDS:
            self._notified_at = -math.inf
        return rate if share >= _OVERLOAD_BEGINS and self.may_notify(now) else 0.0

    def _begin(self, now: float) -> None:
        """Begins a span."""
        self._since = now
        self._applied = self._missed = 0
        self._first_applied = self._last_applied = 0.0

    def _follow(self, now: float) -> None:
        """Begins a span after a pause of the client, which is no part of any."""
        if now - self._last_event > _PAUSE:
            self._begin(now)
        self._last_event = now

    def _rate(self) -> float:
        """Tracked frames per second."""
        return (self._applied - 1) / (self._last_applied - self._first_applied)

    def may_notify(self, now: float) -> bool:
        """Whether a notice is due since the last one; True counts as a notice."""
        if now - self._notified_at < _NOTICE_INTERVAL:
            return False
        self._notified_at = now
        return True
