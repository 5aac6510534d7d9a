"""The worker processes of this machine: which session lives in which, which of them are watched, replaced and recycled."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
from collections.abc import AsyncIterator, Awaitable, Coroutine
from time import monotonic

from ddakf_api.errors import DeadlineExceeded, ResourceExhausted, ServiceError, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb

from ..workers import wire
from .pool import RETRY_AFTER, UNKNOWN, Health, Limits, Memory, OnLost, Progress, worker_lost
from .worker import Worker, WorkerStartFailed

log = logging.getLogger(__name__)

_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 10.0  # seconds between attempts to replace a worker that dies before it is ready
_LOOK_INTERVAL = 1.0  # seconds between looks for workers that are due to be recycled
_RETRY_WHEN_FULL = 5.0  # seconds, told to clients
# A process that starts takes a core for seconds, which belong to the sessions that have lost theirs: a new spare waits until
# they are placed, or for so many seconds; they have begun to be after the first.
_HEAD_START, _LONGEST_HEAD_START = 0.5, 10.0


class LocalPool:
    """A WorkerPool of spawned processes.

    Args:
        size: number of processes that take frames.
        limits: what one request may contain.
        spares: warm processes beside them that take the place of a lost one at once.
        frame_timeout: seconds that a call may take before its worker counts as hung and is replaced.
        warm_timeout: seconds that a worker has to become ready.
        max_memory: bytes that the sessions of a worker may take by the estimate.
        recycle_frames: a worker is replaced in order after so many frames; 0: never.
        recycle_memory: or once it has so many bytes in memory; 0: never.
        on_lost: told which sessions went with a worker.
        on_change: called whenever ``health()`` may have changed.
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
        self._workers: list[Worker] = []  # those that take frames
        self._spares: list[Worker] = []
        self._retiring: set[Worker] = set()
        self._homes: dict[str, _Home] = {}  # by session id
        self._tasks: set[asyncio.Task] = set()
        self._starting = self._restarts = self._recycled = 0
        self._placing = 0  # sessions that are being opened, restored or moved

    async def start(self, progress: Progress) -> None:
        # The first worker compiles and fills the kernel cache; the others then load from it.
        await self._add_worker(progress)
        for outcome in await asyncio.gather(*(self._add_worker() for _ in range(self._size - 1)), return_exceptions=True):
            if isinstance(outcome, BaseException):
                raise outcome
        self._refill()
        self._background(self._recycle_when_due())

    async def open(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        return await self._place(wire.Kind.OPEN, session_id, request, memory)

    async def restore(self, session_id: str, request: bytes, memory: Memory = UNKNOWN) -> bytes:
        return await self._place(wire.Kind.RESTORE, session_id, request, memory)

    async def submit(self, session_id: str, frame: bytes, options: bytes, *, max_points: int, turn_by: float = math.inf) -> bytes:
        home = self._home(session_id)
        async with home.lock, home.worker.turns:
            if monotonic() > turn_by:
                raise DeadlineExceeded("the frame's deadline passed before its turn came")
            home.worker.frames += 1
            return await self._call(home.worker, wire.Kind.FRAME, session_id, wire.join(options, frame, max_points))

    async def configure(self, session_id: str, request: bytes) -> bytes:
        return await self._at_home(wire.Kind.CONFIGURE, session_id, request)

    async def reset(self, session_id: str, request: bytes) -> None:
        await self._at_home(wire.Kind.RESET, session_id, request)

    def snapshot(self, session_id: str, *, compressed: bool = False) -> Awaitable[bytes]:
        worker = self._home(session_id).worker
        answer = worker.send(wire.Kind.SNAPSHOT, session_id, b"compressed" if compressed else b"")
        return self._in_time(worker, session_id, answer)

    async def close(self, session_id: str) -> None:
        home = self._homes.get(session_id)
        if home is None:
            return
        async with home.lock:  # it may be moving
            if self._homes.get(session_id) is home:
                del self._homes[session_id]
                home.worker.sessions.pop(session_id, None)
                await self._call(home.worker, wire.Kind.CLOSE, session_id)

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
        if before := self._homes.get(session_id):  # whoever had it opened left before it was complete
            before.worker.sessions.pop(session_id, None)
            before.worker.tell(wire.Kind.CLOSE, session_id)
        worker.sessions[session_id] = memory
        home = self._homes[session_id] = _Home(worker)
        try:
            async with home.lock, self._place_in(worker), worker.turns:
                return await self._call(worker, kind, session_id, request)
        except BaseException:
            worker.sessions.pop(session_id, None)
            if self._homes.get(session_id) is home:
                del self._homes[session_id]
            # Whoever asked may have left while the worker was at it.
            worker.tell(wire.Kind.CLOSE, session_id)
            raise

    @contextlib.asynccontextmanager
    async def _place_in(self, worker: Worker) -> AsyncIterator[None]:
        """One session after the other, between which the frames of those that are there have their turns."""
        self._placing += 1
        try:
            async with worker.placing:
                yield
        finally:
            self._placing -= 1

    def _home(self, session_id: str) -> _Home:
        try:
            return self._homes[session_id]
        except KeyError:
            raise worker_lost(session_id) from None

    async def _at_home(self, kind: wire.Kind, session_id: str, payload: bytes) -> bytes:
        home = self._home(session_id)
        async with home.lock:
            return await self._call(home.worker, kind, session_id, payload)

    async def _call(self, worker: Worker, kind: wire.Kind, session_id: str, payload: bytes = b"") -> bytes:
        return await self._in_time(worker, session_id, worker.send(kind, session_id, payload))

    async def _in_time(self, worker: Worker, session_id: str, answer: asyncio.Future[bytes]) -> bytes:
        try:
            async with asyncio.timeout(self._frame_timeout):
                return await answer
        except TimeoutError:
            log.error("a worker did not answer in %.0f s and is replaced", self._frame_timeout)
            worker.process.kill()
            raise worker_lost(session_id) from None
        finally:
            del answer  # its error, if it is one, has this frame

    # Workers --------------------------------------------------------------------------------------------------------

    def _background(self, work: Coroutine) -> asyncio.Task:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _add_worker(self, progress: Progress = lambda *_: None) -> None:
        self._admit(await Worker.start(self._limits, self._warm_timeout, progress))

    def _refill(self) -> None:
        """Starts as many workers as are missing."""
        there = len(self._workers) + len(self._spares) + self._starting
        for _ in range(self._size + self._n_spares - there):
            self._background(self._recruit())
            self._starting += 1

    async def _recruit(self) -> None:
        """Adds a worker, however many attempts it takes."""
        await self._give_way()
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

    async def _give_way(self) -> None:
        """Returns when the sessions of a lost worker have been placed elsewhere, or once one is missing that takes frames."""
        latest = monotonic() + _LONGEST_HEAD_START
        pause = _HEAD_START
        while pause and len(self._workers) == self._size:
            await asyncio.sleep(pause)
            pause = _HEAD_START if self._placing and monotonic() < latest else 0

    def _admit(self, worker: Worker) -> None:
        """A worker that is warm takes frames, or waits until one is missing."""
        (self._workers if len(self._workers) < self._size else self._spares).append(worker)
        worker.keeper = self._background(self._keep(worker))
        self._on_change()

    async def _keep(self, worker: Worker) -> None:
        """Waits for the end of a worker, tells whom it concerns, and replaces it."""
        await worker.gone.wait()
        self._remove(worker)
        self._restarts += 1
        lost = sorted(session_id for session_id, home in self._homes.items() if home.worker is worker)
        for session_id in lost:
            del self._homes[session_id]
        log.error("a worker was lost", extra={"worker": worker.process.pid, "sessions_lost": len(lost)})
        self._on_lost(lost)
        self._refill()
        self._on_change()

    def _remove(self, worker: Worker) -> None:
        """Takes a worker out; a spare takes its place."""
        self._retiring.discard(worker)
        for workers in (self._workers, self._spares):
            if worker in workers:
                workers.remove(worker)
        while self._spares and len(self._workers) < self._size:
            self._workers.append(self._spares.pop(0))

    async def _recycle_when_due(self) -> None:
        """Replaces workers that have tracked or hold too much, one after the other, each when a spare waits for it."""
        while True:
            await asyncio.sleep(_LOOK_INTERVAL)
            for worker in list(self._workers):
                due = worker.frames >= self._recycle_frames or worker.resident_bytes() >= self._recycle_memory
                if due and self._spares and worker in self._workers:
                    await self._recycle(worker)

    async def _recycle(self, worker: Worker) -> None:
        """Moves the sessions of a worker to a spare and ends it; none of their frames is lost."""
        log.info(
            "a worker is recycled",
            extra={"worker": worker.process.pid, "frames": worker.frames, "bytes": worker.resident_bytes()},
        )
        self._remove(worker)
        successor = self._workers[-1]
        self._retiring.add(worker)
        self._refill()
        for session_id in list(worker.sessions):
            await self._move(session_id, worker, successor)
        if worker.gone.is_set():
            return
        self._retiring.discard(worker)
        if worker.sessions:  # a move failed: it goes on as one too many, and is due again
            self._workers.append(worker)
        else:
            self._recycled += 1
            worker.keeper.cancel()
            await worker.end()
        self._on_change()

    async def _move(self, session_id: str, old: Worker, new: Worker) -> None:
        """Moves a session between two frames; it stays where it is when that fails."""
        home = self._homes.get(session_id)
        if home is None or home.worker is not old:
            return
        try:
            async with home.lock:
                if self._homes.get(session_id) is not home:
                    return
                data = await self._call(old, wire.Kind.SNAPSHOT, session_id)
                request = pb.RestoreSessionRequest(data=data).SerializeToString()
                async with self._place_in(new), new.turns:
                    await self._call(new, wire.Kind.RESTORE, session_id, request)
                if self._homes.get(session_id) is not home:  # it was lost with the old worker meanwhile
                    new.tell(wire.Kind.CLOSE, session_id)
                    return
                home.worker = new
                new.sessions[session_id] = old.sessions.pop(session_id)
                old.tell(wire.Kind.CLOSE, session_id)
        except ServiceError as error:
            log.warning("a session could not be moved: %s", error, extra={"session": session_id})


class _Home:
    """Where a session lives.

    Attributes:
        lock: held by whoever has a call of the session in the worker, or moves it.
    """

    def __init__(self, worker: Worker):
        self.worker = worker
        self.lock = asyncio.Lock()
