"""gRPC service and server: session calls, the Track stream, health and reflection."""

from __future__ import annotations

import asyncio
import functools
import logging

import grpc
from ddakf_api.errors import (
    DeadlineExceeded,
    FailedPrecondition,
    ServiceError,
)
from ddakf_api.transport import server_options
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc
from google.protobuf import empty_pb2
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from ddakf import errors as library

from ...auth.guard import Guard
from ...auth.tls import Tls
from ...info import server_info
from ...sessions.service import Sessions
from ...settings import Settings
from ...streaming.stream import Stream
from ...streaming.streams import Streams
from ..listener import listen
from .bounded_requests import BoundedRequests
from .errors import abort, without_traceback
from .guard import GrpcGuard
from .health import BoundedHealth

log = logging.getLogger(__name__)

SERVICE_NAME = pb.DESCRIPTOR.services_by_name["TrackingService"].full_name


def _answering_errors(call):
    """Decorator: ends a failed call with the error's code, message and details."""

    @functools.wraps(call)
    async def answering(self, request, context):
        try:
            return await call(self, _usable(request), context)
        except (ServiceError, library.DdakfError) as error:
            failure = without_traceback(error)
        except grpc.aio.AbortError:
            raise
        except grpc.aio.InternalError as error:
            log.debug("the client left during %s: %s", call.__name__, error)
            return None
        except Exception as error:
            log.exception("%s failed", call.__name__)
            failure = without_traceback(error)
        del request  # gRPC keeps the Python frames of an abort
        await abort(context, failure)

    return answering


def _usable(request):
    """The request. Raises the error of a rejected one; see :class:`.bounded_requests.BoundedRequests`."""
    if isinstance(request, ServiceError):
        raise request
    return request


class TrackingService(rpc.TrackingServiceServicer):
    """Calls of the contract, passed on to :class:`Sessions` or :class:`Streams`."""

    def __init__(self, sessions: Sessions, streams: Streams, settings: Settings):
        self._sessions, self._streams, self._settings = sessions, streams, settings

    @_answering_errors
    async def GetServerInfo(self, request, context):
        return server_info(self._settings, self._sessions.draining)

    @_answering_errors
    async def CreateSession(self, request, context):
        return await self._sessions.create(request)

    @_answering_errors
    async def GetSession(self, request, context):
        return await self._sessions.get(request.name, request.view)

    @_answering_errors
    async def ListSessions(self, request, context):
        return await self._sessions.list(request)

    @_answering_errors
    async def UpdateSession(self, request, context):
        return await self._sessions.update(request)

    @_answering_errors
    async def ResetSession(self, request, context):
        return await self._sessions.reset(request)

    @_answering_errors
    async def DeleteSession(self, request, context):
        await self._sessions.delete(request.name)
        return empty_pb2.Empty()

    @_answering_errors
    async def SnapshotSession(self, request, context):
        return await self._sessions.snapshot(request.name)

    @_answering_errors
    async def RestoreSession(self, request, context):
        return await self._sessions.restore(request)

    @_answering_errors
    async def GetSessionHistory(self, request, context):
        return await self._sessions.history(request)

    @_answering_errors
    async def CreateMesh(self, request, context):
        return await self._sessions.meshes.create(request)

    @_answering_errors
    async def GetMesh(self, request, context):
        return await self._sessions.meshes.get(request)

    @_answering_errors
    async def ListMeshes(self, request, context):
        return await self._sessions.meshes.list(request)

    @_answering_errors
    async def DeleteMesh(self, request, context):
        await self._sessions.meshes.delete(request.name)
        return empty_pb2.Empty()

    @_answering_errors
    async def Track(self, request_iterator, context):
        patience = self._settings.reader_timeout
        try:
            async with asyncio.timeout(patience):
                first = _usable(await context.read())
        except TimeoutError:
            raise DeadlineExceeded(f"no start came within {patience:g} s") from None
        if not isinstance(first, pb.TrackRequest) or not first.HasField("start"):
            raise FailedPrecondition("the first message of a Track stream has to be start", field="start")
        stream = await self._streams.open(first.start)
        reader = asyncio.create_task(_read(context, stream))
        try:
            await stream.deliver(context.write)
        finally:
            reader.cancel()
            closing = self._streams.leave(stream)
        await asyncio.shield(closing)

    @_answering_errors
    async def WatchSession(self, request, context):
        watcher = await self._streams.watch(request)
        try:
            await watcher.deliver(context.write, self._settings.reader_timeout)
        finally:
            self._streams.unwatch(watcher)


async def _read(context: grpc.aio.ServicerContext, stream: Stream) -> None:
    """Reads at all times: an unread stream would buffer frames in the transport, where none can be dropped."""
    try:
        while (request := await context.read()) is not grpc.aio.EOF:
            await stream.receive(_usable(request))
        stream.finish()
    except Exception as error:  # the connection broke, or the request is invalid
        stream.end(error)


class GrpcServer:
    """The listening server. ``start`` binds the port; ``serving`` sets the health status.

    Args:
        guard: checks every call.
        tls: certificates; None: no encryption.
    """

    def __init__(self, sessions: Sessions, streams: Streams, settings: Settings, guard: Guard, tls: Tls | None):
        self._settings, self._tls = settings, tls
        # With SO_REUSEPORT a second server would share the clients instead of failing.
        options = [*server_options(settings.max_message_bytes), ("grpc.so_reuseport", 0)]
        interceptors = [GrpcGuard(guard), BoundedRequests(settings.request_timeout)]
        self._server = grpc.aio.server(options=options, interceptors=interceptors)
        rpc.add_TrackingServiceServicer_to_server(TrackingService(sessions, streams, settings), self._server)
        self._health = BoundedHealth()
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        names = (SERVICE_NAME, health.SERVICE_NAME, reflection.SERVICE_NAME)
        reflection.enable_server_reflection(names, self._server)

    async def start(self) -> int:
        """Binds the port and returns it.

        Raises:
            InvalidConfig: the address or the port is not available.
        """
        s = self._settings
        await self.serving(False)
        listen(s.host, s.grpc_port, "grpc_port").close()  # gRPC has one error for all reasons
        try:
            host = f"[{s.host}]" if ":" in s.host else s.host
            address = f"{host}:{s.grpc_port}"
            if self._tls is None:
                port = self._server.add_insecure_port(address)
            else:
                port = self._server.add_secure_port(address, self._tls.grpc_credentials())
        except RuntimeError:
            raise library.InvalidConfig("grpc_port", f"a free port on {s.host}", str(s.grpc_port)) from None
        await self._server.start()
        return port

    async def serving(self, ready: bool) -> None:
        """Sets the status of each service in grpc.health.v1."""
        status = health_pb2.HealthCheckResponse.SERVING if ready else health_pb2.HealthCheckResponse.NOT_SERVING
        for service in ("", SERVICE_NAME):
            await self._health.set(service, status)
        for service in (health.SERVICE_NAME, reflection.SERVICE_NAME):  # these answer from the start
            await self._health.set(service, health_pb2.HealthCheckResponse.SERVING)

    async def stop(self, grace: float) -> None:
        """Ends all calls, the remaining ones after ``grace`` seconds."""
        await self._server.stop(grace)
