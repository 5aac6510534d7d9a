"""Watchers: read-only readers of a session's responses, in addition to its client.

A session has one hub, :class:`Watchers`. It appends every response, one shared object, to the queue of each watcher. A full
queue drops its oldest result. Nothing here waits, so a slow watcher delays neither the tracker nor another watcher.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Awaitable, Callable, Set

from ddakf_api.errors import DeadlineExceeded, ResourceExhausted
from ddakf_api.v1 import tracking_pb2 as pb

from .response import Response

# Queued responses per watcher, each with its frame. Watchers share the objects, so this bounds the memory of a session's
# responses.
_CAPACITY = 4
_RETRY_WHEN_FULL = 5.0  # seconds


class Watcher:
    """One reader. A transport calls :meth:`deliver`, and leaves the watcher to :meth:`.streams.Streams.unwatch` at the end.

    Args:
        hub: of the session.
        started: what it is told first.
        request: how it reads. ``every_nth``: arrays only in results whose count of applied frames is a multiple of it;
            ``include_frames``: with their frames.
        key_id: of the key that it reads with; empty: none.
    """

    def __init__(self, hub: Watchers, started: pb.Started, request: pb.WatchSessionRequest, key_id: str):
        self._hub, self.key_id = hub, key_id
        self._waiting: deque[tuple[Response, bytes | memoryview]] = deque([(Response(pb.TrackResponse(started=started)), b"")])
        self._every_nth, self._with_frames = max(request.every_nth, 1), request.include_frames
        self._changed = asyncio.Event()
        self._closed = False
        self._error: Exception | None = None

    def put(self, response: Response, frame: bytes | memoryview = b"") -> None:
        """Queues a response, with arrays and frame if it is an n-th result. A full queue drops its oldest result.

        Who reads no frames learns of no change of the tracker.
        """
        if not self._with_frames and (response.has("reset") or response.has("update")):
            return
        with_arrays = response.message.result.frames_applied % self._every_nth == 0
        with_frame = self._with_frames and with_arrays and response.has("result")
        self._waiting.append((response if with_arrays else response.without_arrays(), frame if with_frame else b""))
        if len(self._waiting) > _CAPACITY:
            oldest = next((i for i, (waiting, _) in enumerate(self._waiting) if waiting.has("result")), 0)
            del self._waiting[oldest]
        self._changed.set()

    def close(self, error: Exception | None) -> None:
        """Closes the queue. Queued responses are still read; then ``error`` is raised, if any."""
        if not self._closed:
            self._closed, self._error = True, error
            self._changed.set()

    def leave(self) -> None:
        """Removes the watcher and drops its error, whose traceback refers to the watcher."""
        self._error = None
        self._hub.discard(self)

    async def deliver(self, send: Callable[[Response], Awaitable[None]], timeout: float) -> None:
        """Sends all responses, Started first.

        Raises:
            DeadlineExceeded: the reader did not read one for ``timeout`` seconds. Else the reason of the session's end.
        """
        async for response in self.responses():
            try:
                async with asyncio.timeout(timeout):
                    await send(response)
            except TimeoutError:
                raise DeadlineExceeded(f"the watcher has not read its responses for {timeout:g} s") from None

    async def responses(self) -> AsyncIterator[Response]:
        """All responses, Started first. Raises the reason of the session's end."""
        while True:
            while self._waiting:
                response, frame = self._waiting.popleft()
                if frame:
                    yield Response.of_frame(frame)
                yield response
            if self._closed:
                break
            self._changed.clear()
            await self._changed.wait()
        error, self._error = self._error, None
        try:
            if error:
                raise error
        finally:
            del error  # the error's traceback refers to this Python frame: a reference cycle


class Watchers:
    """All watchers of one session."""

    def __init__(self):
        self._watchers: set[Watcher] = set()

    def __len__(self) -> int:
        return len(self._watchers)

    def add(
        self, name: str, request: pb.WatchSessionRequest, statistics: pb.SessionStatistics, max_watchers: int, key_id: str
    ) -> Watcher:
        """Adds a watcher of the session of this name.

        Raises:
            ResourceExhausted: the session has ``max_watchers`` already.
        """
        if len(self) >= max_watchers:
            message = f"{name} has its {max_watchers} watchers already; try again later"
            raise ResourceExhausted(message, retry_after=_RETRY_WHEN_FULL)
        started = pb.Started(
            name=name,
            last_sequence_number=statistics.last_sequence_number,
            last_capture_time=statistics.last_capture_time,
        )
        watcher = Watcher(self, started, request, key_id)
        self._watchers.add(watcher)
        return watcher

    def discard(self, watcher: Watcher) -> None:
        """Removes a watcher."""
        self._watchers.discard(watcher)

    def publish(self, response: Response, frame: bytes | memoryview = b"") -> None:
        """Queues a response of the stream, and the serialised frame that it answers, for every watcher; no pongs."""
        if self._watchers and not response.has("pong"):
            for watcher in self._watchers:
                watcher.put(response, frame)

    def shut_out(self, key_ids: Set[str], error: Exception) -> None:
        """Closes the watchers of these keys with an error."""
        for watcher in self._watchers:
            if watcher.key_id in key_ids:
                watcher.close(error)

    def close(self, error: Exception | None) -> None:
        """Closes every watcher, with the reason of the session's end."""
        for watcher in self._watchers:
            watcher.close(error)
