"""Penalties: a session whose frames exceed their limit is slowed, then moved to a worker of low priority, then ended."""

from __future__ import annotations

import logging
from collections.abc import Callable

from ddakf_api.errors import FrameTooCostly, ServiceError
from ddakf_api.v1 import tracking_pb2 as pb

from ...observability.metrics import Metrics
from ...settings import Settings
from ...workers.pool import WorkerPool
from ..recovery.durability import Irrecoverable
from ..session import Session

log = logging.getLogger(__name__)

_SLOWED_RATE = 1.0  # frames per second
_FORGIVEN_AFTER = 100  # tracked frames that undo one beyond its limit


class Penalties:
    """Counts the frames of sessions that exceed their limit, and acts on the counts.

    Args:
        give_up: ends a session for the given reason.
    """

    def __init__(self, settings: Settings, pool: WorkerPool, metrics: Metrics, give_up: Callable[[Session, ServiceError], None]):
        self._settings, self._pool, self._give_up = settings, pool, give_up
        self._penalties = metrics.penalties

    def frame_rate(self, session: Session) -> float:
        """Frames per second that a session may have; 0: not limited."""
        rate = session.limits.max_frame_rate
        if session.costly_frames < self._settings.costly_slow_after:
            return rate
        return min(rate or _SLOWED_RATE, _SLOWED_RATE)

    def frame_tracked(self, session: Session) -> None:
        """Counts a frame within its limit."""
        if session.costly_frames:
            session.costly_frames = max(session.costly_frames - 1 / _FORGIVEN_AFTER, 0.0)

    async def frame_given_up(self, session: Session) -> None:
        """Counts a frame beyond its limit, and slows, moves or ends its session.

        Raises:
            Irrecoverable: the session has ended.
        """
        before, settings = session.costly_frames, self._settings
        now = session.costly_frames = before + 1
        if now >= settings.costly_end_after:
            self._record(session, "ended")
            reason = FrameTooCostly(f"{session.name} has ended: {now:.0f} frames exceeded their limit of processor time")
            self._give_up(session, reason)
            raise Irrecoverable(reason)
        if before < settings.costly_slow_after <= now:
            self._record(session, "slowed")
            message = f"{now:.0f} frames exceeded their limit of processor time: {_SLOWED_RATE:g} per second are tracked"
            session.notify(pb.Notice(kind=pb.NOTICE_KIND_SLOW_DOWN, message=message, value=self.frame_rate(session)))
        if now >= settings.costly_isolate_after:
            if before < settings.costly_isolate_after:
                self._record(session, "isolated")
            await self._isolate(session)  # again, if the loss of its worker has brought it back

    async def _isolate(self, session: Session) -> None:
        try:
            await self._pool.isolate(session.id)
        except ServiceError as error:  # the next costly frame tries again
            log.warning("a session could not be isolated: %s", error, extra={"session": session.id})

    def _record(self, session: Session, penalty: str) -> None:
        self._penalties.labels(penalty).inc()
        log.warning("frames exceed their limit: the session is %s", penalty, extra={"session": session.id})
