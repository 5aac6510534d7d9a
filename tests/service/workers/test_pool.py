"""Contract of a worker pool, for every implementation."""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from collections.abc import Callable

import numpy as np
import pytest
import pytest_asyncio
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh, unpack
from ddakf_api.errors import (
    DeadlineExceeded,
    InvalidArgument,
    InvalidConfig,
    InvalidFrame,
    InvalidMesh,
    InvalidSnapshot,
    ResourceExhausted,
    WorkerLost,
)
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.workers.compute.tracker_host import TrackerHost
from ddakf_service.workers.messages import wire
from ddakf_service.workers.pool import Limits, Memory
from ddakf_service.workers.process_pool import ProcessPool

from ddakf import Tracker
from tests.lanes import every

from ..conftest import frame_of, is_running, make_sheet, workers

LIMITS = Limits(max_points=5_000, max_vertices=1_000, max_faces=2_000, max_body_vertices=1_000, max_image_pixels=100_000)


def local(size=2, limits=LIMITS, **options) -> ProcessPool:
    return ProcessPool(size, limits, **{"frame_timeout": 20.0, "warm_timeout": 300.0, **options})


@pytest.fixture(params=every(2, ["local", "ray"]), scope="module")
def implementation(request) -> Callable[..., ProcessPool]:
    """Makes a pool with processes of this machine, or with actors of a Ray cluster."""
    if request.param == "local":
        return local
    cluster = request.getfixturevalue("cluster")
    import ray
    from ddakf_service.workers.ray_actors import RayActors

    ray.init(cluster.address, log_to_driver=False, configure_logging=False)  # for all pools, of which each would end it

    def on_ray(size=2, limits=LIMITS, **options) -> ProcessPool:
        return local(size, limits, source=RayActors(limits, cluster.address), **options)

    return on_ray


NAMES = ("one", "two", "three", "copy", "bad", "greedy", "other", "modest")  # of the sessions in these tests
PROCESSORS = 16  # of the Ray cluster: more than all workers of the pools


pytestmark = pytest.mark.asyncio(loop_scope="module")


@contextlib.asynccontextmanager
async def running(pool):
    """The pool between its start and its stop."""
    await pool.start(lambda *_: None)
    try:
        yield pool
    finally:
        await pool.stop()


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def shared_pool(implementation):
    """Two workers, shared by the tests."""
    lost: list[str] = []
    pool = implementation(on_lost=lost.extend)
    pool.lost = lost
    async with running(pool):
        yield pool


@pytest_asyncio.fixture(loop_scope="module")
async def pool(shared_pool):
    """Two ready workers without sessions."""
    await until(lambda: shared_pool.health().ready == 2)
    shared_pool.lost.clear()
    shared_pool.restarts = shared_pool.health().restarts
    yield shared_pool
    for name in NAMES:
        await shared_pool.close(name)


def creation(sheet, config_json: str = "") -> bytes:
    session = pb.Session(garment=pack_mesh(*sheet), config_json=config_json)
    return pb.CreateSessionRequest(api_version=API_VERSION, session=session).SerializeToString()


async def track(pool, session_id: str, frame: pb.Frame, max_points: int = LIMITS.max_points, **options) -> pb.Result:
    options = pb.ResultOptions(**options).SerializeToString()
    numbers, arrays = await pool.submit(session_id, frame.SerializeToString(), options, max_points=max_points)
    return pb.Result.FromString(b"".join((numbers, arrays)))


async def until(condition, seconds: float = 60.0) -> None:
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.01)


@pytest.mark.slow
async def test_sessions_live_where_they_were_opened(pool, sheet):
    assert (pool.health().ready, pool.health().wanted) == (2, 2)
    for session_id in ("one", "two", "three"):
        opened = pb.Session.FromString(await pool.open(session_id, creation(sheet)))
        assert opened.garment_vertex_count == len(sheet.vertices)
    results = await asyncio.gather(*(track(pool, i, frame_of(sheet, 1)) for i in ("one", "two", "three")))
    assert {result.sequence_number for result in results} == {1}
    await pool.close("two")
    with pytest.raises(WorkerLost):
        await track(pool, "two", frame_of(sheet, 2))
    await pool.close("two")


