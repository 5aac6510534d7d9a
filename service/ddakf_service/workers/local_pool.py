"""Pool of this machine's worker processes: placement of sessions, replacement and recycling of workers."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import AsyncIterator, Awaitable, Coroutine
from time import monotonic

from ddakf_api.errors import DeadlineExceeded, ResourceExhausted, ServiceError, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb

from . import wire
from .pool import RETRY_AFTER, UNKNOWN, Health, Limits, Memory, OnLost, Progress, worker_lost
from .worker import Worker, WorkerStartFailed

log = logging.getLogger(__name__)

_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 10.0  # seconds between attempts to replace a worker that dies before it is ready
_LOOK_INTERVAL = 1.0  # seconds between checks for workers to recycle
_RETRY_WHEN_FULL = 5.0  # seconds, sent to clients
# A starting process uses a core for seconds, and sessions of a lost worker need it more. A new spare therefore waits until
# they are placed: at least the head start, after which placement has begun, and at most the longest one. Seconds.
_HEAD_START, _LONGEST_HEAD_START = 0.5, 10.0


class LocalPool:
    """A WorkerPool of spawned processes.

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
    ):
        self._size, self._n_spares, self._limits = size, spares, limits
        self._frame_timeout, self._warm_timeout = frame_timeout, warm_timeout
        self._max_memory = max_memory
        self._recycle_frames, self._recycle_memory = recycle_frames or math.inf, recycle_memory or math.inf
        self._on_lost, self._on_change = on_lost, on_change
        self._workers: list[Worker] = []  # those that accept frames
        self._spares: list[Worker] = []
        self._retiring: set[Worker] = set()
        self._placements: dict[str, _Placement] = {}  # by session id
        self._tasks: set[asyncio.Task] = set()
        self._starting = self._restarts = self._recycled = 0
        self._placements_in_progress = 0  # sessions that are being opened, restored or moved

    async def start(self, progress: Progress) -> None:
        # The first worker compiles the kernels and fills the cache; the others load from it.
        await self._add_worker(progress)
        for result in await asyncio.gather(*(self._add_worker() for _ in range(self._size - 1)), return_exceptions=True):
            if isinstance(result, BaseException):
                raise result
        self._start_missing()
        self._background(self._recycle_when_due())

    async def open(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        return await self._place(wire.Kind.OPEN, session_id, request, memory)

    async def restore(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        return await self._place(wire.Kind.RESTORE, session_id, request, memory)

    async def submit(
        self, session_id: str, frame: bytes | memoryview, options: bytes, *, max_points: int, start_by: float = math.inf
    ) -> tuple[bytes, bytes | memoryview]:
        placement = self._placement(session_id)
        async with placement.lock, placement.worker.frame_slots:
            if monotonic() > start_by:
                raise DeadlineExceeded("the frame's deadline passed before its turn came")
            placement.worker.frames += 1
            head = wire.frame_request_head(options, max_points)
            return wire.unpack_result(await self._call(placement.worker, wire.Kind.FRAME, session_id, head, frame))

    async def configure(self, session_id: str, request: bytes) -> bytes:
        return await self._call_worker_of(wire.Kind.CONFIGURE, session_id, request)

    async def reset(self, session_id: str, request: bytes) -> None:
        await self._call_worker_of(wire.Kind.RESET, session_id, request)

    def snapshot(self, session_id: str, *, compressed: bool = False) -> Awaitable[bytes]:
        worker = self._placement(session_id).worker
        answer = worker.send(wire.Kind.SNAPSHOT, session_id, b"compressed" if compressed else b"")
        return self._in_time(worker, session_id, answer)

    async def close(self, session_id: str) -> None:
        placement = self._placements.get(session_id)
        if placement is None:
            return
        async with placement.lock:  # the session may be moving between workers
            if self._placements.get(session_id) is placement:
                del self._placements[session_id]
                placement.worker.sessions.pop(session_id, None)
                await self._call(placement.worker, wire.Kind.CLOSE, session_id)

    def health(self) -> Health:
        return Health(len(self._workers), self._size, self._restarts, len(self._spares), self._recycled)

    def process_ids(self) -> list[int]:
        return [worker.process.pid for worker in self._workers]

    async def stop(self) -> None:
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(worker.end() for worker in [*self._workers, *self._spares, *self._retiring]))
        for workers in (self._workers, self._spares, self._retiring):
            workers.clear()

    # Sessions -------------------------------------------------------------------------------------------------------

    async def _place(self, kind: wire.Kind, session_id: str, request: bytes, memory: Memory) -> bytes:
        """Creates a session on the least loaded worker."""
        if not self._workers:
            raise Unavailable("no worker is ready; try again in a few seconds", retry_after=RETRY_AFTER)
        worker = min(self._workers, key=lambda w: (w.memory_with(memory) > self._max_memory, len(w.sessions)))
        if worker.memory_with(memory) > self._max_memory:
            raise ResourceExhausted(
                f"memory: no worker has {sum(memory) >> 20} MiB left for the session; try again later, or with fewer points",
                retry_after=_RETRY_WHEN_FULL,
            )
        if before := self._placements.get(session_id):  # an earlier caller left before the session was open
            before.worker.sessions.pop(session_id, None)
            before.worker.send_without_answer(wire.Kind.CLOSE, session_id)
        worker.sessions[session_id] = memory
        placement = self._placements[session_id] = _Placement(worker)
        try:
            async with placement.lock, self._placement_turn(worker), worker.frame_slots:
                return await self._call(worker, kind, session_id, request)
        except BaseException:
            worker.sessions.pop(session_id, None)
            if self._placements.get(session_id) is placement:
                del self._placements[session_id]
            # The caller may have left while the worker opened the session.
            worker.send_without_answer(wire.Kind.CLOSE, session_id)
            raise

    @contextlib.asynccontextmanager
    async def _placement_turn(self, worker: Worker) -> AsyncIterator[None]:
        """Lets one session at a time be placed in a worker; frames of its other sessions are tracked in between."""
        self._placements_in_progress += 1
        try:
            async with worker.placement_lock:
                yield
        finally:
            self._placements_in_progress -= 1

    def _placement(self, session_id: str) -> _Placement:
        try:
            return self._placements[session_id]
        except KeyError:
            raise worker_lost(session_id) from None

    async def _call_worker_of(self, kind: wire.Kind, session_id: str, request: bytes) -> bytes:
        placement = self._placement(session_id)
        async with placement.lock:
            return await self._call(placement.worker, kind, session_id, request)

    async def _call(self, worker: Worker, kind: wire.Kind, session_id: str, *request: bytes | memoryview) -> bytes:
        return await self._in_time(worker, session_id, worker.send(kind, session_id, *request))

    async def _in_time(self, worker: Worker, session_id: str, answer: asyncio.Future[bytes]) -> bytes:
        try:
            async with asyncio.timeout(self._frame_timeout):
                return await answer
        except TimeoutError:
            log.error("a worker did not answer in %.0f s and is replaced", self._frame_timeout)
            worker.process.kill()
            raise worker_lost(session_id) from None
        finally:
            del answer  # the traceback of its error refers to this Python frame: a reference cycle

    # Workers --------------------------------------------------------------------------------------------------------

    def _background(self, work: Coroutine) -> asyncio.Task:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _add_worker(self, progress: Progress = lambda *_: None) -> None:
        self._add_warm_worker(await Worker.start(self._limits, self._warm_timeout, progress))

    def _start_missing(self) -> None:
        """Starts the missing workers."""
        running = len(self._workers) + len(self._spares) + self._starting
        for _ in range(self._size + self._n_spares - running):
            self._background(self._replace())
            self._starting += 1

    async def _replace(self) -> None:
        """Starts a worker; tries again until it succeeds."""
        await self._wait_for_restores()
        pause = _FIRST_PAUSE
        while True:
            try:
                await self._add_worker()
                self._starting -= 1
                return
            except (WorkerStartFailed, OSError) as error:
                log.error("a worker could not be started, next attempt in %.1f s: %s", pause, error)
                await asyncio.sleep(pause)
                pause = min(2 * pause, _LONGEST_PAUSE)

    async def _wait_for_restores(self) -> None:
        """Returns when the sessions of a lost worker have been placed elsewhere, or at once without a spare to replace it."""
        latest = monotonic() + _LONGEST_HEAD_START
        pause = _HEAD_START
        while pause and len(self._workers) == self._size:
            await asyncio.sleep(pause)
            pause = _HEAD_START if self._placements_in_progress and monotonic() < latest else 0

    def _add_warm_worker(self, worker: Worker) -> None:
        """Adds a warm worker to those that accept frames, or else to the spares."""
        (self._workers if len(self._workers) < self._size else self._spares).append(worker)
        worker.exit_watcher = self._background(self._watch(worker))
        self._on_change()

    async def _watch(self, worker: Worker) -> None:
        """Waits for the end of a worker, reports its sessions as lost, and replaces it."""
        await worker.gone.wait()
        self._remove(worker)
        self._restarts += 1
        lost = sorted(session_id for session_id, placement in self._placements.items() if placement.worker is worker)
        for session_id in lost:
            del self._placements[session_id]
        log.error("a worker was lost", extra={"worker": worker.process.pid, "sessions_lost": len(lost)})
        self._on_lost(lost)
        self._start_missing()
        self._on_change()

    def _remove(self, worker: Worker) -> None:
        """Removes a worker; a spare replaces it."""
        self._retiring.discard(worker)
        for workers in (self._workers, self._spares):
            if worker in workers:
                workers.remove(worker)
        while self._spares and len(self._workers) < self._size:
            self._workers.append(self._spares.pop(0))

    async def _recycle_when_due(self) -> None:
        """Recycles workers beyond their limit of frames or memory, one at a time, each when a spare is ready."""
        while True:
            await asyncio.sleep(_LOOK_INTERVAL)
            for worker in list(self._workers):
                due = worker.frames >= self._recycle_frames or worker.resident_bytes() >= self._recycle_memory
                if due and self._spares and worker in self._workers:
                    await self._recycle(worker)

    async def _recycle(self, worker: Worker) -> None:
        """Moves the sessions of a worker to a spare, without loss of a frame, and ends the worker."""
        log.info(
            "a worker is recycled",
            extra={"worker": worker.process.pid, "frames": worker.frames, "bytes": worker.resident_bytes()},
        )
        self._remove(worker)
        successor = self._workers[-1]
        self._retiring.add(worker)
        self._start_missing()
        for session_id in list(worker.sessions):
            await self._move(session_id, worker, successor)
        if worker.gone.is_set():
            return
        self._retiring.discard(worker)
        if worker.sessions:  # a move failed: the worker continues as a surplus and is due again
            self._workers.append(worker)
        else:
            self._recycled += 1
            worker.exit_watcher.cancel()
            await worker.end()
        self._on_change()

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
                async with self._placement_turn(new), new.frame_slots:
                    await self._call(new, wire.Kind.RESTORE, session_id, request)
                if self._placements.get(session_id) is not placement:  # the old worker was lost meanwhile
                    new.send_without_answer(wire.Kind.CLOSE, session_id)
                    return
                placement.worker = new
                new.sessions[session_id] = old.sessions.pop(session_id)
                old.send_without_answer(wire.Kind.CLOSE, session_id)
        except ServiceError as error:
            log.warning("a session could not be moved: %s", error, extra={"session": session_id})


class _Placement:
    """The worker of a session.

    Attributes:
        lock: held during a call of the session in the worker, and during a move.
    """

    def __init__(self, worker: Worker):
        self.worker = worker
        self.lock = asyncio.Lock()
