"""Flow: what happens to frames that arrive while their session is busy, or faster than they may, and who is told."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import NamedTuple, Protocol

from ddakf_api.v1 import tracking_pb2 as pb


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
