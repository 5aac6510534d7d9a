"""Asynchronous stream: the state machine of ``exchange`` with tasks, where ``stream`` has threads."""

from __future__ import annotations

import asyncio
import contextlib
import threading
import time
from collections.abc import AsyncIterable, AsyncIterator, Callable, Coroutine, Iterable, Iterator
from typing import Protocol
from weakref import WeakValueDictionary

import grpc
from ddakf_api.errors import Cancelled, ServiceError, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb

from ddakf_client.calls import CLOSED, failure
from ddakf_client.exchange import Exchange, Plan, encode_request, without_notices
from ddakf_client.frames import held
from ddakf_client.results import FrameError, Notice, Result
from ddakf_client.stream import JOIN_SECONDS

_END = object()
_LOST_STATUS = "Internal error from Core"
_STATUS_SECONDS = 1.0
_LEAST_PAUSE = 0.05  # seconds
_taking: WeakValueDictionary[int, threading.Thread] = WeakValueDictionary()
"""Threads that wait for the next frame of an iterator, by its id."""


class Connection(Protocol):
    """The part of a client that a stream uses.

    Attributes:
        target: "host:port" of the present server.
        others: number of further addresses to try.
    """

    target: str
    others: int

    def open_track(self, requests: AsyncIterator[pb.TrackRequest]) -> grpc.aio.StreamStreamCall:
        """Opens the call of the stream."""

    def move(self, target: str) -> None:
        """Connects to the server at another address from now on."""

    def move_on(self, target: str) -> None:
        """Connects to the address after one that does not answer, unless the connection has moved already."""


async def track(
    connection: Connection, frames: AsyncIterable[object] | Iterable[object], plan: Plan
) -> AsyncIterator[Result | FrameError]:
    """Streams frames and yields their answers. Returns when every frame has an answer, else raises the reason."""
    stream = _Stream(plan, frames, lambda: connection.others > 0)
    untried = connection.others
    try:
        while True:
            target = connection.target
            stream.open(connection.open_track)
            try:
                while (response := await stream.read()) is not grpc.aio.EOF:
                    for answer in without_notices(stream.receive(response), connection.move, plan.on_notice):
                        yield answer
                for refused in stream.ended():
                    yield refused
                return
            except grpc.RpcError as error:
                status = await stream.server_status() or error
                # The server closed the stream normally while this side was still writing.
                if status.code() is grpc.StatusCode.OK:
                    stream.ended()
                lost = status.details() == _LOST_STATUS  # no status of the server: the connection is lost
                failed = Unavailable(f"the connection to {target} was lost") if lost else None
                failed = stream.silence or failed or failure(status, target, plan.timeout)
                if not stream.may_resume(failed, untried):
                    raise stream.failure or failed from None
                untried -= 1
                connection.move_on(target)
            except asyncio.CancelledError:  # a read raises this also when this side cancelled the call, or closed the client
                if asyncio.current_task().cancelling():
                    raise
                failed = stream.silence or Cancelled(CLOSED)
                if not stream.may_resume(failed, untried):
                    raise stream.failure or failed from None
                untried -= 1
                connection.move_on(target)
            await stream.pause()
    finally:
        await stream.close()


