"""HTTP server of REST and WebSocket: uvicorn with bounded and encrypted connections."""

from __future__ import annotations

import asyncio
import contextlib
import socket

import uvicorn
from starlette.types import ASGIApp

from ..auth.tls import Tls
from ..settings import Settings
from .http_methods import HttpMethods
from .http_protocol import http_protocol
from .listener import listen
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
            SecurityHeaders(HttpMethods(app)),
            http=http_protocol(settings.request_timeout + _RESPONSE_GRACE, settings.reader_timeout),
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
            InvalidConfig: the address or the port is not available.
        """
        listener = listen(self._settings.host, self._settings.http_port, "http_port")
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _SEND_BUFFER)
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


class _QuietServer(uvicorn.Server):
    @contextlib.contextmanager
    def capture_signals(self):
        yield  # the service handles signals
