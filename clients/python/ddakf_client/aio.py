"""Asynchronous client: the API of ``client`` with ``async``. Arguments and errors are described there."""

from __future__ import annotations

from collections.abc import AsyncIterable, AsyncIterator, Callable, Coroutine, Generator, Iterable, Sequence
from dataclasses import replace
from typing import Any, Generic, Literal, TypeVar, Unpack, overload

import grpc
import numpy as np
from ddakf_api import API_VERSION
from ddakf_api.codec import DEFAULT_CODEC, DEFAULT_STEP
from ddakf_api.errors import FailedPrecondition, ServiceError, SessionNotFound
from ddakf_api.transport import MAX_MESSAGE_BYTES, client_options
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub

from ddakf_client import calls
from ddakf_client.aio_stream import track
from ddakf_client.exchange import Plan, TrackOptions, log_notice
from ddakf_client.history import History, history_from, history_request
from ddakf_client.results import (
    FrameError,
    MeshInfo,
    Notice,
    Result,
    ServerInfo,
    SessionInfo,
    mesh_info_from,
    session_info_from,
    vertex_map_from,
)
from ddakf_client.watch import awatch, watch_request

T = TypeVar("T", bound="AsyncClient | AsyncSession")


class Opening(Generic[T]):
    """A client or session under construction: ``await`` it, or enter it with ``async with``."""

    def __init__(self, coroutine: Coroutine[Any, Any, T]):
        self._coroutine = coroutine

    def __await__(self) -> Generator[Any, None, T]:
        return self._coroutine.__await__()

    async def __aenter__(self) -> T:
        self._opened = await self._coroutine
        return self._opened

    async def __aexit__(self, *error: object) -> None:
        await self._opened.__aexit__(*error)


def aconnect(
    target: str | Sequence[str],
    *,
    timeout: float = calls.TIMEOUT,
    credentials: grpc.ChannelCredentials | None = None,
    api_key: str | None = None,
    max_message_bytes: int = MAX_MESSAGE_BYTES,
) -> Opening[AsyncClient]:
    """As :func:`ddakf_client.connect`: ``async with aconnect(...) as client``, or ``client = await aconnect(...)``."""

    targets = calls.targets_of(target)
    calls.require_timeout(timeout)

    def open_channel(target: str) -> grpc.aio.Channel:
        options = client_options(target, max_message_bytes)
        if credentials is None:
            return grpc.aio.insecure_channel(target, options)
        return grpc.aio.secure_channel(target, credentials, options)

    async def opened() -> AsyncClient:
        client = AsyncClient(open_channel, targets, timeout=timeout, api_key=api_key, max_message_bytes=max_message_bytes)
        try:
            client.server = await client.server_info()
        except ServiceError:
            await client.close()
            raise
        return client

    return Opening(opened())


