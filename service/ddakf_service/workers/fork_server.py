"""Fork server: a process that has loaded all that a worker needs, and the workers forked from it.

It has one thread and no gRPC: a fork of it is a complete worker, ready in milliseconds, which shares its memory and becomes a
child of the server. On other systems than Linux, whose frameworks forbid forks, a fork server becomes the worker itself.
"""

from __future__ import annotations

import asyncio
import ctypes
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, NamedTuple, Protocol

if TYPE_CHECKING:  # this module has to be imported within milliseconds, see ForkServer
    from .pool import Limits, Progress

FORKS = sys.platform == "linux"
# One compute thread per worker: sessions are the unit of parallelism, and more threads than cores add only waiting.
ONE_THREAD = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}

_PROGRAM = (sys.executable, "-m", "ddakf_service.workers.compute.process")
_PR_SET_CHILD_SUBREAPER = 36
STREAM_BUFFER = 4 << 20  # bytes; a result of 100,000 vertices fits without pausing the transport
_POLL_INTERVAL = 0.01  # seconds


class WorkerStartFailed(RuntimeError):
    """A worker died or hung before it had tracked its first frame."""


class Process(Protocol):
    """The part of ``subprocess.Popen`` that a worker uses."""

    pid: int

    def kill(self) -> None: ...

    def wait(self, timeout: float | None = None) -> int: ...


class Connected(NamedTuple):
    """A ready worker process, and the server's end of its pipe.

    Attributes:
        here: it runs on this machine.
        leaving: whether its machine is about to stop.
    """

    process: Process
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter
    here: bool = True
    leaving: Callable[[], bool] = lambda: False


class WorkerSource(Protocol):
    """Makes workers."""

    async def worker(self, progress: Progress) -> Connected:
        """A ready worker; raises WorkerStartFailed or OSError."""

    async def end(self, patience: float = 0.0) -> None:
        """Gives back what the source itself has; its workers go on."""


class ForkServer:
    """A fork server process, from its launch.

    ``ddakf serve`` launches one before it imports gRPC and the web framework: both load at the same time.
    """

    def __init__(self, forks: bool = FORKS):
        if forks:
            _adopt_orphans()
        with _ends() as (ours, theirs):
            # The event loop would fork, which gRPC's threads forbid; Popen spawns the new program directly.
            self.process = subprocess.Popen(
                [*_PROGRAM, str(os.getpid()), str(theirs.fileno()), "fork" if forks else "single"],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                env={**os.environ, **ONE_THREAD},
            )
        self._control = ours
        self._writer: asyncio.StreamWriter | None = None
        self._loaded = False

    async def load(self, limits: Limits, progress: Progress) -> None:
        """Returns when the fork server has loaded the kernels and tracked a frame; at once if it has.

        Raises:
            WorkerStartFailed: it ended before. OSError: it is gone.
        """
        if self._writer is not None:
            return
        reader, self._writer = await asyncio.open_unix_connection(sock=self._control.dup())
        log = {name: os.environ[name] for name in ("DDAKF_LOG_LEVEL", "DDAKF_LOG_FORMAT") if name in os.environ}
        self._writer.write(json.dumps({"limits": limits.to_json(), "log": log}).encode() + b"\n")
        while step := json.loads(await reader.readline() or b"null"):
            if step == "ready":
                self._loaded = True
                return
            progress(*step)
        code = await asyncio.to_thread(self.process.wait)
        raise WorkerStartFailed(f"a worker ended with status {code} before it was ready; see its log")

    def connect(self) -> socket.socket:
        """Asks for a worker; returns the server's end of its pipe.

        Raises:
            OSError: the fork server is gone.
        """
        with _ends() as (ours, theirs):
            socket.send_fds(self._control, [b"w"], [theirs.fileno()])
        return ours

    def leave(self) -> None:
        """Closes the socket: a fork server that waits for it ends, a worker that it has become goes on."""
        if self._writer is not None:
            self._writer.close()
        self._control.close()

    async def end(self, patience: float = 0.0) -> None:
        """Ends the fork server; kills it after ``patience`` seconds, or at once while it loads. Its workers go on."""
        self.leave()
        await ended(self.process, patience if self._loaded else 0.0)


