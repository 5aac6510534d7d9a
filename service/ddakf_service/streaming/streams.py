"""Streams of a server: opening, takeover and leaving of streams, and watchers."""

from __future__ import annotations

import asyncio
import contextlib
from time import monotonic

from ddakf_api.errors import SessionBusy, StreamTakenOver
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.version import require_compatible

from ..auth.principal import current_principal
from ..sessions.components import SessionComponents
from ..sessions.responses.watchers import Watcher
from ..sessions.session import Session
from ..token_bucket import TokenBucket
from ..workers.messages.encode import require_known_encodings
from .frame_recorder import FrameRecorder
from .rate_limit import RateLimit, frame_bucket
from .stream import Stream

# A client that left its stream may open the next one before the server notices, or before its last frame has been tracked.
_LEAVE_DETECTION_TIMEOUT = 0.5  # seconds until the server must have noticed that the client left
_END_TIMEOUT = 5.0  # seconds that an ending stream may take


class Streams:
    """At most one stream per session, and any number of watchers within their quota."""

    def __init__(self, components: SessionComponents, recorder: FrameRecorder):
        self._pool, self._settings, self._admission = components.pool, components.settings, components.admission
        self._catalog, self._persistence = components.catalog, components.persistence
        self._durability, self._tracker_access = components.durability, components.tracker_access
        self._penalties, self._ownership, self._tasks = components.penalties, components.ownership, components.tasks
        self._recorder = recorder
        self._watchers: set[Watcher] = set()  # also those of sessions that have ended, until they have read why
        self._key_buckets: dict[str, TokenBucket] = {}  # of frames, by key

    async def require_session(self, name: str) -> None:
        """Checks that the caller's key may use a session; raises as :meth:`.SessionCatalog.changeable`."""
        await self._ownership.require(name)

    async def open(self, start: pb.Start) -> Stream:
        """Opens the stream of a session; the caller ends it with :meth:`leave`."""
        require_compatible(start.api_version, peer="client")
        require_known_encodings(start.result_options)
        mode = self._admission.flow_mode(start.flow_mode)
        self._admission.require_running("streams")
        session = await self._ownership.obtain(start.name, takeover=start.takeover)
        self._require_room(replaced=session.stream)
        stream = None
        await self._tracker_access.wait_for_lease(session)  # a stream before may wait for it with a frame
        while stream is None:  # of simultaneous takeovers each ends the stream of the one before
            await self._wait_until_free(session, start.takeover)
            session = self._catalog.changeable(start.name)  # another key may own the name by now
            _require_free(session, start.takeover)
            async with self._tracker_access.exclusive(session):
                self._catalog.changeable(start.name)  # the key may have been revoked meanwhile
                _require_free(session, start.takeover)
                if session.stream is None:  # none was opened meanwhile
                    stream = session.stream = self._stream(session, start, mode)
        self._persistence.save(session)
        return stream

    def _stream(self, session: Session, start: pb.Start, mode: pb.FlowMode) -> Stream:
        """The stream of a session that has none; the caller holds the session's lock."""
        self._admission.require_running("streams")
        self._require_room()
        session.departure_time = None
        collaborators = self._pool, self._durability, self._penalties, self._recorder, self._rate_limit()
        return Stream(session, start, mode, self._settings, *collaborators)

    def _rate_limit(self) -> RateLimit:
        """The frame rates of a new stream of the caller."""
        caller = current_principal.get()
        return RateLimit(self._key_buckets.setdefault(caller.id, frame_bucket()), caller.frames_per_second)

    def leave(self, stream: Stream) -> asyncio.Task[None]:
        """Closes a stream in the background, so that the client learns of the end before the frame in the worker is tracked."""
        stream.discard_error()
        return self._tasks.start(self._close(stream))

    async def _close(self, stream: Stream) -> None:
        """Returns when the worker has no frame of the stream."""
        await stream.close()
        if stream.session.stream is stream:
            stream.session.stream = None
            stream.session.departure_time = monotonic()
            self._persistence.save(stream.session)
        stream.session_free.set()

    async def watch(self, request: pb.WatchSessionRequest) -> Watcher:
        """Adds a reader of the session's responses, with or without a stream; the caller ends it with :meth:`unwatch`."""
        require_compatible(request.api_version, peer="client")
        session = await self._ownership.readable(request.name)
        self._require_room()
        key_id, most = current_principal.get().id, self._settings.max_watchers
        watcher = session.watchers.add(session.name, request, session.statistics, most, key_id)
        self._watchers.add(watcher)
        return watcher

    def unwatch(self, watcher: Watcher) -> None:
        """Removes a reader."""
        self._watchers.discard(watcher)
        watcher.leave()

    def _require_room(self, *, replaced: Stream | None = None) -> None:
        """Checks that the caller's key may have one more stream, in place of the ``replaced`` one."""
        streams = (session.stream for session in self._catalog)
        key_ids = [stream.key_id for stream in streams if stream not in (None, replaced)]
        key_ids += [watcher.key_id for watcher in self._watchers]
        self._admission.require_stream_room(current_principal.get(), key_ids)

    async def _wait_until_free(self, session: Session, takeover: bool) -> None:
        """Returns when the present stream of a session, if any, is closed: with ``takeover`` it ends, else after the timeouts."""
        if session.stream is not None and takeover:
            before = session.stream
            before.end(StreamTakenOver(f"another stream took over {session.name}"))
            await self._close(before)
        elif session.stream is not None:
            await self._wait_for_end(session.stream)

    async def _wait_for_end(self, stream: Stream) -> None:
        """Returns when a stream whose client has left is closed, or after the timeouts."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(_LEAVE_DETECTION_TIMEOUT):
                await stream.ending.wait()
            async with asyncio.timeout(_END_TIMEOUT):
                await stream.session_free.wait()


def _require_free(session: Session, takeover: bool) -> None:
    if session.stream is not None and not takeover:
        raise SessionBusy(f"{session.name} has a stream already; ask for takeover to end it")
