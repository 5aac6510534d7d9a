"""One stream's state, without any waiting: the synchronous and the asynchronous client each put theirs around it.

Frames go through a slot for one. In lossless flow the slot has to be free before a frame is offered; in realtime flow a
newer frame replaces the one in the slot. The slot is emptied while fewer than :data:`IN_FLIGHT` frames are unanswered,
so that neither a slow server nor a slow line makes frames pile up in buffers that nobody sees.

A stream survives its connection: what is unanswered is kept, and sent again to the server that answers next, as far as that
has not tracked it. In realtime flow only the newest such frame is.
"""

from __future__ import annotations

import logging
import random
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import NamedTuple

from ddakf_api import API_VERSION
from ddakf_api.codec import CODECS, DEFAULT_CODEC, DEFAULT_DEPTH_CODEC, DEFAULT_STEP, DEPTH_CODECS
from ddakf_api.errors import DeadlineExceeded, Draining, InvalidArgument, InvalidFrame, ServiceError, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb

from ddakf_client.calls import require_every_nth
from ddakf_client.frames import Frame, to_message
from ddakf_client.results import FrameError, Notice, Result, frame_error_from, notice_from, result_from

FLOWS = {"realtime": pb.FLOW_MODE_REALTIME, "lossless": pb.FLOW_MODE_LOSSLESS}
COMPACT = pb.ResultOptions(
    vertex_encoding=pb.ARRAY_ENCODING_QUANTISED_16,
    sigma_encoding=pb.ARRAY_ENCODING_FLOAT16,
    reliability_encoding=pb.ARRAY_ENCODING_QUANTISED_8,
)
IN_FLIGHT = 8
"""Frames unanswered at most: enough to keep a server busy over a line of 200 ms at 30 frames per second."""

ON_ERROR = ("raise", "yield")
RESUME = 30.0
"""Seconds for which a lost connection is tried to be had again, unless the caller says otherwise."""
_FIRST_PAUSE, _LONGEST_PAUSE = 0.05, 2.0  # seconds between attempts

log = logging.getLogger("ddakf_client")


def log_notice(notice: Notice) -> None:
    """What happens to notices unless the caller takes them."""
    log.warning("%s: %s", notice.kind, notice.message)


@dataclass(frozen=True)
class Plan:
    """What a caller wants from a stream; the fields are described in :meth:`ddakf_client.Session.track`.

    Raises:
        InvalidArgument: a flow, codec or way to report errors that does not exist.
    """

    name: str
    timeout: float
    flow: str = "realtime"
    codec: str = DEFAULT_CODEC
    step: float = DEFAULT_STEP
    on_error: str = "raise"
    on_notice: Callable[[Notice], None] = log_notice
    velocities: bool = False
    covariance: bool = False
    takeover: bool = False
    depth_codec: str = DEFAULT_DEPTH_CODEC
    compact: bool = False
    every_nth: int = 1
    resume: float = RESUME

    def __post_init__(self) -> None:
        for field, allowed in (("flow", FLOWS), ("codec", CODECS), ("on_error", ON_ERROR), ("depth_codec", DEPTH_CODECS)):
            value = getattr(self, field)
            if not isinstance(value, str) or value not in allowed:
                raise InvalidArgument(field=field, expected=" or ".join(allowed), got=repr(value)[:80])
        for field in ("velocities", "covariance", "takeover", "compact"):
            if not isinstance(getattr(self, field), bool):
                raise InvalidArgument(field=field, expected="True or False", got=repr(getattr(self, field))[:80])
        require_every_nth(self.every_nth)
        if isinstance(self.resume, bool) or not isinstance(self.resume, (int, float)) or not self.resume >= 0:
            raise InvalidArgument(field="resume", expected="seconds, or 0", got=repr(self.resume)[:80])

    def start(self, again: bool = False) -> pb.TrackRequest:
        """The first request; ``again`` takes the session over from the stream that was lost, should the server still have it."""
        options = pb.ResultOptions(
            include_velocities=self.velocities, include_covariance=self.covariance, every_nth=self.every_nth
        )
        if self.compact:
            options.MergeFrom(COMPACT)
        return pb.TrackRequest(
            start=pb.Start(
                name=self.name,
                api_version=API_VERSION,
                flow_mode=FLOWS[self.flow],
                result_options=options,
                takeover=self.takeover or again,
            )
        )


class Offered(NamedTuple):
    """A frame on its way: its number, the caller's object, when it was handed over (monotonic clock, seconds)."""

    sequence: int
    frame: object
    handed_over: float


class Sent(NamedTuple):
    """A frame without an answer, and when it was sent."""

    offered: Offered
    at: float