class ForkedWorkers:
    """Source of workers: a fork server, launched again when it is lost.

    Args:
        fork_server: one that was launched earlier.
    """

    def __init__(self, limits: Limits, fork_server: ForkServer | None = None, *, forks: bool = FORKS):
        self._limits, self._fork_server, self._forks = limits, fork_server, forks
        self._lock = asyncio.Lock()

    async def worker(self, progress: Progress) -> Connected:
        """A ready worker process.

        Raises:
            WorkerStartFailed, OSError: there is none; the next call launches another fork server.
        """
        async with self._lock:
            fork_server = self._fork_server = self._fork_server or ForkServer(self._forks)
            try:
                await fork_server.load(self._limits, progress)
                connected = await _connected(fork_server.connect(), None if self._forks else fork_server.process)
            except BaseException:
                await self.end()
                raise
            if not self._forks:
                self._fork_server = None
                fork_server.leave()
            return connected

    async def end(self, patience: float = 0.0) -> None:
        """Ends the fork server, if any."""
        fork_server, self._fork_server = self._fork_server, None
        if fork_server is not None:
            await fork_server.end(patience)


class ForkedProcess:
    """A worker that the fork server forked and this process adopted; it leads a process group, with its Draco decoder."""

    def __init__(self, pid: int):
        self.pid = pid
        self._status: int | None = None
        self._lock = threading.Lock()  # no other process has the id before this one is reaped

    def kill(self) -> None:
        with self._lock:
            if self._status is None:
                os.killpg(self.pid, signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        """The exit status; subprocess.TimeoutExpired after ``timeout`` seconds."""
        begun = time.monotonic()
        while not self._reap():
            if timeout is not None and time.monotonic() - begun > timeout:
                raise subprocess.TimeoutExpired("worker", timeout)
            time.sleep(_POLL_INTERVAL)
        return self._status

    def _reap(self) -> bool:
        with self._lock:
            if self._status is not None:
                return True
            pid, status = os.waitpid(self.pid, os.WNOHANG)
            if not pid:
                return False
            self._status = os.waitstatus_to_exitcode(status)
        # This process adopted the decoder of a killed worker too; it ends with its input.
        with suppress(ChildProcessError):
            while True:
                os.waitpid(-self.pid, 0)
        return True


async def ended(process: Process, patience: float) -> int:
    """The exit status of a process when it has ended; kills it after ``patience`` seconds."""
    try:
        return await asyncio.to_thread(process.wait, patience)
    except subprocess.TimeoutExpired:
        process.kill()
        return await asyncio.to_thread(process.wait)


@contextmanager
def _ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    """Both ends of a pipe: one to keep, unless an error comes, and one to pass on."""
    ours, theirs = socket.socketpair()
    with theirs:
        try:
            yield ours, theirs
        except BaseException:
            ours.close()
            raise


def _adopt_orphans() -> None:
    """Lets this process adopt the workers, whose parent by birth ends at once."""
    if ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
        raise OSError(ctypes.get_errno(), "the system does not let this process adopt its workers (PR_SET_CHILD_SUBREAPER)")


async def _connected(pipe: socket.socket, process: Process | None) -> Connected:
    """A worker process when it is ready; without ``process`` it tells its id, as a child of this process."""
    from .messages import wire

    reader, writer = await asyncio.open_unix_connection(sock=pipe, limit=STREAM_BUFFER)
    try:
        ready = await wire.read(reader)
    except BaseException as error:
        writer.close()
        if isinstance(error, asyncio.IncompleteReadError):
            raise WorkerStartFailed("a worker ended before it was ready; see its log") from None
        raise
    return Connected(process or ForkedProcess(int(ready.content)), reader, writer)
