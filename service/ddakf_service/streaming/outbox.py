"""Outbox: answers of a stream on their way to its client."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from ddakf_api.v1 import tracking_pb2 as pb

# Answers that may wait for a slow reader: one, so that the next frame is tracked while this one is sent.
_OUTBOX_CAPACITY = 1


class Outbox:
    """Answers on their way to the client; ``publish`` is told each of them too, without waiting."""

    def __init__(self, publish: Callable[[pb.TrackResponse], None]):
        self._publish = publish
        self._responses: deque[pb.TrackResponse] = deque()
        self._changed = asyncio.Event()
        self._room = asyncio.Event()
        self._closed = False
        self._error: Exception | None = None

    async def put(self, response: pb.TrackResponse) -> None:
        """Leaves an answer, once there is room for it; watchers get it at once."""
        self._publish(response)
        while len(self._responses) > _OUTBOX_CAPACITY and not self._closed:
            self._room.clear()
            await self._room.wait()
        self._append(response)

    def notify(self, notice: pb.Notice) -> None:
        """Leaves a notice without waiting, in place of one of its kind that still waits."""
        response = pb.TrackResponse(notice=notice)
        self._publish(response)
        older = [r for r in self._responses if r.HasField("notice") and r.notice.kind == notice.kind]
        for waiting in older:
            self._responses.remove(waiting)
        self._append(response)

    def _append(self, response: pb.TrackResponse) -> None:
        if not self._closed:
            self._responses.append(response)
            self._changed.set()

    def close(self, error: Exception | None = None) -> None:
        """No more answers; ``get`` hands out those that wait, and then raises ``error``, if any."""
        if not self._closed:
            self._closed, self._error = True, error
            self._changed.set()
            self._room.set()

    async def get(self) -> pb.TrackResponse | None:
        """The next answer; None after the last."""
        while not self._responses and not self._closed:
            self._changed.clear()
            await self._changed.wait()
        if self._responses:
            self._room.set()
            return self._responses.popleft()
        self._raise_error()
        return None

    def forget_error(self) -> None:
        """Nobody asks any more. Its frames hold the stream and, through it, this."""
        self._error = None

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        try:
            if error:
                raise error
        finally:
            del error  # which this frame, being one of its, would keep
