"""The streams and watchers of sessions: how they are opened, taken over and left."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Set
from time import monotonic

from ddakf_api.errors import ServiceError, SessionBusy, StreamTakenOver
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.version import require_compatible

from .admission import Admission
from .directory import Directory
from .durability import Durability
from .outcomes import Outcomes
from .records import Records
from .seats import Seats
from .session import Session
from .settings import Settings
from .stream import Stream
from .trust.principal import current_principal
from .watch import Watcher
from .workers import WorkerPool

# A client that left its stream may ask for the next one before its leaving is noticed here, or before the frame that is
# in the worker has been tracked.
_NOTICE_PATIENCE = 0.5  # seconds that a stream has to turn out to be left
_ENDING_PATIENCE = 5.0  # seconds that a stream which is ending has to end


class Streams:
    """One stream of a session at most, and watchers beside it."""

    def __init__(
        self,
        pool: WorkerPool,
        settings: Settings,
        admission: Admission,
        directory: Directory,
        records: Records,
        durability: Durability,
        seats: Seats,
        outcomes: Outcomes,
    ):
        self._pool, self._settings, self._admission = pool, settings, admission
        self._directory, self._records, self._durability = directory, records, durability
        self._seats, self._outcomes = seats, outcomes

    async def open(self, start: pb.Start) -> Stream:
        """The stream of a session; the caller ends with :meth:`leave`."""
        require_compatible(start.api_version, peer="client")
        self._admission.require_running("streams")
        await self._directory.known(start.name)
        session = self._directory.mine(start.name)
        self._require_room(replaced=session.stream)
        if session.stream is not None and start.takeover:
            before = session.stream
            before.end(StreamTakenOver(f"another stream took {session.name} over"))
            await self._close(before)
        elif session.stream is not None:
            await self._ended_by_itself(session.stream)
        session = self._directory.mine(start.name)  # it may have been deleted, and made by another key, meanwhile
        if session.stream is not None:
            raise _busy(session)
        mode = self._admission.mode(start.flow_mode)
        async with self._seats.of(session):
            self._directory.mine(start.name)  # the key may have been revoked while this waited
            if session.stream is not None:  # opened while this waited
                raise _busy(session)
            self._admission.require_running("streams")
            self._require_room()
            session.departed = None
            parts = self._pool, self._durability, self._outcomes
            session.stream = Stream(session, start, mode, *parts, self._settings.reader_timeout, self._settings.max_image_pixels)
        self._records.save(session)
        return session.stream

    def leave(self, stream: Stream) -> asyncio.Task[None]:
        """Closes a stream in the background: its client need not wait for a frame that is in the worker to be told why."""
        stream.left()
        return self._durability.background(self._close(stream))

    async def _close(self, stream: Stream) -> None:
        """Returns when nothing of the stream is left in a worker."""
        await stream.close()
        if stream.session.stream is stream:
            stream.session.stream = None
            stream.session.departed = monotonic()
            self._records.save(stream.session)
        stream.gone.set()

    def watch(self, request: pb.WatchSessionRequest) -> Watcher:
        """A reader of the session's answers, with or without a stream; the caller has it ``leave``."""
        require_compatible(request.api_version, peer="client")
        session = self._directory.readable(request.name)
        self._require_room()
        return session.watchers.add(session.name, session.statistics, request.every_nth, self._settings.max_watchers)

    def shut_out(self, key_ids: Set[str], reason: ServiceError) -> None:
        """Ends those of keys that were revoked."""
        for session in self._directory if key_ids else ():
            if session.stream is not None and session.stream.key_id in key_ids:
                session.stream.end(reason)
            session.watchers.shut_out(key_ids, reason)

    def _require_room(self, *, replaced: Stream | None = None) -> None:
        """For one more of the key of this call, in place of the one that is ``replaced``."""
        streams = (session.stream for session in self._directory)
        key_ids = [stream.key_id for stream in streams if stream not in (None, replaced)]
        for session in self._directory:
            key_ids += session.watchers.key_ids()
        self._admission.require_stream_room(current_principal.get(), key_ids)

    async def _ended_by_itself(self, stream: Stream) -> None:
        """Returns when a stream whose client has left is gone; without it, when the patience is at its end."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_NOTICE_PATIENCE):
                await stream.ending.wait()
            async with asyncio.timeout(_ENDING_PATIENCE):
                await stream.gone.wait()


def _busy(session: Session) -> SessionBusy:
    return SessionBusy(f"{session.name} has a stream already; ask for takeover to end it")
