"""What becomes of frames, told to whom it concerns: the session's counters, the metrics, the history."""

from __future__ import annotations

import logging
from time import monotonic

from ddakf_api.errors import DeadlineExceeded, Internal, ServiceError, WorkerLost, to_detail
from ddakf_api.v1 import tracking_pb2 as pb

from ..observability.metrics import Metrics, codec_of, flow_of
from ..observability.tracing import Tracer
from ..sessions.session import Session
from ..store.history import History
from .mailbox import Waiting

log = logging.getLogger(__name__)


class FrameRecorder:
    """Counts frames by outcome, and keeps what became of them over time."""

    def __init__(self, metrics: Metrics, history: History, tracer: Tracer):
        self._metrics, self._history, self._tracer = metrics, history, tracer

    def applied(self, session: Session, result: pb.Result, waiting: Waiting, started: float, mode: pb.FlowMode) -> None:
        """A frame was tracked; its work was ``started`` then (monotonic clock). Completes the result."""
        session.record_result(result, waiting.arrived)
        result.timings["queue"] = started - waiting.arrived
        result.timings["server"] = monotonic() - waiting.arrived
        codec, flow = codec_of(waiting.frame), flow_of(mode)
        self._metrics.observe(result, codec, flow)
        self._history.applied(session.uid, result, result.timings["server"])
        if not session.closed:  # a frame may come out of the worker after its session's end
            self._history.state(session.uid, session.state)
        self._tracer.applied(session.id, waiting.frame, result, codec, flow)

    def dropped(self, session: Session, count: int) -> None:
        """Frames were overtaken by newer ones, or came faster than they may."""
        session.touch()  # who sends too many frames is there
        session.statistics.frames_dropped += count
        self._metrics.frames.labels("dropped").inc(count)
        self._history.count(session.uid, "dropped", count)

    def refused(self, session: Session, frame: pb.Frame, error: ServiceError, arrived: float) -> pb.TrackResponse:
        """A frame that ``arrived`` then (monotonic clock) was not tracked: its answer."""
        session.touch()  # who sends frames, if bad ones, is there
        statistics = session.statistics
        late = isinstance(error, DeadlineExceeded)
        self._history.count(session.uid, "late" if late else "rejected")
        if late:
            statistics.frames_late += 1
            self._metrics.frames.labels("late").inc()
        else:
            statistics.frames_rejected += 1
            self._metrics.frames.labels("failed" if isinstance(error, (Internal, WorkerLost)) else "rejected").inc()
            log.info("a frame was rejected: %s", error, extra={"session": session.id, "sequence": frame.sequence_number})
        self._tracer.refused(session.id, frame, error, monotonic() - arrived)
        return pb.TrackResponse(
            frame_error=pb.FrameError(
                sequence_number=frame.sequence_number,
                capture_time=frame.capture_time,
                error=to_detail(error),
                frames_rejected=statistics.frames_rejected,
                frames_dropped=statistics.frames_dropped,
                frames_late=statistics.frames_late,
            )
        )
