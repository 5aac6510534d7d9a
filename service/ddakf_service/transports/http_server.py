"""HTTP server of REST and WebSocket: uvicorn with bounded and encrypted connections."""

from __future__ import annotations

import asyncio
import contextlib
import socket

import h11
import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from ddakf.errors import InvalidConfig

from ..auth.tls import Tls
from ..settings import Settings
from .rest.cross_origin import SecurityHeaders
from .websocket.keepalive import WebSocketProtocol

_RESPONSE_GRACE = 1.0  # seconds for the response to a late request before its connection is closed
_STOP_PATIENCE = 2  # seconds that a stop waits for calls in progress
# Bytes of the operating system's send buffer per connection. By default it holds megabytes for a slow watcher: stale results.
_SEND_BUFFER = 1 << 19


class HttpServer:
    """uvicorn in the server's event loop.

    Args:
        app: the application with its guard.
        tls: certificates; None: no encryption.
    """

    def __init__(self, app: ASGIApp, settings: Settings, tls: Tls | None):
        self._settings, self._tls = settings, tls
        config = uvicorn.Config(
            SecurityHeaders(app),
            http=http_protocol(settings.request_timeout + _RESPONSE_GRACE),
            ws=WebSocketProtocol,
            ws_max_size=settings.max_message_bytes,
            ws_ping_interval=settings.keepalive,
            ws_ping_timeout=settings.keepalive,
            ws_per_message_deflate=False,
            log_config=None,
            access_log=False,
            server_header=False,
            lifespan="off",
            timeout_graceful_shutdown=_STOP_PATIENCE,
        )
        if tls is not None:
            config.load()  # uvicorn would read the files once only
            config.ssl = tls.context()
        self._server = _QuietServer(config)
        self._task: asyncio.Task | None = None
        self._following: asyncio.Task | None = None

    async def start(self) -> int:
        """Binds the port and returns it.

        Raises:
            InvalidConfig: the port is not available.
        """
        host, port = self._settings.host, self._settings.http_port
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            listener = socket.create_server((host, port), family=family, backlog=512)
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
        except OSError as error:
            raise InvalidConfig("http_port", f"a free port on {host}", f"{port}: {error.strerror}") from None
        if self._tls is not None:
            self._following = asyncio.create_task(self._tls.follow(self._server.config.ssl))
        self._task = asyncio.create_task(self._server.serve(sockets=[listener]))
        while not self._server.started:
            if self._task.done():
                await self._task  # raises the reason
                raise RuntimeError("the HTTP server ended while it started")
            await asyncio.sleep(0.01)
        return listener.getsockname()[1]

    async def stop(self) -> None:
        """Stops after the calls in progress."""
        self._server.should_exit = True
        if self._following:
            self._following.cancel()
        if self._task:
            await self._task


def http_protocol(patience: float) -> type[H11Protocol]:
    """uvicorn's h11 protocol with a time limit per request; h11 bounds the headers.

    Args:
        patience: seconds from the connection, or from the first byte of a request, to the end of the request's body; then
            the connection is closed.
    """

    class Protocol(H11Protocol):
        _cutting: asyncio.TimerHandle | None = None

        def connection_made(self, transport: asyncio.Transport) -> None:
            super().connection_made(transport)
            self._await_request()

        def data_received(self, data: bytes) -> None:
            super().data_received(data)
            self._await_request()

        def connection_lost(self, exc: Exception | None) -> None:
            self._stop_cutting()
            super().connection_lost(exc)

        def _await_request(self) -> None:
            upgraded = self.transport.get_protocol() is not self
            if upgraded or self.conn.their_state not in (h11.IDLE, h11.SEND_BODY):
                self._stop_cutting()
            elif self._cutting is None:
                self._cutting = self.loop.call_later(patience, self.transport.close)

        def _stop_cutting(self) -> None:
            if self._cutting is not None:
                self._cutting.cancel()
                self._cutting = None

    return Protocol


class _QuietServer(uvicorn.Server):
    @contextlib.contextmanager
    def capture_signals(self):
        yield  # the service handles signals