@pytest.mark.slow
async def test_what_cannot_be_used_changes_nothing(pool, sheet):
    await pool.open("one", creation(sheet))
    with pytest.raises(InvalidMesh):
        await pool.open("bad", creation(sheet._replace(faces=sheet.faces[:0])))
    await track(pool, "one", frame_of(sheet, 1))
    with pytest.raises(InvalidFrame, match="capture_time"):
        await track(pool, "one", frame_of(sheet, 1))
    with pytest.raises(InvalidArgument, match="vertex_encoding"):
        await track(pool, "one", frame_of(sheet, 2), vertex_encoding=pb.ARRAY_ENCODING_INT32)
    assert (await track(pool, "one", frame_of(sheet, 2))).sequence_number == 2


@pytest.mark.slow
async def test_a_snapshot_goes_on_exactly(pool, sheet):
    await pool.open("one", creation(sheet))
    await track(pool, "one", frame_of(sheet, 1))
    data = await pool.snapshot("one")
    await pool.restore("copy", pb.RestoreSessionRequest(data=data).SerializeToString())
    following = frame_of(sheet, 2, shift=(0.003, 0, 0.002))
    original, copy = [await track(pool, i, following, include_covariance=True) for i in ("one", "copy")]
    assert original.vertices == copy.vertices
    assert original.covariance == copy.covariance
    with pytest.raises(InvalidSnapshot):
        await pool.restore("bad", pb.RestoreSessionRequest(data=data[:50]).SerializeToString())
    await pool.reset("one", pb.ResetSessionRequest().SerializeToString())
    again = await track(pool, "one", frame_of(sheet, 1))
    vertices = unpack(again.vertices, 3, field="vertices", max_items=10_000)
    assert np.abs(vertices - sheet.vertices).max() < 0.01


@pytest.mark.slow
async def test_a_killed_worker_is_noticed_and_replaced(pool, sheet):
    await pool.open("one", creation(sheet))
    await pool.open("two", creation(sheet))
    victim, survivor = pool.process_ids()
    os.kill(victim, signal.SIGKILL)
    await until(lambda: pool.lost)
    assert pool.lost == ["one"]
    with pytest.raises(WorkerLost, match="was lost"):
        await track(pool, "one", frame_of(sheet, 1))
    assert (await track(pool, "two", frame_of(sheet, 1))).sequence_number == 1
    await until(lambda: pool.health().ready == 2)
    assert pool.health().restarts == pool.restarts + 1
    assert survivor in pool.process_ids()
    assert victim not in pool.process_ids()
    await pool.open("one", creation(sheet))
    assert (await track(pool, "one", frame_of(sheet, 1))).sequence_number == 1


@pytest.mark.slow
async def test_a_worker_that_sends_nonsense_is_replaced(pool, sheet):
    await pool.open("one", creation(sheet))
    worker = pool._placements["one"].worker
    worker._reader.feed_data(b"\xff" + wire.head(wire.Kind.RESULT, 1, "", 0)[1:])
    await until(lambda: pool.lost)
    with pytest.raises(WorkerLost):
        await track(pool, "one", frame_of(sheet, 1))
    await until(lambda: pool.health()[:3] == (2, 2, pool.restarts + 1))
    assert not is_running(worker.process.pid)


@pytest.mark.slow
async def test_a_call_in_progress_fails_when_its_worker_is_killed(pool, sheet):
    await pool.open("one", creation(sheet))
    placement = pool.process_ids()[0]
    os.kill(placement, signal.SIGSTOP)
    call = asyncio.create_task(track(pool, "one", frame_of(sheet, 1)))
    await asyncio.sleep(0.05)
    os.kill(placement, signal.SIGKILL)
    with pytest.raises(WorkerLost):
        await call


