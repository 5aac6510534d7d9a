"""Synchronous client: connection, session calls, and the entry points of streams and watchers."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any, Literal, Unpack, overload

import grpc
import numpy as np
from ddakf_api import API_VERSION
from ddakf_api.codec import DEFAULT_CODEC, DEFAULT_DEPTH_CODEC, DEFAULT_STEP
from ddakf_api.errors import FailedPrecondition, ServiceError, SessionNotFound
from ddakf_api.transport import MAX_MESSAGE_BYTES, client_options
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub

from ddakf_client import calls
from ddakf_client.exchange import RESUME, Plan, TrackOptions, log_notice
from ddakf_client.history import History, history_from, history_request
from ddakf_client.results import (
    FrameError,
    Limits,
    MeshInfo,
    Notice,
    Result,
    ServerInfo,
    SessionInfo,
    mesh_info_from,
    session_info_from,
    vertex_map_from,
)
from ddakf_client.stream import track
from ddakf_client.watch import watch, watch_request


def connect(
    target: str | Sequence[str],
    *,
    timeout: float = calls.TIMEOUT,
    credentials: grpc.ChannelCredentials | None = None,
    api_key: str | None = None,
    max_message_bytes: int = MAX_MESSAGE_BYTES,
) -> Client:
    """Connects to a server and compares versions.

    Args:
        target: "host:port"; or several of servers that share their sessions, as a list or with commas between them. The first
            one that answers is used, and the next one when it stops to, or when a stream gets no answer within the timeout.
        timeout: seconds per call, and per answer to a frame; above 0, at most 1e9.
        credentials: TLS credentials, see :func:`~ddakf_client.tls_credentials`; None: no encryption.
        api_key: sent with every call, without white space around it.
        max_message_bytes: limit of one message in either direction.

    Raises:
        InvalidArgument: the target has no port, the timeout is out of range, or the key cannot be sent.
        Unavailable, DeadlineExceeded: no server answers at this address.
        VersionMismatch: client and server have incompatible versions.
    """
    targets = calls.targets_of(target)
    calls.require_timeout(timeout)

    def open_channel(target: str) -> grpc.Channel:
        options = client_options(target, max_message_bytes)
        if credentials is None:
            return grpc.insecure_channel(target, options)
        return grpc.secure_channel(target, credentials, options)

    client = Client(open_channel, targets, timeout=timeout, api_key=api_key, max_message_bytes=max_message_bytes)
    try:
        client.server = client.server_info()
    except ServiceError:
        client.close()
        raise
    return client


class Client:
    """A connection to a server, made by :func:`connect`. Use it as a context, or call :meth:`close`.

    Attributes:
        target: "host:port" of the present server; changes when it redirects the client, or does not answer.
        timeout: seconds per call.
        server: properties of the server when the client connected.
    """

    server: ServerInfo

    def __init__(
        self,
        open_channel: Callable[[str], grpc.Channel],
        targets: Sequence[str],
        *,
        timeout: float,
        api_key: str | None,
        max_message_bytes: int,
    ):
        self._open_channel, self._targets, self.timeout = open_channel, targets, calls.plain(timeout)
        self._max_message_bytes = max_message_bytes
        self._addresses = tuple(targets)  # with that of the last redirection
        self._channels: dict[str, grpc.Channel] = {}  # by target
        self._closed = False
        self._metadata = calls.metadata_for(api_key)
        self.move(targets[0])

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Closes the connection and its calls. Sessions stay on the server until they expire."""
        self._closed = True
        for channel in self._channels.values():
            channel.close()

    def move(self, target: str) -> None:
        """Sends later calls to the server at another address. Open streams stay on their connection."""
        if target not in self._addresses:
            self._addresses = (*self._targets, target)
        self.target = target
        if target not in self._channels:
            self._channels[target] = self._open_channel(target)
        self._stub = TrackingServiceStub(self._channels[target])

    @property
    def others(self) -> int:
        """The number of further addresses to try."""
        return len(self._addresses) - 1

    def move_on(self, target: str) -> None:
        """Sends later calls to the address after one that does not answer, unless they have gone elsewhere already.

        The addresses are those of :func:`connect` and, after them, that of the last redirection: a successor may not listen
        yet, or no longer.
        """
        if self.target == target:
            self.move(calls.after(target, self._addresses))

    def server_info(self) -> ServerInfo:
        """Properties and limits of the server. Raises VersionMismatch for an incompatible version."""
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
        """Creates a session. The end of its context deletes it.

        Args:
            garment: (V, 3) rest vertices in metres, with `faces`; or an object with ``vertices`` and ``faces``; or the name
                that :meth:`upload_mesh` returned.
            faces: (F, 3) vertex indices.
            body: the body in its initial pose: an object with ``vertices`` and ``faces``, a tuple of both, or a name.
            config: configuration of the tracker: a dict of stages, or a ``ddakf.Config``.
            fabric: name of a fabric preset.
            clean: repair an invalid garment; see :attr:`Session.vertex_map`.
            flow: "realtime" (the newest frame replaces older ones) or "lossless" (every frame, in order).
            codec: codec of the clouds, a name of ``CODECS``.
            step: quantisation step of the clouds, metres.
            labels: free key-value pairs.
            limits: limits other than the defaults of the server.
            session_id: 4-63 of [a-z0-9-]; empty: the server chooses.

        Raises:
            InvalidMesh, InvalidConfig, SessionExists, ResourceExhausted, CodecError: see ``ddakf_client.errors``.
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
        """Opens an existing session. The end of its context does not delete it.

        Raises:
            SessionNotFound: the session does not exist.
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
        """Creates a session that continues from :meth:`Session.snapshot` of this server or another.

        Raises:
            InvalidSnapshot: the data is no snapshot.
        """
        request = calls.restore_request(snapshot, labels=labels, limits=limits, session_id=session_id)
        return self._session("RestoreSession", request, keep=False, flow=flow, codec=codec, step=step)

    def sessions(self, *, state: str | None = None, labels: Mapping[str, str] | None = None) -> Iterator[SessionInfo]:
        """Yields the sessions of the server, oldest first, ended ones newest first, filtered by `state` and `labels` if given.

        Their ``config`` is None: ``open_session(id).info()`` has it.
        """
        page_token = ""
        while True:
            page = self.call("ListSessions", calls.list_request(state=state, labels=labels, page_token=page_token))
            yield from map(session_info_from, page.sessions)
            page_token = page.next_page_token
            if not page_token:
                return

    def upload_mesh(self, mesh: object, faces: np.ndarray | None = None) -> str:
        """Stores a mesh on the server and returns its name, for any number of sessions; the same mesh has the same name.

        Args:
            mesh: (V, 3) vertices in metres, with `faces`; or an object with ``vertices`` and ``faces``.

        Raises:
            InvalidMesh: larger than any garment or body may be. ResourceExhausted: beyond a quota of the key.
        """
        return self.call("CreateMesh", calls.mesh_request(mesh, faces)).name

    def meshes(self) -> Iterator[MeshInfo]:
        """Yields the uploaded meshes of the key, oldest first."""
        page_token = ""
        while True:
            page = self.call("ListMeshes", pb.ListMeshesRequest(page_token=page_token))
            yield from map(mesh_info_from, page.meshes)
            page_token = page.next_page_token
            if not page_token:
                return

    def delete_mesh(self, name: str) -> None:
        """Deletes an uploaded mesh. Sessions that use it go on. Raises NotFound: the key has no mesh of this name."""
        self.call("DeleteMesh", calls.delete_mesh_request(name))

    def history(
        self,
        session_id: str,
        *,
        start: datetime | None = None,
        end: datetime | None = None,
        resolution: float = 0.0,
        max_samples: int = 0,
    ) -> History:
        """History of a live session, or of the last ended session with this id.

        Args:
            start, end: with a time zone; default: from the creation of the session to its end, or to now.
            resolution: seconds per sample; 0: the finest with at most `max_samples`.
            max_samples: largest number of samples; 0: 500.

        Raises:
            SessionNotFound: the server has no history of this session.
            Unavailable: the server cannot reach its database.
        """
        request = history_request(session_id, start=start, end=end, resolution=resolution, max_samples=max_samples)
        return history_from(self.call("GetSessionHistory", request))

    def _session(self, method: str, request: object, *, keep: bool, **options: object) -> Session:
        limit = calls.message_limit(self._max_message_bytes, self.server)
        plan = Plan("", self.timeout, max_message_bytes=limit, **options)
        calls.require_codec(plan.codec, self.server)
        message = self.call(method, request)
        return Session(self, message, replace(plan, name=message.name), keep=keep)

    def call(self, method: str, request: object, timeout: float | None = None):
        """Makes a unary call by its name in the schema. Raises the classes of ``errors``."""
        timeout = self.timeout if timeout is None else timeout
        for _ in self._addresses:
            target = self.target
            try:
                return getattr(self._open_stub(), method)(request, timeout=timeout, metadata=self._metadata)
            except grpc.RpcError as error:
                failed = calls.failure(error, target, timeout)
                if not calls.may_call_elsewhere(error, failed, method):
                    break
            self.move_on(target)
        raise failed

    def open_track(self, requests: Iterator[pb.TrackRequest]) -> grpc.Call:
        return calls.opened_in_thread(lambda: self._open_stub().Track(requests, metadata=self._metadata))

    def open_watch(self, request: pb.WatchSessionRequest) -> grpc.Call:
        return calls.opened_in_thread(lambda: self._open_stub().WatchSession(request, metadata=self._metadata))

    def _open_stub(self) -> TrackingServiceStub:
        if self._closed:
            raise FailedPrecondition(calls.CLOSED)
        return self._stub


