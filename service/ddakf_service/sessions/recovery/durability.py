"""Durability: checkpoints of live sessions, and their restore after the loss of a worker."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from time import monotonic
from typing import Protocol

from ddakf_api.errors import ResourceExhausted, ServiceError, Unavailable, WorkerLost
from ddakf_api.v1 import tracking_pb2 as pb

from ...background_tasks import BackgroundTasks
from ...observability.metrics import Metrics
from ...store.clock import clock
from ...store.files.checkpoints import Checkpoint
from ...workers.pool import WorkerPool, may_be_cause, worker_lost
from ..session import Session, take_meshes
from .tenure import Tenure

log = logging.getLogger(__name__)

_LOG_INTERVAL = 2.0  # seconds between two lines about a session that waits for a worker
_RETRY_INTERVAL = 0.1  # seconds between attempts
_MAX_RESTORES = 8  # concurrent restores, each of which copies a checkpoint of megabytes for its worker
_MAX_WORKER_LOSSES, _WORKER_LOSS_SPAN = 3, 60.0  # a session ends when its frames lose more workers within so many seconds


class Irrecoverable(Exception):
    """A session cannot be restored, or not now; ``reason`` is the error for its callers."""

    def __init__(self, reason: ServiceError):
        super().__init__(str(reason))
        self.reason = reason


class CheckpointStore(Protocol):
    """Checkpoints that outlive the process."""

    def checkpoint(self, session: Session, checkpoint: Checkpoint) -> None:
        """Stores a checkpoint; does not wait."""

    async def newest(self, session: Session) -> Checkpoint | pb.CreateSessionRequest | None:
        """The newest checkpoint, else the creation request; None: neither is stored. Raises ``Unavailable``."""


class Durability:
    """Takes checkpoints of sessions and restores those whose worker was lost in another worker.

    Args:
        every: frames between two checkpoints.
        give_up: ends a session that cannot be restored, for the given reason.
        tenure: whether this server may answer for its sessions.
    """

    def __init__(
        self,
        pool: WorkerPool,
        store: CheckpointStore,
        metrics: Metrics,
        every: int,
        give_up: Callable[[Session, ServiceError], None],
        tenure: Tenure,
        tasks: BackgroundTasks,
    ):
        self._tenure, self._tasks = tenure, tasks
        self._pool, self._store, self._metrics = pool, store, metrics
        self._every, self._give_up = every, give_up
        self._restore_slots = asyncio.Semaphore(_MAX_RESTORES)
        self._restores: dict[int, asyncio.Task[ServiceError | None]] = {}  # by the session's uid
        self._checkpoints_taken = 0

    # Checkpoints ----------------------------------------------------------------------------------------------------

    def frame_tracked(self, session: Session) -> None:
        """Takes a checkpoint if one is due. To be called right after a frame, before any other call of the session."""
        if session.statistics.frames_applied - session.checkpointed_frames >= self._every:
            self.checkpoint(session)

    async def checkpoint_now(self, session: Session) -> None:
        """Takes a checkpoint of this moment and returns when it is in memory.

        Raises:
            WorkerLost: the checkpoint failed; the session continues from the previous one.
        """
        taking = self.checkpoint(session)
        if taking is None or not await asyncio.shield(taking):
            raise worker_lost(session.id)

    def checkpoint(self, session: Session) -> asyncio.Task[bool] | None:
        """Starts a checkpoint of this moment. None: the worker was lost; the session is restored from the previous one."""
        session.checkpointed_frames = session.statistics.frames_applied
        checkpoint = Checkpoint(pb.SessionSnapshot(session=session.message()), session.answers.serialised())
        try:
            data = self._pool.snapshot(session.id)
        except WorkerLost:
            return None
        self._checkpoints_taken += 1
        return self._tasks.start(self._store_checkpoint(session, checkpoint, data, self._checkpoints_taken))

    async def _store_checkpoint(self, session: Session, checkpoint: Checkpoint, data: Awaitable[bytes], number: int) -> bool:
        try:
            checkpoint.snapshot.data = await data
        except ServiceError as error:
            log.warning("no checkpoint could be taken: %s", error, extra={"session": session.id})
            return False
        if number > session.checkpoint_number:
            session.checkpoint_number, session.checkpoint_time = number, clock.now()
            session.checkpoint = checkpoint.snapshot
            if not session.closed:
                self._store.checkpoint(session, checkpoint)
        return True

    async def wait_to_answer(self, session: Session) -> None:
        """Returns when this server may answer for a session: at once, unless its leases could not be renewed.

        Raises:
            Irrecoverable: the session has ended, or has gone to another server.
        """
        try:
            await self._tenure.wait(session)
        except Unavailable as error:
            raise Irrecoverable(error) from error

    # Recovery -------------------------------------------------------------------------------------------------------

    def record_worker_loss(self, session: Session, error: WorkerLost) -> None:
        """Records that a frame of this session was lost with its worker; counts the loss if the frame may be the cause.

        Raises:
            Irrecoverable: too many workers were lost; the session has ended, before it takes down every worker.
        """
        session.has_worker = False
        if not may_be_cause(error):
            return
        now = monotonic()
        session.worker_losses.append(now)
        if sum(now - moment < _WORKER_LOSS_SPAN for moment in session.worker_losses) > _MAX_WORKER_LOSSES:
            lost = f"{_MAX_WORKER_LOSSES + 1} workers were lost over its frames"
            self._end(session, WorkerLost(f"{session.name} has ended: {lost}"))

    def revive(self, session: Session) -> asyncio.Task[ServiceError | None]:
        """Restores a session in the background, with attempts until it succeeds or the session ends.

        An attempt takes the session's lock, so the caller must not hold it. The result is the reason of a failure, or None.
        """
        restore = self._restores.get(session.uid)
        if restore is None:
            restore = self._restores[session.uid] = self._tasks.start(self._revive(session))
            restore.add_done_callback(lambda _: self._restores.pop(session.uid))
        return restore

    async def _revive(self, session: Session) -> ServiceError | None:
        logged = monotonic()
        while not (session.has_worker or session.closed):
            try:
                async with session.lock:  # between two attempts another server may get the session
                    if not session.closed:
                        await self._restore(session)
            except Irrecoverable as error:
                return error.reason
            except (WorkerLost, Unavailable, ResourceExhausted) as error:
                if session.stored_only and isinstance(error, ResourceExhausted):  # its client may try again
                    return error
                if (now := monotonic()) - logged > _LOG_INTERVAL:
                    logged = now
                    log.warning("the session waits for a worker: %s", error, extra={"session": session.id})
                await asyncio.sleep(_RETRY_INTERVAL)
            except ServiceError as error:
                log.error("the session could not be restored: %s", error, extra={"session": session.id})
                reason = WorkerLost(f"{session.name} was lost with its worker and could not be restored: {error}")
                self._give_up(session, reason)
                return reason
        return None if session.has_worker else worker_lost(session.id)

    def _end(self, session: Session, reason: ServiceError) -> None:
        self._give_up(session, reason)
        raise Irrecoverable(reason)

    async def _restore(self, session: Session) -> None:
        """Restores a session from the newest checkpoint, or from its creation request without one."""
        if session.stored_only and session.checkpoint is None:
            await self._load_stored(session)
        checkpoint = session.checkpoint
        if checkpoint is not None:
            async with self._restore_slots:
                request = pb.RestoreSessionRequest(data=checkpoint.data).SerializeToString()
                answer = await self._pool.restore(session.id, request, session.memory)
        else:
            answer = await self._pool.open(session.id, session.creation_request().SerializeToString(), session.memory)
            if session.last_reset:
                await self._pool.reset(session.id, session.last_reset)
        if session.stored_only:
            session.meshes, session.stored_only = take_meshes(pb.Session.FromString(answer)), False
        lost = session.record_recovery(checkpoint.session.statistics if checkpoint else pb.SessionStatistics())
        session.checkpointed_frames = session.statistics.frames_applied
        session.has_worker = True
        if session.epoch:  # what an earlier server still writes is older than this
            self.checkpoint(session)
        self._metrics.recoveries.inc()
        log.warning("the session continues in another worker", extra={"session": session.id, "frames_lost": lost})
        message = f"the session's worker was replaced; {lost} applied frames were lost"
        session.notify(pb.Notice(kind=pb.NOTICE_KIND_RESUMED, message=message, value=lost))

    async def _load_stored(self, session: Session) -> None:
        """Loads a session's checkpoint or creation request from the store.

        Raises:
            Irrecoverable: the store cannot be read now, and the session stays; or it has neither, and the session ends.
        """
        try:
            stored = await self._store.newest(session)
        except Unavailable as error:
            raise Irrecoverable(error) from error
        if stored is None:
            self._end(session, WorkerLost(f"{session.name} was lost with its server, before its first checkpoint"))
        if isinstance(stored, Checkpoint):
            session.checkpoint = stored.snapshot
            session.answers.load(stored.answers)
        else:
            session.meshes = take_meshes(stored.session)
