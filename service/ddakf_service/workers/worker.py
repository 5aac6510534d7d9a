"""One worker process, and the server's end of its pipe: spawned, spoken to, ended."""

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

from ..workers import wire
from .pool import UNKNOWN, Limits, Memory, Progress, worker_lost

log = logging.getLogger(__name__)

# One compute thread per worker: sessions are the unit of parallelism, and more threads than cores only add waiting.
ONE_THREAD = {name: "1" for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")}

_STREAM_BUFFER = 4 << 20  # bytes; a result of 100,000 vertices fits without pausing the transport
_EXIT_PATIENCE = 5.0  # seconds that a worker has to end by itself once its pipe is closed
_FRAMES_IN_PIPE = 2  # one that is tracked, and one so that the worker need not wait; the others' turns come in order


class WorkerStartFailed(RuntimeError):
    """A worker died or hung before it had tracked its first frame."""


class Worker:
    """One process and the server's end of its pipe.

    Attributes:
        sessions: with the memory that each is estimated to take.
        turns: taken by a frame, or a session that is placed, for as long as it is in the pipe or the worker.
        placing: taken by a session that waits for such a turn, so that no frame waits for several of them.
        frames: submitted so far.
        gone: set once the process is.
        keeper: waits for that.
    """

    keeper: asyncio.Task

    def __init__(self, process: subprocess.Popen, reader: asyncio.StreamReader, writer: asyncio.StreamWriter):
        self.process = process
        self.sessions: dict[str, Memory] = {}
        self.turns, self.placing = asyncio.Semaphore(_FRAMES_IN_PIPE), asyncio.Lock()
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
            # Not the event loop's own way to start a process: it forks, which gRPC's threads forbid, while this one
            # goes straight to the new program.
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
        """Estimated bytes of its sessions, with one more."""
        all_of_them = [*self.sessions.values(), more]
        return sum(memory.kept for memory in all_of_them) + max(memory.frame for memory in all_of_them)

    def resident_bytes(self) -> int:
        """What the process has in memory; 0 where the system does not say."""
        try:
            return int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except OSError:
            return 0

    def send(self, kind: wire.Kind, session_id: str, payload: bytes = b"") -> asyncio.Future[bytes]:
        """Places a request at once; its answer comes later.

        Raises:
            WorkerLost: the worker is gone. The answer may be so, too.
        """
        if self.gone.is_set():
            raise worker_lost(session_id)
        number = next(self._numbers)
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._waiting[number] = session_id, answer
        answer.add_done_callback(lambda _: self._waiting.pop(number, None))
        self._writer.writelines((wire.Message(kind, number, session_id, payload).head(), payload))
        return answer

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
        except ValueError as error:
            raise WorkerStartFailed(f"a worker sent what cannot be read before it was ready: {error}") from None

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
        for session_id, answer in list(self._waiting.values()):
            if not answer.done():
                answer.set_exception(worker_lost(session_id))
        await self.end(patience=0)
