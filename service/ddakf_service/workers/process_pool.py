"""Process pool: sessions on worker processes of this machine or a cluster, their calls, placement and moves."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable
from time import monotonic

from ddakf_api.errors import DeadlineExceeded, ResourceExhausted, ServiceError, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb

from .fork_server import ForkedWorkers, ForkServer, WorkerSource
from .messages import wire
from .placement import Placement, Turn
from .pool import RETRY_AFTER, UNKNOWN, Health, Limits, Memory, OnLost, Progress, worker_lost
from .roster import Roster
from .worker import Worker

log = logging.getLogger(__name__)

_RETRY_WHEN_FULL = 5.0  # seconds, sent to clients


class ProcessPool:
    """A WorkerPool of processes.

    Args:
        size: number of processes that accept frames.
        limits: upper bounds of one request.
        spares: number of warm processes in reserve that replace a lost one at once.
        frame_timeout: seconds per call; a worker that takes longer counts as hung and is replaced.
        warm_timeout: seconds for a worker to become ready.
        max_memory: estimated bytes of the sessions of a worker.
        recycle_frames: a worker is replaced in order after so many frames; 0: never.
        recycle_memory: a worker is replaced in order at so many resident bytes; 0: never.
        on_lost: called with the ids of the sessions lost with a worker.
        on_change: called when ``health()`` may have changed.
        fork_server: of the workers, launched earlier.
        source: of workers elsewhere; None: forks of the fork server.
    """

    def __init__(
        self,
        size: int,
        limits: Limits,
        *,
        spares: int = 0,
        frame_timeout: float,
        warm_timeout: float,
        max_memory: float = math.inf,
        recycle_frames: int = 0,
        recycle_memory: int = 0,
        on_lost: OnLost = lambda ids: None,
        on_change=lambda: None,
        fork_server: ForkServer | None = None,
        source: WorkerSource | None = None,
    ):
        self._frame_timeout, self._max_memory, self._on_lost = frame_timeout, max_memory, on_lost
        self._placements: dict[str, Placement] = {}  # by session id
        self._roster = Roster(
            size,
            source or ForkedWorkers(limits, fork_server),
            spares=spares,
            warm_timeout=warm_timeout,
            recycle_frames=recycle_frames,
            recycle_memory=recycle_memory,
            move=self._move,
            on_lost=self._lose,
            on_change=on_change,
        )

    async def start(self, progress: Progress) -> None:
        await self._roster.start(progress)

    async def open(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        return await self._place(wire.Kind.OPEN, session_id, request, memory)

    async def import_snapshot(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        return await self._place(wire.Kind.IMPORT, session_id, request, memory)

    async def restore(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        return await self._place(wire.Kind.RESTORE, session_id, request, memory)

    async def submit(
        self,
        session_id: str,
        frame: bytes | memoryview,
        options: bytes,
        *,
        max_points: int,
        start_by: float = math.inf,
        rate: float = 0.0,
    ) -> tuple[bytes, bytes | memoryview]:
        placement = self._placement(session_id)
        async with placement.lock, Turn(placement) as turn:
            if monotonic() > start_by:
                raise DeadlineExceeded("the frame's deadline passed before its turn came")
            worker = placement.worker
            grant = worker.shares.grant(session_id, rate, monotonic())
            head = wire.frame_request_head(options, max_points, grant)
            worker.frames += 1

            def record_refused(spent: wire.Spent) -> None:
                worker.shares.record_refused(session_id, spent)
                turn.took(spent.processor)

            # The future has no name here: the traceback of its error refers to this Python frame.
            content = await self._in_time(
                worker,
                session_id,
                worker.send(turn.kind, session_id, head, frame, turn_over=turn.over, record=record_refused),
            )
            spent = wire.unpack_spent(content)
            worker.shares.record(session_id, spent)
            turn.took(spent.processor)
            return wire.unpack_result(content)

    def affordable_rate(self, session_id: str) -> float:
        placement = self._placements.get(session_id)
        return 0.0 if placement is None else placement.worker.shares.affordable_rate(session_id)

    async def configure(self, session_id: str, request: bytes) -> bytes:
        placement = self._placement(session_id)
        async with placement.lock, placement.worker.building_lock:  # a worker builds one model at a time
            return await self._call(placement.worker, wire.Kind.CONFIGURE, session_id, request)

    async def reset(self, session_id: str, request: bytes) -> None:
        placement = self._placement(session_id)
        async with placement.lock:
            await self._call(placement.worker, wire.Kind.RESET, session_id, request)

    def snapshot(self, session_id: str, *, compressed: bool = False) -> Awaitable[bytes]:
        worker = self._placement(session_id).worker
        answer = worker.send(wire.Kind.SNAPSHOT, session_id, b"compressed" if compressed else b"")
        return self._in_time(worker, session_id, answer)

    def count_memory(self, session_id: str, memory: Memory) -> None:
        worker = self._placement(session_id).worker
        before = worker.sessions.pop(session_id, UNKNOWN)
        try:
            self._require_memory(worker, memory)
            before = memory
        finally:
            worker.sessions[session_id] = before

    async def isolate(self, session_id: str) -> None:
        async with self._roster.isolation:
            placement = self._placement(session_id)
            isolated = await self._roster.isolated()
            if placement.worker is not isolated:
                self._require_memory(isolated, placement.worker.sessions.get(session_id, UNKNOWN))
                await self._move(session_id, placement.worker, isolated)
                isolated.lower_priority()  # its threads that were being started when it began

    async def close(self, session_id: str) -> None:
        placement = self._placements.get(session_id)
        if placement is None:
            return
        async with placement.lock:  # the session may be moving between workers
            if self._placements.get(session_id) is placement:
                del self._placements[session_id]
                placement.worker.release(session_id)
                await self._call(placement.worker, wire.Kind.CLOSE, session_id)

    def health(self) -> Health:
        return self._roster.health()

    def process_ids(self) -> list[int]:
        return [worker.process.pid for worker in self._roster.accepting]

    async def stop(self) -> None:
        await self._roster.stop()

    # Sessions -------------------------------------------------------------------------------------------------------

    async def _place(self, kind: wire.Kind, session_id: str, request: bytes, memory: Memory) -> bytes:
        """Creates a session on the least loaded worker."""
        if not self._roster.accepting:
            raise Unavailable("no worker is ready; try again in a few seconds", retry_after=RETRY_AFTER)
        worker = min(self._roster.accepting, key=lambda w: (w.memory_with(memory) > self._max_memory, len(w.sessions)))
        self._require_memory(worker, memory)
        if before := self._placements.get(session_id):  # an earlier caller left before the session was open
            before.worker.release(session_id)
            before.worker.send_without_answer(wire.Kind.CLOSE, session_id)
        worker.sessions[session_id] = memory
        placement = self._placements[session_id] = Placement(worker)
        try:
            async with placement.lock, worker.building_lock:
                return await self._call(worker, kind, session_id, request)
        except BaseException:
            worker.release(session_id)
            if self._placements.get(session_id) is placement:
                del self._placements[session_id]
            # The caller may have left while the worker opened the session.
            worker.send_without_answer(wire.Kind.CLOSE, session_id)
            raise

    def _require_memory(self, worker: Worker, memory: Memory) -> None:
        if worker.memory_with(memory) > self._max_memory:
            raise ResourceExhausted(
                f"memory: no worker has {sum(memory) >> 20} MiB left for the session; try again later, or with fewer points",
                retry_after=_RETRY_WHEN_FULL,
            )

    def _placement(self, session_id: str) -> Placement:
        try:
            return self._placements[session_id]
        except KeyError:
            raise worker_lost(session_id) from None

    async def _call(self, worker: Worker, kind: wire.Kind, session_id: str, *request: bytes | memoryview) -> bytes:
        return await self._in_time(worker, session_id, worker.send(kind, session_id, *request))

    async def _in_time(self, worker: Worker, session_id: str, answer: asyncio.Future[bytes]) -> bytes:
        try:
            async with asyncio.timeout(self._frame_timeout):
                return await answer
        except TimeoutError:
            fields = {"session": session_id, "worker": worker.process.pid}
            log.error("a worker did not answer in %.0f s and is replaced", self._frame_timeout, extra=fields)
            worker.process.kill()
            raise worker_lost(session_id, suspected=True) from None
        finally:
            del answer  # the traceback of its error refers to this Python frame: a reference cycle

    def _lose(self, worker: Worker) -> None:
        """Reports the sessions of a lost worker as lost."""
        lost = sorted(session_id for session_id, placement in self._placements.items() if placement.worker is worker)
        for session_id in lost:
            del self._placements[session_id]
        log.error("a worker was lost", extra={"worker": worker.process.pid, "sessions_lost": len(lost)})
        self._on_lost(lost)

    async def _move(self, session_id: str, old: Worker, new: Worker) -> None:
        """Moves a session between two frames; after a failure the session stays in its worker."""
        placement = self._placements.get(session_id)
        if placement is None or placement.worker is not old:
            return
        try:
            async with placement.lock:
                if self._placements.get(session_id) is not placement:
                    return
                data = await self._call(old, wire.Kind.SNAPSHOT, session_id)
                request = pb.RestoreSessionRequest(data=data).SerializeToString()
                async with new.building_lock:
                    await self._call(new, wire.Kind.RESTORE, session_id, request)
                if self._placements.get(session_id) is not placement:  # the old worker was lost meanwhile
                    new.send_without_answer(wire.Kind.CLOSE, session_id)
                    return
                placement.worker = new
                new.sessions[session_id] = old.release(session_id)
                old.send_without_answer(wire.Kind.CLOSE, session_id)
        except ServiceError as error:
            log.warning("a session could not be moved: %s", error, extra={"session": session_id})
