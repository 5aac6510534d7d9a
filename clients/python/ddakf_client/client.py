"""The synchronous client."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import replace
from datetime import datetime
from typing import Any

import grpc
import numpy as np
from ddakf_api import API_VERSION
from ddakf_api.codec import DEFAULT_CODEC, DEFAULT_DEPTH_CODEC, DEFAULT_STEP
from ddakf_api.errors import ServiceError, SessionNotFound
from ddakf_api.transport import MAX_MESSAGE_BYTES, client_options
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub

from ddakf_client import calls
from ddakf_client.exchange import RESUME, Plan, log_notice
from ddakf_client.history import History, history_from, history_request
from ddakf_client.results import (
    FrameError,
    Limits,
    Notice,
    Result,
    ServerInfo,
    SessionInfo,
    session_info_from,
    vertex_map_from,
)
from ddakf_client.stream import track
from ddakf_client.watch import watch, watch_request


def connect(
    target: str,
    *,
    timeout: float = calls.TIMEOUT,
    credentials: grpc.ChannelCredentials | None = None,
    api_key: str | None = None,
    max_message_bytes: int = MAX_MESSAGE_BYTES,
) -> Client:
    """Connects to a server and compares versions.

    Args:
        target: "host:port".
        timeout: seconds that each call, and the answer to each frame, may take.
        credentials: of TLS, e.g. ``grpc.ssl_channel_credentials(root_certificates)``; None: no encryption.
        api_key: sent with every call.
        max_message_bytes: of one message, in either direction.

    Raises:
        Unavailable, DeadlineExceeded: no server answers there.
        VersionMismatch: client and server do not fit together.
    """
    options = client_options(max_message_bytes)

    def open_channel(target: str) -> grpc.Channel:
        if credentials is None:
            return grpc.insecure_channel(target, options)
        return grpc.secure_channel(target, credentials, options)

    client = Client(open_channel, target, timeout=timeout, api_key=api_key)
    try:
        client.server = client.server_info()
    except ServiceError:
        client.close()
        raise
    return client


class Client:
    """A connection to a server, made by :func:`connect`; use it as a context, or call :meth:`close`.

    Attributes:
        target: "host:port"; another one once the server has said that it continues there.
        timeout: seconds that each call may take.
        server: what the server said when the connection was made.
    """

    server: ServerInfo

    def __init__(
        self, open_channel: Callable[[str], grpc.Channel], target: str, *, timeout: float, api_key: str | None
    ):
        self._open_channel, self.timeout = open_channel, timeout
        self._channels: dict[str, grpc.Channel] = {}  # by target
        self._metadata = calls.metadata_for(api_key)
        self.move(target)

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the connection and what is open on it. Sessions stay on the server until they expire."""
        for channel in self._channels.values():
            channel.close()

    def move(self, target: str) -> None:
        """Sends everything from now on to the server at another address; streams that are open stay where they are."""
        self.target = target
        if target not in self._channels:
            self._channels[target] = self._open_channel(target)
        self._stub = TrackingServiceStub(self._channels[target])

    def server_info(self) -> ServerInfo:
        """What the server is and allows; raises VersionMismatch when it does not fit."""
        return calls.checked_server(self.call("GetServerInfo", pb.GetServerInfoRequest(api_version=API_VERSION)))

    def create_session(
        self,
        garment: object,
        faces: np.ndarray | None = None,
        *,
        body: object = None,
        config: Mapping[str, Any] | object = None,
        fabric: str = "",
        clean: bool = False,
        flow: str = "realtime",
        codec: str = DEFAULT_CODEC,
        step: float = DEFAULT_STEP,
        labels: Mapping[str, str] | None = None,
        limits: Limits | None = None,
        session_id: str = "",
    ) -> Session:
        """Creates a session; leaving its context deletes it.

        Args:
            garment: (V, 3) rest vertices in metres, with `faces`; or an object with ``vertices`` and ``faces``.
            faces: (F, 3) vertex indices.
            body: an object with ``vertices`` and ``faces`` or a tuple of both: the body in its pose at the start.
            config: the tracker's configuration, stages of fields, or a ``ddakf.Config``.
            fabric: name of a fabric preset.
            clean: repair the garment rather than refuse it; see :attr:`Session.vertex_map`.
            flow: "realtime" (the newest frame wins) or "lossless" (every frame, in order).
            codec: how clouds are sent, a name of ``CODECS``.
            step: quantisation step of the cloud, metres.
            labels: free key-value pairs.
            limits: bounds other than the server's defaults.
            session_id: 4-63 of [a-z0-9-]; the server chooses when empty.

        Raises:
            InvalidMesh, InvalidConfig, SessionExists, ResourceExhausted, CodecError: as they say.
        """
        request = calls.create_request(
            garment,
            faces,
            body=body,
            config=config,
            fabric=fabric,
            clean=clean,
            labels=labels,
            limits=limits,
            session_id=session_id,
        )
        return self._session("CreateSession", request, keep=False, flow=flow, codec=codec, step=step)

    def open_session(
        self, session_id: str, *, flow: str = "realtime", codec: str = DEFAULT_CODEC, step: float = DEFAULT_STEP
    ) -> Session:
        """A session that exists already; leaving its context keeps it.

        Raises:
            SessionNotFound: no such session.
        """
        request = pb.GetSessionRequest(name=calls.session_name(session_id))
        return self._session("GetSession", request, keep=True, flow=flow, codec=codec, step=step)

    def restore_session(
        self,
        snapshot: bytes,
        *,
        flow: str = "realtime",
        codec: str = DEFAULT_CODEC,
        step: float = DEFAULT_STEP,
        labels: Mapping[str, str] | None = None,
        limits: Limits | None = None,
        session_id: str = "",
    ) -> Session:
        """A new session that goes on from :meth:`Session.snapshot`, of this server or another.

        Raises:
            InvalidSnapshot: the bytes are none.
        """
        request = calls.restore_request(snapshot, labels=labels, limits=limits, session_id=session_id)
        return self._session("RestoreSession", request, keep=False, flow=flow, codec=codec, step=step)

    def sessions(self, *, state: str | None = None, labels: Mapping[str, str] | None = None) -> Iterator[SessionInfo]:
        """The server's sessions, oldest first; only those in `state` and with all `labels`, when given."""
        page_token = ""
        while True:
            page = self.call("ListSessions", calls.list_request(state=state, labels=labels, page_token=page_token))
            yield from map(session_info_from, page.sessions)
            page_token = page.next_page_token
            if not page_token:
                return

    def history(
        self,
        session_id: str,
        *,
        start: datetime | None = None,
        end: datetime | None = None,
        resolution: float = 0.0,
        max_samples: int = 0,
    ) -> History:
        """What happened in a session over time, a live one or the last past one of this id.

        Args:
            start, end: with a time zone; without them from its creation up to now, or to its end.
            resolution: seconds per sample; 0: as fine as fits into `max_samples`.
            max_samples: 0: 500.

        Raises:
            SessionNotFound: none is remembered.
            Unavailable: the server's database cannot be reached now.
        """
        request = history_request(session_id, start=start, end=end, resolution=resolution, max_samples=max_samples)
        return history_from(self.call("GetSessionHistory", request))

    def _session(self, method: str, request: object, *, keep: bool, **options: object) -> Session:
        plan = Plan("", self.timeout, **options)
        calls.require_codec(plan.codec, self.server)
        message = self.call(method, request)
        return Session(self, message, replace(plan, name=message.name), keep=keep)

    def call(self, method: str, request: object, timeout: float | None = None):
        """A unary call by its name in the schema; errors as the classes of ``errors``."""
        timeout = self.timeout if timeout is None else timeout
        try:
            return getattr(self._stub, method)(request, timeout=timeout, metadata=self._metadata)
        except grpc.RpcError as error:
            raise calls.failure(error, self.target, timeout) from None

    def open_track(self, requests: Iterator[pb.TrackRequest]) -> grpc.Call:
        return self._stub.Track(requests, metadata=self._metadata)

    def open_watch(self, request: pb.WatchSessionRequest) -> grpc.Call:
        return self._stub.WatchSession(request, metadata=self._metadata)


