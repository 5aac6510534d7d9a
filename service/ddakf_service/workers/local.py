"""Worker processes of this machine: spawned, watched, replaced."""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import os
import socket
import subprocess
import sys

from ddakf_api.errors import Unavailable, from_detail
from ddakf_api.v1 import tracking_pb2 as pb

from . import wire
from .pool import RETRY_AFTER, Health, Limits, OnLost, Progress, worker_lost

log = logging.getLogger(__name__)

# One compute thread per worker: sessions are the unit of parallelism, and more threads than cores only add waiting.
ONE_THREAD = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}

_STREAM_BUFFER = 4 << 20  # bytes; a result of 100,000 vertices fits without pausing the transport
_EXIT_PATIENCE = 5.0  # seconds that a worker has to end by itself once its pipe is closed
_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 10.0  # seconds between attempts to replace a worker that dies before it is ready


class WorkerStartFailed(RuntimeError):
    """A worker died or hung before it had tracked its first frame."""


class LocalPool:
    """A WorkerPool of spawned processes.

    Args:
        size: number of processes.
        limits: what one request may contain.
        frame_timeout: seconds that a call may take before its worker counts as hung and is replaced.
        warm_timeout: seconds that a worker has to become ready.
        on_lost: told which sessions went with a worker.
        on_change: called whenever ``health()`` may have changed.
    """

    def __init__(
        self,
        size: int,
        limits: Limits,
        *,
        frame_timeout: float,
        warm_timeout: float,
        on_lost: OnLost = lambda ids: None,
        on_change=lambda: None,
    ):
        self._size, self._limits = size, limits
        self._frame_timeout, self._warm_timeout = frame_timeout, warm_timeout
        self._on_lost, self._on_change = on_lost, on_change
        self._workers: list[_Worker] = []  # the ready ones
        self._homes: dict[str, _Worker] = {}  # session id to its worker
        self._keepers: list[asyncio.Task] = []
        self._restarts = 0

    async def start(self, progress: Progress) -> None:
        # The first worker compiles and fills the kernel cache; the others then load from it.
        await self._add_worker(progress)
        others = [self._add_worker(lambda *_: None) for _ in range(self._size - 1)]
        for outcome in await asyncio.gather(*others, return_exceptions=True):
            if isinstance(outcome, BaseException):
                raise outcome

    async def open(self, session_id: str, request: bytes) -> bytes:
        return await self._place(wire.Kind.OPEN, session_id, request)

    async def restore(self, session_id: str, request: bytes) -> bytes:
        return await self._place(wire.Kind.RESTORE, session_id, request)

    async def submit(self, session_id: str, frame: bytes, options: bytes) -> bytes:
        return await self._call(self._home(session_id), wire.Kind.FRAME, session_id, wire.join(options, frame))

    async def reset(self, session_id: str, request: bytes) -> None:
        await self._call(self._home(session_id), wire.Kind.RESET, session_id, request)

    async def snapshot(self, session_id: str) -> bytes:
        return await self._call(self._home(session_id), wire.Kind.SNAPSHOT, session_id)

    async def close(self, session_id: str) -> None:
        worker = self._homes.pop(session_id, None)
        if worker is None:
            return
        worker.sessions.discard(session_id)
        await self._call(worker, wire.Kind.CLOSE, session_id)

    def health(self) -> Health:
        return Health(len(self._workers), self._size, self._restarts)

    def process_ids(self) -> list[int]:
        """Of the ready workers."""
        return [worker.process.pid for worker in self._workers]

    async def stop(self) -> None:
        for keeper in self._keepers:
            keeper.cancel()
        await asyncio.gather(*self._keepers, return_exceptions=True)
        await asyncio.gather(*(worker.end() for worker in self._workers))
        self._workers.clear()

    async def _place(self, kind: wire.Kind, session_id: str, request: bytes) -> bytes:
        """Creates a session on the least loaded worker."""
        if not self._workers:
            raise Unavailable("no worker is ready; try again in a few seconds", retry_after=RETRY_AFTER)
        worker = min(self._workers, key=lambda w: len(w.sessions))
        worker.sessions.add(session_id)
        self._homes[session_id] = worker
        try:
            return await self._call(worker, kind, session_id, request)
        except BaseException:
            worker.sessions.discard(session_id)
            self._homes.pop(session_id, None)
            # Whoever asked may have left while the worker was at it.
            worker.tell(wire.Kind.CLOSE, session_id)
            raise

    def _home(self, session_id: str) -> _Worker:
        try:
            return self._homes[session_id]
        except KeyError:
            raise worker_lost(session_id) from None

    async def _call(self, worker: _Worker, kind: wire.Kind, session_id: str, payload: bytes = b"") -> bytes:
        try:
            async with asyncio.timeout(self._frame_timeout):
                return await worker.call(kind, session_id, payload)
        except TimeoutError:
            log.error("a worker did not answer in %.0f s and is replaced", self._frame_timeout)
            worker.process.kill()
            raise worker_lost(session_id) from None

    async def _add_worker(self, progress: Progress) -> None:
        worker = await _Worker.start(self._limits, self._warm_timeout, progress)
        self._workers.append(worker)
        self._keepers.append(asyncio.create_task(self._keep(worker)))
        self._on_change()

    async def _keep(self, worker: _Worker) -> None:
        """Waits for the end of a worker, tells whom it concerns, replaces it, and so on."""
        while True:
            await worker.gone.wait()
            self._forget(worker)
            worker = await self._replacement()
            self._workers.append(worker)
            self._on_change()

    def _forget(self, worker: _Worker) -> None:
        self._workers.remove(worker)
        self._restarts += 1
        log.error("a worker was lost", extra={"worker": worker.process.pid, "sessions_lost": len(worker.sessions)})
        lost = sorted(worker.sessions)
        for session_id in lost:
            self._homes.pop(session_id, None)
        self._on_lost(lost)
        self._on_change()

    async def _replacement(self) -> _Worker:
        pause = _FIRST_PAUSE
        while True:
            try:
                return await _Worker.start(self._limits, self._warm_timeout, lambda *_: None)
            except (WorkerStartFailed, OSError) as error:
                log.error("a worker could not be replaced, next attempt in %.1f s: %s", pause, error)
                await asyncio.sleep(pause)
                pause = min(2 * pause, _LONGEST_PAUSE)


