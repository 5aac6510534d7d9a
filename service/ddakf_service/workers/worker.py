"""Worker: one worker process and the server's end of its pipe."""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import os
import socket
import subprocess
import sys
from pathlib import Path

from ddakf_api.errors import from_detail
from ddakf_api.v1 import tracking_pb2 as pb

from . import wire
from .pool import UNKNOWN, Limits, Memory, Progress, worker_lost

log = logging.getLogger(__name__)

# One compute thread per worker: sessions are the unit of parallelism, and more threads than cores add only waiting.
ONE_THREAD = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}

_STREAM_BUFFER = 4 << 20  # bytes; a result of 100,000 vertices fits without pausing the transport
_EXIT_PATIENCE = 5.0  # seconds for a worker to end by itself after its pipe is closed
_FRAMES_IN_PIPE = 2  # the tracked frame and the next one, so that the worker never waits; further frames queue in order


class WorkerStartFailed(RuntimeError):
    """A worker died or hung before it had tracked its first frame."""


class Worker:
    """One process and the server's end of its pipe.

    Attributes:
        sessions: estimated memory by session id.
        frame_slots: held by a frame, or by the placement of a session, while it is in the pipe or the worker.
        placement_lock: held by a placement that waits for a slot, so that a frame waits for one placement at most.
        frames: number of submitted frames.
        gone: set when the process has ended.
        exit_watcher: task that waits for ``gone``.
    """

    exit_watcher: asyncio.Task

    def __init__(self, process: subprocess.Popen, reader: asyncio.StreamReader, writer: asyncio.StreamWriter):
        self.process = process
        self.sessions: dict[str, Memory] = {}
        self.frame_slots, self.placement_lock = asyncio.Semaphore(_FRAMES_IN_PIPE), asyncio.Lock()
        self.frames = 0
        self.gone = asyncio.Event()
        self._reader, self._writer = reader, writer
        self._numbers = itertools.count(1)
        self._waiting: dict[int, tuple[str, asyncio.Future[bytes]]] = {}
        self._listener: asyncio.Task | None = None

    @classmethod
    async def start(cls, limits: Limits, timeout: float, progress: Progress) -> Worker:
        """Spawns a process and returns when it has tracked its first frame."""
        ours, theirs = socket.socketpair()
        with theirs:
            reader, writer = await asyncio.open_unix_connection(sock=ours, limit=_STREAM_BUFFER)
            # The event loop would fork, which gRPC's threads forbid; Popen spawns the new program directly.
            try:
                process = subprocess.Popen(
                    [sys.executable, "-m", "ddakf_service.workers.process", str(theirs.fileno()), limits.to_json()],
                    pass_fds=(theirs.fileno(),),
                    stdin=subprocess.DEVNULL,
                    env={**os.environ, **ONE_THREAD},
                )
            except OSError:
                writer.close()
                raise
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

    def memory_with(self, more: Memory = UNKNOWN) -> int:
        """Estimated bytes of the worker's sessions and one more."""
        all_of_them = [*self.sessions.values(), more]
        return sum(memory.session for memory in all_of_them) + max(memory.frame for memory in all_of_them)

    def resident_bytes(self) -> int:
        """Resident bytes of the process; 0 where the system does not report them."""
        try:
            return int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except OSError:
            return 0

    def send(self, kind: wire.Kind, session_id: str, *content: bytes | memoryview) -> asyncio.Future[bytes]:
        """Sends a request, its content in pieces, at once; returns a future of the answer.

        Raises:
            WorkerLost: the worker is gone. The future may raise it too.
        """
        if self.gone.is_set():
            raise worker_lost(session_id)
        number = next(self._numbers)
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._waiting[number] = session_id, answer
        answer.add_done_callback(lambda _: self._waiting.pop(number, None))
        self._writer.writelines((wire.head(kind, number, session_id, sum(map(len, content))), *content))
        return answer

    def send_without_answer(self, kind: wire.Kind, session_id: str) -> None:
        """Sends a request and ignores its answer."""
        if not self.gone.is_set():
            self._writer.write(wire.Message(kind, 0, session_id).head())

    async def end(self, patience: float = _EXIT_PATIENCE) -> None:
        """Closes the pipe, which ends the process; kills it after ``patience`` seconds."""
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
                progress(*json.loads(message.content))
        except (asyncio.IncompleteReadError, ConnectionError):
            code = await asyncio.to_thread(self.process.wait)
            raise WorkerStartFailed(f"a worker ended with status {code} before it was ready; see its log") from None
        except ValueError as error:
            raise WorkerStartFailed(f"a worker sent an invalid message before it was ready: {error}") from None

    async def _listen(self) -> None:
        try:
            while True:
                message = await wire.read(self._reader)
                _, answer = self._waiting.get(message.number, ("", None))
                if answer is None or answer.done():
                    continue  # the caller has left
                if message.kind is wire.Kind.ERROR:
                    answer.set_exception(from_detail(pb.ErrorDetail.FromString(message.content)))
                else:
                    answer.set_result(message.content)
        except (asyncio.IncompleteReadError, ConnectionError):
            # The operating system closes the pipe of a killed process at once: a kill is detected here too.
            await self._lose()
        except Exception:
            log.exception("a worker sent an invalid message and is replaced", extra={"worker": self.process.pid})
            await self._lose()

    async def _lose(self) -> None:
        self.gone.set()
        for session_id, answer in list(self._waiting.values()):
            if not answer.done():
                answer.set_exception(worker_lost(session_id))
        await self.end(patience=0)
