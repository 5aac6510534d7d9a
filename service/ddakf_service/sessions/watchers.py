"""Watchers: who reads a session's answers beside its client, and cannot slow it.

A session has one hub, :class:`Watchers`. It hands every answer, the same object to all, to the queue of each watcher;
a full queue loses its oldest result. Nothing here waits, so neither the tracker nor another watcher is ever held up.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import AsyncIterator, Set

from ddakf_api.errors import ResourceExhausted
from ddakf_api.v1 import tracking_pb2 as pb

# Answers that wait for one watcher. They are shared between the watchers, so this bounds what a session's answers take.
_CAPACITY = 4
_RETRY_WHEN_FULL = 5.0  # seconds
_ARRAY = pb.PackedArray.DESCRIPTOR


class Watcher:
    """One reader. A transport sends what :meth:`responses` yields, and calls :meth:`leave` at the end.

    Args:
        hub: of the session.
        started: what it is told first.
        every_nth: arrays only in results whose count of applied frames is a multiple of it.

        key_id: of the key that it reads with; empty: none.

    Attributes:
        skipped: results that it was too slow for.
    """

    def __init__(self, hub: Watchers, started: pb.Started, every_nth: int, key_id: str):
        self._hub, self.key_id = hub, key_id
        self._waiting = deque([pb.TrackResponse(started=started)])
        self._every_nth = max(every_nth, 1)
        self._changed = asyncio.Event()
        self._closed = False
        self._error: Exception | None = None
        self.skipped = 0

    def put(self, response: pb.TrackResponse, numbers: pb.TrackResponse) -> None:
        """Leaves an answer, of which ``numbers`` is the one without arrays; the oldest result goes when there are too many."""
        whole = not response.HasField("result") or response.result.frames_applied % self._every_nth == 0
        self._waiting.append(response if whole else numbers)
        if len(self._waiting) > _CAPACITY:
            oldest = next((r for r in self._waiting if r.HasField("result")), self._waiting[0])
            self._waiting.remove(oldest)
            self.skipped += 1
        self._changed.set()

    def close(self, error: Exception | None) -> None:
        """No more answers; those that wait are still read, and then ``error`` is raised, if any."""
        if not self._closed:
            self._closed, self._error = True, error
            self._changed.set()

    def leave(self) -> None:
        """Nothing more is left for it. The frames of its error hold this."""
        self._error = None
        self._hub.discard(self)

    async def responses(self) -> AsyncIterator[pb.TrackResponse]:
        """Everything to send, beginning with Started; raises why the session ended."""
        while True:
            while self._waiting:
                yield self._waiting.popleft()
            if self._closed:
                break
            self._changed.clear()
            await self._changed.wait()
        error, self._error = self._error, None
        try:
            if error:
                raise error
        finally:
            del error  # which this frame, being one of its, would keep


class Watchers:
    """The hub of a session."""

    def __init__(self):
        self._watchers: set[Watcher] = set()

    def __len__(self) -> int:
        return len(self._watchers)

    def key_ids(self) -> list[str]:
        """The key of each watcher; empty: none."""
        return [watcher.key_id for watcher in self._watchers]

    def add(self, name: str, statistics: pb.SessionStatistics, every_nth: int, most: int, key_id: str) -> Watcher:
        """A new watcher of the session of this name.

        Raises:
            ResourceExhausted: there are ``most`` already.
        """
        if len(self) >= most:
            raise ResourceExhausted(f"{name} has its {most} watchers already; try again later", retry_after=_RETRY_WHEN_FULL)
        started = pb.Started(
            name=name,
            last_sequence_number=statistics.last_sequence_number,
            last_capture_time=statistics.last_capture_time,
        )
        watcher = Watcher(self, started, every_nth, key_id)
        self._watchers.add(watcher)
        return watcher

    def discard(self, watcher: Watcher) -> None:
        """The watcher has left."""
        self._watchers.discard(watcher)

    def publish(self, response: pb.TrackResponse) -> None:
        """Hands an answer of the stream to every watcher; pongs are the client's alone."""
        if not self._watchers or response.HasField("pong"):
            return
        numbers = without_arrays(response)
        for watcher in self._watchers:
            watcher.put(response, numbers)

    def shut_out(self, key_ids: Set[str], error: Exception) -> None:
        """Those who read with one of these keys are told why they may no more."""
        for watcher in self._watchers:
            if watcher.key_id in key_ids:
                watcher.close(error)

    def close(self, error: Exception | None) -> None:
        """The session is gone; every watcher is told why."""
        for watcher in self._watchers:
            watcher.close(error)


def without_arrays(response: pb.TrackResponse) -> pb.TrackResponse:
    """The answer with the numbers of its result alone; another kind of answer as it is."""
    if not response.HasField("result"):
        return response
    numbers = pb.TrackResponse()
    for field, value in response.result.ListFields():
        if field.name == "timings":
            numbers.result.timings.update(value)
        elif field.message_type is not _ARRAY:
            setattr(numbers.result, field.name, value)
    return numbers