class _Worker:
    """One process and the server's end of its pipe."""

    def __init__(self, process: subprocess.Popen, reader: asyncio.StreamReader, writer: asyncio.StreamWriter):
        self.process = process
        self.sessions: set[str] = set()
        self.gone = asyncio.Event()
        self._reader, self._writer = reader, writer
        self._numbers = itertools.count(1)
        self._waiting: dict[int, tuple[str, asyncio.Future[bytes]]] = {}
        self._listener: asyncio.Task | None = None

    @classmethod
    async def start(cls, limits: Limits, timeout: float, progress: Progress) -> _Worker:
        """Spawns a process and returns when it has tracked its first frame."""
        ours, theirs = socket.socketpair()
        with theirs:
            reader, writer = await asyncio.open_unix_connection(sock=ours, limit=_STREAM_BUFFER)
            # Not the event loop's own way to start a process: it forks, which gRPC's threads forbid, while this one
            # goes straight to the new program.
            process = subprocess.Popen(
                [sys.executable, "-m", "ddakf_service.workers.process", str(theirs.fileno()), limits.to_json()],
                pass_fds=(theirs.fileno(),),
                stdin=subprocess.DEVNULL,
                env={**os.environ, **ONE_THREAD},
            )
        worker = cls(process, reader, writer)
        try:
            async with asyncio.timeout(timeout):
                await worker._become_ready(progress)
        except TimeoutError:
            await worker.end(patience=0)
            raise WorkerStartFailed(f"a worker was not ready after {timeout:.0f} s") from None
        except BaseException:
            await worker.end(patience=0)
            raise
        worker._listener = asyncio.create_task(worker._listen())
        return worker

    async def call(self, kind: wire.Kind, session_id: str, payload: bytes) -> bytes:
        if self.gone.is_set():
            raise worker_lost(session_id)
        number = next(self._numbers)
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._waiting[number] = session_id, answer
        message = wire.Message(kind, number, session_id, payload)
        try:
            self._writer.writelines((message.head(), payload))
            return await answer
        finally:
            del self._waiting[number]

    def tell(self, kind: wire.Kind, session_id: str) -> None:
        """A request whose answer nobody waits for."""
        if not self.gone.is_set():
            self._writer.write(wire.Message(kind, 0, session_id).head())

    async def end(self, patience: float = _EXIT_PATIENCE) -> None:
        """Closes the pipe, at which the process ends; kills it if it does not."""
        if self._listener not in (None, asyncio.current_task()):
            self._listener.cancel()
        self._writer.close()
        try:
            await asyncio.to_thread(self.process.wait, patience)
        except subprocess.TimeoutExpired:
            self.process.kill()
            await asyncio.to_thread(self.process.wait)

    async def _become_ready(self, progress: Progress) -> None:
        try:
            while (message := await wire.read(self._reader)).kind is not wire.Kind.READY:
                progress(*json.loads(message.payload))
        except (asyncio.IncompleteReadError, ConnectionError):
            code = await asyncio.to_thread(self.process.wait)
            raise WorkerStartFailed(f"a worker ended with status {code} before it was ready; its log says why") from None

    async def _listen(self) -> None:
        try:
            while True:
                message = await wire.read(self._reader)
                _, answer = self._waiting.get(message.number, ("", None))
                if answer is None or answer.done():
                    continue  # whoever asked has left
                if message.kind is wire.Kind.ERROR:
                    answer.set_exception(from_detail(pb.ErrorDetail.FromString(message.payload)))
                else:
                    answer.set_result(message.payload)
        except (asyncio.IncompleteReadError, ConnectionError):
            # The kernel closes the pipe of a killed process at once, so this is also how a kill is noticed.
            await self._lose()
        except Exception:
            log.exception("a worker sent what cannot be read and is replaced", extra={"worker": self.process.pid})
            await self._lose()

    async def _lose(self) -> None:
        self.gone.set()
        for session_id, answer in self._waiting.values():
            if not answer.done():
                answer.set_exception(worker_lost(session_id))
        await self.end(patience=0)