class _Stream:
    """An exchange and its tasks, which end with the stream.

    Args:
        may_move: whether a server that exceeds the timeout is left for another one.

    Attributes:
        silence: why the present call was given up; None: it was not.
    """

    def __init__(self, plan: Plan, frames: AsyncIterable[object] | Iterable[object], may_move: Callable[[], bool]):
        self._exchange = Exchange(plan, time.monotonic())
        self._frames, self._may_move = frames, may_move
        self.silence: ServiceError | None = None
        self._changed = asyncio.Event()
        self._statuses: list[grpc.aio.AioRpcError] = []
        self._call: grpc.aio.StreamStreamCall | None = None
        self._calls = 0
        self._tasks: list[asyncio.Task] = []

    @property
    def failure(self) -> BaseException | None:
        return self._exchange.failure

    def open(self, open_call: Callable[[AsyncIterator[pb.TrackRequest]], grpc.aio.StreamStreamCall]) -> None:
        """Opens the first call of the stream, or the next one after a lost connection."""
        self._calls += 1
        self.silence = None
        self._statuses = statuses = []
        self._call = open_call(self.requests(self._calls))
        self._call.add_done_callback(lambda call: statuses.append(_status_of(call)))
        self._changed.set()
        if self._tasks:
            self._tasks.pop().cancel()  # it sleeps until the deadline of the last call
        else:
            self._tasks = [asyncio.create_task(self._pull())]
        self._tasks.append(asyncio.create_task(self._watch()))

    async def server_status(self) -> grpc.aio.AioRpcError | None:
        """The status that the server sent, or None if it did not arrive.

        If a write fails because the call has ended, grpc.aio replaces the status of the server by one of its own, before or
        after the former arrives (https://github.com/grpc/grpc/issues/36066).
        """
        deadline = time.monotonic() + _STATUS_SECONDS
        while time.monotonic() < deadline:
            for status in self._statuses:
                if status.details() != _LOST_STATUS:
                    return status
            await asyncio.sleep(0.01)
        return None

    def may_resume(self, error: ServiceError, untried: int) -> bool:
        """Whether to open the stream again. The ended call sends nothing more."""
        self._calls += 1
        self._changed.set()
        return self._exchange.may_resume(error, time.monotonic(), untried)

    async def pause(self) -> None:
        """Waits until the next attempt."""
        await asyncio.sleep(self._exchange.pause(time.monotonic()))

    async def close(self) -> None:
        if self._call:
            self._call.cancel()
        for task in self._tasks:
            task.cancel()
        if self._tasks:  # the caller may then reuse the iterator
            await asyncio.wait(self._tasks, timeout=JOIN_SECONDS)

    async def read(self) -> pb.TrackResponse:
        """Returns the next response, or EOF."""
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

    async def requests(self, number: int) -> AsyncIterator[pb.TrackRequest]:
        """Yields the requests of call ``number`` until it is replaced."""
        exchange = self._exchange
        yield exchange.start_request(again=exchange.lost)
        while True:
            await self._until(lambda: exchange.is_done() or self._calls != number or exchange.can_take())
            if self._calls != number:
                return
            if exchange.is_done():
                exchange.finish(time.monotonic())
                return
            offered = exchange.take(time.monotonic())
            self._changed.set()
            try:
                yield encode_request(offered, exchange.plan)
            except ServiceError as error:
                if (ping := exchange.refuse(offered, error)) is not None:
                    yield ping

    async def _pull(self) -> None:
        failed = None
        try:
            frames = _as_async_iterator(self._frames)
            while await self._until(self._exchange.can_offer):
                if (frame := await anext(frames, _END)) is _END:
                    break
                self._exchange.offer(held(frame), time.monotonic())
                self._changed.set()
        except asyncio.CancelledError:
            if asyncio.current_task().cancelling():  # the stream ends
                raise
            failed = Cancelled("the source of frames was cancelled")
        except Exception as error:  # of the iterator of the caller: raised where the results are read
            failed = error
        finally:
            self._exchange.exhaust(failed)
            self._changed.set()

    async def _watch(self) -> None:
        """Ends the stream when the server exceeds the timeout; only the call where there is another server or attempt."""
        while True:
            while (left := self._exchange.deadline(now := time.monotonic()) - now) > 0:
                await asyncio.sleep(left)
            error = self._exchange.overdue(now)
            if not (self._exchange.lost or self._may_move()):
                self._fail(error)
                return
            if self.silence is None:
                self.silence = Unavailable(error.message)
                self._call.cancel()
            await asyncio.sleep(_LEAST_PAUSE)

    async def _until(self, condition: Callable[[], bool]) -> bool:
        while not condition():
            self._changed.clear()
            await self._changed.wait()
        return True

    def _fail(self, error: Exception) -> None:
        self._exchange.fail(error)
        self._call.cancel()


def _status_of(call: grpc.aio.Call) -> grpc.aio.AioRpcError:
    """The status of a finished call as an error. Its coroutines return at once."""

    def value(coroutine: Coroutine):
        try:
            coroutine.send(None)
        except StopIteration as end:
            return end.value
        coroutine.close()

    code, details, trailing = value(call.code()), value(call.details()), value(call.trailing_metadata())
    return grpc.aio.AioRpcError(code, grpc.aio.Metadata(), trailing or grpc.aio.Metadata(), details)


async def _as_async_iterator(frames: AsyncIterable[object] | Iterable[object]) -> AsyncIterator[object]:
    """Yields frames of either kind of iterable. An ordinary iterator runs in threads, because it may wait for a camera.

    Daemons: one that waits for ever does not keep the program from its end, as a thread of the loop's executor does. A thread
    waits for that of an earlier stream of the same iterator: after ``break`` the loop closes that stream later.
    """
    if isinstance(frames, AsyncIterable):
        async for frame in frames:
            yield frame
        return
    iterator, loop = iter(frames), asyncio.get_running_loop()
    while True:
        taken, before = loop.create_future(), _taking.get(id(iterator))
        thread = threading.Thread(target=_take, args=(iterator, before, loop, taken), name="ddakf-frames", daemon=True)
        _taking[id(iterator)] = thread
        thread.start()
        try:
            await asyncio.wait([taken])  # does not cancel it
        except asyncio.CancelledError:
            await asyncio.wait([taken], timeout=JOIN_SECONDS)
            if not taken.cancel():
                taken.exception()  # nobody reads it any more
            raise
        if (frame := taken.result()) is _END:
            return
        yield frame


def _take(
    iterator: Iterator[object], before: threading.Thread | None, loop: asyncio.AbstractEventLoop, taken: asyncio.Future
) -> None:
    """Sets the next frame, the end, or the iterator's error, unless nobody waits for it any more."""
    if before:
        before.join(JOIN_SECONDS)
    try:
        settle, outcome = taken.set_result, next(iterator, _END)
    except BaseException as error:
        settle, outcome = taken.set_exception, error
    with contextlib.suppress(RuntimeError):  # the loop has ended
        loop.call_soon_threadsafe(lambda: taken.done() or settle(outcome))
