"""Every received frame counts once, also one whose session or client is lost. The pool of workers is a fake one."""

from __future__ import annotations

import asyncio
from collections import Counter
from time import monotonic

import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import Unavailable, WorkerLost
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.metrics import Metrics
from ddakf_service.observability.tracing import NoTracer
from ddakf_service.sessions import service
from ddakf_service.settings import Settings
from ddakf_service.store.store import Store
from ddakf_service.streaming.frame_message import FrameMessage
from ddakf_service.streaming.frame_recorder import FrameRecorder
from ddakf_service.streaming.streams import Streams
from ddakf_service.workers.pool import worker_lost

START = pb.Start(name="sessions/some", api_version=API_VERSION, flow_mode=pb.FLOW_MODE_LOSSLESS)


class Pool:
    """Tracks a frame when it is ``free``; ``lost``: the frame ends its worker."""

    def __init__(self):
        self.tracking, self.free, self.lost = asyncio.Event(), asyncio.Event(), False

    async def open(self, session_id, request, memory):
        return pb.Session().SerializeToString()

    restore = open

    async def submit(self, session_id, frame, options, **_):
        self.tracking.set()
        await self.free.wait()
        if self.lost:
            raise worker_lost(session_id, suspected=True)
        return pb.Result(sequence_number=pb.Frame.FromString(bytes(frame)).sequence_number).SerializeToString(), b""

    def affordable_rate(self, session_id):
        return 0.0

    def count_memory(self, session_id, memory):
        pass

    async def snapshot(self, session_id, compressed=False):
        return b""

    async def close(self, session_id):
        pass


class Serving:
    """A server with the session "some" and its lossless stream, in which one frame may wait."""

    @classmethod
    async def begin(cls, start: pb.Start = START, max_frame_rate: float = 0.0) -> Serving:
        self, settings = cls(), Settings(data_dir="none", lossless_queue=1, max_frame_rate=max_frame_rate)
        self.pool, self.metrics = Pool(), Metrics()
        self.store = Store(settings, self.metrics)
        self.server = service.Sessions(self.pool, settings, self.metrics, self.store)
        await self.server.load()
        await self.server.create(pb.CreateSessionRequest(api_version=API_VERSION, session_id="some"))
        self.streams = Streams(self.server.components, FrameRecorder(self.metrics, self.store.history, NoTracer()))
        self.stream = await self.streams.open(start)
        return self

    async def deliver(self) -> None:
        await self.stream.deliver(lambda response: asyncio.sleep(0))

    async def receive(self, *numbers: int) -> None:
        for number in numbers:
            frame = pb.Frame(sequence_number=number, capture_time=number, point_cloud=pb.PointCloud())
            await self.stream.receive(FrameMessage.of(frame))

    def counts(self) -> Counter[str]:
        """Frames by outcome."""
        (family,) = self.metrics.frames.collect()
        return +Counter({sample.labels["outcome"]: int(sample.value) for sample in family.samples if "_total" in sample.name})


@pytest.fixture
async def serving():
    serving = await Serving.begin()
    yield serving
    await serving.streams.leave(serving.stream)
    await serving.server._tasks.settle(1.0)
    await asyncio.to_thread(serving.store.close)


async def test_the_frame_with_which_a_session_is_lost(serving):
    """It has taken down as many workers as a session may."""
    serving.pool.lost = True
    serving.pool.free.set()
    serving.server._catalog.readable("sessions/some").worker_losses.extend([monotonic()] * 3)
    await serving.receive(1)
    with pytest.raises(WorkerLost, match="4 workers were lost"):
        await serving.deliver()
    assert serving.counts() == {"failed": 1}


async def test_a_frame_whose_session_cannot_be_restored_now(serving, monkeypatch):
    """The client comes back and sends it again."""

    async def unreadable(session):
        raise Unavailable("no disk")

    session = serving.server._catalog.readable("sessions/some")
    await serving.server._tasks.settle(1.0)
    session.has_worker, session.stored_only, session.checkpoint = False, True, None
    monkeypatch.setattr(serving.server._persistence, "newest", unreadable)
    await serving.receive(1)
    with pytest.raises(Unavailable, match="no disk"):
        await serving.deliver()
    assert serving.counts() == {"failed": 1}


async def test_a_frame_whose_session_is_deleted_while_it_is_tracked(serving):
    await serving.receive(1)
    await serving.pool.tracking.wait()
    deletion = asyncio.create_task(serving.server.delete("sessions/some"))
    await serving.stream.ending.wait()
    serving.pool.free.set()
    await deletion
    await serving.streams.leave(serving.stream)
    assert serving.counts() == {"dropped": 1}


@pytest.mark.parametrize("how", ["its client leaves", "the session is deleted"])
async def test_a_frame_that_waits_for_another_worker_when_its_stream_ends(serving, monkeypatch, how):
    """It has not failed: the next worker would have tracked it."""
    restoring, free = asyncio.Event(), asyncio.Event()

    async def restore(session_id, request, memory):
        restoring.set()
        await free.wait()
        return pb.Session().SerializeToString()

    monkeypatch.setattr(serving.pool, "restore", restore)
    serving.server.lose(["some"])
    await serving.receive(1)
    await restoring.wait()
    ended = serving.server.delete("sessions/some") if how == "the session is deleted" else serving.stream.close()
    ending = asyncio.create_task(ended)
    await serving.streams.leave(serving.stream)
    free.set()
    await ending
    assert serving.counts() == {"dropped": 1}


@pytest.mark.parametrize("rate", [0.0, 1e-3], ids=["full mailbox", "frame rate"])
async def test_a_frame_that_is_held_back_when_its_client_leaves(serving, rate):
    """One may wait. The first one is in the worker; at the low rate it has been tracked, and the second one is held back."""
    serving.server._catalog.readable("sessions/some").limits.max_frame_rate = rate
    if rate:
        serving.pool.free.set()
    delivery, reader = (asyncio.create_task(work) for work in (serving.deliver(), serving.receive(1, 2, 3, 4)))
    await serving.pool.tracking.wait()
    for _ in range(100):
        await asyncio.sleep(0)
    assert serving.counts() == ({"applied": 1} if rate else {})
    delivery.cancel()
    reader.cancel()
    closing = serving.streams.leave(serving.stream)
    serving.pool.free.set()
    await closing
    assert serving.counts() == {"applied": 1, "dropped": 3 if rate else 2}