class AsyncClient:
    """As :class:`ddakf_client.Client`, made by :func:`aconnect`."""

    server: ServerInfo

    def __init__(
        self,
        open_channel: Callable[[str], grpc.aio.Channel],
        targets: Sequence[str],
        *,
        timeout: float,
        api_key: str | None,
        max_message_bytes: int,
    ):
        self._open_channel, self._targets, self.timeout = open_channel, targets, calls.plain(timeout)
        self._max_message_bytes = max_message_bytes
        self._addresses = tuple(targets)  # with that of the last redirection
        self._channels: dict[str, grpc.aio.Channel] = {}  # by target
        self._closed = False
        self._metadata = calls.metadata_for(api_key)
        self.move(targets[0])

    async def __aenter__(self) -> AsyncClient:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self.close()

    async def close(self) -> None:
        """Closes the connection and its calls. Sessions stay on the server until they expire."""
        self._closed = True
        for channel in self._channels.values():
            await channel.close()

    def move(self, target: str) -> None:
        """As :meth:`ddakf_client.Client.move`."""
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
        """As :meth:`ddakf_client.Client.move_on`."""
        if self.target == target:
            self.move(calls.after(target, self._addresses))

    async def server_info(self) -> ServerInfo:
        """Properties and limits of the server. Raises VersionMismatch for an incompatible version."""
        return calls.checked_server(await self.call("GetServerInfo", pb.GetServerInfoRequest(api_version=API_VERSION)))

    def create_session(
        self,
        garment: object,
        faces: np.ndarray | None = None,
        *,
        flow: str = "realtime",
        codec: str = DEFAULT_CODEC,
        step: float = DEFAULT_STEP,
        **session: Any,
    ) -> Opening[AsyncSession]:
        """As :meth:`ddakf_client.Client.create_session`, with the same further arguments."""
        request = calls.create_request(garment, faces, **session)
        return self._session("CreateSession", request, keep=False, flow=flow, codec=codec, step=step)

    def open_session(
        self, session_id: str, *, flow: str = "realtime", codec: str = DEFAULT_CODEC, step: float = DEFAULT_STEP
    ) -> Opening[AsyncSession]:
        """As :meth:`ddakf_client.Client.open_session`."""
        request = pb.GetSessionRequest(name=calls.session_name(session_id))
        return self._session("GetSession", request, keep=True, flow=flow, codec=codec, step=step)

    def restore_session(
        self,
        snapshot: bytes,
        *,
        flow: str = "realtime",
        codec: str = DEFAULT_CODEC,
        step: float = DEFAULT_STEP,
        **session: Any,
    ) -> Opening[AsyncSession]:
        """As :meth:`ddakf_client.Client.restore_session`, with the same further arguments."""
        request = calls.restore_request(snapshot, **session)
        return self._session("RestoreSession", request, keep=False, flow=flow, codec=codec, step=step)

    async def sessions(self, **filters: Any) -> AsyncIterator[SessionInfo]:
        """As :meth:`ddakf_client.Client.sessions`, with the same arguments."""
        page_token = ""
        while True:
            page = await self.call("ListSessions", calls.list_request(**filters, page_token=page_token))
            for message in page.sessions:
                yield session_info_from(message)
            page_token = page.next_page_token
            if not page_token:
                return

    async def upload_mesh(self, mesh: object, faces: np.ndarray | None = None) -> str:
        """As :meth:`ddakf_client.Client.upload_mesh`."""
        return (await self.call("CreateMesh", calls.mesh_request(mesh, faces))).name

    async def meshes(self) -> AsyncIterator[MeshInfo]:
        """As :meth:`ddakf_client.Client.meshes`."""
        page_token = ""
        while True:
            page = await self.call("ListMeshes", pb.ListMeshesRequest(page_token=page_token))
            for message in page.meshes:
                yield mesh_info_from(message)
            page_token = page.next_page_token
            if not page_token:
                return

    async def delete_mesh(self, name: str) -> None:
        """As :meth:`ddakf_client.Client.delete_mesh`."""
        await self.call("DeleteMesh", calls.delete_mesh_request(name))

    async def history(self, session_id: str, **span: Any) -> History:
        """As :meth:`ddakf_client.Client.history`, with the same arguments."""
        return history_from(await self.call("GetSessionHistory", history_request(session_id, **span)))

    def _session(self, method: str, request: object, *, keep: bool, **options: Any) -> Opening[AsyncSession]:
        limit = calls.message_limit(self._max_message_bytes, self.server)
        plan = Plan("", self.timeout, max_message_bytes=limit, **options)
        calls.require_codec(plan.codec, self.server)

        async def opened() -> AsyncSession:
            message = await self.call(method, request)
            return AsyncSession(self, message, replace(plan, name=message.name), keep=keep)

        return Opening(opened())

    async def call(self, method: str, request: object, timeout: float | None = None) -> Any:
        """Makes a unary call by its name in the schema. Raises the classes of ``errors``."""
        timeout = self.timeout if timeout is None else timeout
        for _ in self._addresses:
            target = self.target
            try:
                with calls.closing_is_an_error():
                    return await getattr(self._open_stub(), method)(request, timeout=timeout, metadata=self._metadata)
            except grpc.RpcError as error:
                failed = calls.failure(error, target, timeout)
                if not calls.may_call_elsewhere(error, failed, method):
                    break
            self.move_on(target)
        raise failed

    def open_track(self, requests: AsyncIterator[pb.TrackRequest]) -> grpc.aio.StreamStreamCall:
        return self._open_stub().Track(requests, metadata=self._metadata)

    def open_watch(self, request: pb.WatchSessionRequest) -> grpc.aio.UnaryStreamCall:
        return self._open_stub().WatchSession(request, metadata=self._metadata)

    def _open_stub(self) -> TrackingServiceStub:
        if self._closed:
            raise FailedPrecondition(calls.CLOSED)
        return self._stub


