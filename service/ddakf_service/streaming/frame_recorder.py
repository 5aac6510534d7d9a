"""Frame recorder: each frame's result or error, to the session's counters, the metrics, the history and the spans."""

from __future__ import annotations

import logging
import math
from time import monotonic
from weakref import WeakKeyDictionary

from ddakf_api.errors import (
    DeadlineExceeded,
    FrameTooCostly,
    Internal,
    ResourceExhausted,
    ServiceError,
    Unavailable,
    WorkerLost,
    to_detail,
)
from ddakf_api.v1 import tracking_pb2 as pb

from ..observability.metrics import Metrics, codec_of, flow_of
from ..observability.tracing import Tracer
from ..sessions.responses.response import Response
from ..sessions.session import Session
from ..store.tables.history import History
from .frame_message import FrameMessage
from .mailbox import QueuedFrame

log = logging.getLogger(__name__)

_SERVER_ERRORS = Internal, ResourceExhausted, Unavailable, WorkerLost  # no fault of the frame
_LOG_INTERVAL = 1.0  # seconds between two lines about refused frames of a session; a client may send thousands per second


class FrameRecorder:
    """Records frames by outcome: applied, dropped, late, rejected, costly or failed."""

    def __init__(self, metrics: Metrics, history: History, tracer: Tracer):
        self._metrics, self._history, self._tracer = metrics, history, tracer
        self._logged: WeakKeyDictionary[Session, tuple[float, int]] = WeakKeyDictionary()  # time and refusals, at its last line

    def applied(self, session: Session, result: pb.Result, queued: QueuedFrame, started: float, mode: pb.FlowMode) -> None:
        """Records a tracked frame and completes its result with counters and timings.

        Args:
            started: when it left the mailbox, monotonic clock, seconds.
        """
        session.record_result(result, queued.arrived)
        result.timings["queue"] = started - queued.arrived
        result.timings["server"] = monotonic() - queued.arrived
        codec, flow = codec_of(queued.frame.measurement, queued.frame.codec), flow_of(mode)
        self._metrics.observe(result, codec, flow)
        self._history.applied(session.uid, result, result.timings["server"])
        if not session.closed:  # the result of a frame may arrive after the end of its session
            self._history.state(session.uid, session.state)
        self._tracer.applied(session.id, queued.frame, result, codec, flow)

    def dropped(self, session: Session, count: int) -> None:
        """Records frames that newer ones displaced, that exceeded the frame rate, or that waited at the end of their stream."""
        session.touch()  # a dropped frame counts as activity
        session.statistics.frames_dropped += count
        self._metrics.frames.labels("dropped").inc(count)
        self._history.count(session.uid, "dropped", count)

    def refused(self, session: Session, frame: FrameMessage, error: ServiceError, arrived: float) -> Response:
        """Records a frame that was not tracked, and returns the response to it.

        Args:
            arrived: time of arrival, monotonic clock, seconds.
        """
        session.touch()  # a rejected frame counts as activity
        statistics = session.statistics
        late = isinstance(error, DeadlineExceeded)
        self._history.count(session.uid, "late" if late else "rejected")
        if late:
            statistics.frames_late += 1
            self._metrics.frames.labels("late").inc()
        else:
            statistics.frames_rejected += 1
            self._metrics.frames.labels(_outcome(error)).inc()
            self._log_refusal(session, frame, error)
        self._tracer.refused(session.id, frame, error, monotonic() - arrived)
        frame_error = pb.FrameError(
            sequence_number=frame.sequence_number,
            capture_time=frame.capture_time,
            error=to_detail(error),
            frames_rejected=statistics.frames_rejected,
            frames_dropped=statistics.frames_dropped,
            frames_late=statistics.frames_late,
        )
        return Response(pb.TrackResponse(frame_error=frame_error))

    def _log_refusal(self, session: Session, frame: FrameMessage, error: ServiceError) -> None:
        """Logs a refused frame, with the number of those since the session's last line, if a line is due."""
        now, count = monotonic(), session.statistics.frames_rejected
        logged_at, logged = self._logged.get(session, (-math.inf, count - 1))
        if now - logged_at >= _LOG_INTERVAL:
            self._logged[session] = now, count
            fields = {"session": session.id, "sequence": frame.sequence_number, "frames": count - logged}
            log.info("a frame was rejected: %s", error, extra=fields)


def _outcome(error: ServiceError) -> str:
    """Label of a frame that was not tracked."""
    if isinstance(error, FrameTooCostly):
        return "costly"
    return "failed" if isinstance(error, _SERVER_ERRORS) else "rejected"
