"""Worker: one worker process and the server's end of its pipe."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import logging
import os
from collections.abc import Callable, Set
from heapq import nlargest
from pathlib import Path
from typing import NamedTuple

from ddakf_api.errors import from_detail
from ddakf_api.v1 import tracking_pb2 as pb

from .compute.lanes import FRAMES
from .fair_shares import FairShares
from .fork_server import Process, WorkerSource, WorkerStartFailed, ended
from .messages import wire
from .pool import UNKNOWN, Memory, Progress, worker_lost

log = logging.getLogger(__name__)

EXIT_PATIENCE = 5.0  # seconds for a worker to end by itself after its pipe is closed
_STATUS_PATIENCE = 0.2  # seconds for a worker whose pipe is closed to end with a status of its own
_FRAMES_IN_PIPE = 2  # the tracked frame and the next one, so that the worker never waits; further frames queue in order
# Requests of clients that are rarer than frames and do more. Restores of checkpoints follow each loss: no sign of its cause.
_CHANGES = {wire.Kind.OPEN, wire.Kind.IMPORT, wire.Kind.CONFIGURE, wire.Kind.RESET}
_GIVING_WAY = 10  # added to the nice value, which Ray may have raised already


class _Call(NamedTuple):
    """A request without an answer."""

    kind: wire.Kind
    session_id: str
    answer: asyncio.Future[bytes]
    turn_over: Callable[[], None]
    record: Callable[[wire.Spent], None]


class Worker:
    """One process and the server's end of its pipe.

    Attributes:
        sessions: estimated memory by session id.
        frame_slots: held by a frame while it is in the pipe or on the light lane of the worker.
        heavy_slots: held by a frame while it is in the pipe or on the heavy lane.
        building_lock: held while a session is opened, restored or configured: the worker builds one model at a time, and the
            timeout of a call begins with its turn.
        frames: number of submitted frames.
        shares: of its processor time, among the sessions.
        leaving: whether its machine is about to stop.
        gone: set when the process has ended, or is about to.
        exit_watcher: task that waits for ``gone``.
    """

    exit_watcher: asyncio.Task

    def __init__(
        self,
        process: Process,
        reader: asyncio.StreamReader,
        writer: asyncio.StreamWriter,
        here: bool = True,
        leaving: Callable[[], bool] = lambda: False,
    ):
        self.process, self._here, self.leaving = process, here, leaving
        self.sessions: dict[str, Memory] = {}
        self.frame_slots, self.heavy_slots = asyncio.Semaphore(_FRAMES_IN_PIPE), asyncio.Semaphore(1)
        self.building_lock = asyncio.Lock()
        self.frames, self.shares = 0, FairShares()
        self.bytes_at_start = 0  # resident, with the sessions of the worker that it replaced
        self.gone = asyncio.Event()
        self._reader, self._writer = reader, writer
        self._numbers = itertools.count(1)
        self._calls: dict[int, _Call] = {}
        self._listener: asyncio.Task | None = None
        self._lowered: int | None = None  # nice value

    @classmethod
    async def start(cls, source: WorkerSource, timeout: float, progress: Progress) -> Worker:
        """A worker that is ready for sessions.

        Raises:
            WorkerStartFailed, OSError: it could not be started.
        """
        try:
            async with asyncio.timeout(timeout):
                worker = cls(*await source.worker(progress))
        except TimeoutError:
            raise WorkerStartFailed(f"a worker was not ready after {timeout:.0f} s") from None
        worker._listener = asyncio.create_task(worker._listen())
        return worker

    def memory_with(self, more: Memory = UNKNOWN) -> int:
        """Estimated bytes of the worker's sessions and one more."""
        all_of_them = [*self.sessions.values(), more]
        return sum(m.session for m in all_of_them) + sum(nlargest(FRAMES, (m.frame for m in all_of_them)))

    def release(self, session_id: str) -> Memory:
        """Forgets a session, with its share of the worker's time; returns its estimated memory."""
        self.shares.forget(session_id)
        return self.sessions.pop(session_id, UNKNOWN)

    def resident_bytes(self) -> int:
        """Resident bytes of the process; 0 where the system does not report them, or on another machine."""
        if not self._here:
            return 0
        try:
            return int(Path(f"/proc/{self.process.pid}/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
        except OSError:
            return 0

    def lower_priority(self) -> None:
        """Gives way to all other processes of this machine where they need the cores; safe to call again.

        A thread that is being started at this time may keep the priority of before; a later call lowers it.
        """
        if not self._here:
            return
        reached: set[str] = set()
        with contextlib.suppress(OSError):  # it has ended, or the system has no /proc
            if self._lowered is None:  # the system knows the highest value
                self._lowered = os.getpriority(os.PRIO_PROCESS, self.process.pid) + _GIVING_WAY
            while started := set(os.listdir(f"/proc/{self.process.pid}/task")) - reached:  # threads start others meanwhile
                for thread in started:
                    with contextlib.suppress(ProcessLookupError):  # the thread has ended
                        os.setpriority(os.PRIO_PROCESS, int(thread), self._lowered)
                reached |= started

    def send(
        self,
        kind: wire.Kind,
        session_id: str,
        *content: bytes | memoryview,
        turn_over: Callable[[], None] = lambda: None,
        record: Callable[[wire.Spent], None] = lambda spent: None,
    ) -> asyncio.Future[bytes]:
        """Sends a request, its content in pieces, at once; returns a future of the answer.

        Args:
            turn_over: called when the request continues beside others, see :mod:`.lanes`.
            record: called with what a request has taken that ends with an error.

        Raises:
            WorkerLost: the worker is gone. The future may raise it too.
        """
        if self.gone.is_set():
            raise worker_lost(session_id)
        number = next(self._numbers)
        answer: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._calls[number] = _Call(kind, session_id, answer, turn_over, record)
        answer.add_done_callback(lambda _: self._calls.pop(number, None))
        self._writer.writelines((wire.head(kind, number, session_id, sum(map(len, content))), *content))
        return answer

    def send_without_answer(self, kind: wire.Kind, session_id: str) -> None:
        """Sends a request and ignores its answer."""
        if not self.gone.is_set():
            self._writer.write(wire.Message(kind, 0, session_id).head())

    async def answered(self) -> None:
        """Returns when the calls so far are answered."""
        if answers := [call.answer for call in self._calls.values()]:
            await asyncio.wait(answers)

    async def end(self, patience: float = EXIT_PATIENCE) -> int:
        """Closes the pipe, which ends the process; kills it after ``patience`` seconds. Returns its exit status.

        Calls without an answer raise ``WorkerLost``.
        """
        if self._listener not in (None, asyncio.current_task()):
            self._listener.cancel()
        self._fail_calls()
        self._writer.close()
        return await ended(self.process, patience)

    def _fail_calls(self, suspects: Set[str] | None = None) -> None:
        """Ends all calls, also later ones, with ``WorkerLost``.

        Args:
            suspects: sessions with a request that is rarer than frames; a call may be the cause if no other session has one.
                None: there is no cause to look for.
        """
        self.gone.set()
        for call in list(self._calls.values()):
            if not call.answer.done():
                suspected = suspects is not None and suspects <= {call.session_id}
                call.answer.set_exception(worker_lost(call.session_id, suspected=suspected))

    async def _listen(self) -> None:
        try:
            while True:
                message = await wire.read(self._reader)
                call = self._calls.get(message.number)
                if call is None or call.answer.done():
                    continue  # the caller has left
                if message.kind is wire.Kind.ASIDE:
                    call.turn_over()
                elif message.kind is wire.Kind.ERROR:
                    detail, spent = wire.unpack_error(message.content)
                    call.record(spent)
                    call.answer.set_exception(from_detail(pb.ErrorDetail.FromString(detail)))
                else:
                    call.answer.set_result(message.content)
        except (asyncio.IncompleteReadError, OSError):
            # The operating system closes the pipe of a killed process at once: a kill is detected here too. A machine that
            # vanishes is a TimeoutError, or one of the network.
            await self._lose(_STATUS_PATIENCE if self._here else 0.0)
        except Exception:
            log.exception("a worker sent an invalid message and is replaced", extra={"worker": self.process.pid})
            await self._lose(0.0)

    async def _lose(self, patience: float) -> None:
        self._fail_calls({call.session_id for call in self._calls.values() if call.kind in _CHANGES})
        status = await self.end(patience)
        if self._here:  # Ray does not tell the status of an actor
            log.error("a lost worker has ended", extra={"worker": self.process.pid, "status": status})
