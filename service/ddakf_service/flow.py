"""Flow: what happens to frames that arrive while their session is busy, or faster than they may, and who is told."""

from __future__ import annotations

import asyncio
import math
from collections import deque
from typing import NamedTuple, Protocol

from ddakf_api.v1 import tracking_pb2 as pb

_BURST = 0.1  # seconds' worth of frames that may come at once: a line that stutters is no offence
_ROUNDING = 1e-6  # of a frame
_SPAN = 1.0  # seconds that are judged together
_BEGUN, _OVER = 0.25, 0.05  # shares of frames that are not tracked
_REPEAT = 10.0  # seconds between two notices of the same overload


class Waiting(NamedTuple):
    """A frame and when it arrived (monotonic clock, seconds)."""

    frame: pb.Frame
    arrived: float


class Mailbox(Protocol):
    """Where the reader of a stream leaves frames, and the session takes them from."""

    async def put(self, frame: pb.Frame, arrived: float) -> int:
        """Leaves a frame that arrived then (monotonic clock, seconds) and returns how many older ones it displaced; may wait,
        which holds the client back."""

    async def get(self) -> Waiting | None:
        """The next frame to track, or None when no more will come."""

    def close(self) -> None:
        """No more frames will be put; those that wait can still be taken."""

    def __len__(self) -> int:
        """Frames that wait."""


class LosslessMailbox:
    """All frames, in order; ``put`` waits while ``capacity`` of them do. For one reader and one taker."""

    def __init__(self, capacity: int):
        self._frames: deque[Waiting] = deque()
        self._capacity = capacity
        self._closed = False
        self._filled, self._room = asyncio.Event(), asyncio.Event()

    async def put(self, frame: pb.Frame, arrived: float) -> int:
        while len(self._frames) >= self._capacity and not self._closed:
            self._room.clear()
            await self._room.wait()
        self._frames.append(Waiting(frame, arrived))
        self._filled.set()
        return 0

    async def get(self) -> Waiting | None:
        while not self._frames and not self._closed:
            self._filled.clear()
            await self._filled.wait()
        self._room.set()
        return self._frames.popleft() if self._frames else None

    def close(self) -> None:
        self._closed = True
        self._filled.set()
        self._room.set()

    def __len__(self) -> int:
        return len(self._frames)


class RealtimeMailbox:
    """One frame: the newest wins, so that latency stays bounded however fast frames come."""

    def __init__(self):
        self._newest: Waiting | None = None
        self._closed = False
        self._filled = asyncio.Event()

    async def put(self, frame: pb.Frame, arrived: float) -> int:
        displaced = len(self)
        self._newest = Waiting(frame, arrived)
        self._filled.set()
        return displaced

    async def get(self) -> Waiting | None:
        while self._newest is None and not self._closed:
            self._filled.clear()
            await self._filled.wait()
        waiting, self._newest = self._newest, None
        return waiting

    def close(self) -> None:
        self._closed = True
        self._filled.set()

    def __len__(self) -> int:
        return int(self._newest is not None)


def mailbox_for(mode: pb.FlowMode, capacity: int) -> Mailbox:
    """The mailbox of a flow mode; ``capacity`` bounds the lossless one."""
    return LosslessMailbox(capacity) if mode == pb.FLOW_MODE_LOSSLESS else RealtimeMailbox()


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
