"""The worker pool's contract, for every implementation of it."""

from __future__ import annotations

import asyncio
import os
import signal

import numpy as np
import pytest
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh, unpack
from ddakf_api.errors import InvalidFrame, InvalidMesh, InvalidSnapshot, SessionNotFound, Unavailable, WorkerLost
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.workers import Limits
from ddakf_service.workers.local import LocalPool, WorkerStartFailed

from .conftest import frame_of, is_running

LIMITS = Limits(max_points=5_000, max_vertices=1_000, max_faces=2_000, max_body_vertices=1_000)


def local(**options) -> LocalPool:
    return LocalPool(2, LIMITS, **{"frame_timeout": 20.0, "warm_timeout": 300.0, **options})


IMPLEMENTATIONS = [pytest.param(local, id="local")]


@pytest.fixture(params=IMPLEMENTATIONS)
async def pool(request):
    lost: list[str] = []
    pool = request.param(on_lost=lost.extend)
    pool.lost = lost
    await pool.start(lambda *_: None)
    try:
        yield pool
    finally:
        await pool.stop()


def creation(sheet) -> bytes:
    session = pb.Session(garment=pack_mesh(*sheet))
    return pb.CreateSessionRequest(api_version=API_VERSION, session=session).SerializeToString()


async def track(pool, session_id: str, frame: pb.Frame, **options) -> pb.Result:
    payload = await pool.submit(session_id, frame.SerializeToString(), pb.ResultOptions(**options).SerializeToString())
    return pb.Result.FromString(payload)


async def until(condition, seconds: float = 60.0) -> None:
    async with asyncio.timeout(seconds):
        while not condition():
            await asyncio.sleep(0.01)


@pytest.mark.slow
async def test_sessions_live_where_they_were_opened(pool, sheet):
    assert pool.health() == (2, 2, 0)
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
    with pytest.raises(InvalidFrame, match="vertex_encoding"):
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
    await until(lambda: pool.lost, 2.0)
    assert pool.lost == ["one"]
    with pytest.raises(WorkerLost, match="create the session anew"):
        await track(pool, "one", frame_of(sheet, 1))
    assert (await track(pool, "two", frame_of(sheet, 1))).sequence_number == 1
    await until(lambda: pool.health().ready == 2)
    assert pool.health().restarts == 1
    assert survivor in pool.process_ids()
    assert victim not in pool.process_ids()
    await pool.open("one", creation(sheet))
    assert (await track(pool, "one", frame_of(sheet, 1))).sequence_number == 1


@pytest.mark.slow
async def test_a_worker_that_sends_nonsense_is_replaced(pool, sheet):
    await pool.open("one", creation(sheet))
    worker = pool._homes["one"]
    worker._reader.feed_data(b"\xff" + bytes(14))
    await until(lambda: pool.lost, 5.0)
    with pytest.raises(WorkerLost):
        await track(pool, "one", frame_of(sheet, 1))
    await until(lambda: pool.health() == (2, 2, 1))
    assert not is_running(worker.process.pid)


@pytest.mark.slow
async def test_a_call_in_progress_fails_when_its_worker_is_killed(pool, sheet):
    await pool.open("one", creation(sheet))
    home = pool.process_ids()[0]
    os.kill(home, signal.SIGSTOP)
    call = asyncio.create_task(track(pool, "one", frame_of(sheet, 1)))
    await asyncio.sleep(0.05)
    os.kill(home, signal.SIGKILL)
    with pytest.raises(WorkerLost):
        await asyncio.wait_for(call, 2.0)


@pytest.mark.slow
@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
async def test_a_hung_worker_is_replaced(implementation, sheet):
    pool = implementation(frame_timeout=1.0)
    await pool.start(lambda *_: None)
    try:
        await pool.open("one", creation(sheet))
        os.kill(pool.process_ids()[0], signal.SIGSTOP)
        with pytest.raises(WorkerLost):
            await track(pool, "one", frame_of(sheet, 1))
        await until(lambda: pool.health().restarts == 1)
    finally:
        await pool.stop()


@pytest.mark.slow
@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
async def test_stopping_leaves_no_process(implementation):
    pool = implementation()
    await pool.start(lambda *_: None)
    pids = pool.process_ids()
    assert len(pids) == 2
    await pool.stop()
    assert not any(is_running(pid) for pid in pids)


async def test_without_a_ready_worker_sessions_are_refused(sheet):
    with pytest.raises(Unavailable) as caught:
        await local().open("one", creation(sheet))
    assert caught.value.retry_after > 0


async def test_a_worker_that_is_not_ready_in_time_fails_the_start():
    pool = local(warm_timeout=0.01)
    with pytest.raises(WorkerStartFailed):
        await pool.start(lambda *_: None)
    await pool.stop()


async def test_an_unknown_session_of_a_worker_is_not_found():
    with pytest.raises(SessionNotFound):
        compute().frame("none", b"\0\0\0\0")


def compute():
    from ddakf_service.workers.compute import Compute

    return Compute(LIMITS)
