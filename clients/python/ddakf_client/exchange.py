"""Stream state machine without waiting, used by the synchronous and the asynchronous client.

A slot holds one frame before it is sent. In lossless mode a frame is offered only to a free slot; in realtime mode a newer frame
replaces the one in the slot. The slot is emptied while fewer than :data:`IN_FLIGHT` frames are unanswered. A slow server or
network therefore fills no hidden buffers.

A stream survives the loss of its connection. It stores unanswered frames, and after a reconnect it sends again those that the
server has not tracked: in lossless mode all, in realtime mode the newest one. In lossless mode the server repeats the answers to
those that it has tracked.
"""

from __future__ import annotations

import logging
import math
import random
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, TypedDict

from ddakf_api import API_VERSION
from ddakf_api.codec import CODECS, DEFAULT_CODEC, DEFAULT_DEPTH_CODEC, DEFAULT_STEP, DEPTH_CODECS
from ddakf_api.errors import (
    DeadlineExceeded,
    Draining,
    InvalidArgument,
    InvalidFrame,
    MessageTooLarge,
    ServiceError,
    Unavailable,
)
from ddakf_api.v1 import tracking_pb2 as pb

from ddakf_client.calls import plain, require_every_nth, require_handler, require_step, require_timeout
from ddakf_client.frames import Frame, time_of, to_message
from ddakf_client.results import FrameError, Notice, Result, frame_error_from, notice_from, result_from

FLOWS = {"realtime": pb.FLOW_MODE_REALTIME, "lossless": pb.FLOW_MODE_LOSSLESS}
COMPACT = pb.ResultOptions(
    vertex_encoding=pb.ARRAY_ENCODING_QUANTISED_16,
    sigma_encoding=pb.ARRAY_ENCODING_FLOAT16,
    reliability_encoding=pb.ARRAY_ENCODING_QUANTISED_8,
)
IN_FLIGHT = 8
"""Largest number of unanswered frames: keeps a server busy at 30 frames per second and 200 ms of network latency."""

ON_ERROR = ("raise", "yield")
RESUME = 30.0
"""Default time in seconds for attempts to reconnect."""
_FIRST_PAUSE, _LONGEST_PAUSE = 0.1, 2.0  # seconds between attempts to reconnect
_PAUSE_SHARE = 0.25  # of the time since the connection was lost: pauses grow, and lengthen an outage by no more

log = logging.getLogger("ddakf_client")


def log_notice(notice: Notice) -> None:
    """Default handler of notices."""
    log.warning("%s: %s", notice.kind, notice.message)


class TrackOptions(TypedDict, total=False):
    """Options of :meth:`ddakf_client.Session.track`, but ``on_error``, which decides what it yields."""

    flow: str | None
    codec: str | None
    step: float | None
    on_notice: Callable[[Notice], None]
    velocities: bool
    covariance: bool
    takeover: bool
    depth_codec: str
    compact: bool
    every_nth: int
    timeout: float | None
    resume: float


