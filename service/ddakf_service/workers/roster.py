"""Roster: the worker processes of a pool by their duty, their replacement and recycling."""

from __future__ import annotations

import asyncio
import logging
import math
from collections.abc import Awaitable, Callable

from ddakf_api.errors import Unavailable

from ..background_tasks import BackgroundTasks
from .fork_server import WorkerSource, WorkerStartFailed
from .pool import Health, Progress
from .worker import EXIT_PATIENCE, Worker

log = logging.getLogger(__name__)

_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 10.0  # seconds between attempts to replace a worker that dies before it is ready
_LOOK_INTERVAL = 1.0  # seconds between checks for workers to recycle
_GROWTH = 1.25  # of a worker's memory since it took sessions over: another one would need as much for them

# Moves a session, by its id, from one worker to another; after a failure it stays where it was.
Move = Callable[[str, Worker, Worker], Awaitable[None]]


class Roster:
    """Worker processes: those that accept frames, warm spares, and one for isolated sessions while there are some.

    A spare replaces a lost worker at once, and a new process the spare.

    Args:
        size: number of workers that accept frames.
        spares: number of warm workers in reserve.
        warm_timeout: seconds for a worker to become ready.
        recycle_frames: a worker is replaced in order after so many frames; 0: never.
        recycle_memory: a worker is replaced in order at so many resident bytes; 0: never.
        move: of the sessions of a recycled worker.
        on_lost: called with a worker that was lost.
        on_change: called when ``health()`` may have changed.

    Attributes:
        accepting: the workers that accept frames.
        isolation: held while the worker of isolated sessions is begun or ended, or gets a session.
    """

    def __init__(
        self,
        size: int,
        source: WorkerSource,
        *,
        spares: int,
        warm_timeout: float,
        recycle_frames: int,
        recycle_memory: int,
        move: Move,
        on_lost: Callable[[Worker], None],
        on_change: Callable[[], None],
    ):
        self._size, self._n_spares = size, spares
        self._source, self._warm_timeout = source, warm_timeout
        self._recycle_frames, self._recycle_memory = recycle_frames or math.inf, recycle_memory or math.inf
        self._move, self._on_lost, self._on_change = move, on_lost, on_change
        self.accepting: list[Worker] = []
        self.isolation = asyncio.Lock()
        self._spares: list[Worker] = []
        self._retiring: set[Worker] = set()
        self._isolated: Worker | None = None
        self._tasks = BackgroundTasks()
        self._starting = self._restarts = self._recycled = 0

    async def start(self, progress: Progress) -> None:
        """Returns when all workers accept frames; spares start later."""
        await self._add_worker(progress)
        for result in await asyncio.gather(*(self._add_worker() for _ in range(self._size - 1)), return_exceptions=True):
            if isinstance(result, BaseException):
                raise result
        self._start_missing()
        self._tasks.start(self._recycle_when_due())

    def health(self) -> Health:
        return Health(len(self.accepting), self._size, self._restarts, len(self._spares), self._recycled)

    async def stop(self) -> None:
        """Ends all workers and the fork server."""
        await self._tasks.cancel()
        workers = [*self.accepting, *self._spares, *self._retiring, *([self._isolated] if self._isolated else [])]
        await asyncio.gather(*(worker.end() for worker in workers))
        await self._source.end(EXIT_PATIENCE)
        for workers in (self.accepting, self._spares, self._retiring):
            workers.clear()

    async def isolated(self) -> Worker:
        """The worker of isolated sessions, begun if there is none: a spare, which another one replaces, or a new process.

        The caller holds ``isolation``.

        Raises:
            Unavailable: none can be started.
        """
        if self._isolated is not None:
            return self._isolated
        if self._spares:
            worker = self._spares.pop(0)
            self._start_missing()
        else:
            try:
                worker = await Worker.start(self._source, self._warm_timeout, lambda *_: None)
            except (WorkerStartFailed, OSError) as error:
                raise Unavailable(f"no worker for isolated sessions can be started: {error}") from None
            worker.exit_watcher = self._tasks.start(self._watch(worker))
        worker.lower_priority()
        log.info("a worker for isolated sessions begins", extra={"worker": worker.process.pid})
        self._isolated = worker
        return worker

    async def _end_isolated(self) -> None:
        """Ends the worker of isolated sessions when it has none."""
        async with self.isolation:
            worker = self._isolated
            if worker is not None and not worker.sessions:
                self._isolated = None
                worker.exit_watcher.cancel()
                await worker.end()

    # Replacement ----------------------------------------------------------------------------------------------------

    async def _add_worker(self, progress: Progress = lambda *_: None) -> None:
        self._add_warm_worker(await Worker.start(self._source, self._warm_timeout, progress))

    def _add_warm_worker(self, worker: Worker) -> None:
        """Adds a warm worker to those that accept frames, or else to the spares."""
        (self.accepting if len(self.accepting) < self._size else self._spares).append(worker)
        worker.exit_watcher = self._tasks.start(self._watch(worker))
        self._on_change()

    def _start_missing(self) -> None:
        """Starts the missing workers."""
        running = len(self.accepting) + len(self._spares) + self._starting
        for _ in range(self._size + self._n_spares - running):
            self._tasks.start(self._replace())
            self._starting += 1

    async def _replace(self) -> None:
        """Starts a worker; tries again until it succeeds."""
        pause = _FIRST_PAUSE
        while True:
            try:
                await self._add_worker()
                self._starting -= 1
                return
            except Exception as error:  # also one that nobody expects: the pool would be short of a worker for good
                is_known = isinstance(error, (WorkerStartFailed, OSError))
                log.error("a worker could not be started, next attempt in %.1f s: %s", pause, error, exc_info=not is_known)
                await asyncio.sleep(pause)
                pause = min(2 * pause, _LONGEST_PAUSE)

    async def _watch(self, worker: Worker) -> None:
        """Waits for the end of a worker, reports it as lost, and replaces it."""
        await worker.gone.wait()
        self._remove(worker)
        self._restarts += 1
        self._on_lost(worker)
        self._start_missing()
        self._on_change()

    def _remove(self, worker: Worker) -> None:
        """Removes a worker; a spare replaces it."""
        self._retiring.discard(worker)
        if worker is self._isolated:
            self._isolated = None
        for workers in (self.accepting, self._spares):
            if worker in workers:
                workers.remove(worker)
        while self._spares and len(self.accepting) < self._size:
            self.accepting.append(self._spares.pop(0))

    # Recycling ------------------------------------------------------------------------------------------------------

    async def _recycle_when_due(self) -> None:
        """Recycles workers beyond their limit of frames or memory, and those whose machine is about to stop, one at a time, each
        when a spare is ready."""
        while True:
            await asyncio.sleep(_LOOK_INTERVAL)
            await self._end_isolated()
            for spare in [worker for worker in self._spares if worker.leaving()]:
                await self._replace_spare(spare)
            for worker in list(self.accepting):
                most = max(self._recycle_memory, _GROWTH * worker.bytes_at_start)
                used_up = worker.frames >= self._recycle_frames or worker.resident_bytes() >= most
                due = used_up or worker.leaving()
                if due and self._spares and worker in self.accepting:
                    await self._recycle(worker)

    async def _replace_spare(self, spare: Worker) -> None:
        """Ends a spare and starts another one."""
        if spare in self._spares:
            self._spares.remove(spare)
            spare.exit_watcher.cancel()
            self._start_missing()
            self._on_change()
            await spare.end()

    async def _recycle(self, worker: Worker) -> None:
        """Moves the sessions of a worker to a spare, without loss of a frame, and ends the worker."""
        log.info(
            "a worker is recycled",
            extra={"worker": worker.process.pid, "frames": worker.frames, "bytes": worker.resident_bytes()},
        )
        self._remove(worker)
        successor = self.accepting[-1]
        self._retiring.add(worker)
        self._start_missing()
        for session_id in list(worker.sessions):
            await self._move(session_id, worker, successor)
        if worker.gone.is_set():
            return
        if worker.sessions:  # a move failed: the worker continues as a surplus and is due again
            self.accepting.append(worker)
        else:
            self._recycled += 1
            successor.bytes_at_start = successor.resident_bytes()
            await worker.answered()  # a snapshot may have been asked for during the move
            worker.exit_watcher.cancel()
            await worker.end()
        self._retiring.discard(worker)
        self._on_change()
