"""One Track call, whatever carries it: requests go to the mailbox, answers come out of the outbox."""

from __future__ import annotations

import asyncio
import logging
import math
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Iterator
from contextlib import contextmanager
from time import monotonic

from ddakf_api.errors import DeadlineExceeded, InvalidFrame, ServiceError, WorkerLost
from ddakf_api.v1 import tracking_pb2 as pb

from ..auth.principal import current_principal
from ..observability.logs import current_session
from ..sessions.durability import TELL_EVERY, Durability, Irrecoverable
from ..sessions.session import Session
from ..sessions.watchers import without_arrays
from ..workers.pool import WorkerPool, worker_lost
from .frame_bounds import require_payload_within
from .frame_recorder import FrameRecorder
from .mailbox import Waiting, mailbox_for
from .outbox import Outbox
from .rate_limit import Overload, RateLimit

log = logging.getLogger(__name__)


class Stream:
    """The conversation of a session with its client.

    A transport calls :meth:`receive` for each request, :meth:`finish` when no more will come, has :meth:`deliver` send the
    answers, and calls :meth:`close` at the end, whichever side ended it.

    Args:
        reader_timeout: seconds that the client may not read before the stream ends.

    Attributes:
        key_id: of the key that it was opened with; empty: none.
        ending: set once nothing more is tracked, though a frame may still be in the worker.
        gone: set by whoever closed the stream, once its session is free for another one.
    """

    def __init__(
        self,
        session: Session,
        start: pb.Start,
        mode: pb.FlowMode,
        pool: WorkerPool,
        durability: Durability,
        recorder: FrameRecorder,
        reader_timeout: float,
        max_image_pixels: int,
    ):
        self.session, self.key_id = session, current_principal.get().id
        self._pool, self._durability, self._recorder = pool, durability, recorder
        self._options = start.result_options.SerializeToString()
        self._every_nth = max(start.result_options.every_nth, 1)
        self._mode, self._reader_timeout = mode, reader_timeout
        self._max_image_pixels = max_image_pixels
        self._mailbox = mailbox_for(mode, session.limits.max_frames_in_flight)
        self._outbox = Outbox(session.watchers.publish)
        self._rate_limit, self._overload = RateLimit(), Overload(monotonic())
        self.ending, self.gone = asyncio.Event(), asyncio.Event()
        self._pump = asyncio.create_task(self._run())

    # From the client ------------------------------------------------------------------------------------------------

    async def receive(self, request: pb.TrackRequest) -> None:
        """Takes a request; waits in lossless mode while the session is behind."""
        match request.WhichOneof("message"):
            case "frame":
                await self._receive_frame(request.frame, monotonic())
            case "ping":
                pong = pb.Pong(token=request.ping.token, server_time=time.time())
                await self._outbox.put(pb.TrackResponse(pong=pong))
            case _:
                self.end(
                    InvalidFrame(field="message", expected="a frame or a ping", got=request.WhichOneof("message") or "nothing")
                )

    def finish(self) -> None:
        """The client sends no more; the frames that wait are still answered."""
        self._mailbox.close()

    async def _receive_frame(self, frame: pb.Frame, arrived: float) -> None:
        try:
            self._check(frame)
        except InvalidFrame as error:
            await self._outbox.put(self._recorder.refused(self.session, frame, error, arrived))
            return
        if await self._may_come(arrived):
            self._count_dropped(await self._mailbox.put(frame, arrived))

    def _check(self, frame: pb.Frame) -> None:
        """Refuses at the door what would only take memory while it waits."""
        require_payload_within(frame, self.session.limits.max_points, self._max_image_pixels)
        if not 0 <= frame.deadline < math.inf:
            raise InvalidFrame(field="deadline", expected="seconds from its arrival, or 0", got=f"{frame.deadline:g}")

    async def _may_come(self, now: float) -> bool:
        """Whether a frame keeps to the session's frame rate. In lossless flow it does, once this returns."""
        rate = self.session.limits.max_frame_rate
        if self._mode == pb.FLOW_MODE_LOSSLESS:
            while not self.ending.is_set() and (pause := self._rate_limit.wait(rate, monotonic())) > 0:
                await asyncio.sleep(pause)
            return True
        if self._rate_limit.wait(rate, now) == 0:
            return True
        self._recorder.dropped(self.session, 1)
        if self._overload.may_tell(now):
            self._tell_to_slow_down(rate, f"the session may have {rate:g} frames per second")
        return False

    def _count_dropped(self, count: int) -> None:
        if count:
            self._recorder.dropped(self.session, count)
            self._count_missed(count)

    def _count_missed(self, count: int) -> None:
        if rate := self._overload.missed(count, monotonic()):
            self._tell_to_slow_down(rate, f"more frames come than can be tracked, which are {rate:.3g} per second")

    def _tell_to_slow_down(self, rate: float, message: str) -> None:
        self.notify(pb.Notice(kind=pb.NOTICE_KIND_SLOW_DOWN, message=message, value=rate))

    # To the client --------------------------------------------------------------------------------------------------

    def notify(self, notice: pb.Notice) -> None:
        """Tells the client something in between its results."""
        self._outbox.notify(notice)

    async def deliver(self, send: Callable[[pb.TrackResponse], Awaitable[None]]) -> None:
        """Sends everything, beginning with Started.

        Raises:
            ServiceError: what ended the stream before its time; DeadlineExceeded when it was a client that does not read.
        """
        async for response in self.responses():
            try:
                async with asyncio.timeout(self._reader_timeout):
                    await send(response)
            except TimeoutError:
                error = DeadlineExceeded(f"the client has not read its answers for {self._reader_timeout:g} s")
                log.warning("a stream ends: %s", error, extra={"session": self.session.id})
                self.end(error)
                try:
                    raise error from None
                finally:
                    del error  # which this frame, being one of its, would keep

    async def responses(self) -> AsyncIterator[pb.TrackResponse]:
        """Everything to send, beginning with Started; raises the error that ended the stream, if one did."""
        statistics = self.session.statistics
        yield pb.TrackResponse(
            started=pb.Started(
                name=self.session.name,
                last_sequence_number=statistics.last_sequence_number,
                last_capture_time=statistics.last_capture_time,
                flow_mode=self._mode,
                max_frames_in_flight=self.session.limits.max_frames_in_flight,
            )
        )
        while (response := await self._outbox.get()) is not None:
            yield response

    # The end --------------------------------------------------------------------------------------------------------

    def left(self) -> None:
        """The transport sends nothing more."""
        self._outbox.forget_error()

    def end(self, error: Exception | None) -> None:
        """Ends the stream from the server's side, with what the client shall be told."""
        self.ending.set()
        self._outbox.close(error)
        self._mailbox.close()

    async def close(self) -> None:
        """Returns when the frame that is in the worker, if any, has been counted; frames that wait are dropped."""
        self.end(None)
        while await self._mailbox.get() is not None:
            self._recorder.dropped(self.session, 1)
        # Not the pump itself: whoever waits here may be cancelled, and the frame in the worker shall be counted still.
        await asyncio.wait({self._pump})

    # Tracking -------------------------------------------------------------------------------------------------------

    async def _run(self) -> None:
        """Tracks frame after frame until no more come; one is in the worker at a time."""
        current_session.set(self.session.id)
        try:
            while not self.ending.is_set() and (waiting := await self._mailbox.get()) is not None:
                await self._outbox.put(await self._track(waiting))
            self._outbox.close()
        except Irrecoverable as error:
            self.end(error.reason)
        except Exception as error:
            log.exception("a stream failed")
            self.end(error)

    async def _track(self, waiting: Waiting) -> pb.TrackResponse:
        """The answer to a frame.

        Raises:
            Irrecoverable: the session cannot be had back.
        """
        started, session = monotonic(), self.session
        try:
            result = await self._tracked(waiting, started)
        except ServiceError as error:
            if isinstance(error, DeadlineExceeded):
                self._count_missed(1)
            return self._recorder.refused(session, waiting.frame, error, waiting.arrived)
        response = pb.TrackResponse(result=result)
        return without_arrays(response) if result.frames_applied % self._every_nth else response

    async def _tracked(self, waiting: Waiting, started: float) -> pb.Result:
        """Has a frame tracked, once more in another worker if the first one is lost."""
        try:
            return await self._submit(waiting, started)
        except WorkerLost:
            return await self._submit(waiting, started)

    async def _submit(self, waiting: Waiting, started: float) -> pb.Result:
        frame, session = waiting.frame, self.session
        if not session.seated:
            await self._seated()
        async with session.lock:
            if not session.seated:  # any more
                raise worker_lost(session.id)
            self._check_order(frame)
            turn_by = waiting.arrived + frame.deadline if frame.deadline else math.inf
            most = session.limits.max_points
            try:
                with self._telling_to_wait():
                    answer = await self._pool.submit(
                        session.id, frame.SerializeToString(), self._options, max_points=most, turn_by=turn_by
                    )
            except WorkerLost:
                self._durability.lost(session)
                raise
            result = pb.Result.FromString(answer)
            self._recorder.applied(session, result, waiting, started, self._mode)
            self._overload.applied()
            self._durability.tracked(session)
        return result

    @contextmanager
    def _telling_to_wait(self) -> Iterator[None]:
        """While a frame is in the worker for longer than usual, its client is told that it is; it would count the silence."""
        self._tell_later(monotonic())
        try:
            yield
        finally:
            self._telling.cancel()

    def _tell_later(self, began: float) -> None:
        self._telling = asyncio.get_running_loop().call_later(TELL_EVERY, self._tell_to_wait, began)

    def _tell_to_wait(self, began: float) -> None:
        self._tell_later(began)
        self.notify(pb.Notice(kind=pb.NOTICE_KIND_WAITING, message="a frame takes long", value=monotonic() - began))

    async def _seated(self) -> None:
        """Returns when the session has a worker.

        Raises:
            WorkerLost: the stream is about to end before that. Irrecoverable: it will have none.
        """
        reviving, ending = self._durability.revive(self.session), asyncio.create_task(self.ending.wait())
        await asyncio.wait((reviving, ending), return_when=asyncio.FIRST_COMPLETED)
        ending.cancel()
        if not reviving.done():
            raise worker_lost(self.session.id)
        if reason := reviving.result():
            raise Irrecoverable(reason)

    def _check_order(self, frame: pb.Frame) -> None:
        last = self.session.statistics.last_sequence_number
        if frame.sequence_number <= last:
            raise InvalidFrame(
                field="sequence_number",
                expected=f"more than {last}, that of the last frame",
                got=str(frame.sequence_number),
            )
