"""Pool of local processes in situations that no client can cause."""

from __future__ import annotations

import asyncio
import math
import os
import subprocess
from dataclasses import replace

import pytest
from ddakf_api.errors import ResourceExhausted, SessionNotFound, Unavailable
from ddakf_service.workers import worker
from ddakf_service.workers.compute.tracker_host import TrackerHost
from ddakf_service.workers.messages import wire
from ddakf_service.workers.placement import Placement
from ddakf_service.workers.pool import Limits, Memory
from ddakf_service.workers.process_pool import ProcessPool
from ddakf_service.workers.worker import WorkerStartFailed

from ddakf.errors import FrameTooCostly

from ..conftest import frame_of
from .test_pool import LIMITS, creation, local


async def test_without_a_ready_worker_sessions_are_refused(sheet):
    with pytest.raises(Unavailable) as caught:
        await local().open("one", creation(sheet))
    assert caught.value.retry_after > 0


async def test_workers_end_before_the_connection_to_their_cluster():
    """Whoever waits for an actor on a closed connection fails, and the server with him."""
    ended = []

    class Source:
        async def end(self, patience):
            ended.append("source")

    class Leaving(worker.Worker):
        async def end(self, patience=0.0):
            await asyncio.sleep(0.01)
            ended.append("worker")

    pool = local(2, source=Source())
    pool._roster.accepting += [Leaving(None, None, None) for _ in range(2)]
    await pool.stop()
    assert ended == ["worker", "worker", "source"]


class Worker(worker.Worker):
    """Records the messages without an answer."""

    def __init__(self):
        super().__init__(None, None, None)
        self.told = []

    def send_without_answer(self, kind, session_id):
        self.told.append((kind, session_id))


@pytest.fixture
def staffed(monkeypatch):
    """Makes a pool whose workers answer every call with nothing."""

    async def call(worker, kind, session_id, request=b""):
        return b""

    def make(size: int, **options) -> tuple[ProcessPool, list[worker.Worker]]:
        pool = local(size, **options)
        monkeypatch.setattr(pool, "_call", call)
        pool._roster.accepting += [Worker() for _ in range(size)]
        return pool, pool._roster.accepting

    return make


@pytest.mark.parametrize("size", [1, 3, 8])
async def test_sessions_are_spread_evenly_over_the_workers(staffed, size):
    pool, workers = staffed(size)
    for number in range(5 * size):
        await pool.open(str(number), b"")
        assert max(len(worker.sessions) for worker in workers) == number // size + 1
    for session_id in list(workers[0].sessions):
        await pool.close(session_id)
    for number in range(5):
        await pool.open(f"again-{number}", b"")
    assert {len(worker.sessions) for worker in workers} == {5}


async def test_a_session_goes_to_a_worker_that_has_the_memory_for_it(staffed):
    """Also where another one has fewer sessions; no worker goes beyond its limit."""
    pool, workers = staffed(2, max_memory=100.0)
    await pool.open("large", b"", Memory(90, 0))
    for number in range(4):
        await pool.open(str(number), b"", Memory(20, 0))
    with pytest.raises(ResourceExhausted, match="memory"):
        await pool.open("more", b"", Memory(21, 0))
    await pool.open("last", b"", Memory(20, 0))
    assert [list(worker.sessions) for worker in workers] == [["large"], ["0", "1", "2", "3", "last"]]
    assert [worker.memory_with() for worker in workers] == [90, 100]


async def test_the_time_of_a_configuration_begins_when_the_worker_is_free_to_build(staffed, monkeypatch):
    """Otherwise changes that queue in a healthy worker would exceed the time of a call, for which it is ended."""
    pool, _ = staffed(1)
    for name in ("one", "two"):
        await pool.open(name, b"")
    sent, answered = [], asyncio.Event()

    async def call(worker, kind, session_id, request=b""):
        sent.append(session_id)
        await answered.wait()
        return b""

    monkeypatch.setattr(pool, "_call", call)
    calls = asyncio.gather(pool.configure("one", b""), pool.configure("two", b""), pool.open("new", b""))
    for _ in range(10):
        await asyncio.sleep(0)
    assert sent == ["one"]
    answered.set()
    await calls
    assert sent == ["one", "two", "new"]