@pytest.mark.slow
async def test_a_hung_worker_is_replaced(implementation, sheet):
    pool = implementation(frame_timeout=1.0)
    async with running(pool):
        await pool.open("one", creation(sheet))
        os.kill(pool.process_ids()[0], signal.SIGSTOP)
        with pytest.raises(WorkerLost):
            await track(pool, "one", frame_of(sheet, 1))
        await until(lambda: pool.health().restarts == 1)


@pytest_asyncio.fixture(loop_scope="module")
async def recycling_pool(implementation):
    """One worker that is replaced after three frames, and a spare."""
    pool = implementation(1, spares=1, recycle_frames=3)
    async with running(pool):
        yield pool


@pytest.mark.slow
async def test_a_worker_is_recycled_without_losing_a_frame(recycling_pool, sheet):
    """Its results equal those of an undisturbed worker to the bit."""
    pool = recycling_pool
    for name in ("one", "two"):
        await pool.open(name, creation(sheet))
    (first,) = pool.process_ids()
    results, number = [], 0
    async with asyncio.timeout(180):
        while pool.health().recycled == 0 or number < 5:
            number += 1
            frame = frame_of(sheet, number, shift=(0.001 * number, 0, 0))
            results.append([await track(pool, name, frame, include_covariance=True) for name in ("one", "two")])
            await asyncio.sleep(0.02)
    assert first not in pool.process_ids()
    await until(lambda: not is_running(first))
    assert pool.health().restarts == 0
    undisturbed = TrackerHost(LIMITS)
    undisturbed.open("one", creation(sheet))
    options = pb.ResultOptions(include_covariance=True).SerializeToString()
    for i, pair in enumerate(results, 1):
        frame = frame_of(sheet, i, shift=(0.001 * i, 0, 0)).SerializeToString()
        content = undisturbed.frame("one", wire.frame_request_head(options, LIMITS.max_points) + frame)
        expected = pb.Result.FromString(b"".join(wire.unpack_result(content)))
        assert [(r.vertices, r.covariance) for r in pair] == [(expected.vertices, expected.covariance)] * 2
    await until(lambda: pool.health().spares == 1)


@pytest.mark.slow
async def test_a_worker_answers_what_it_was_asked_during_a_move_before_it_ends(sheet, monkeypatch):
    pool, asked = local(1, spares=1, recycle_frames=1), []

    async def call(worker, kind, *request):
        if kind is wire.Kind.RESTORE:  # in the successor
            os.kill(first, signal.SIGSTOP)
            asked.append(asyncio.ensure_future(pool.snapshot("one")))
            asyncio.get_running_loop().call_later(1.0, os.kill, first, signal.SIGCONT)
        return await carry_out(worker, kind, *request)

    async with running(pool):
        await pool.open("one", creation(sheet))
        (first,), carry_out = pool.process_ids(), pool._call
        monkeypatch.setattr(pool, "_call", call)
        await track(pool, "one", frame_of(sheet, 1))
        await until(lambda: pool.health().recycled == 1)
        assert len(await asyncio.wait_for(asked[0], 10.0)) > 0


@pytest.mark.slow
async def test_a_worker_whose_sessions_need_the_memory_is_recycled_once(sheet):
    """Its successor needs as much for them."""
    pool = local(1, spares=1, recycle_memory=1)
    async with running(pool):
        await pool.open("one", creation(sheet))
        await until(lambda: pool.health().recycled == 1 and pool.health().spares == 1)
        await asyncio.sleep(2.5)  # looks
        assert pool.health().recycled == 1
        await track(pool, "one", frame_of(sheet, 1))


