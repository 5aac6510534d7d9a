"""Ray actors as workers: the same requests and answers, on a TCP connection that an actor opens to this server.

Frames and results take this connection and not Ray's object store, which would copy them. Ray places the actors on the nodes and
ends them with this server. A connection whose other end vanishes is cut after some seconds.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import signal
import socket
import subprocess
import sys
import threading
from typing import Any

import ray
from ray.exceptions import RayError

from .fork_server import STREAM_BUFFER, Connected, WorkerStartFailed
from .messages import wire
from .pool import Limits, Progress

log = logging.getLogger(__name__)

_NAMESPACE = "ddakf"
_TOKEN_BYTES = 32
_NODE_DIGITS = 56  # hexadecimal, of the id of a node
_NODES_INTERVAL = 1.0  # seconds between looks at the nodes
_POLL_INTERVAL = 0.1  # seconds
_PATIENCE = 10.0  # seconds for an actor that has connected to send its token
_DEAD_AFTER = 8  # seconds without a sign of the other end
_RAY_ERRORS = (RayError, RuntimeError, ValueError)  # of its calls, also after its end


class RayActors:
    """Source of workers: actors on a Ray cluster, one processor each.

    Args:
        address: of the cluster, as ``ray.init`` takes it; "auto": the one of this machine, or of ``RAY_ADDRESS``.
    """

    def __init__(self, limits: Limits, address: str):
        self._limits, self._address = limits, address
        self._lock = asyncio.Lock()
        self._server: asyncio.Server | None = None
        self._host = self._node = ""
        self._connected_here = False
        self._draining: frozenset[str] = frozenset()  # nodes
        self._following: asyncio.Task[None] | None = None
        self._expected: dict[bytes, asyncio.Future[tuple[asyncio.StreamReader, asyncio.StreamWriter, str]]] = {}

    async def worker(self, progress: Progress) -> Connected:
        """A ready worker on some node.

        Raises:
            WorkerStartFailed: the cluster cannot be reached, or the actor ended before it was ready.
        """
        async with self._lock:
            if self._server is None:
                await self._connect()
            port = self._server.sockets[0].getsockname()[1]
        progress("loading", 0, 1, "an actor on the Ray cluster")
        token = secrets.token_bytes(_TOKEN_BYTES)
        arrival = self._expected[token] = asyncio.get_running_loop().create_future()
        creation = asyncio.ensure_future(asyncio.to_thread(ActorProcess, self._host, port, token, self._limits.to_json()))
        try:
            process = await asyncio.shield(creation)  # a thread cannot be cancelled
            reader, writer, node = await _unless_ended(arrival, process)
            await _unless_ended(asyncio.ensure_future(_ready(reader, process)), process)
        except BaseException as error:
            creation.add_done_callback(_kill_created)
            if arrival.done() and not arrival.cancelled():
                arrival.result()[1].close()
            if isinstance(error, _RAY_ERRORS) and not isinstance(error, WorkerStartFailed):
                raise WorkerStartFailed(f"no actor can be created: {_first_line(error)}") from error
            raise
        finally:
            arrival.cancel()
            self._expected.pop(token, None)
        progress("loading", 1, 1, "done")
        return Connected(process, reader, writer, here=False, leaving=lambda: node in self._draining)

    async def end(self, patience: float = 0.0) -> None:
        """Closes the connection to the cluster; its workers have ended."""
        if self._following is not None:
            self._following.cancel()
        if self._server is not None:
            self._server.close()
            self._server = None
            if self._connected_here:
                await asyncio.to_thread(ray.shutdown)

    async def _connect(self) -> None:
        """Connects to the cluster, and listens for the actors."""
        if not ray.is_initialized():
            # stdout is the server's own; the actors log to Ray's files
            options = {"address": self._address, "namespace": _NAMESPACE, "log_to_driver": False, "configure_logging": False}
            try:
                await asyncio.to_thread(_require_port, self._address)
                await asyncio.to_thread(ray.init, **options)
            except (OSError, RuntimeError, ValueError) as error:
                raise WorkerStartFailed(f"the Ray cluster {self._address!r} cannot be reached: {_first_line(error)}") from None
            self._connected_here = True
            _keep_own_handler_of_sigterm()
        self._host, self._node = ray.util.get_node_ip_address(), ray.get_runtime_context().get_node_id()
        self._server = await asyncio.start_server(self._arrived, self._host, 0, limit=STREAM_BUFFER)
        self._following = asyncio.create_task(self._follow_nodes())

    async def _follow_nodes(self) -> None:
        """Keeps the set of nodes that drain: Ray places no actors on these, and ends them at their deadline.

        It ends with the node of this server, from which no actor can be created any more; the next worker connects again.
        """
        while True:
            await asyncio.sleep(_NODES_INTERVAL)
            if self._connected_here and await asyncio.to_thread(_has_ended, self._node):
                log.error("the Ray node of this server has ended; the server connects to the cluster again")
                return await self._disconnect()
            draining = await asyncio.to_thread(_draining_nodes)
            for node in draining - self._draining:
                log.info("a node drains; its sessions move", extra={"node": node})
            self._draining = draining

    async def _disconnect(self) -> None:
        """Leaves the cluster, of which the actors that were created from here end. Who waits for one learns of it."""
        async with self._lock:
            self._server.close()
            self._server, self._draining = None, frozenset()
            for arrival in self._expected.values():
                if not arrival.done():
                    arrival.set_exception(WorkerStartFailed("the Ray node of this server has ended"))
            await asyncio.to_thread(ray.shutdown)

    async def _arrived(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """A connection: that of an actor begins with its token and the id of its node, any other is closed."""
        arrival, node = None, ""
        try:
            async with asyncio.timeout(_PATIENCE):
                arrival = self._expected.pop(await reader.readexactly(_TOKEN_BYTES), None)
                node = (await reader.readexactly(_NODE_DIGITS)).decode("ascii", "replace") if arrival else ""
        except (TimeoutError, OSError, asyncio.IncompleteReadError):
            pass
        if arrival is None or arrival.done():
            log.warning("a connection that no worker of this server has opened is closed")
            writer.close()
            return
        _watch(writer.get_extra_info("socket"))
        arrival.set_result((reader, writer, node))


class ActorProcess:
    """An actor, with the methods of a process.

    Attributes:
        pid: on its own node; 0 until it is ready.

    Raises:
        RayError, RuntimeError, ValueError: it cannot be created.
    """

    def __init__(self, host: str, port: int, token: bytes, limits: str):
        self.pid, self._killed = 0, False
        if not ray.is_initialized():  # the server stops; Ray would start a cluster of its own
            raise RuntimeError("the connection to the cluster has ended")
        actor = ray.remote(num_cpus=1, max_restarts=0, max_task_retries=0, scheduling_strategy="SPREAD")(Actor)
        self._actor = actor.remote()
        level = logging.getLevelName(logging.getLogger().getEffectiveLevel()).lower()
        self._ending: Any = self._actor.serve.remote(host, port, token, limits, level)

    def kill(self) -> None:
        """Ends the actor at once, or as soon as Ray reaches its node."""
        self._killed = True
        if not ray.is_initialized():  # its calls would start a cluster of their own; the actor ends with the connection
            return
        try:
            ray.kill(self._actor, no_restart=True)
        except _RAY_ERRORS:  # it has ended, or the cluster has
            log.debug("an actor could not be killed", exc_info=True)

    def failure(self) -> str:
        """The reason of its end in one line; empty while it works."""
        if not ray.is_initialized():
            return "the connection to the cluster has ended"
        try:
            if not ray.wait([self._ending], timeout=0)[0]:
                return ""
            ray.get(self._ending)
        except _RAY_ERRORS as error:
            return str(error).strip().rpartition("\n")[2]
        return "it ended"

    def wait(self, timeout: float | None = None) -> int:
        """The status, 0 for an end in order; subprocess.TimeoutExpired after ``timeout`` seconds.

        A killed actor is not waited for: Ray learns of the end of one on a vanished node after half a minute, and a wait for each
        of them would hold up every other task of the threads.
        """
        if self._killed or not ray.is_initialized():
            return 1
        try:
            done, _ = ray.wait([self._ending], timeout=timeout)
            if not done:
                raise subprocess.TimeoutExpired("actor", timeout)
            ray.get(self._ending)
            status = 0
        except _RAY_ERRORS:
            status = 1
        self.kill()  # its work has ended, well or not, and its process is still there
        return status


class Actor:
    """A worker in a process of Ray."""

    def serve(self, host: str, port: int, token: bytes, limits: str, level: str) -> None:
        """Connects to the server, loads everything, and answers requests until the connection closes."""
        from ddakf.commands import warmup

        from ..observability.logs import configure_logging
        from .compute.process import work
        from .compute.tracker_host import TrackerHost

        connection = socket.create_connection((host, port))
        _watch(connection)
        connection.sendall(token + ray.get_runtime_context().get_node_id().encode())
        configure_logging(level, "text")
        warmup.warm()
        tracker_host = TrackerHost(Limits.from_json(limits))
        tracker_host.warm()
        work(wire.BlockingChannel(connection), tracker_host)


async def _ready(reader: asyncio.StreamReader, process: ActorProcess) -> None:
    process.pid = int((await wire.read(reader)).content)


async def _unless_ended(awaited: asyncio.Future, process: ActorProcess):
    """The result of a future, or WorkerStartFailed when the actor ends before."""
    try:
        while not awaited.done():
            await asyncio.wait((awaited,), timeout=_POLL_INTERVAL)
            if not awaited.done() and (reason := process.failure()):
                raise WorkerStartFailed(f"an actor was not ready: {reason}")
        return awaited.result()
    except (asyncio.IncompleteReadError, ConnectionError):
        raise WorkerStartFailed("an actor ended before it was ready; see its log") from None
    finally:
        awaited.cancel()


def _kill_created(creation: asyncio.Future[ActorProcess]) -> None:
    """Kills an actor that nobody waits for any more."""
    if not creation.cancelled() and creation.exception() is None:
        creation.result().kill()


def _first_line(error: BaseException) -> str:
    return str(error).strip().partition("\n")[0] or type(error).__name__


def _draining_nodes() -> frozenset[str]:
    """The nodes that were asked to drain, by Kubernetes, an autoscaler or ``ray drain-node``. Ray has no public call for it."""
    try:
        from ray._private.state import state

        return frozenset(state.get_draining_nodes())
    except (ImportError, AttributeError, *_RAY_ERRORS):
        log.debug("the nodes that drain are not known", exc_info=True)
        return frozenset()


def _has_ended(node: str) -> bool:
    """Whether the cluster knows that a node has ended; False while the cluster does not answer."""
    try:
        return any(each["NodeID"] == node and not each["Alive"] for each in ray.nodes())
    except _RAY_ERRORS:
        log.debug("the nodes of the cluster are not known", exc_info=True)
        return False


def _keep_own_handler_of_sigterm() -> None:
    """Takes SIGTERM back from Ray, whose handler aborts the process three seconds later: an orderly stop may take longer."""
    if threading.current_thread() is threading.main_thread() and (handler := signal.getsignal(signal.SIGTERM)) is not None:
        signal.signal(signal.SIGTERM, handler)  # Python keeps the handler that it had, and does not know of Ray's


def _require_port(address: str) -> None:
    """Raises OSError where nothing listens at "host:port": Ray would try for minutes."""
    host, separator, port = address.rpartition(":")
    if separator and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), _PATIENCE).close()


def _watch(connection: socket.socket) -> None:
    """Sends small messages at once, and notices within seconds that the other node is gone."""
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    if sys.platform == "linux":
        for option, value in ((socket.TCP_KEEPIDLE, 2), (socket.TCP_KEEPINTVL, 2), (socket.TCP_KEEPCNT, _DEAD_AFTER // 2 - 1)):
            connection.setsockopt(socket.IPPROTO_TCP, option, value)
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, 1000 * _DEAD_AFTER)