class Session:
    """A garment on the server, made by :meth:`Client.create_session`.

    Attributes:
        name: "sessions/{session_id}".
        session_id: the part of the name after "sessions/".
        vertex_map: (V,) vertex i of the garment is vertex ``vertex_map[i]`` of the sent mesh; None unless the session was
            created with ``clean=True``.
        keep: the end of the context does not delete the session.
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
            pass  # expired or deleted already
        except ServiceError:
            if error_type is None:  # else the error inside the context takes precedence
                raise

    @overload
    def track(
        self, frames: Iterable[object], *, on_error: Literal["raise"] = "raise", **options: Unpack[TrackOptions]
    ) -> Iterator[Result]: ...

    @overload
    def track(
        self, frames: Iterable[object], *, on_error: str, **options: Unpack[TrackOptions]
    ) -> Iterator[Result | FrameError]: ...

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
        """Streams frames and yields their results in order, until every frame has an answer.

        A separate thread pulls the frames, so that `frames` may wait for a camera. In lossless mode it pulls them only as
        fast as the server tracks them. An error of `frames` is raised once the frames before it have their answers.

        Args:
            frames: :class:`Frame` objects, tuples in the order of its fields, or objects with its attributes.
            flow, codec, step: override those of the session.
            on_error: a refused frame ends the stream ("raise") or yields a :class:`FrameError` ("yield").
            on_notice: called with each notice of the server; the default logs it.
            velocities, covariance: request these arrays.
            takeover: end another stream of the session.
            depth_codec: compression of depth images, a name of ``DEPTH_CODECS``; images of floats that it cannot encode are
                sent as "zstd".
            compact: vertices, sigma and reliability take 9 bytes per vertex instead of 20; errors in docs/protocol.md.
            every_nth: only every n-th result of the session has arrays; those of the others are empty.
            timeout: seconds per answer to a frame.
            resume: seconds of attempts to reconnect, with growing pauses, after the connection is lost or the server stops.
                The session then continues after its last frame. Unanswered frames are sent again, in realtime mode only the
                newest one. ``on_notice`` is called with "resumed"; its ``value`` is the number of answered frames that the
                server has lost. 0: raise instead.

        Raises:
            SessionBusy: the session has another stream.
            WorkerLost, Unavailable, DeadlineExceeded, SessionNotFound, ...: reason for the early end of the stream.
            InvalidFrame, MessageTooLarge: a frame was refused; ``sequence`` is its number.
        """
        plan = self._plan.of_stream(
            flow=flow,
            codec=codec,
            step=step,
            timeout=timeout,
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

    def watch(self, *, every_nth: int = 1, on_notice: Callable[[Notice], None] = log_notice) -> Iterator[Result | FrameError]:
        """Yields the answers of the session's stream from now on. A watcher cannot slow the stream.

        A slow watcher misses results. ``latency`` of a result is nan, because another client sent the frame. Without a stream
        the watcher waits; it does not keep a session from expiring.

        Args:
            every_nth: only every n-th result has arrays; those of the others are empty.
            on_notice: called with each notice of the server; the default logs it.

        Raises:
            SessionNotFound, SessionExpired, WorkerLost, Draining, Unavailable: reason for the end, always one of them.
            ResourceExhausted: the session has the maximum number of watchers.
        """
        calls.require_handler(on_notice)
        return watch(self._client.open_watch(watch_request(self.name, every_nth)), on_notice, self._client.target)

    def info(self) -> SessionInfo:
        """State and statistics after the last frame."""
        return session_info_from(self._client.call("GetSession", pb.GetSessionRequest(name=self.name)))

    def reset(self, vertices: np.ndarray | None = None, *, velocities: np.ndarray | None = None) -> SessionInfo:
        """Restarts the tracker from (V, 3) metres (default: the rest shape) with (V, 3) metres per second (default: zero)."""
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
        """Changes the given fields, also during a stream; the tracker keeps its state.

        Args:
            config: a dict of stages, over the defaults; the fabric stays unless given.
            etag: of the session as last read; the update fails if the session has changed since.

        Raises:
            FailedPrecondition: the session has another etag.
        """
        request = calls.update_request(self.name, labels=labels, config=config, fabric=fabric, limits=limits, etag=etag)
        return session_info_from(self._client.call("UpdateSession", request))

    def snapshot(self) -> bytes:
        """The state of the tracker, for :meth:`Client.restore_session`."""
        return self._client.call("SnapshotSession", pb.SnapshotSessionRequest(name=self.name)).data

    def delete(self) -> None:
        """Deletes the session on the server."""
        self._client.call("DeleteSession", pb.DeleteSessionRequest(name=self.name))