@pytest.mark.slow
async def test_a_spare_takes_the_place_of_a_lost_worker_at_once(implementation, sheet):
    lost = []
    pool = implementation(1, spares=1, on_lost=lambda ids: lost.append((ids, pool.health().ready)))
    async with running(pool):
        await until(lambda: pool.health().spares == 1)
        await pool.open("one", creation(sheet))
        os.kill(pool.process_ids()[0], signal.SIGKILL)
        await until(lambda: lost)
        assert lost == [(["one"], 1)], "who is told finds a worker"
        await pool.open("one", creation(sheet))
        assert (await track(pool, "one", frame_of(sheet, 1))).sequence_number == 1
        await until(lambda: pool.health().spares == 1)


@pytest.mark.slow
async def test_a_checkpoint_is_of_the_moment_it_was_asked_for(pool, sheet):
    await pool.open("one", creation(sheet))
    await track(pool, "one", frame_of(sheet, 1))
    before = pool.snapshot("one", compressed=True)
    plain = pool.snapshot("one")
    after = track(pool, "one", frame_of(sheet, 2))
    before, plain, _ = await asyncio.gather(before, plain, after)
    assert Tracker.restore(before)._track.time == Tracker.restore(plain)._track.time == frame_of(sheet, 1).capture_time


@pytest.mark.slow
async def test_no_frame_waits_for_all_the_sessions_that_are_opened_meanwhile(implementation, sheet):
    """The first sessions of a lost worker continue while the last ones wait for their restore."""
    pool = implementation(1)
    async with running(pool):
        await pool.open("first", creation(sheet))
        opening = [asyncio.create_task(pool.open(f"s{i}", creation(sheet))) for i in range(8)]
        await asyncio.sleep(0)
        await track(pool, "first", frame_of(sheet, 1))
        assert not all(task.done() for task in opening)
        await asyncio.gather(*opening)


@pytest.mark.slow
async def test_frames_are_tracked_in_turn_and_late_ones_not_at_all(pool, sheet):
    """A session with many frames waits for a session with one."""
    for name in ("greedy", "other", "modest"):
        await pool.open(name, creation(sheet))
    assert pool._placements["greedy"].worker is pool._placements["modest"].worker
    order = []

    async def submit(name, numbers):
        for number in numbers:
            await track(pool, name, frame_of(sheet, number))
            order.append(name)

    await asyncio.gather(submit("greedy", range(1, 31)), submit("modest", range(1, 11)))
    assert order.index("modest") <= 2
    assert order[:18].count("modest") >= 8
    late = pool.submit("modest", frame_of(sheet, 11).SerializeToString(), b"", max_points=LIMITS.max_points, start_by=0.0)
    with pytest.raises(DeadlineExceeded):
        await late
    assert (await track(pool, "modest", frame_of(sheet, 11))).sequence_number == 11


@pytest.mark.slow
async def test_another_configuration_goes_on_from_the_same_state(pool, sheet):
    await pool.open("one", creation(sheet))
    await track(pool, "one", frame_of(sheet, 1))


    async def configure(gate: float) -> pb.Session:
        text = json.dumps({"associate": {"wide_gate": gate}})
        change = pb.UpdateSessionRequest(session=pb.Session(config_json=text, fabric="silk"))
        change.update_mask.paths.extend(("config_json", "fabric"))
        return pb.Session.FromString(await pool.configure("one", change.SerializeToString()))

    answer = await configure(0.05)
    assert (json.loads(answer.config_json)["associate"]["wide_gate"], answer.fabric) == (0.05, "silk")
    with pytest.raises(InvalidConfig, match="wide_gate"):
        await configure(-1)
    with pytest.raises(InvalidFrame, match="capture_time"):
        await track(pool, "one", frame_of(sheet, 1))
    assert (await track(pool, "one", frame_of(sheet, 2))).sequence_number == 2


@pytest_asyncio.fixture(scope="module", loop_scope="module")
async def single_pool(implementation):
    """One worker, which a session with a costly frame shares with another, and no spare."""
    pool = implementation(1, Limits(200_000, 20_000, 40_000, 1_000, 1))
    async with running(pool):
        yield pool


