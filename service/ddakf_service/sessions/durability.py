"""Sessions survive their workers: checkpoints while they are tracked, and the way back from one."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Awaitable, Callable, Coroutine
from time import monotonic
from typing import Protocol

from ddakf_api.errors import ResourceExhausted, ServiceError, Unavailable, WorkerLost
from ddakf_api.v1 import tracking_pb2 as pb

from ..observability.metrics import Metrics
from ..workers.pool import WorkerPool, worker_lost
from .session import Session, taken_meshes

log = logging.getLogger(__name__)

TELL_EVERY = 2.0  # seconds between two notices that a session waits: less than any client's patience
_PAUSE = 0.1  # seconds between attempts
_MOST_RESTORED = 8  # sessions at a time, of each of which the checkpoint, megabytes, is copied for its worker
_MOST_BLAMES, _BLAME_SPAN = 3, 60.0  # workers lost over a session's own frames within so many seconds, after which it ends


class Irrecoverable(Exception):
    """A session cannot be had back, or not now; ``reason`` is what everyone is told."""

    def __init__(self, reason: ServiceError):
        super().__init__(str(reason))
        self.reason = reason


class CheckpointStore(Protocol):
    """Checkpoints that outlive the process."""

    def checkpoint(self, session: Session, snapshot: pb.SessionSnapshot) -> None:
        """Stores a checkpoint; does not wait."""

    async def newest(self, session: Session) -> pb.SessionSnapshot | pb.CreateSessionRequest | None:
        """The newest checkpoint, else the creation request; None: neither is stored. Raises ``Unavailable``."""


class Durability:
    """Takes checkpoints of sessions, and has those that have lost their worker restored in another one.

    Args:
        every: frames between two checkpoints.
        give_up: told which session cannot be had back, and why.
    """

    def __init__(
        self,
        pool: WorkerPool,
        records: CheckpointStore,
        metrics: Metrics,
        every: int,
        give_up: Callable[[Session, ServiceError], None],
    ):
        self._pool, self._records, self._metrics = pool, records, metrics
        self._every, self._give_up = every, give_up
        self._tasks: set[asyncio.Task] = set()
        self._restoring = asyncio.Semaphore(_MOST_RESTORED)
        self._reviving: dict[int, asyncio.Task[ServiceError | None]] = {}  # by the session's uid
        self._placed = 0

    def background(self, work: Coroutine) -> asyncio.Task:
        """Runs something beside; :meth:`settle` waits for it."""
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def settle(self, timeout: float) -> None:
        """Returns when nothing runs in the background any more, or after ``timeout`` seconds."""
        end = monotonic() + timeout
        while self._tasks and (left := end - monotonic()) > 0:  # some begin others
            await asyncio.wait(set(self._tasks), timeout=left)

    # Checkpoints ----------------------------------------------------------------------------------------------------

    def tracked(self, session: Session) -> None:
        """A frame was tracked and no other call was made since: takes a checkpoint if one is due."""
        if session.statistics.frames_applied - session.placed >= self._every:
            self.checkpoint(session)

    async def secure(self, session: Session) -> None:
        """Takes one of this moment, and returns when it is there.

        Raises:
            WorkerLost: it could not be taken; the session goes on from the one before.
        """
        keeping = self.checkpoint(session)
        if keeping is None or not await asyncio.shield(keeping):
            raise worker_lost(session.id)

    def checkpoint(self, session: Session) -> asyncio.Task[bool] | None:
        """Takes one of this moment; the answer comes later. None: the worker is gone, and the session on its way back from the
        one before."""
        session.placed = session.statistics.frames_applied
        message = session.message()
        try:
            answer = self._pool.snapshot(session.id)
        except WorkerLost:
            return None
        self._placed += 1
        return self.background(self._keep(session, message, answer, self._placed))

    async def _keep(self, session: Session, message: pb.Session, answer: Awaitable[bytes], number: int) -> bool:
        try:
            data = await answer
        except ServiceError as error:
            log.warning("no checkpoint could be taken: %s", error, extra={"session": session.id})
            return False
        if number > session.checkpoint_number:
            session.checkpoint_number, session.checkpoint_time = number, time.time()
            session.checkpoint = pb.SessionSnapshot(session=message, data=data)
            if not session.closed:
                self._records.checkpoint(session, session.checkpoint)
        return True

    # The way back ---------------------------------------------------------------------------------------------------

    def lost(self, session: Session) -> None:
        """A worker was lost while it tracked a frame of this session.

        Raises:
            Irrecoverable: it was not the first one; the session ends before it takes all workers down.
        """
        session.seated = False
        now = monotonic()
        session.blames.append(now)
        if sum(now - moment < _BLAME_SPAN for moment in session.blames) > _MOST_BLAMES:
            self._end(session, WorkerLost(f"{session.name} has ended: {_MOST_BLAMES + 1} workers were lost over its frames"))

    def revive(self, session: Session) -> asyncio.Task[ServiceError | None]:
        """Has a session restored in the background, for as long as that takes and the session lives; why it could not be.

        The lock of the session is taken for that: whoever waits for the answer must not hold it.
        """
        reviving = self._reviving.get(session.uid)
        if reviving is None:
            reviving = self._reviving[session.uid] = self.background(self._revive(session))
            reviving.add_done_callback(lambda _: self._reviving.pop(session.uid))
        return reviving

    async def _revive(self, session: Session) -> ServiceError | None:
        async with session.lock:
            began = told = monotonic()
            while not (session.seated or session.closed):
                try:
                    await self._restore(session)
                except Irrecoverable as error:
                    return error.reason
                except (WorkerLost, Unavailable, ResourceExhausted) as error:
                    # At the start the workers are not warm yet, or others have their memory: its client may ask again.
                    if session.asleep and not isinstance(error, WorkerLost):
                        return error
                    if (now := monotonic()) - told > TELL_EVERY:
                        told = now
                        self._tell_to_wait(session, now - began, error)
                    await asyncio.sleep(_PAUSE)
                except ServiceError as error:
                    log.error("the session could not be restored: %s", error, extra={"session": session.id})
                    reason = WorkerLost(f"{session.name} was lost with its worker and could not be restored: {error}")
                    self._give_up(session, reason)
                    return reason
        return None if session.seated else worker_lost(session.id)

    def _tell_to_wait(self, session: Session, seconds: float, error: ServiceError) -> None:
        log.warning("the session waits for a worker: %s", error, extra={"session": session.id})
        message = "the session's worker is gone and no other is ready yet: its frames wait"
        session.tell(pb.Notice(kind=pb.NOTICE_KIND_WAITING, message=message, value=seconds))

    def _end(self, session: Session, reason: ServiceError) -> None:
        self._give_up(session, reason)
        raise Irrecoverable(reason)

    async def _restore(self, session: Session) -> None:
        """From the newest checkpoint, or, where there is none, from the beginning."""
        if session.asleep and session.checkpoint is None:
            await self._wake(session)
        checkpoint = session.checkpoint
        if checkpoint is not None:
            async with self._restoring:
                request = pb.RestoreSessionRequest(data=checkpoint.data).SerializeToString()
                answer = await self._pool.restore(session.id, request, session.memory)
        else:
            answer = await self._pool.open(session.id, session.beginning().SerializeToString(), session.memory)
            if session.last_reset:
                await self._pool.reset(session.id, session.last_reset)
        if session.asleep:
            session.meshes, session.asleep = taken_meshes(pb.Session.FromString(answer)), False
        forgotten = session.forget_since(checkpoint.session.statistics if checkpoint else pb.SessionStatistics())
        session.placed = session.statistics.frames_applied
        session.seated = True
        self._metrics.recoveries.inc()
        log.warning("the session goes on in another worker", extra={"session": session.id, "frames_lost": forgotten})
        message = f"the session's worker was replaced; {forgotten} applied frames were forgotten"
        session.tell(pb.Notice(kind=pb.NOTICE_KIND_RESUMED, message=message, value=forgotten))

    async def _wake(self, session: Session) -> None:
        """Brings a session from the store.

        Raises:
            Irrecoverable: the store cannot be read now, which leaves the session as it is; or it has nothing.
        """
        try:
            kept = await self._records.newest(session)
        except Unavailable as error:
            raise Irrecoverable(error) from error
        if kept is None:
            self._end(session, WorkerLost(f"{session.name} was lost with its server, before its first checkpoint"))
        if isinstance(kept, pb.SessionSnapshot):
            session.checkpoint = kept
        else:
            session.meshes = taken_meshes(kept.session)
