"""Server: startup, main loop and shutdown of the service."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import shlex
import signal
from collections.abc import Callable
from typing import NamedTuple

from ddakf_api.transport import is_loopback

import ddakf

from .auth.guard import Guard
from .auth.key_database import DatabaseKeyStore
from .auth.keys import KeyRing
from .auth.refusals import Refusals
from .auth.tls import Tls
from .build import build
from .observability.metrics import Metrics
from .observability.tracing import tracer_for
from .sessions.service import Sessions
from .settings import Settings
from .store.store import Store
from .streaming.frame_recorder import FrameRecorder
from .streaming.streams import Streams
from .transports.grpc.service import GrpcServer
from .transports.http_guard import HttpGuard
from .transports.http_server import HttpServer
from .transports.rest.cross_origin import origin_checked
from .transports.rest.routes import create_app
from .transports.websocket.routes import add_websockets
from .workers.fork_server import ForkServer, WorkerSource
from .workers.pool import Limits, Progress
from .workers.process_pool import ProcessPool

log = logging.getLogger(__name__)

_LOOPBACK = ("127.0.0.1", "::1", "localhost")
_STATUS_GRACE = 0.5  # seconds for ended streams to deliver their status


class Addresses(NamedTuple):
    """Addresses of the service; ``encrypted``: with TLS."""

    host: str
    grpc_port: int
    http_port: int
    encrypted: bool = False

    @property
    def grpc(self) -> str:
        return f"{_bracketed(self.host)}:{self.grpc_port}"

    @property
    def http(self) -> str:
        return f"http{'s' if self.encrypted else ''}://{_bracketed(self.host)}:{self.http_port}"


class Server:
    """gRPC and REST in one event loop, in front of a pool of workers.

    Args:
        fork_server: of the workers, launched earlier.
    """

    def __init__(self, settings: Settings, fork_server: ForkServer | None = None):
        self._settings = settings
        if sentence := _unreachable(settings):
            log.warning(sentence)
        self._metrics = Metrics()
        self._metrics.workers.set(settings.workers)
        self._metrics.sessions_limit.set(settings.max_sessions)
        self._metrics.build_info.labels(ddakf.__version__, build()).set(1)
        self._tracer = tracer_for(settings.trace_sample, settings.server_id)
        self._store = Store(settings, self._metrics)
        self._was_ready = False
        limits = Limits(
            settings.max_points,
            settings.max_vertices,
            settings.max_faces,
            settings.max_body_vertices,
            settings.max_image_pixels,
            settings.frame_limit,
        )
        source = _ray_actors(limits, settings.ray_address) if settings.worker_kind == "ray" else None
        self._pool = ProcessPool(
            settings.workers,
            limits,
            spares=settings.spare_workers,
            frame_timeout=settings.frame_timeout,
            warm_timeout=settings.warm_timeout,
            max_memory=settings.max_memory_bytes,
            recycle_frames=settings.recycle_frames,
            recycle_memory=settings.recycle_memory_bytes,
            on_lost=lambda ids: self._sessions.lose(ids),
            on_change=self._follow_workers,
            fork_server=None if source else fork_server,
            source=source,
        )
        self._unused_fork_server = fork_server if source else None
        self._sessions = Sessions(self._pool, settings, self._metrics, self._store)
        recorder = FrameRecorder(self._metrics, self._store.history, self._tracer)
        self._streams = Streams(self._sessions.components, recorder)
        self._keys = KeyRing(DatabaseKeyStore(self._store.database), self._sessions.shut_out, self._follow_keys)
        refusals = Refusals(self._metrics.calls_refused)
        guard = Guard(self._keys, refusals, anonymous=_anonymous(settings), local=not settings.allow_anonymous)
        tls = Tls.of(settings.tls_certificate, settings.tls_key, settings.tls_client_ca)
        self._grpc = GrpcServer(self._sessions, self._streams, settings, guard, tls)
        self._store.ready = lambda: not self._not_ready()
        app = create_app(self._sessions, settings, self._metrics, self._not_ready, self._store)
        add_websockets(app, self._streams, settings.reader_timeout)
        guarded = HttpGuard(app, guard)
        checked = origin_checked(guarded, settings.cors_origins, refusals)
        self._http = HttpServer(checked, settings, tls)
        self._warm = False
        self._restarts_seen = self._recycled_seen = 0
        self._stopping = asyncio.Event()
        self._health_update: asyncio.Future | None = None

    async def run(self, progress: Progress, ready: Callable[[Addresses], None]) -> None:
        """Serves until SIGTERM, SIGINT or SIGHUP; a second one of the first two ends the process at once.

        Args:
            progress: called during the warm-up.
            ready: called with the addresses when the server accepts sessions.

        Raises:
            InvalidConfig: a port is not available.
            WorkerStartFailed: a worker cannot track.
        """
        self._handle_signals(asyncio.get_running_loop())
        try:
            await self._load_keys()
            await self._sessions.load()
            encrypted = bool(self._settings.tls_certificate)
            addresses = Addresses(self._settings.host, await self._grpc.start(), await self._http.start(), encrypted)
            warming = asyncio.create_task(self._start_pool(progress))
            stopping = asyncio.create_task(self._stopping.wait())
            await asyncio.wait((warming, stopping), return_when=asyncio.FIRST_COMPLETED)
            if warming.done():
                await warming
                ready(addresses)
                program = {"version": ddakf.__version__, "build": build()}
                log.info("ready", extra={"grpc": addresses.grpc, "http": addresses.http, **program})
                await self._serve()
            else:
                warming.cancel()
                await asyncio.gather(warming, return_exceptions=True)
        finally:
            await self._shut_down()

    def stop(self) -> None:
        """Starts an orderly shutdown."""
        self._stopping.set()

    async def _load_keys(self) -> None:
        """Loads the keys and logs a warning when everybody has access."""
        await self._keys.start()
        if _anonymous(self._settings) and self._settings.host not in _LOOPBACK:
            log.warning("anyone who can reach %s may use this service: it needs no keys", self._settings.host)

    async def _start_pool(self, progress: Progress) -> None:
        if self._unused_fork_server is not None:
            await self._unused_fork_server.end()
        await self._pool.start(progress)
        self._warm = True
        self._follow_workers()

    async def _serve(self) -> None:
        expiring = asyncio.create_task(self._sessions.expire_idle())
        await self._stopping.wait()
        expiring.cancel()
        log.info("stopping")
        await self._grpc.serving(False)
        await self._sessions.drain(self._settings.drain_grace)

    async def _shut_down(self) -> None:
        async with contextlib.AsyncExitStack() as shutdown:  # each one runs, the last first, even when another fails
            for stop, *arguments in (
                (asyncio.to_thread, self._tracer.close),
                (asyncio.to_thread, self._store.close),
                (self._pool.stop,),
                (self._keys.stop,),
                (self._http.stop,),
                (self._grpc.stop, _STATUS_GRACE),
            ):
                shutdown.push_async_callback(stop, *arguments)
        log.info("stopped")

    def _handle_signals(self, loop: asyncio.AbstractEventLoop) -> None:
        for number in (signal.SIGTERM, signal.SIGINT):
            loop.add_signal_handler(number, self._on_signal)
        if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:  # nohup
            loop.add_signal_handler(signal.SIGHUP, self.stop)  # the end of a terminal sends two: from its shell too

    def _on_signal(self) -> None:
        if self._stopping.is_set():
            log.warning("stopped by a second signal")
            os._exit(1)  # the workers end with their pipes
        self.stop()

    def _not_ready(self) -> str:
        if self._stopping.is_set():
            return "the server is about to stop"
        if not (self._keys.loaded or _anonymous(self._settings)):
            return "the keys have not been read yet"
        if not self._warm:
            return "the kernels are not loaded yet"
        return "" if self._pool.health().ready else "no worker is ready"

    def _follow_keys(self) -> None:
        """Logs a warning when nobody has access; the server may be ready now."""
        if not (_anonymous(self._settings) or len(self._keys)):
            log.warning("calls need a key, but no key exists: ddakf keys create NAME --scope stream%s", self._key_options())
        self._update_health()

    def _key_options(self) -> str:
        """The options with which ``ddakf keys`` finds the database of this service; a URL may have a password."""
        if self._settings.database_url:
            return " --database-url URL, with that of this service"
        default = Settings.model_fields["data_dir"].default
        return "" if self._settings.data_dir == default else f" --data-dir {shlex.quote(self._settings.data_dir)}"

    def _follow_workers(self) -> None:
        health = self._pool.health()
        self._metrics.workers_ready.set(health.ready)
        self._metrics.workers_spare.set(health.spares)
        self._metrics.workers_recycled.inc(health.recycled - self._recycled_seen)
        self._recycled_seen = health.recycled
        self._metrics.worker_restarts.inc(health.restarts - self._restarts_seen)
        self._restarts_seen = health.restarts
        self._update_health()

    def _update_health(self) -> None:
        self._health_update = asyncio.ensure_future(self._publish_health())

    async def _publish_health(self) -> None:
        ready = not self._not_ready()  # read here, because it may have changed since the call
        await self._grpc.serving(ready)
        if ready != self._was_ready:
            self._was_ready = ready
            self._store.announce_readiness()


def _ray_actors(limits: Limits, address: str) -> WorkerSource:
    from .workers.ray_actors import RayActors  # ray is an extra

    return RayActors(limits, address)


def _anonymous(settings: Settings) -> bool:
    """Whether calls without a key are admitted."""
    return not settings.require_keys and (settings.allow_anonymous or settings.host in _LOOPBACK)


def _unreachable(settings: Settings) -> str:
    """One sentence where other gateways send clients to an address at which this one does not listen; empty: they do not."""
    address, host = settings.gateway_address, settings.host
    if not (settings.share_sessions and address and is_loopback(host)) or is_loopback(address.rpartition(":")[0]):
        return ""
    return f"gateway_address is {address}, but host is {host}: clients come here only through a proxy on this machine"


def _bracketed(host: str) -> str:
    return f"[{host}]" if ":" in host else host