async def test_the_frames_after_a_costly_one_that_was_refused_leave_the_turns_to_others(single_pool, sheet, monkeypatch):
    """A frame is refused after its decoding, which may take as long as tracking."""
    pool = single_pool
    monkeypatch.setattr("ddakf_service.workers.placement.SLICE", 0.0)
    await pool.open("one", creation(sheet))
    with pytest.raises(InvalidFrame):
        await track(pool, "one", pb.Frame(sequence_number=1, point_cloud=pb.PointCloud(data=b"12", point_count=7)))
    (worker,) = pool._roster.accepting
    await worker.heavy_slots.acquire()
    waits = asyncio.create_task(track(pool, "one", frame_of(sheet, 1)))
    await asyncio.sleep(0.1)
    assert not waits.done()
    worker.heavy_slots.release()
    await waits
    await pool.close("one")


@pytest.mark.slow
async def test_a_costly_frame_does_not_hold_up_the_frames_of_others(single_pool, sheet):
    pool, large, order = single_pool, make_sheet(100, 0.01), []
    await pool.open("large", creation(large, '{"discretisation": {"working_edge": 0}}'))  # a working mesh would be cheap
    await pool.open("small", creation(sheet))
    await track(pool, "small", frame_of(sheet, 1))

    async def submit(name, sheet, numbers):
        for number in numbers:
            await track(pool, name, frame_of(sheet, number), max_points=200_000)
            order.append(name)

    noise = np.random.default_rng(0).normal(0.0, 0.004, (20 * len(large.vertices), 3))
    dense = large._replace(vertices=np.tile(large.vertices, (20, 1)) + noise)
    costly = asyncio.create_task(submit("large", dense, [1, 2]))
    await asyncio.sleep(0)
    await submit("small", sheet, range(2, 6))
    await costly
    assert order.index("large") >= 2, order
    for name in ("large", "small"):
        await pool.close(name)


@pytest.mark.slow
async def test_an_isolated_session_continues_exactly_in_a_worker_of_low_priority(single_pool, sheet):
    pool, (shared,) = single_pool, single_pool.process_ids()
    for name in ("moved", "stays"):
        await pool.open(name, creation(sheet))
        await track(pool, name, frame_of(sheet, 1))
    await asyncio.gather(*(pool.isolate("moved") for _ in range(2)))
    assert pool.process_ids() == [shared]
    own = pool._placements["moved"].worker.process.pid
    assert own != shared
    if own in workers(os.getpid()):  # of this machine, and no actor
        niceness = {os.getpriority(os.PRIO_PROCESS, int(thread)) for thread in os.listdir(f"/proc/{own}/task")}
        assert min(niceness) > os.getpriority(os.PRIO_PROCESS, shared)
    moved, stayed = [await track(pool, i, frame_of(sheet, 2), include_covariance=True) for i in ("moved", "stays")]
    assert (moved.vertices, moved.covariance) == (stayed.vertices, stayed.covariance)
    await pool.close("moved")
    await until(lambda: not is_running(own))
    assert (await track(pool, "stays", frame_of(sheet, 3))).sequence_number == 3
    await pool.close("stays")


@pytest.mark.slow
async def test_sessions_beyond_a_worker_s_memory_are_refused(implementation, sheet):
    pool = implementation(1, max_memory=100.0)
    async with running(pool):
        await pool.open("one", creation(sheet), Memory(30, 20))
        await pool.open("two", creation(sheet), Memory(20, 20))  # both may be tracked at a time
        with pytest.raises(ResourceExhausted, match="memory") as caught:
            await pool.open("three", creation(sheet), Memory(20, 0))
        assert caught.value.retry_after > 0
        await pool.close("two")
        await pool.open("three", creation(sheet), Memory(20, 0))


@pytest.mark.slow
async def test_stopping_leaves_no_process(implementation):
    pool = implementation()
    await pool.start(lambda *_: None)
    pids = pool.process_ids()
    assert len(pids) == 2
    await pool.stop()
    await until(lambda: not any(is_running(pid) for pid in pids))  # Ray ends its processes by itself
