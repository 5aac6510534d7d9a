"""The streams and watchers of sessions: how they are opened, taken over and left."""

from __future__ import annotations

import asyncio
import contextlib
from time import monotonic

from ddakf_api.errors import SessionBusy, StreamTakenOver
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.version import require_compatible

from ..auth.principal import current_principal
from ..sessions.components import SessionComponents
from ..sessions.session import Session
from ..sessions.watchers import Watcher
from .frame_recorder import FrameRecorder
from .stream import Stream

# A client that left its stream may ask for the next one before its leaving is noticed here, or before the frame that is
# in the worker has been tracked.
_NOTICE_PATIENCE = 0.5  # seconds that a stream has to turn out to be left
_ENDING_PATIENCE = 5.0  # seconds that a stream which is ending has to end


class Streams:
    """One stream of a session at most, and watchers beside it."""

    def __init__(self, components: SessionComponents, recorder: FrameRecorder):
        self._pool, self._settings, self._admission = components.pool, components.settings, components.admission
        self._catalog, self._persistence = components.catalog, components.persistence
        self._durability, self._tracker_access = components.durability, components.tracker_access
        self._recorder = recorder

    async def open(self, start: pb.Start) -> Stream:
        """The stream of a session; the caller ends with :meth:`leave`."""
        require_compatible(start.api_version, peer="client")
        self._admission.require_running("streams")
        await self._catalog.known(start.name)
        session = self._catalog.mine(start.name)
        self._require_room(replaced=session.stream)
        if session.stream is not None and start.takeover:
            before = session.stream
            before.end(StreamTakenOver(f"another stream took {session.name} over"))
            await self._close(before)
        elif session.stream is not None:
            await self._ended_by_itself(session.stream)
        session = self._catalog.mine(start.name)  # it may have been deleted, and made by another key, meanwhile
        if session.stream is not None:
            raise _busy(session)
        mode = self._admission.mode(start.flow_mode)
        async with self._tracker_access.of(session):
            self._catalog.mine(start.name)  # the key may have been revoked while this waited
            if session.stream is not None:  # opened while this waited
                raise _busy(session)
            self._admission.require_running("streams")
            self._require_room()
            session.departed = None
            parts = self._pool, self._durability, self._recorder
            session.stream = Stream(session, start, mode, *parts, self._settings.reader_timeout, self._settings.max_image_pixels)
        self._persistence.save(session)
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
            self._persistence.save(stream.session)
        stream.gone.set()

    def watch(self, request: pb.WatchSessionRequest) -> Watcher:
        """A reader of the session's answers, with or without a stream; the caller has it ``leave``."""
        require_compatible(request.api_version, peer="client")
        session = self._catalog.readable(request.name)
        self._require_room()
        key_id = current_principal.get().id
        return session.watchers.add(session.name, session.statistics, request.every_nth, self._settings.max_watchers, key_id)

    def _require_room(self, *, replaced: Stream | None = None) -> None:
        """For one more of the key of this call, in place of the one that is ``replaced``."""
        streams = (session.stream for session in self._catalog)
        key_ids = [stream.key_id for stream in streams if stream not in (None, replaced)]
        for session in self._catalog:
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
