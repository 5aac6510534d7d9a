"""Outbox: responses of a stream on their way to its client, with room for one."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from ddakf_api.v1 import tracking_pb2 as pb

from ..sessions.responses.response import Response

# Responses that may wait for a slow reader: one, so that the next frame is tracked while this one is sent.
_OUTBOX_CAPACITY = 1


class Outbox:
    """Queue of responses to the client.

    Args:
        publish: receives every response and, if given, the frame that it answers, at once; for the session's watchers.
    """

    def __init__(self, publish: Callable[..., None]):
        self._publish = publish
        self._responses: deque[Response] = deque()
        self._changed = asyncio.Event()
        self._room = asyncio.Event()
        self._closed = False
        self._error: Exception | None = None

    async def put(self, response: Response, frame: bytes | memoryview = b"") -> None:
        """Appends a response when there is room; publishes it at once, with the serialised frame that it answers."""
        self._publish(response, frame)
        while len(self._responses) >= _OUTBOX_CAPACITY and not self._closed:
            self._room.clear()
            await self._room.wait()
        self._append(response)

    def notify(self, notice: pb.Notice) -> None:
        """Appends a notice without waiting. It replaces a queued one of its kind, but RESUMED ones, each with its own losses."""
        response = Response(pb.TrackResponse(notice=notice))
        self._publish(response)
        if notice.kind != pb.NOTICE_KIND_RESUMED:
            older = [r for r in self._responses if r.has("notice") and r.message.notice.kind == notice.kind]
            for waiting in older:
                self._responses.remove(waiting)
        self._append(response)

    def _append(self, response: Response) -> None:
        if not self._closed:
            self._responses.append(response)
            self._changed.set()

    def close(self, error: Exception | None = None) -> None:
        """Closes the outbox. ``get`` returns the queued responses, then raises ``error``, if any."""
        if not self._closed:
            self._closed, self._error = True, error
            self._changed.set()
            self._room.set()

    async def get(self) -> Response | None:
        """The next response; None after the last."""
        while not self._responses and not self._closed:
            self._changed.clear()
            await self._changed.wait()
        if self._responses:
            self._room.set()
            return self._responses.popleft()
        self._raise_error()
        return None

    def discard_error(self) -> None:
        """Drops the error: its traceback refers to the stream and, through it, to this outbox."""
        self._error = None

    def _raise_error(self) -> None:
        error, self._error = self._error, None
        try:
            if error:
                raise error
        finally:
            del error  # the error's traceback refers to this Python frame: a reference cycle
