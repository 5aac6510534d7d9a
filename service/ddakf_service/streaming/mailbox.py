"""Backpressure: a bounded mailbox of frames per stream, newest wins or lossless."""

from __future__ import annotations

import asyncio
from collections import deque
from typing import NamedTuple, Protocol

from ddakf_api.errors import InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb

from .frame_message import FrameMessage


class QueuedFrame(NamedTuple):
    """A frame and its time of arrival (monotonic clock, seconds); with ``refusal`` it is not tracked, but refused in its turn."""

    frame: FrameMessage
    arrived: float
    refusal: InvalidFrame | None = None


class Mailbox(Protocol):
    """Queue between the reader of a stream and the session."""

    async def put(self, frame: FrameMessage, arrived: float, refusal: InvalidFrame | None = None) -> int:
        """Adds a frame and returns the number of frames that will not be tracked: older ones that it displaced, or itself where
        the mailbox is closed. A wait holds the client back.

        Args:
            arrived: time of arrival, monotonic clock, seconds.
            refusal: why the frame is not to be tracked.
        """

    async def get(self) -> QueuedFrame | None:
        """The next frame to track; None after the last."""

    def close(self) -> None:
        """Closes the mailbox to new frames. Queued frames can still be taken."""

    def clear(self) -> int:
        """Removes the queued frames; returns their number."""

    def __len__(self) -> int:
        """Number of queued frames."""


class LosslessMailbox:
    """All frames, in order; ``put`` waits while ``capacity`` frames are queued. One producer, one consumer."""

    def __init__(self, capacity: int):
        self._frames: deque[QueuedFrame] = deque()
        self._capacity = capacity
        self._closed = False
        self._filled, self._room = asyncio.Event(), asyncio.Event()

    async def put(self, frame: FrameMessage, arrived: float, refusal: InvalidFrame | None = None) -> int:
        while len(self._frames) >= self._capacity and not self._closed:
            self._room.clear()
            await self._room.wait()
        if self._closed:
            return 1
        self._frames.append(QueuedFrame(frame, arrived, refusal))
        self._filled.set()
        return 0

    async def get(self) -> QueuedFrame | None:
        while not self._frames and not self._closed:
            self._filled.clear()
            await self._filled.wait()
        self._room.set()
        return self._frames.popleft() if self._frames else None

    def close(self) -> None:
        self._closed = True
        self._filled.set()
        self._room.set()

    def clear(self) -> int:
        count = len(self._frames)
        self._frames.clear()
        return count

    def __len__(self) -> int:
        return len(self._frames)


class RealtimeMailbox:
    """One frame: the newest wins, so that latency stays bounded at any frame rate."""

    def __init__(self):
        self._newest: QueuedFrame | None = None
        self._closed = False
        self._filled = asyncio.Event()

    async def put(self, frame: FrameMessage, arrived: float, refusal: InvalidFrame | None = None) -> int:
        if self._closed:
            return 1
        displaced = len(self)
        self._newest = QueuedFrame(frame, arrived, refusal)
        self._filled.set()
        return displaced

    async def get(self) -> QueuedFrame | None:
        while self._newest is None and not self._closed:
            self._filled.clear()
            await self._filled.wait()
        queued, self._newest = self._newest, None
        return queued

    def close(self) -> None:
        self._closed = True
        self._filled.set()

    def clear(self) -> int:
        count, self._newest = len(self), None
        return count

    def __len__(self) -> int:
        return int(self._newest is not None)


def mailbox_for(mode: pb.FlowMode, capacity: int) -> Mailbox:
    """The mailbox of a flow mode; ``capacity`` bounds the lossless mailbox."""
    return LosslessMailbox(capacity) if mode == pb.FLOW_MODE_LOSSLESS else RealtimeMailbox()
