"""Pool of local processes in situations that no client can cause."""

from __future__ import annotations

import asyncio
import math
import os
import subprocess
from dataclasses import replace

import pytest
from ddakf_api.errors import SessionNotFound, Unavailable
from ddakf_service.workers.compute.tracker_host import TrackerHost
from ddakf_service.workers.messages import wire
from ddakf_service.workers.placement import Placement
from ddakf_service.workers.pool import Limits, Memory
from ddakf_service.workers.worker import WorkerStartFailed

from ddakf.errors import FrameTooCostly

from ..conftest import frame_of
from .test_pool import LIMITS, creation, local


async def test_without_a_ready_worker_sessions_are_refused(sheet):
    with pytest.raises(Unavailable) as caught:
        await local().open("one", creation(sheet))
    assert caught.value.retry_after > 0


class Worker:
    """Records its sessions and messages."""

    def __init__(self):
        self.sessions, self.told = {}, []
        self.placement_lock = asyncio.Lock()

    def release(self, session_id):
        return self.sessions.pop(session_id, None)

    def send_without_answer(self, kind, session_id):
        self.told.append((kind, session_id))

    def memory_with(self, more):
        return 0


async def test_a_session_that_is_opened_once_more_leaves_nothing_where_it_was(monkeypatch):
    pool, old, new = local(), Worker(), Worker()
    pool._roster.accepting.append(new)
    pool._placements["one"], old.sessions["one"] = Placement(old), Memory(1, 1)

    async def call(worker, kind, session_id, request=b""):
        return b""

    monkeypatch.setattr(pool, "_call", call)
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
