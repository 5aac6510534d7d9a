"""The asynchronous stream: as ``stream``, with tasks in place of threads."""

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncIterable, AsyncIterator, Callable, Coroutine, Iterable

import grpc
from ddakf_api.errors import ServiceError
from ddakf_api.v1 import tracking_pb2 as pb

from ddakf_client.calls import failure
from ddakf_client.exchange import Exchange, Plan, encode_request
from ddakf_client.results import FrameError, Notice, Result

_NO_MORE = object()
_LOST_STATUS = "Internal error from Core"
_STATUS_SECONDS = 1.0


async def track(
    open_call: Callable[[AsyncIterator[pb.TrackRequest]], grpc.aio.StreamStreamCall],
    frames: AsyncIterable[object] | Iterable[object],
    plan: Plan,
    target: str,
) -> AsyncIterator[Result | FrameError]:
    """Streams frames and yields what comes back; returns when every frame has its answer, or raises why not."""
    stream = _Stream(plan, frames)
    stream.run(open_call(stream.requests()))
    try:
        while (response := await stream.read()) is not grpc.aio.EOF:
            for answer in stream.receive(response):
                if isinstance(answer, Notice):
                    plan.on_notice(answer)
                else:
                    yield answer
        for refused in stream.ended():
            yield refused
    except grpc.RpcError as error:
        status = await stream.servers_status() or error
        # The server ended the stream in order, while this side was still writing.
        if status.code() is grpc.StatusCode.OK:
            stream.ended()
        raise (stream.failure or failure(status, target, plan.timeout)) from None
    except asyncio.CancelledError:
        # What a read raises when the call was cancelled from this side, too.
        if stream.failure:
            raise stream.failure from None
        raise
    finally:
        stream.close()


class _Stream:
    """An exchange and the tasks beside it, which end with the stream."""

    def __init__(self, plan: Plan, frames: AsyncIterable[object] | Iterable[object]):
        self._exchange = Exchange(plan, time.monotonic())
        self._frames = frames
        self._changed = asyncio.Event()
        self._statuses: list[grpc.aio.AioRpcError] = []

    @property
    def failure(self) -> BaseException | None:
        return self._exchange.failure

    def run(self, call: grpc.aio.StreamStreamCall) -> None:
        self._call = call
        call.add_done_callback(lambda call: self._statuses.append(_status_of(call)))
        self._tasks = [asyncio.create_task(self._pull()), asyncio.create_task(self._watch())]

    async def servers_status(self) -> grpc.aio.AioRpcError | None:
        """What the server ended the call with, if that can be found.

        A write that fails because the call has ended makes grpc.aio put a status of its own in the place of the
        server's, before or after that one arrives (https://github.com/grpc/grpc/issues/36066).
        """
        deadline = time.monotonic() + _STATUS_SECONDS
        while time.monotonic() < deadline:
            for status in self._statuses:
                if status.details() != _LOST_STATUS:
                    return status
            await asyncio.sleep(0.01)
        return None

    def close(self) -> None:
        self._call.cancel()
        for task in self._tasks:
            task.cancel()

    async def read(self) -> pb.TrackResponse:
        """The next answer, or EOF."""
        self._exchange.reading(time.monotonic())
        try:
            return await self._call.read()
        finally:
            self._exchange.reading(None)

    def receive(self, response: pb.TrackResponse) -> list[Result | FrameError | Notice]:
        self._changed.set()
        return self._exchange.receive(response, time.monotonic())

    def ended(self) -> list[FrameError]:
        return self._exchange.ended()

    async def requests(self) -> AsyncIterator[pb.TrackRequest]:
        exchange = self._exchange
        yield exchange.plan.start()
        while True:
            await self._until(lambda: exchange.is_done() or exchange.can_take())
            if exchange.is_done():
                exchange.finish(time.monotonic())
                return
            offered = exchange.take(time.monotonic())
            self._changed.set()
            try:
                yield encode_request(offered, exchange.plan)
            except ServiceError as error:
                exchange.refuse(offered, error)
                if exchange.failure:
                    self._call.cancel()

    async def _pull(self) -> None:
        try:
            frames = _asynchronous(self._frames)
            while await self._until(self._exchange.can_offer):
                if (frame := await anext(frames, _NO_MORE)) is _NO_MORE:
                    break
                self._exchange.offer(frame, time.monotonic())
                self._changed.set()
        except Exception as error:  # of the caller's iterator: raised where the results are read
            self._fail(error)
        self._exchange.exhausted = True
        self._changed.set()

    async def _watch(self) -> None:
        """Ends a stream whose server has been silent for too long."""
        while (left := self._exchange.deadline(now := time.monotonic()) - now) > 0:
            await asyncio.sleep(left)
        self._fail(self._exchange.overdue())

    async def _until(self, condition: Callable[[], bool]) -> bool:
        while not condition():
            self._changed.clear()
            await self._changed.wait()
        return True

    def _fail(self, error: Exception) -> None:
        self._exchange.failure = self._exchange.failure or error
        self._call.cancel()


def _status_of(call: grpc.aio.Call) -> grpc.aio.AioRpcError:
    """The status of a call that has one, as an error. Nothing is waited for: coroutines end at once."""

    def value(coroutine: Coroutine):
        try:
            coroutine.send(None)
        except StopIteration as end:
            return end.value
        coroutine.close()

    code, details, trailing = value(call.code()), value(call.details()), value(call.trailing_metadata())
    return grpc.aio.AioRpcError(code, grpc.aio.Metadata(), trailing or grpc.aio.Metadata(), details)


async def _asynchronous(frames: AsyncIterable[object] | Iterable[object]) -> AsyncIterator[object]:
    """Frames of either kind; an ordinary iterator runs in a thread, for it may wait for a camera."""
    if isinstance(frames, AsyncIterable):
        async for frame in frames:
            yield frame
        return
    ordinary = iter(frames)
    while (frame := await asyncio.to_thread(next, ordinary, _NO_MORE)) is not _NO_MORE:
        yield frame