class AsyncSession:
    """As :class:`ddakf_client.Session`, made by :meth:`AsyncClient.create_session`."""

    def __init__(self, client: AsyncClient, message: pb.Session, plan: Plan, *, keep: bool):
        self._client, self._plan = client, plan
        self.name = message.name
        self.session_id = message.name.removeprefix("sessions/")
        self.vertex_map = vertex_map_from(message)
        self.keep = keep

    async def __aenter__(self) -> AsyncSession:
        return self

    async def __aexit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        if self.keep:
            return
        try:
            await self.delete()
        except SessionNotFound:
            pass  # expired or deleted already
        except ServiceError:
            if error_type is None:  # else the error inside the context takes precedence
                raise

    @overload
    def track(
        self,
        frames: AsyncIterable[object] | Iterable[object],
        *,
        on_error: Literal["raise"] = "raise",
        **options: Unpack[TrackOptions],
    ) -> AsyncIterator[Result]: ...

    @overload
    def track(
        self, frames: AsyncIterable[object] | Iterable[object], *, on_error: str, **options: Unpack[TrackOptions]
    ) -> AsyncIterator[Result | FrameError]: ...

    def track(
        self, frames: AsyncIterable[object] | Iterable[object], *, on_error: str = "raise", **options: Unpack[TrackOptions]
    ) -> AsyncIterator[Result | FrameError]:
        """As :meth:`ddakf_client.Session.track`, with the same options; an ordinary iterator runs in a thread."""
        plan = self._plan.of_stream(on_error=on_error, **options)
        calls.require_codec(plan.codec, self._client.server)
        return track(self._client, frames, plan)

    def watch(
        self, *, every_nth: int = 1, on_notice: Callable[[Notice], None] = log_notice
    ) -> AsyncIterator[Result | FrameError]:
        """As :meth:`ddakf_client.Session.watch`."""
        calls.require_handler(on_notice)
        return awatch(self._client.open_watch(watch_request(self.name, every_nth)), on_notice, self._client.target)

    async def info(self) -> SessionInfo:
        """State and statistics after the last frame."""
        return session_info_from(await self._client.call("GetSession", pb.GetSessionRequest(name=self.name)))

    async def reset(self, vertices: np.ndarray | None = None, *, velocities: np.ndarray | None = None) -> SessionInfo:
        """As :meth:`ddakf_client.Session.reset`."""
        request = calls.reset_request(self.name, vertices, velocities=velocities)
        return session_info_from(await self._client.call("ResetSession", request))

    async def update(self, **changes: Any) -> SessionInfo:
        """As :meth:`ddakf_client.Session.update`, with the same arguments."""
        request = calls.update_request(self.name, **changes)
        return session_info_from(await self._client.call("UpdateSession", request))

    async def snapshot(self) -> bytes:
        """The state of the tracker, for ``restore_session``."""
        return (await self._client.call("SnapshotSession", pb.SnapshotSessionRequest(name=self.name))).data

    async def delete(self) -> None:
        """Deletes the session on the server."""
        await self._client.call("DeleteSession", pb.DeleteSessionRequest(name=self.name))
