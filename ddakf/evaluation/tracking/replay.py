"""Replay: tracks a source in this process or on a server, and yields every frame with its result and time."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager

import ddakf
from ddakf.errors import DdakfError
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.tracking.server import Server, client_package
from ddakf.evaluation.tracking.sources import Source

WAIT = 0.1  # s between checks for the end of the stream


def local(source: Source, config: ddakf.Config | None = None) -> Iterator[tuple[CapturedFrame, object, float]]:
    """Tracks in this process.

    Yields:
        Frame, :class:`ddakf.results.FrameResult`, and the seconds that the step took.
    """
    tracker = ddakf.Tracker(source.garment, body=source.body, config=config or ddakf.Config())
    if source.start is not None:
        tracker.reset(vertices=source.start)
    for frame in source:
        started = time.perf_counter()
        try:
            result = tracker.step(
                frame.points,
                timestamp=frame.timestamp,
                sensor_origin=frame.sensor_origin,
                body_vertices=frame.body_vertices,
                colors=frame.colors,
            )
        except DdakfError as error:
            raise DdakfError(f"frame {frame.number}: {error}") from error
        yield frame, result, time.perf_counter() - started


def remote(
    source: Source, server: Server, config: ddakf.Config | None = None, codec: str | None = None
) -> Iterator[tuple[CapturedFrame, object, float]]:
    """Tracks on a server: every frame in order, each sent after the result of the one before.

    Args:
        source: the frames.
        server: its address and credentials.
        config: of the tracker; default the server's.
        codec: of the clouds; default the client's.

    Yields:
        Frame, the client's result, and the seconds from handing over the frame to its result.

    Raises:
        MissingDependency: the client is not installed.
        DdakfError: the server refused or ended the stream; the message is its sentence.
    """
    client = client_package()
    options = {} if codec is None else {"codec": codec}
    sent: list[CapturedFrame] = []
    try:
        with (
            server.connect() as connection,
            connection.create_session(source.garment, body=source.body, config=config, flow="lossless", **options) as session,
        ):
            if source.start is not None:
                session.reset(source.start)
            with _paced(source, sent) as (frames, permit):
                for number, result in enumerate(session.track(frames, covariance=True)):
                    yield sent[number], result, result.latency
                    permit.release()
    except client.ServiceError as error:
        raise DdakfError(str(error)) from error


@contextmanager
def _paced(source: Source, sent: list[CapturedFrame]):
    """Frames that wait for a permit each, since the client pulls them in a thread of its own; they end with the context."""
    permit, ended = threading.Semaphore(1), threading.Event()

    def frames() -> Iterator[CapturedFrame]:
        for frame in source:
            while not permit.acquire(timeout=WAIT):
                if ended.is_set():
                    return
            sent.append(frame)
            yield frame

    try:
        yield frames(), permit
    finally:
        ended.set()
