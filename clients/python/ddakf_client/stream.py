"""The synchronous stream: the caller's thread reads answers; others pull frames, send them, and watch the time."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager

import grpc
from ddakf_api.errors import ServiceError
from ddakf_api.v1 import tracking_pb2 as pb

from ddakf_client.calls import failure
from ddakf_client.exchange import Exchange, Plan, encode_request
from ddakf_client.results import FrameError, Notice, Result

_JOIN_SECONDS = 1.0
_NO_MORE = object()


def track(
    open_call: Callable[[Iterator[pb.TrackRequest]], grpc.Call], frames: Iterable[object], plan: Plan, target: str
) -> Iterator[Result | FrameError]:
    """Streams frames and yields what comes back; returns when every frame has its answer, or raises why not."""
    stream = _Stream(plan, frames)
    stream.run(open_call(stream.requests()))
    try:
        while (response := stream.read()) is not None:
            for answer in stream.receive(response):
                if isinstance(answer, Notice):
                    plan.on_notice(answer)
                else:
                    yield answer
        yield from stream.ended()
    except grpc.RpcError as error:
        raise (stream.failure or failure(error, target, plan.timeout)) from None
    finally:
        stream.close()


class _Stream:
    """An exchange with a lock around it and threads beside it, which end with the stream."""

    def __init__(self, plan: Plan, frames: Iterable[object]):
        self._exchange = Exchange(plan, time.monotonic())
        self._frames = frames
        self._changed = threading.Condition()
        self._closed = threading.Event()

    @property
    def failure(self) -> BaseException | None:
        return self._exchange.failure

    def run(self, call: grpc.Call) -> None:
        self._call = call
        self._threads = [threading.Thread(target=work, daemon=True) for work in (self._pull, self._watch)]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        with self._change():
            self._closed.set()
        self._call.cancel()
        # So that the caller may go on with the same iterator; nothing can interrupt one that waits for a camera.
        for thread in self._threads:
            thread.join(_JOIN_SECONDS)

    # The caller's thread --------------------------------------------------------------------------------------------

    def read(self) -> pb.TrackResponse | None:
        """The next answer, or None at the end."""
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

    # gRPC's thread --------------------------------------------------------------------------------------------------

    def requests(self) -> Iterator[pb.TrackRequest]:
        exchange = self._exchange
        yield exchange.plan.start()
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._over() or exchange.can_take())
                if self._over():
                    exchange.finish(time.monotonic())
                    return
                offered = exchange.take(time.monotonic())
                self._changed.notify_all()
            try:
                yield encode_request(offered, exchange.plan)
            except ServiceError as error:
                with self._change():
                    exchange.refuse(offered, error)
                if exchange.failure:
                    self._call.cancel()

    def _over(self) -> bool:
        return self._closed.is_set() or self._exchange.is_done()

    # Threads of the stream ------------------------------------------------------------------------------------------

    def _pull(self) -> None:
        try:
            frames = iter(self._frames)
            while self._wait_to_offer() and (frame := next(frames, _NO_MORE)) is not _NO_MORE:
                with self._change():
                    self._exchange.offer(frame, time.monotonic())
        except BaseException as error:  # of the caller's iterator: raised where the results are read
            self._fail(error)
        with self._change():
            self._exchange.exhausted = True

    def _wait_to_offer(self) -> bool:
        """Whether the stream goes on, once it may have another frame."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed.is_set() or self._exchange.can_offer())
        return not self._closed.is_set()

    def _watch(self) -> None:
        """Ends a stream whose server has been silent for too long."""
        while not self._closed.wait(max(0.0, self._seconds_left())):
            if self._seconds_left() <= 0:
                with self._changed:
                    error = self._exchange.overdue()
                self._fail(error)
                return

    def _seconds_left(self) -> float:
        with self._changed:
            now = time.monotonic()
            return self._exchange.deadline(now) - now

    def _fail(self, error: BaseException) -> None:
        self._exchange.failure = self._exchange.failure or error
        self._call.cancel()

    @contextmanager
    def _change(self) -> Iterator[None]:
        with self._changed:
            yield
            self._changed.notify_all()
