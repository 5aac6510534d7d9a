"""Synchronous stream: the thread of the caller reads answers; other threads pull frames, send them and watch the timeout."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Protocol

import grpc
from ddakf_api.errors import ServiceError, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb

from ddakf_client.calls import failure
from ddakf_client.exchange import Exchange, Plan, encode_request, without_notices
from ddakf_client.frames import held
from ddakf_client.results import FrameError, Notice, Result

JOIN_SECONDS = 1.0
"""Longest wait for a source of frames when its stream ends."""

_LEAST_PAUSE = 0.05  # seconds
_END = object()


class Connection(Protocol):
    """The part of a client that a stream uses.

    Attributes:
        target: "host:port" of the present server.
        others: number of further addresses to try.
    """

    target: str
    others: int

    def open_track(self, requests: Iterator[pb.TrackRequest]) -> grpc.Call:
        """Opens the call of the stream."""

    def move(self, target: str) -> None:
        """Connects to the server at another address from now on."""

    def move_on(self, target: str) -> None:
        """Connects to the address after one that does not answer, unless the connection has moved already."""


def track(connection: Connection, frames: Iterable[object], plan: Plan) -> Iterator[Result | FrameError]:
    """Streams frames and yields their answers. Returns when every frame has an answer, else raises the reason."""
    stream = _Stream(plan, frames, lambda: connection.others > 0)
    untried = connection.others
    try:
        while True:
            target = connection.target
            stream.open(connection.open_track)
            try:
                while (response := stream.read()) is not None:
                    yield from without_notices(stream.receive(response), connection.move, plan.on_notice)
                yield from stream.ended()
                return
            except grpc.RpcError as error:
                failed = stream.silence or failure(error, target, plan.timeout)
                if not stream.may_resume(failed, untried):
                    raise stream.failure or failed from None
                untried -= 1
                connection.move_on(target)
            stream.pause()
    finally:
        stream.close()


class _Stream:
    """An exchange with a lock and threads, which end with the stream.

    Args:
        may_move: whether a server that exceeds the timeout is left for another one.

    Attributes:
        silence: why the present call was given up; None: it was not.
    """

    def __init__(self, plan: Plan, frames: Iterable[object], may_move: Callable[[], bool]):
        self._exchange = Exchange(plan, time.monotonic())
        self._frames, self._may_move = frames, may_move
        self.silence: ServiceError | None = None
        self._changed = threading.Condition()
        self._closed = threading.Event()
        self._opened = threading.Event()  # a call, whose deadline may be nearer than that of the last one; or closed
        self._call: grpc.Call | None = None
        self._calls = 0
        self._threads: list[threading.Thread] = []

    @property
    def failure(self) -> BaseException | None:
        return self._exchange.failure

    def open(self, open_call: Callable[[Iterator[pb.TrackRequest]], grpc.Call]) -> None:
        """Opens the first call of the stream, or the next one after a lost connection."""
        with self._change():
            self._calls += 1
        self.silence = None
        self._call = open_call(self.requests(self._calls))
        self._opened.set()
        if self._threads:
            return
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._pull, self._watch)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        with self._change():
            self._closed.set()
        self._opened.set()
        if self._call:  # else the client was closed before
            self._call.cancel()
        # The caller may then reuse the iterator; an iterator that waits for a camera cannot be interrupted.
        for thread in self._threads:
            thread.join(JOIN_SECONDS)

    # The caller's thread --------------------------------------------------------------------------------------------

    def read(self) -> pb.TrackResponse | None:
        """Returns the next response, or None at the end."""
        self._exchange.reading(time.monotonic())
        try:
            return next(self._call, None)
        finally:
            self._exchange.reading(None)

    def receive(self, response: pb.TrackResponse) -> list[Result | FrameError | Notice]:
        now = time.monotonic()
        with self._change():
            return self._exchange.receive(response, now)

    def ended(self) -> list[FrameError]:
        with self._changed:
            return self._exchange.ended()

    def may_resume(self, error: ServiceError, untried: int) -> bool:
        """Whether to open the stream again. The ended call sends nothing more."""
        with self._change():
            self._calls += 1
            return self._exchange.may_resume(error, time.monotonic(), untried)

    def pause(self) -> None:
        """Waits until the next attempt."""
        with self._changed:
            seconds = self._exchange.pause(time.monotonic())
        self._closed.wait(seconds)

    # gRPC's thread --------------------------------------------------------------------------------------------------

    def requests(self, number: int) -> Iterator[pb.TrackRequest]:
        """Yields the requests of call ``number`` until it is replaced."""
        exchange = self._exchange
        with self._changed:
            start = exchange.start_request(again=exchange.lost)
        yield start
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._over() or self._calls != number or exchange.can_take())
                if self._calls != number:
                    return
                if self._over():
                    exchange.finish(time.monotonic())
                    return
                offered = exchange.take(time.monotonic())
                self._changed.notify_all()
            try:
                yield encode_request(offered, exchange.plan)
            except ServiceError as error:
                with self._change():
                    ping = exchange.refuse(offered, error)
                if ping is not None:
                    yield ping

    def _over(self) -> bool:
        return self._closed.is_set() or self._exchange.is_done()

    # Threads of the stream ------------------------------------------------------------------------------------------

    def _pull(self) -> None:
        failed = None
        try:
            frames = iter(self._frames)
            while self._wait_to_offer() and (frame := next(frames, _END)) is not _END:
                own = held(frame)
                with self._change():
                    self._exchange.offer(own, time.monotonic())
        except BaseException as error:  # of the iterator of the caller: raised where the results are read
            failed = error
        with self._change():
            self._exchange.exhaust(failed)

    def _wait_to_offer(self) -> bool:
        """Waits until another frame may be offered; returns whether the stream continues."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed.is_set() or self._exchange.can_offer())
        return not self._closed.is_set()

    def _watch(self) -> None:
        """Ends the stream when the server exceeds the timeout; only the call where there is another server or attempt."""
        while True:
            self._opened.wait(max(_LEAST_PAUSE if self.silence else 0.0, self._seconds_left()))
            self._opened.clear()
            if self._closed.is_set():
                return
            if self._seconds_left() > 0:
                continue
            with self._changed:
                error, again = self._exchange.overdue(time.monotonic()), self._exchange.lost
            if not (again or self._may_move()):
                self._fail(error)
                return
            if self.silence is None:
                self.silence = Unavailable(error.message)
                self._call.cancel()

    def _seconds_left(self) -> float:
        with self._changed:
            now = time.monotonic()
            return self._exchange.deadline(now) - now

    def _fail(self, error: BaseException) -> None:
        self._exchange.fail(error)
        self._call.cancel()

    @contextmanager
    def _change(self) -> Iterator[None]:
        with self._changed:
            yield
            self._changed.notify_all()
