"""Token bucket: a mean rate of events, and a burst."""

from __future__ import annotations

_ROUNDING = 1e-6  # of an event


class TokenBucket:
    """Allows events at a mean rate.

    Args:
        burst: seconds of events that may come at once.
    """

    def __init__(self, burst: float):
        self._burst = burst
        self._tokens = 1.0
        self._filled_at = 0.0

    def wait(self, rate: float, now: float) -> float:
        """Seconds until the next event is allowed. A return of 0 takes a token.

        Args:
            rate: events per second; 0: not limited.
            now: monotonic clock, seconds.
        """
        if rate <= 0:
            return 0.0
        self._tokens = min(max(1.0, self._burst * rate), self._tokens + rate * (now - self._filled_at))
        self._filled_at = now
        if self._tokens < 1.0 - _ROUNDING:
            return (1.0 - self._tokens) / rate
        self._tokens -= 1.0
        return 0.0

    def give_back(self) -> None:
        """Returns a token of an event that did not take place."""
        self._tokens += 1.0