async def test_what_a_session_needs_can_change(staffed):
    pool, (worker,) = staffed(1, max_memory=100.0)
    await pool.open("one", b"", Memory(10, 0))
    await pool.open("two", b"", Memory(20, 0))
    pool.count_memory("one", Memory(80, 0))
    with pytest.raises(ResourceExhausted, match="memory"):
        pool.count_memory("two", Memory(21, 0))
    assert worker.sessions == {"one": Memory(80, 0), "two": Memory(20, 0)}


async def test_a_session_that_is_opened_once_more_leaves_nothing_where_it_was(staffed):
    (pool, (new,)), old = staffed(1), Worker()
    pool._placements["one"], old.sessions["one"] = Placement(old), Memory(1, 1)
    await pool.open("one", b"", Memory(2, 2))
    assert (old.sessions, old.told) == ({}, [(wire.Kind.CLOSE, "one")])
    assert (new.sessions, new.told) == ({"one": Memory(2, 2)}, [])


async def test_a_session_that_is_lost_while_it_moves_stays_nowhere(monkeypatch):
    """Its worker dies after the answer to the snapshot; the restore must not find the moved session."""

    pool, old, new = local(), Worker(), Worker()
    old.sessions["one"] = Memory(1, 1)
    placement = pool._placements["one"] = Placement(old)

    async def call(worker, kind, session_id, request=b""):
        if worker is new:
            del pool._placements["one"]
        return b""

    monkeypatch.setattr(pool, "_call", call)
    await pool._move("one", old, new)
    assert placement.worker is old
    assert new.sessions == {}
    assert new.told == [(wire.Kind.CLOSE, "one")]


async def test_a_process_that_cannot_be_started_leaves_no_descriptor(monkeypatch):
    def refuse(*_, **__):
        raise OSError("no more processes")

    monkeypatch.setattr(subprocess, "Popen", refuse)
    pool, counts = local(), []
    for _ in range(3):
        with pytest.raises(OSError, match="no more processes"):
            await pool.start(lambda *_: None)
        await asyncio.sleep(0)  # a transport closes its socket a moment later
        counts.append(len(os.listdir("/proc/self/fd")))
    assert counts[0] == counts[2]


async def test_a_worker_that_is_not_ready_in_time_fails_the_start():
    pool = local(warm_timeout=0.01)
    with pytest.raises(WorkerStartFailed):
        await pool.start(lambda *_: None)
    await pool.stop()


def test_a_frame_beyond_its_limit_changes_nothing_in_its_worker(sheet):
    """Its decoding counts: a part of the limit may be used up before the first stage."""
    limits = replace(LIMITS, frame_limit=1e-6)
    host, undisturbed = TrackerHost(limits), TrackerHost(LIMITS)
    head = wire.frame_request_head(b"", LIMITS.max_points)
    for each in (host, undisturbed):
        each.open("one", creation(sheet))
    for number in (1, 2):
        with pytest.raises(FrameTooCostly, match="processor time"):
            host.frame("one", head + frame_of(sheet, number).SerializeToString())
    host._limits = LIMITS
    good = head + frame_of(sheet, 1).SerializeToString()
    ours, theirs = (bytes(wire.unpack_result(each.frame("one", good))[1]) for each in (host, undisturbed))
    assert ours == theirs


def test_a_limit_grows_with_garment_and_cloud():
    limits = replace(LIMITS, frame_limit=0.5)
    assert limits.processor_limit(0, 0) == 0.5
    assert limits.processor_limit(20_000, 0) == limits.processor_limit(0, 100_000) == 1.0
    assert Limits.from_json(limits.to_json()) == limits
    assert Limits.from_json(LIMITS.to_json()).processor_limit(10, 10) == math.inf


def test_an_unknown_session_of_a_worker_is_not_found():
    with pytest.raises(SessionNotFound):
        TrackerHost(LIMITS).frame("none", wire.frame_request_head(b"", 1))