@dataclass(frozen=True)
class Plan:
    """Options of a stream; :meth:`ddakf_client.Session.track` describes the fields.

    Attributes:
        max_message_bytes: largest request that this client sends and the server accepts.

    Raises:
        InvalidArgument: an option has an invalid value.
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
    max_message_bytes: float = math.inf

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, plain(value))
        for field, allowed in (("flow", FLOWS), ("codec", CODECS), ("on_error", ON_ERROR), ("depth_codec", DEPTH_CODECS)):
            value = getattr(self, field)
            if not isinstance(value, str) or value not in allowed:
                raise InvalidArgument(field=field, expected=" or ".join(allowed), got=repr(value)[:80])
        for field in ("velocities", "covariance", "takeover", "compact"):
            if not isinstance(getattr(self, field), bool):
                raise InvalidArgument(field=field, expected="True or False", got=repr(getattr(self, field))[:80])
        require_handler(self.on_notice)
        require_every_nth(self.every_nth)
        require_timeout(self.timeout)
        require_step(self.step)
        if isinstance(self.resume, bool) or not isinstance(self.resume, (int, float)) or not self.resume >= 0:
            raise InvalidArgument(field="resume", expected="seconds, or 0", got=repr(self.resume)[:80])

    def of_stream(self, *, on_error: str, **options: Any) -> Plan:
        """The plan of a stream, whose options other than None replace those of the session."""
        of_session = ("flow", "codec", "step", "timeout")
        given = {name: value for name, value in options.items() if value is not None or name not in of_session}
        return replace(self, on_error=on_error, **given)

    def start(self, answered_through: int | None = None) -> pb.TrackRequest:
        """The first request.

        Args:
            answered_through: after a lost connection, the number up to which all frames have been answered: take over the session
                from the old stream, and in lossless mode repeat the answers to later frames.
        """
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
                takeover=self.takeover or answered_through is not None,
                answered_through=answered_through if self.flow == "lossless" else None,
            )
        )


class Offered(NamedTuple):
    """A frame to send: its number, the object of the caller, and its time of submission (monotonic clock, seconds)."""

    sequence: int
    frame: object
    submitted: float


class Sent(NamedTuple):
    """An unanswered frame and the time at which it was sent."""

    offered: Offered
    at: float


class Exchange:
    """State of one stream. Times are arguments, on the monotonic clock. The caller prevents concurrent use.

    Attributes:
        started: the server has opened the stream.
        lost: the connection is lost and not yet replaced.
        exhausted: no more frames will be offered.
        failure: error that is raised to the caller, the first one: of the source, or one that ends the stream early.
    """

    def __init__(self, plan: Plan, now: float):
        self.plan = plan
        self.started = self.exhausted = self.lost = False
        self.failure: BaseException | None = None
        self._ends_early = False  # nothing more is sent
        self._lossless = plan.flow == "lossless"
        self._in_flight = IN_FLIGHT
        self._next_sequence = 1
        self._slot: Offered | None = None
        self._dropped = 0
        self._refused: list[FrameError] = []
        self._warned: set[str] = set()  # codes of warnings
        # Unanswered frames by number. In realtime mode those up to _answered_through count as answered.
        self._unanswered: dict[int, Sent] = {}
        self._answered_through = 0
        self._last_answered = 0
        self._resend: deque[Offered] = deque()  # frames to send again, before the one in the slot
        self._to_repeat, self._repeated_through = 0, 0  # answers that the server still repeats, and the last of their frames
        self._attempts = 0  # to reconnect, since the last answered frame
        self._lost_since = self._open_since = now
        self._owed_since = now  # since when the server owes the start or the end of the stream
        self._reading_since: float | None = None

    def start_request(self, again: bool) -> pb.TrackRequest:
        """The first request of a call; ``again``: of one after a lost connection."""
        unsent = [offered.sequence for offered in (*self._resend, self._slot) if offered]
        return self.plan.start(min([*self._unanswered, *unsent], default=self._next_sequence) - 1 if again else None)

    # Frames in ------------------------------------------------------------------------------------------------------

    def can_offer(self) -> bool:
        return self.started and not (self._lossless and self._slot)

    def offer(self, frame: object, now: float) -> None:
        """Puts a frame into the slot; in realtime mode it replaces the one in the slot."""
        self._dropped += self._slot is not None
        self._slot = Offered(self._next_sequence, frame, now)
        self._next_sequence += 1

    def exhaust(self, error: BaseException | None = None) -> None:
        """Notes that no more frames come. An error of their source is raised once the frames before it have their answers."""
        self.exhausted, self.failure = True, self.failure or error

    def fail(self, error: BaseException) -> None:
        """Ends the stream early."""
        self.failure, self._ends_early = self.failure or error, True

    def can_take(self) -> bool:
        waiting = len(self._waiting())
        return self.started and bool(self._slot or self._resend) and waiting < self._in_flight

    def take(self, now: float) -> Offered:
        """Returns the next frame to send: first those to send again, then the one in the slot."""
        if self._resend:
            offered = self._resend.popleft()
        else:
            offered, self._slot = self._slot, None
        self._unanswered[offered.sequence] = Sent(offered, now)
        return offered

    def is_done(self) -> bool:
        """Whether nothing more will be sent."""
        return self._ends_early or (self.exhausted and self._slot is None and not self._resend and not self.lost)

    def finish(self, now: float) -> None:
        """Marks the end of the requests as sent: the server owes the end of the stream."""
        self._owed_since = now

    def refuse(self, offered: Offered, error: ServiceError) -> pb.TrackRequest | None:
        """Notes that a frame could not be made a message.

        Returns a ping to send if no earlier frame is unanswered: the refusal is delivered with the next response, and the pong
        may be the only one for a long time. None: no ping is needed.
        """
        if self._unanswered.pop(offered.sequence, None) is None:
            return None  # the connection was lost meanwhile: it will be tried again
        error.sequence = offered.sequence
        if self.plan.on_error == "raise":
            self.fail(error)
            return None
        self._refused.append(FrameError(offered.sequence, time_of(offered.frame), error))
        return pb.TrackRequest(ping=pb.Ping()) if offered.sequence < self._first_waiting() else None

    def _first_waiting(self) -> float:
        """Number of the first frame that was taken and has no answer; infinite: none."""
        resend = (offered.sequence for offered in self._resend)
        return min((*self._waiting(), *resend), default=math.inf)

    # Answers out ----------------------------------------------------------------------------------------------------

    def reading(self, now: float | None) -> None:
        """Sets the time since when the caller waits for an answer; None: it does not wait."""
        self._reading_since = now

    def receive(self, response: pb.TrackResponse, now: float) -> list[Result | FrameError | Notice]:
        """Converts a response to answers for the caller, with those of frames that could not be sent in their place."""
        kind = response.WhichOneof("message")
        if kind == "started":
            return self._start(response.started, now)
        elif kind == "notice":
            return [notice_from(response.notice)]
        elif kind in ("result", "frame_error") and self._has_answer(getattr(response, kind).sequence_number):
            return []
        elif kind == "result":
            latency = self._answered(response.result.sequence_number, now)
            result = result_from(response.result, dropped_before_sending=self._dropped, latency=latency)
            self._log_new_warnings(result)
            return [*self.refused(result.sequence), result, *self.refused(self._first_waiting())]
        elif kind == "frame_error":
            return [*self._rejected(frame_error_from(response.frame_error)), *self.refused(self._first_waiting())]
        return self.refused(self._first_waiting())  # a pong

    def _log_new_warnings(self, result: Result) -> None:
        """Logs the first warning of each code; ``Result.warnings`` has all."""
        for code, field, message in result.warnings:
            if code not in self._warned:
                self._warned.add(code)
                log.warning("%s: %s", field, message)

    def ended(self) -> list[FrameError]:
        """The last answers after the server has ended the stream without an error.

        Raises:
            ServiceError: a frame was refused and the plan requires an error. An error of the source is raised as it is.
            Unavailable: a frame has no answer.
        """
        if self.failure:
            raise self.failure
        waiting = self._waiting()
        if waiting or not self.is_done():
            before = f"it had answered frame {min(waiting)}" if waiting else "all frames were sent"
            raise Unavailable(f"the server ended the stream before {before}")
        return self.refused()

    def refused(self, before: float = math.inf) -> list[FrameError]:
        """The frames before this number that could not be sent, each once."""
        refused = [each for each in self._refused if each.sequence < before]
        self._refused = [each for each in self._refused if each.sequence >= before]
        return refused

    # A lost connection ----------------------------------------------------------------------------------------------

    def may_resume(self, error: ServiceError, now: float, untried: int = 0) -> bool:
        """Whether to open the stream again after it ended with this error.

        Args:
            untried: number of addresses at which a stream that has never been open may still be opened.
        """
        if self._ends_early or type(error) not in (Unavailable, Draining):
            return False
        if not (self.started or self.lost):
            return untried > 0
        if not self.lost:
            self.lost, self.started = True, False
            if self._attempts == 0 or now - self._open_since > self.plan.resume:  # else the same outage goes on
                self._lost_since, self._attempts = now, 0
        return now < self._window_end()

    def pause(self, now: float) -> float:
        """Seconds before the next attempt: growing, and random so that clients do not reconnect at the same time.

        The last attempt begins before the time for attempts is over.
        """
        self._attempts += 1
        growing = _PAUSE_SHARE * (now - self._lost_since)
        seconds = random.uniform(0.5, 1.0) * min(max(growing, _FIRST_PAUSE), _LONGEST_PAUSE)
        if self.lost:
            seconds = max(min(seconds, self._window_end() - now - _FIRST_PAUSE), 0.5 * _FIRST_PAUSE)
        self._owed_since = now + seconds
        return seconds

    def _window_end(self) -> float:
        """Time by which a lost connection has to be replaced."""
        return self._lost_since + self.plan.resume

    def _start(self, started: pb.Started, now: float) -> list[FrameError | Notice]:
        """Handles the start of the stream, the first one or one after a reconnect."""
        last, resumed = started.last_sequence_number, self.lost
        self.started, self.lost, self._open_since = True, False, now
        self._next_sequence = max(self._next_sequence, last + 1)
        self._in_flight = min(self._in_flight, started.max_frames_in_flight or self._in_flight)
        if not resumed:
            return []
        # A connection may be lost before all frames of the previous one were sent again.
        unanswered = [*(sent.offered for _, sent in sorted(self._unanswered.items())), *self._resend]
        resent = [offered for offered in unanswered if offered.sequence > max(last, self._answered_through)]
        self._to_repeat, self._repeated_through = started.repeated_answers, last
        tracked = (offered for offered in unanswered if offered.sequence <= last and self._to_repeat)
        self._unanswered = {offered.sequence: Sent(offered, now) for offered in tracked}
        if not self._lossless:
            resent = resent[-1:] if self._slot is None else []
        self._resend = deque(resent)
        lost_frames = max(self._last_answered - last, 0)
        sent_again = f"{len(resent)} of {len(unanswered)}"
        message = f"connected again: the session continues after frame {last}; {sent_again} frames are sent again"
        if self._to_repeat:
            message += f", {self._to_repeat} answers are repeated"
        return [Notice("resumed", message, float(lost_frames), ""), *self.refused(self._first_waiting())]

    def _has_answer(self, sequence: int) -> bool:
        """Whether the caller has the answer to this frame already: the server repeats it among others that were lost."""
        if self._to_repeat == 0:
            return False
        self._to_repeat -= 1
        answered = sequence not in self._unanswered
        if self._to_repeat == 0:  # the tracked frames that are still unanswered stay so
            last = self._repeated_through
            self._unanswered = {other: sent for other, sent in self._unanswered.items() if other > last or other == sequence}
        return answered

    def deadline(self, now: float) -> float:
        """Time by which the server has to send something; if it owes nothing, the timeout from now.

        An attempt to reconnect has the timeout too, and ends with the time for attempts.
        """
        waiting = self._waiting()
        if self._reading_since is None or not (waiting or self._owes_more()):
            due = now + self.plan.timeout
        else:
            oldest = min((self._unanswered[sequence].at for sequence in waiting), default=self._owed_since)
            due = max(oldest if self.started else self._owed_since, self._reading_since) + self.plan.timeout
        return min(due, self._window_end()) if self.lost else due

    def overdue(self, now: float) -> DeadlineExceeded:
        """The error of an exceeded deadline."""
        waiting = self._waiting()
        if self.lost and now >= self._window_end():
            return DeadlineExceeded(f"the connection did not come back within {self.plan.resume:g} s")
        owed = f"frame {min(waiting)}" if waiting else "the end of the stream"
        return DeadlineExceeded(
            f"no answer to {owed if self.started else 'the start of the stream'} within {self.plan.timeout:g} s"
        )

    def _waiting(self) -> list[int]:
        """The frames that the server owes an answer to."""
        return [sequence for sequence in self._unanswered if sequence > self._answered_through]

    def _owes_more(self) -> bool:
        return not self.started or self.is_done()

    def _answered(self, sequence: int, now: float) -> float:
        """Removes this frame and all earlier ones: results come in order, so earlier frames are answered or dropped."""
        sent = self._unanswered.get(sequence)
        self._unanswered = {other: sent for other, sent in self._unanswered.items() if other > sequence}
        self._last_answered, self._attempts = sequence, 0
        return now - sent.offered.submitted if sent else 0.0

    def _rejected(self, refused: FrameError) -> list[FrameError]:
        """Removes a refused frame. A refusal may precede results of earlier frames; in realtime mode these may be dropped.

        Where the plan requires an error, nothing more is sent, and it is raised once the frames before it have their answers.
        """
        self._unanswered.pop(refused.sequence, None)
        self._attempts = 0
        if not self._lossless:
            self._answered_through = max(self._answered_through, refused.sequence)
            oldest = refused.sequence - 2 * IN_FLIGHT
            self._unanswered = {other: sent for other, sent in self._unanswered.items() if other > oldest}
        if self.plan.on_error == "raise":
            self.fail(refused.error)
            return []
        return [*self.refused(refused.sequence), refused]


def without_notices(
    answers: Iterable[Result | FrameError | Notice], move: Callable[[str], None], on_notice: Callable[[Notice], None]
) -> Iterator[Result | FrameError]:
    """Yields the answers to frames. Calls ``on_notice`` with notices, and ``move`` with the address in a reconnect notice."""
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
        ServiceError: the frame cannot be sent. An exception of the caller's object becomes an
            :class:`~ddakf_api.errors.InvalidFrame`.
    """
    try:
        message = to_message(Frame.of(offered.frame), offered.sequence, plan.codec, plan.step, plan.depth_codec)
        request = pb.TrackRequest(frame=message)
        if (size := request.ByteSize()) > plan.max_message_bytes:  # it would end the stream, and with it earlier answers
            field = "depth" if message.HasField("depth_image") else "points"
            expected = f"a message of at most {plan.max_message_bytes} bytes"
            raise MessageTooLarge(field=field, expected=expected, got=f"{size} bytes")
        return request
    except ServiceError:
        raise
    except Exception as error:  # an error inside the iterator of gRPC ends the stream without a reason
        got = f"{type(offered.frame).__name__} ({type(error).__name__}: {str(error)[:120]})"
        raise InvalidFrame(field="frame", expected="a frame that can be made a message", got=got) from error