class Exchange:
    """Frames in, answers out. Times are given in, on the monotonic clock; the caller guards against concurrent use.

    Attributes:
        started: the server has opened the stream.
        lost: the connection was lost, and has not been had again yet.
        exhausted: no more frames will be offered.
        failure: why the stream has to end before its time, to be raised to the caller.
    """

    def __init__(self, plan: Plan, now: float):
        self.plan = plan
        self.started = self.exhausted = self.lost = False
        self.failure: BaseException | None = None
        self._lossless = plan.flow == "lossless"
        self._in_flight = IN_FLIGHT
        self._next_sequence = 1
        self._slot: Offered | None = None
        self._dropped = 0
        self._refused: list[FrameError] = []
        # Frames without an answer, by number. In realtime those up to _passed count as answered.
        self._unanswered: dict[int, Sent] = {}
        self._passed = 0
        self._last_answered = 0
        self._again: deque[Offered] = deque()  # frames to send again, before the one in the slot
        self._attempts = 0  # to have the connection again, without a frame answered since
        self._lost_since = now
        self._owed_since = now  # since when the server owes what is no answer to a frame: opening, closing
        self._reading_since: float | None = None

    # Frames in ------------------------------------------------------------------------------------------------------

    def can_offer(self) -> bool:
        return self.started and not (self._lossless and self._slot)

    def offer(self, frame: object, now: float) -> None:
        """Puts a frame into the slot; in realtime flow the one that is there goes."""
        self._dropped += self._slot is not None
        self._slot = Offered(self._next_sequence, frame, now)
        self._next_sequence += 1

    def can_take(self) -> bool:
        waiting = sum(sequence > self._passed for sequence in self._unanswered)
        return self.started and bool(self._slot or self._again) and waiting < self._in_flight

    def take(self, now: float) -> Offered:
        """Empties the slot, to send what was in it; what has to be sent again goes first."""
        if self._again:
            offered = self._again.popleft()
        else:
            offered, self._slot = self._slot, None
        self._unanswered[offered.sequence] = Sent(offered, now)
        return offered

    def is_done(self) -> bool:
        """Nothing more will be sent."""
        return self.failure is not None or (self.exhausted and self._slot is None and not self._again and not self.lost)

    def finish(self, now: float) -> None:
        """Says that the end has been sent: the server owes its own."""
        self._owed_since = now

    def refuse(self, offered: Offered, error: ServiceError) -> None:
        """Notes that a frame could not be made a message."""
        if self._unanswered.pop(offered.sequence, None) is None:
            return  # the connection was lost meanwhile: it will be tried again
        error.sequence = offered.sequence
        if self.plan.on_error == "raise":
            self.failure = self.failure or error
        try:
            timestamp = getattr(offered.frame, "timestamp", None)
        except Exception:  # of the caller's object, which may be why the frame is refused
            timestamp = None
        self._refused.append(FrameError(offered.sequence, timestamp, error))

    # Answers out ----------------------------------------------------------------------------------------------------

    def reading(self, now: float | None) -> None:
        """Says since when the caller waits for an answer; None: it does something else."""
        self._reading_since = now

    def receive(self, response: pb.TrackResponse, now: float) -> list[Result | FrameError | Notice]:
        """What an answer gives to the caller, after the frames that could not be sent before it.

        Raises:
            ServiceError: a frame was refused and the plan says to raise.
        """
        kind = response.WhichOneof("message")
        if kind == "started":
            return self._start(response.started)
        elif kind == "notice":
            return [notice_from(response.notice)]
        elif kind == "result":
            latency = self._answered(response.result.sequence_number, now)
            result = result_from(response.result, dropped_before_sending=self._dropped, latency=latency)
            return [*self.refused(), result]
        elif kind == "frame_error":
            return [*self.refused(), self._rejected(frame_error_from(response.frame_error))]
        return []

    def ended(self) -> list[FrameError]:
        """What is left to say after the server has ended the stream without an error.

        Raises:
            Unavailable: it did so before every frame had its answer.
        """
        if self.failure:
            raise self.failure
        waiting = [sequence for sequence in self._unanswered if sequence > self._passed]
        if waiting or not self.is_done():
            before = f"it had answered frame {min(waiting)}" if waiting else "all frames were sent"
            raise Unavailable(f"the server ended the stream before {before}")
        return self.refused()

    def refused(self) -> list[FrameError]:
        """The frames that could not be sent since this was last asked."""
        refused, self._refused = self._refused, []
        return refused

    # A lost connection ----------------------------------------------------------------------------------------------

    def may_resume(self, error: ServiceError, now: float) -> bool:
        """Whether to open the stream once more, after it ended with this error."""
        if self.failure or not (self.started or self.lost) or type(error) not in (Unavailable, Draining):
            return False
        if not self.lost:
            self.lost, self.started = True, False
            self._lost_since = now if self._attempts == 0 else self._lost_since
        return now - self._lost_since < self.plan.resume

    def pause(self, now: float) -> float:
        """Seconds to wait before the next attempt: longer each time, by chance so that clients do not come all at once."""
        self._attempts += 1
        self._owed_since = now
        return random.uniform(0.5, 1.0) * min(_FIRST_PAUSE * 2**self._attempts, _LONGEST_PAUSE)

    def _start(self, started: pb.Started) -> list[Notice]:
        """The stream is open: the first time, or once more."""
        last, resumed = started.last_sequence_number, self.lost
        self.started, self.lost = True, False
        self._next_sequence = max(self._next_sequence, last + 1)
        self._in_flight = min(self._in_flight, started.max_frames_in_flight or self._in_flight)
        if not resumed:
            return []
        # The connection may have been lost before all were sent that the one before it had lost.
        unanswered = [*(sent.offered for _, sent in sorted(self._unanswered.items())), *self._again]
        kept = [offered for offered in unanswered if offered.sequence > max(last, self._passed)]
        self._unanswered.clear()
        if not self._lossless:
            kept = kept[-1:] if self._slot is None else []
        self._again = deque(kept)
        forgotten = max(self._last_answered - last, 0)
        sent_again = f"{len(kept)} of {len(unanswered)}"
        message = f"connected again: the session goes on after frame {last}; {sent_again} frames are sent again"
        return [Notice("resumed", message, float(forgotten), "")]

    def deadline(self, now: float) -> float:
        """When the server has to have said something; the plan's timeout from now when it owes nothing."""
        if self._reading_since is None or not (self._unanswered or self._owes_more()):
            return now + self.plan.timeout
        oldest = min((sent.at for sent in self._unanswered.values()), default=self._owed_since)
        if not self.started:
            oldest = self._owed_since
        return max(oldest, self._reading_since) + self.plan.timeout

    def overdue(self) -> DeadlineExceeded:
        """The error for a passed deadline."""
        owed = f"frame {min(self._unanswered)}" if self._unanswered else "the end of the stream"
        return DeadlineExceeded(
            f"no answer to {owed if self.started else 'the start of the stream'} within {self.plan.timeout:g} s"
        )

    def _owes_more(self) -> bool:
        return not self.started or self.is_done()

    def _answered(self, sequence: int, now: float) -> float:
        """Results come in order, so every earlier frame has been answered or dropped."""
        sent = self._unanswered.get(sequence)
        self._unanswered = {other: sent for other, sent in self._unanswered.items() if other > sequence}
        self._last_answered, self._attempts = sequence, 0
        return now - sent.offered.handed_over if sent else 0.0

    def _rejected(self, refused: FrameError) -> FrameError:
        """A refusal may overtake the results of earlier frames; in realtime they may also have been dropped."""
        if self.plan.on_error == "raise":
            raise refused.error
        self._unanswered.pop(refused.sequence, None)
        self._attempts = 0
        if not self._lossless:
            self._passed = max(self._passed, refused.sequence)
            oldest = refused.sequence - 2 * IN_FLIGHT
            self._unanswered = {other: sent for other, sent in self._unanswered.items() if other > oldest}
        return refused


def without_notices(
    answers: Iterable[Result | FrameError | Notice], move: Callable[[str], None], on_notice: Callable[[Notice], None]
) -> Iterator[Result | FrameError]:
    """The answers to frames; notices go to ``on_notice``, and a server that they name as the next one to ``move``."""
    for answer in answers:
        if not isinstance(answer, Notice):
            yield answer
            continue
        if answer.kind == "reconnect" and answer.target:
            move(answer.target)
        on_notice(answer)


def encode_request(offered: Offered, plan: Plan) -> pb.TrackRequest:
    """The request of a frame.

    Raises:
        ServiceError: it cannot be sent; :class:`~ddakf_api.errors.InvalidFrame` too for what its object raises itself.
    """
    try:
        message = to_message(Frame.of(offered.frame), offered.sequence, plan.codec, plan.step, plan.depth_codec)
        return pb.TrackRequest(frame=message)
    except ServiceError:
        raise
    except Exception as error:  # raised inside gRPC's iterator it would end the stream without a reason
        got = f"{type(offered.frame).__name__} ({type(error).__name__}: {str(error)[:120]})"
        raise InvalidFrame(field="frame", expected="a frame that can be made a message", got=got) from error
