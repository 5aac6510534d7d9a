"""One Track call, whatever carries it: requests go to the mailbox, answers come out of the outbox."""

from __future__ import annotations

import asyncio
import logging
import time
from collections import deque
from collections.abc import AsyncIterator, Callable
from time import monotonic

from ddakf_api.errors import Internal, InvalidFrame, ServiceError, WorkerLost, to_detail
from ddakf_api.v1 import tracking_pb2 as pb

from .flow import Waiting, mailbox_for
from .session import Session
from .telemetry import Metrics, current_session
from .workers import WorkerPool

log = logging.getLogger(__name__)

# Answers that may wait for a slow reader: one, so that the next frame is tracked while this one is sent.
_OUTBOX_CAPACITY = 1
# A point of the least compact codec takes 12 bytes; smaller clouds carry headers.
_BYTES_PER_POINT, _HEADER_BYTES = 12, 1 << 16


class Outbox:
    """Answers on their way to the client; ``publish`` is told each of them too, without waiting."""

    def __init__(self, publish: Callable[[pb.TrackResponse], None]):
        self._publish = publish
        self._responses: deque[pb.TrackResponse] = deque()
        self._changed = asyncio.Event()
        self._room = asyncio.Event()
        self._closed = False
        self._error: Exception | None = None

    async def put(self, response: pb.TrackResponse) -> None:
        """Leaves an answer, once there is room for it; watchers get it at once."""
        self._publish(response)
        while len(self._responses) > _OUTBOX_CAPACITY and not self._closed:
            self._room.clear()
            await self._room.wait()
        self._append(response)

    def push(self, response: pb.TrackResponse) -> None:
        """Leaves an answer without waiting; for the few that must not be held up."""
        self._publish(response)
        self._append(response)

    def _append(self, response: pb.TrackResponse) -> None:
        if not self._closed:
            self._responses.append(response)
            self._changed.set()

    def close(self, error: Exception | None = None) -> None:
        """No more answers; ``get`` hands out those that wait, and then raises ``error``, if any."""
        if not self._closed:
            self._closed, self._error = True, error
            self._changed.set()
            self._room.set()

    async def get(self) -> pb.TrackResponse | None:
        """The next answer; None after the last."""
        while not self._responses and not self._closed:
            self._changed.clear()
            await self._changed.wait()
        if self._responses:
            self._room.set()
            return self._responses.popleft()
        if self._error:
            raise self._error
        return None


class Stream:
    """The conversation of a session with its client.

    A transport calls :meth:`receive` for each request, :meth:`finish` when no more will come, sends what
    :meth:`responses` yields, and calls :meth:`close` at the end, whichever side ended it.

    Attributes:
        ending: set once nothing more is tracked, though a frame may still be in the worker.
        gone: set by whoever closed the stream, once its session is free for another one.
    """

    def __init__(self, session: Session, start: pb.Start, pool: WorkerPool, metrics: Metrics, mode: pb.FlowMode):
        self.session = session
        self._pool, self._metrics = pool, metrics
        self._options = start.result_options.SerializeToString()
        self._every_nth = max(start.result_options.every_nth, 1)
        self._mode = mode
        self._mailbox = mailbox_for(mode, session.limits.max_frames_in_flight)
        self._outbox = Outbox(session.watchers.publish)
        self.ending, self.gone = asyncio.Event(), asyncio.Event()
        self._pump = asyncio.create_task(self._run())

    async def receive(self, request: pb.TrackRequest) -> None:
        """Takes a request; waits in lossless mode while the session is behind."""
        match request.WhichOneof("message"):
            case "frame":
                await self._receive_frame(request.frame)
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

    def notify(self, notice: pb.Notice) -> None:
        """Tells the client something in between its results."""
        self._outbox.push(pb.TrackResponse(notice=notice))

    def end(self, error: Exception | None) -> None:
        """Ends the stream from the server's side, with what the client shall be told."""
        self.ending.set()
        self._outbox.close(error)
        self._mailbox.close()

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

    async def close(self) -> None:
        """Returns when the frame that is in the worker, if any, has been counted; frames that wait are dropped."""
        self.end(None)
        while (waiting := await self._mailbox.get()) is not None:
            self._count_dropped(1, waiting.frame)
        # Not the pump itself: whoever waits here may be cancelled, and the frame in the worker shall be counted still.
        await asyncio.wait({self._pump})

    async def _receive_frame(self, frame: pb.Frame) -> None:
        try:
            self._check_size(frame)
        except InvalidFrame as error:
            await self._outbox.put(self._rejection(frame, error))
            return
        self._count_dropped(await self._mailbox.put(frame), frame)

    def _check_size(self, frame: pb.Frame) -> None:
        """Refuses at the door what would only take memory while it waits."""
        most = self.session.limits.max_points
        cloud = frame.point_cloud
        if cloud.point_count > most:
            raise InvalidFrame(field="point_cloud.point_count", expected=f"at most {most}", got=str(cloud.point_count))
        if len(cloud.data) > most * _BYTES_PER_POINT + _HEADER_BYTES:
            raise InvalidFrame(
                field="point_cloud.data", expected=f"bytes of at most {most} points", got=f"{len(cloud.data)} bytes"
            )

    async def _run(self) -> None:
        """Tracks frame after frame until no more come; one is in the worker at a time."""
        current_session.set(self.session.id)
        try:
            while not self.ending.is_set() and (waiting := await self._mailbox.get()) is not None:
                response = await self._track(waiting)
                if response is not None:
                    await self._outbox.put(response)
            self._outbox.close()
        except WorkerLost as error:
            self.end(error)
        except Exception as error:
            log.exception("a stream failed")
            self.end(error)

    async def _track(self, waiting: Waiting) -> pb.TrackResponse | None:
        frame, started = waiting.frame, monotonic()
        try:
            async with self.session.lock:
                self._check_order(frame)
                payload = await self._pool.submit(self.session.id, frame.SerializeToString(), self._options)
                result = pb.Result.FromString(payload)
                self.session.record_result(result, waiting.arrived)
        except WorkerLost:
            self._metrics.frames.labels("failed").inc()
            raise
        except ServiceError as error:
            return self._rejection(frame, error)
        result.timings["queue"] = started - waiting.arrived
        result.timings["server"] = monotonic() - waiting.arrived
        self._metrics.observe(result)
        return None if result.frames_applied % self._every_nth else pb.TrackResponse(result=result)

    def _check_order(self, frame: pb.Frame) -> None:
        last = self.session.statistics.last_sequence_number
        if frame.sequence_number <= last:
            raise InvalidFrame(
                field="sequence_number",
                expected=f"more than {last}, that of the last frame",
                got=str(frame.sequence_number),
            )

    def _rejection(self, frame: pb.Frame, error: ServiceError) -> pb.TrackResponse:
        self.session.touch()  # who sends frames, if bad ones, is there
        statistics = self.session.statistics
        statistics.frames_rejected += 1
        self._metrics.frames.labels("failed" if isinstance(error, Internal) else "rejected").inc()
        log.info("a frame was rejected: %s", error, extra={"session": self.session.id, "sequence": frame.sequence_number})
        return pb.TrackResponse(
            frame_error=pb.FrameError(
                sequence_number=frame.sequence_number,
                capture_time=frame.capture_time,
                error=to_detail(error),
                frames_rejected=statistics.frames_rejected,
            )
        )

    def _count_dropped(self, count: int, frame: pb.Frame) -> None:
        if count:
            self.session.statistics.frames_dropped += count
            self._metrics.frames.labels("dropped").inc(count)
            log.debug("a frame was dropped", extra={"session": self.session.id, "before": frame.sequence_number})