class Session:
    """A garment on the server, made by :meth:`Client.create_session`.

    Attributes:
        name: "sessions/{session_id}".
        session_id: the id.
        vertex_map: (V,) vertex i of the garment is vertex ``vertex_map[i]`` of the mesh that was sent; None unless the
            session was created with ``clean=True``.
        keep: leaving the context leaves the session on the server.
    """

    def __init__(self, client: Client, message: pb.Session, plan: Plan, *, keep: bool):
        self._client, self._plan = client, plan
        self.name = message.name
        self.session_id = message.name.removeprefix("sessions/")
        self.vertex_map = vertex_map_from(message)
        self.keep = keep

    def __enter__(self) -> Session:
        return self

    def __exit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        if self.keep:
            return
        try:
            self.delete()
        except SessionNotFound:
            pass  # it has expired, or was deleted by hand
        except ServiceError:
            if error_type is None:  # otherwise what went wrong inside is the news
                raise

    def track(
        self,
        frames: Iterable[object],
        *,
        flow: str | None = None,
        codec: str | None = None,
        step: float | None = None,
        on_error: str = "raise",
        on_notice: Callable[[Notice], None] = log_notice,
        velocities: bool = False,
        covariance: bool = False,
        takeover: bool = False,
        depth_codec: str = DEFAULT_DEPTH_CODEC,
        compact: bool = False,
        every_nth: int = 1,
        timeout: float | None = None,
        resume: float = RESUME,
    ) -> Iterator[Result | FrameError]:
        """Streams frames and yields their results in order, until every frame has been answered.

        Frames are pulled in a thread of their own, so that `frames` may wait for a camera. In lossless flow they are
        pulled only as fast as the server tracks them.

        Args:
            frames: :class:`Frame` objects, tuples in the order of its fields, or objects with its attributes.
            flow, codec, step: other than the session's.
            on_error: a frame that is refused ends the stream ("raise") or gives a :class:`FrameError` ("yield").
            on_notice: called with what the server says in between; by default it is logged.
            velocities, covariance: ask for these arrays.
            takeover: end another stream that the session has.
            depth_codec: how depth images are sent, a name of ``DEPTH_CODECS``; floats go as "zstd" where it cannot have them.
            compact: vertices, sigma and reliability in 9 bytes per vertex rather than 20; docs/protocol.md says how exact.
            every_nth: arrays only in every n-th result of the session; those of the others are empty.
            timeout: seconds that the answer to a frame may take.
            resume: seconds for which a connection that was lost, or whose server stops, is tried to be had again, with
                growing pauses. The session then goes on after the last frame that it has; frames without an answer are
                sent again, in realtime flow the newest alone, and ``on_notice`` is told ("resumed"; ``value`` is the number
                of answered frames that the server has forgotten). 0: such a stream raises.

        Raises:
            SessionBusy: the session has another stream.
            WorkerLost, Unavailable, DeadlineExceeded, SessionNotFound, ...: why the stream ended before its time.
            InvalidFrame: a frame was refused; its ``sequence`` says which.
        """
        given = {"flow": flow, "codec": codec, "step": step, "timeout": timeout}
        plan = replace(
            self._plan,
            **{name: value for name, value in given.items() if value is not None},
            on_error=on_error,
            on_notice=on_notice,
            velocities=velocities,
            covariance=covariance,
            takeover=takeover,
            depth_codec=depth_codec,
            compact=compact,
            every_nth=every_nth,
            resume=resume,
        )
        calls.require_codec(plan.codec, self._client.server)
        return track(self._client, frames, plan)

    def watch(
        self, *, every_nth: int = 1, on_notice: Callable[[Notice], None] = log_notice
    ) -> Iterator[Result | FrameError]:
        """Yields what the session's stream is answered, from now on, without being able to slow it.

        Who reads too slowly misses results. ``latency`` of a result is nan: the frame was somebody else's. Sessions
        without a stream are waited for; a watcher does not keep a session from expiring.

        Args:
            every_nth: arrays only in every n-th result; those of the others are empty.
            on_notice: called with what the server says in between; by default it is logged.

        Raises:
            SessionNotFound, SessionExpired, WorkerLost, Draining, Unavailable: why it ended, for it has no other end.
            ResourceExhausted: the session has as many watchers as it may have.
        """
        return watch(self._client.open_watch(watch_request(self.name, every_nth)), on_notice, self._client.target)

    def info(self) -> SessionInfo:
        """State and statistics as of the last frame."""
        return session_info_from(self._client.call("GetSession", pb.GetSessionRequest(name=self.name)))

    def reset(self, vertices: np.ndarray | None = None, *, velocities: np.ndarray | None = None) -> SessionInfo:
        """Starts the tracker again: from (V, 3) metres, default the rest shape; with (V, 3) m/s, default none."""
        request = calls.reset_request(self.name, vertices, velocities=velocities)
        return session_info_from(self._client.call("ResetSession", request))

    def update(
        self,
        *,
        labels: Mapping[str, str] | None = None,
        config: Mapping[str, Any] | object = None,
        fabric: str | None = None,
        limits: Limits | None = None,
        etag: str = "",
    ) -> SessionInfo:
        """Changes what is given, while frames are tracked too: the tracker goes on where it is.

        Args:
            config: stages of fields, over the defaults; the session's fabric stays, unless another one is given.
            etag: of the session as you saw it: it is changed only if nobody has changed it since.

        Raises:
            FailedPrecondition: the etag is another one.
        """
        request = calls.update_request(
            self.name, labels=labels, config=config, fabric=fabric, limits=limits, etag=etag
        )
        return session_info_from(self._client.call("UpdateSession", request))

    def snapshot(self) -> bytes:
        """The tracker's state, for :meth:`Client.restore_session`."""
        return self._client.call("SnapshotSession", pb.SnapshotSessionRequest(name=self.name)).data

    def delete(self) -> None:
        """Ends the session on the server."""
        self._client.call("DeleteSession", pb.DeleteSessionRequest(name=self.name))
