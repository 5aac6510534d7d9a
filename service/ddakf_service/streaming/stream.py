"""Stream: one client's Track call on any transport, from its requests to its responses."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import contextmanager, suppress
from time import monotonic

from ddakf_api.errors import DeadlineExceeded, FrameTooCostly, InvalidFrame, ServiceError, WorkerLost
from ddakf_api.v1 import tracking_pb2 as pb

from ..auth.principal import current_principal
from ..observability.logs import current_session
from ..sessions.limits.penalties import Penalties
from ..sessions.recovery.durability import Durability, Irrecoverable
from ..sessions.responses.response import Response
from ..sessions.session import Session
from ..settings import Settings
from ..workers.pool import WorkerPool, worker_lost
from .frame_bounds import require_frame_within_bounds
from .frame_message import FrameMessage, TrackRequest
from .frame_recorder import FrameRecorder
from .mailbox import QueuedFrame, mailbox_for
from .outbox import Outbox
from .rate_limit import ArrivalRate, Overload, RateLimit

log = logging.getLogger(__name__)

_SEQUENCE_NUMBERS = 1 << 63
_WAITING_NOTICE_INTERVAL = 2.0  # seconds between two waiting notices: less than any client's timeout
_LOOK_INTERVAL = 0.5  # seconds between looks at the frame rate, which may change while a frame waits for it
_TOO_FAST = "frames arrive faster than they can be tracked: {rate:.3g} per second"


class Stream:
    """A session's stream of requests and responses.

    A transport calls :meth:`receive` for each request and :meth:`finish` after the last one. :meth:`deliver` sends the
    responses. The transport calls :meth:`close` at the end, whichever side ended the stream.

    Attributes:
        key_id: id of the key that opened the stream; empty: no key.
        busy: a frame waits for its answer.
        ending: set when no more frames will be tracked; one frame may still be in the worker.
        session_free: set after :meth:`close`, when the session accepts another stream.
    """

    def __init__(
        self,
        session: Session,
        start: pb.Start,
        mode: pb.FlowMode,
        settings: Settings,
        pool: WorkerPool,
        durability: Durability,
        penalties: Penalties,
        recorder: FrameRecorder,
        rate_limit: RateLimit,
    ):
        self.session, self.key_id = session, current_principal.get().id
        self._settings, self._pool, self._recorder = settings, pool, recorder
        self._durability, self._penalties = durability, penalties
        self._options = start.result_options.SerializeToString()
        self._every_nth = max(start.result_options.every_nth, 1)
        self._mode = mode
        self._most_in_flight = session.limits.max_frames_in_flight
        self._mailbox = mailbox_for(mode, self._most_in_flight)
        self._outbox = Outbox(session.watchers.publish)
        self._repeated = self._answers_to_repeat(start)
        self._rate_limit, self._overload, self._arrivals = rate_limit, Overload(), ArrivalRate()
        self._displaced = 0  # frames, by newer ones since the last frame was taken
        self._held = 0  # frames that were taken and wait for the frame rate
        self.busy = False
        self.ending, self.session_free = asyncio.Event(), asyncio.Event()
        self._tracking_task = asyncio.create_task(self._run())

    def _answers_to_repeat(self, start: pb.Start) -> list[Response]:
        """The answers of earlier streams that the client asks for; the others are dropped."""
        if self._mode == pb.FLOW_MODE_LOSSLESS and start.HasField("answered_through"):
            return self.session.answers.after(start.answered_through, self.session.statistics.last_sequence_number)
        self.session.answers.clear()
        return []

    # From the client ------------------------------------------------------------------------------------------------

    async def receive(self, request: TrackRequest) -> None:
        """Accepts a request. In lossless mode, waits while the mailbox is full."""
        if isinstance(request, FrameMessage):
            await self._receive_frame(request, monotonic())
        elif request.HasField("ping"):
            pong = pb.Pong(token=request.ping.token, server_time=time.time())
            await self._outbox.put(Response(pb.TrackResponse(pong=pong)))
        else:
            self.end(InvalidFrame(field="message", expected="a frame or a ping", got=request.WhichOneof("message") or "nothing"))

    def finish(self) -> None:
        """Marks the end of the client's requests. Queued frames are still tracked."""
        self._mailbox.close()

    async def _receive_frame(self, frame: FrameMessage, arrived: float) -> None:
        refusal = None
        try:
            self._check(frame)
            self._arrivals.arrived(arrived)
        except InvalidFrame as error:
            refusal, frame = error.with_traceback(None), frame._replace(data=b"")  # which takes no memory in the mailbox
        if refusal is not None and self._mode != pb.FLOW_MODE_LOSSLESS:
            await self._outbox.put(self._refused(frame, refusal, arrived))
            return
        try:
            dropped = await self._mailbox.put(frame, arrived, refusal)
        except asyncio.CancelledError:  # the client has left, which ends the reader
            self._recorder.dropped(self.session, 1)
            raise
        self._record_dropped(dropped)

    def _check(self, frame: FrameMessage) -> None:
        """Rejects a frame that is invalid at a glance."""
        if frame.sequence_number >= _SEQUENCE_NUMBERS:  # such a number would leave none to the frames that follow
            raise InvalidFrame(field="sequence_number", expected="less than 2^63", got=str(frame.sequence_number))
        max_points, settings = self.session.limits.max_points, self._settings
        require_frame_within_bounds(frame, max_points, settings.max_image_pixels, settings.max_body_vertices)
        if not 0 <= frame.deadline < math.inf:
            raise InvalidFrame(field="deadline", expected="seconds from its arrival, or 0", got=f"{frame.deadline:g}")

    async def _pause_for_frame_rate(self) -> float:
        """Returns when the frame rates of session and key allow another frame, or the stream ends.

        Returns:
            The rate that it waited for; 0: it did not wait.
        """
        waited_for = 0.0
        while True:
            pause, rate = self._rate_limit.wait(self._frame_rate, monotonic())
            if pause == 0:
                return waited_for
            waited_for = rate
            with suppress(TimeoutError):
                await asyncio.wait_for(self.ending.wait(), min(pause, _LOOK_INTERVAL))
                return waited_for

    async def _next_frame(self) -> QueuedFrame | None:
        """The next frame to track or to refuse; None after the last.

        A frame to track waits for the session's frame rate. In realtime mode a newer one that arrives meanwhile replaces it: the
        answer to the newest frame tells the client how many were dropped.
        """
        queued = await self._mailbox.get()
        if queued is None or queued.refusal is not None:
            return queued
        self._held = 1
        with self._waiting_notices():
            rate = await self._pause_for_frame_rate()
        if self.ending.is_set():
            return None
        self._held = 0
        if self._mode == pb.FLOW_MODE_LOSSLESS:
            return queued
        if len(self._mailbox):
            queued = await self._mailbox.get()
            self._recorder.dropped(self.session, 1)
            self._displaced += 1
        if rate and self._displaced and self._overload.may_notify(monotonic()):
            self._notify_slow_down(rate, self._why_slower(rate))
        self._displaced = 0
        return queued

    def _why_slower(self, rate: float) -> str:
        """The reason of a rate: a limit that somebody has set, or what the worker has time for."""
        if rate in (self._penalties.frame_rate(self.session), self._rate_limit.key_rate):
            return f"the session or its key may have {rate:.3g} frames per second"
        return _TOO_FAST.format(rate=rate)

    @property
    def _frame_rate(self) -> float:
        """Frames per second that the session may have; 0: not limited."""
        allowed = self._penalties.frame_rate(self.session)
        if self._mode == pb.FLOW_MODE_LOSSLESS:
            return allowed
        rates = allowed, self._pool.affordable_rate(self.session.id)
        return min((rate for rate in rates if rate), default=0.0)

    @property
    def _due_rate(self) -> float:
        """Frames per second that are to be tracked in realtime mode; 0: not known, or the mode is lossless."""
        if self._mode == pb.FLOW_MODE_LOSSLESS:
            return 0.0
        return min(self._arrivals.value, self._penalties.frame_rate(self.session) or math.inf)

    def _record_dropped(self, count: int) -> None:
        if count:
            self._displaced += count
            self._recorder.dropped(self.session, count)
            self._record_missed(count)

    def _record_missed(self, count: int) -> None:
        if rate := self._overload.missed(count, monotonic()):
            self._notify_slow_down(rate, _TOO_FAST.format(rate=rate))

    def _notify_slow_down(self, rate: float, message: str) -> None:
        self.notify(pb.Notice(kind=pb.NOTICE_KIND_SLOW_DOWN, message=message, value=rate))

    # To the client --------------------------------------------------------------------------------------------------

    def notify(self, notice: pb.Notice) -> None:
        """Sends a notice to the client."""
        self._outbox.notify(notice)

    async def deliver(self, send: Callable[[Response], Awaitable[None]]) -> None:
        """Sends all responses, Started first.

        Raises:
            ServiceError: the stream ended early. DeadlineExceeded: the client did not read.
        """
        async for response in self.responses():
            try:
                async with asyncio.timeout(self._settings.reader_timeout):
                    await send(response)
            except TimeoutError:
                error = DeadlineExceeded(f"the client has not read its responses for {self._settings.reader_timeout:g} s")
                log.warning("a stream ends: %s", error, extra={"session": self.session.id})
                self.end(error)
                try:
                    raise error from None
                finally:
                    del error  # the error's traceback refers to this Python frame: a reference cycle

    async def responses(self) -> AsyncIterator[Response]:
        """All responses: Started, the repeated ones, the new ones. Raises the error that ended the stream, if any."""
        statistics = self.session.statistics
        started = pb.Started(
            name=self.session.name,
            last_sequence_number=statistics.last_sequence_number,
            last_capture_time=statistics.last_capture_time,
            flow_mode=self._mode,
            max_frames_in_flight=self.session.limits.max_frames_in_flight,
            repeated_answers=len(self._repeated),
        )
        yield Response(pb.TrackResponse(started=started))
        for response in self._repeated:
            yield response
        while (response := await self._outbox.get()) is not None:
            yield response

    # The end --------------------------------------------------------------------------------------------------------

    def discard_error(self) -> None:
        """Drops the error of the outbox: the transport sends nothing more."""
        self._outbox.discard_error()

    def end(self, error: Exception | None) -> None:
        """Ends the stream from the server's side and drops waiting frames. The client receives the error."""
        self.ending.set()
        self._outbox.close(error)
        self._mailbox.close()
        if waiting := self._mailbox.clear() + self._held:
            self._recorder.dropped(self.session, waiting)
        self._held = 0

    async def close(self) -> None:
        """Drops queued frames and returns when the frame in the worker, if any, has been counted."""
        self.end(None)
        # Not the task itself: a cancelled caller must not cancel it, so that the frame in the worker is still counted.
        await asyncio.wait({self._tracking_task})

    # Tracking -------------------------------------------------------------------------------------------------------

    async def _run(self) -> None:
        """Tracks frames until the mailbox is closed, one at a time."""
        current_session.set(self.session.id)
        try:
            while not self.ending.is_set() and (queued := await self._next_frame()) is not None:
                if self.ending.is_set():
                    self._recorder.dropped(self.session, 1)
                    break
                with self._waiting_notices():
                    response = await self._track(queued)
                if response is not None:
                    await self._outbox.put(response, queued.frame.data)
            self._outbox.close()
        except Irrecoverable as error:
            self.end(error.reason)
        except Exception as error:
            log.exception("a stream failed")
            self.end(error)

    async def _track(self, queued: QueuedFrame) -> Response | None:
        """The response to a frame; None: its worker was lost, and the stream has ended before it could be tracked in another.

        Raises:
            Irrecoverable: the session cannot be restored.
        """
        if queued.refusal is not None:
            return self._refused(queued.frame, queued.refusal, queued.arrived)
        try:
            return await self._tracked(queued, monotonic())
        except ServiceError as error:
            if isinstance(error, WorkerLost) and self.ending.is_set():
                self._recorder.dropped(self.session, 1)
                return None
            if isinstance(error, DeadlineExceeded):
                self._record_missed(1)
            refused = self._refused(queued.frame, error, queued.arrived)
            if isinstance(error, FrameTooCostly):
                await self._penalties.frame_given_up(self.session)
            return refused
        except Irrecoverable as error:  # its reason ends the stream: the frame has no answer of its own
            if self.session.closed and not isinstance(error.reason, WorkerLost):  # somebody else ended it, or took it over
                self._recorder.dropped(self.session, 1)
            else:
                self._recorder.refused(self.session, queued.frame, error.reason, queued.arrived)
            raise

    def _refused(self, frame: FrameMessage, error: ServiceError, arrived: float) -> Response:
        """Records the refusal of a frame; returns the response to it."""
        return self._recorded(self._recorder.refused(self.session, frame, error, arrived))

    def _recorded(self, response: Response) -> Response:
        """The same response, recorded for the client of a lossless stream that may come back without it."""
        if self._mode == pb.FLOW_MODE_LOSSLESS:
            self.session.record_answer(response, self._most_in_flight)
        return response

    async def _tracked(self, queued: QueuedFrame, started: float) -> Response:
        """Tracks a frame; tries a second time, in another worker, when the first worker is lost."""
        try:
            return await self._submit(queued, started)
        except WorkerLost:
            return await self._submit(queued, started)

    async def _submit(self, queued: QueuedFrame, started: float) -> Response:
        frame, session = queued.frame, self.session
        if not session.has_worker:
            await self._wait_for_worker()
        async with session.lock:
            if not session.has_worker:  # any more
                raise worker_lost(session.id)
            self._check_order(frame)
            start_by = queued.arrived + frame.deadline if frame.deadline else math.inf
            max_points = session.limits.max_points
            try:
                answer = await self._pool.submit(
                    session.id, frame.data, self._options, max_points=max_points, start_by=start_by, rate=self._due_rate
                )
                await self._durability.wait_to_answer(session)
            except WorkerLost as error:
                self._durability.record_worker_loss(session, error)
                raise
            response = Response.of_result(*answer)
            self._recorder.applied(session, response.message.result, queued, started, self._mode)
            self._overload.applied(monotonic())
            self._penalties.frame_tracked(session)
            if response.message.result.frames_applied % self._every_nth:
                response = response.without_arrays()
            self._recorded(response)  # before the checkpoint of this frame
            self._durability.frame_tracked(session)
        return response

    @contextmanager
    def _waiting_notices(self) -> Iterator[None]:
        """Sends a waiting notice at intervals while a frame has no answer: the client's timeout counts silence."""
        self._schedule_waiting_notice(monotonic())
        self.busy = True
        try:
            yield
        finally:
            self.busy = False
            self._waiting_timer.cancel()

    def _schedule_waiting_notice(self, began: float) -> None:
        self._waiting_timer = asyncio.get_running_loop().call_later(_WAITING_NOTICE_INTERVAL, self._notify_waiting, began)

    def _notify_waiting(self, began: float) -> None:
        self._schedule_waiting_notice(began)
        if self._held:
            message = "the frame waits for its turn: the session or its key may have fewer frames per second than arrive"
        elif self.session.has_worker:
            message = "the frame is still being tracked"
        else:
            message = "the session's worker was lost and it is not in another one yet: its frames wait"
        self.notify(pb.Notice(kind=pb.NOTICE_KIND_WAITING, message=message, value=monotonic() - began))

    async def _wait_for_worker(self) -> None:
        """Returns when the session has a worker.

        Raises:
            WorkerLost: the stream ends first. Irrecoverable: the session cannot be restored.
        """
        restore, ending = self._durability.revive(self.session), asyncio.create_task(self.ending.wait())
        await asyncio.wait((restore, ending), return_when=asyncio.FIRST_COMPLETED)
        ending.cancel()
        if not restore.done():
            raise worker_lost(self.session.id)
        if reason := restore.result():
            raise Irrecoverable(reason)

    def _check_order(self, frame: FrameMessage) -> None:
        last = self.session.statistics.last_sequence_number
        if frame.sequence_number <= last:
            raise InvalidFrame(
                field="sequence_number",
                expected=f"more than {last}, the number of the last frame",
                got=str(frame.sequence_number),
            )
