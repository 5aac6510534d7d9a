"""Checkpoints: the newest complete one is read, damaged ones are skipped, a full disk loses no session."""

from __future__ import annotations

import hashlib
import os
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.metrics import Metrics
from ddakf_service.store.files.checkpoints import Checkpoint, Checkpoints, DamagedCheckpoint, pack, unpack
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf.errors import InvalidConfig

from ..conftest import PATIENCE, fill


def snapshot(number: int, size: int = 1000) -> Checkpoint:
    session = pb.Session(name="sessions/s", statistics=pb.SessionStatistics(frames_applied=number))
    state = pb.SessionSnapshot(session=session, data=number.to_bytes(4, "little") * (size // 4))
    return Checkpoint(state, (b"an answer", b"", bytes(number)))


@pytest.fixture(params=["file", "memory"])
def where(request, tmp_path):
    return tmp_path.as_uri() if request.param == "file" else f"memory://{tmp_path.name}"


@pytest.fixture
def opened(metrics):
    """Opens checkpoints and closes them at the end."""
    made = []

    def open_(url: str, *, keep: int = 2, server_id: str = "here") -> Checkpoints:
        made.append(Checkpoints(url, server_id, keep, metrics))
        made[-1].open()
        return made[-1]

    yield open_
    for checkpoints in made:
        checkpoints.close()


def files(folder: Path) -> list[Path]:
    """Complete checkpoints; beside them the writing thread probes a disk that was full."""
    return sorted(folder.rglob("*.checkpoint"))


async def test_the_newest_comes_back_after_a_restart(opened, where):
    checkpoints = opened(where)
    for number in range(1, 5):
        checkpoints.save(7, snapshot(number))
        assert checkpoints.flush(PATIENCE)
    checkpoints.save(8, snapshot(9))
    checkpoints.close()
    again = opened(where)
    assert await again.newest(7) == snapshot(4)
    assert await again.newest(8) == snapshot(9)
    assert await again.newest(9) is None
    again.save(7, snapshot(5))
    again.flush(PATIENCE)
    assert await again.newest(7) == snapshot(5)


async def test_what_waits_is_the_newest_already(opened, where, metrics):
    checkpoints = Checkpoints(where, "here", 2, metrics)  # nothing is written before it is opened
    checkpoints.save(7, snapshot(1))
    checkpoints.save(7, snapshot(2))
    assert await checkpoints.newest(7) == snapshot(2)
    checkpoints.open()
    checkpoints.close()
    assert await opened(where).newest(7) == snapshot(2)


def test_only_so_many_generations_are_kept(opened, tmp_path):
    checkpoints = opened(str(tmp_path), keep=3)
    for number in range(6):
        checkpoints.save(7, snapshot(number))
        checkpoints.flush(PATIENCE)
    assert len(files(tmp_path)) == 3


async def test_a_later_lease_is_newer_whatever_an_earlier_one_still_writes(opened, tmp_path):
    """Nor does the earlier server delete what the later one has written."""
    earlier, later = opened(str(tmp_path)), opened(str(tmp_path))
    for number in (1, 2, 3):
        earlier.save(7, snapshot(number)._replace(epoch=1))
        earlier.flush(PATIENCE)
    later.save(7, snapshot(4)._replace(epoch=2))
    assert later.flush(PATIENCE)
    for number in (5, 6, 7):
        earlier.save(7, snapshot(number)._replace(epoch=1))
        assert earlier.flush(PATIENCE)
    assert await later.newest(7) == snapshot(4)
    assert len(files(tmp_path)) == 2
    assert await later.stored() == [7]


async def test_what_waits_is_older_than_what_a_later_lease_has_written(opened, tmp_path, metrics):
    """A server that could not write for a while goes on where the session's next server has left it."""
    cut_off, later = Checkpoints(str(tmp_path), "here", 2, metrics), opened(str(tmp_path))
    cut_off.save(7, snapshot(2)._replace(epoch=1))
    assert await cut_off.newest(7) == snapshot(2)._replace(epoch=1), "nothing is stored"
    later.save(7, snapshot(1)._replace(epoch=1))
    assert later.flush(PATIENCE)
    assert await cut_off.newest(7) == snapshot(2)._replace(epoch=1)
    later.save(7, snapshot(3)._replace(epoch=2))
    assert later.flush(PATIENCE)
    assert await cut_off.newest(7) == snapshot(3)


async def test_a_written_checkpoint_is_known(opened, tmp_path):
    checkpoints = opened(str(tmp_path))
    assert await checkpoints.written(7, 0.0), "nothing waits"
    checkpoints.save(7, snapshot(1))
    assert await checkpoints.written(7, PATIENCE)
    assert len(files(tmp_path)) == 1


async def test_ended_sessions_leave_nothing(opened, tmp_path):
    checkpoints, other = opened(str(tmp_path)), opened(str(tmp_path), server_id="there")
    for uid in (1, 2, 3):
        checkpoints.save(uid, snapshot(uid))
    other.save(4, snapshot(4))
    assert checkpoints.flush(PATIENCE)
    assert other.flush(PATIENCE)
    checkpoints.delete(1)
    checkpoints.delete(3)
    assert checkpoints.flush(PATIENCE)
    assert [await checkpoints.newest(uid) for uid in (1, 2, 3)] == [None, snapshot(2), None]
    assert await other.newest(4) == snapshot(4)
    assert len(files(tmp_path)) == 2


def spoil(data: bytes) -> dict[str, bytes]:
    return {
        "cut short": data[: len(data) // 2],
        "empty": b"",
        "a bit flipped": data[:-9] + bytes([data[-9] ^ 1]) + data[-8:],
        "longer": data + b"\0",
        "another version": data[:8] + (99).to_bytes(4, "little") + data[12:],
        "something else": b"x" * len(data),
    }


@pytest.mark.parametrize("how", spoil(bytes(100)))
async def test_damaged_ones_are_passed_over(opened, tmp_path, how, caplog):
    checkpoints = opened(str(tmp_path))
    for number in (1, 2):
        checkpoints.save(7, snapshot(number))
        assert checkpoints.flush(PATIENCE)
    before, newest = files(tmp_path)
    newest.write_bytes(spoil(newest.read_bytes())[how])
    assert await checkpoints.newest(7) == snapshot(1)
    assert newest.name in str([vars(line).get("file") for line in caplog.records])
    before.write_bytes(b"")
    assert await checkpoints.newest(7) is None


async def test_a_write_that_was_cut_off_counts_for_nothing(opened, tmp_path):
    checkpoints = opened(str(tmp_path))
    checkpoints.save(7, snapshot(1))
    checkpoints.flush(PATIENCE)
    (whole,) = files(tmp_path)
    whole.with_name("000000000002.checkpoint.unfinished").write_bytes(whole.read_bytes())
    assert await checkpoints.newest(7) == snapshot(1)
    checkpoints.save(7, snapshot(2))
    checkpoints.flush(PATIENCE)
    assert await checkpoints.newest(7) == snapshot(2)


def test_one_counts_before_the_disk_has_it_and_the_older_ones_go_afterwards(opened, tmp_path, monkeypatch):
    """A slow disk then costs a killed server no frames, and a power cut no checkpoint."""
    left, checkpoints = [], opened(str(tmp_path), keep=1)
    monkeypatch.setattr(os, "fsync", lambda _: left.append([unpack(path.read_bytes()) for path in files(tmp_path)]))
    for number in (1, 2):
        checkpoints.save(7, snapshot(number))
        assert checkpoints.flush(PATIENCE)
    assert left == [[snapshot(1)], [snapshot(1), snapshot(2)]]
    assert len(files(tmp_path)) == 1


async def test_one_that_does_not_reach_the_disk_counts_for_nothing(opened, tmp_path, monkeypatch):
    def fail(_):
        raise OSError("input/output error")

    checkpoints = opened(str(tmp_path))
    checkpoints.save(7, snapshot(1))
    assert checkpoints.flush(PATIENCE)
    monkeypatch.setattr(os, "fsync", fail)
    checkpoints.save(7, snapshot(2))
    while "input/output" not in checkpoints.condition.problem:
        assert not checkpoints.flush(0.01)
    assert [unpack(path.read_bytes()) for path in files(tmp_path)] == [snapshot(1)]
    monkeypatch.undo()
    assert checkpoints.flush(PATIENCE)
    assert await checkpoints.newest(7) == snapshot(2)


@given(st.binary(max_size=200), st.lists(st.binary(max_size=9), max_size=3))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_refused_or_whole(data, answers):
    with pytest.raises(DamagedCheckpoint):
        unpack(data)
    with pytest.raises(DamagedCheckpoint):
        unpack(framed(2, data + b"\xff" * 9))
    whole = Checkpoint(pb.SessionSnapshot(data=data), tuple(answers))
    assert unpack(pack(whole)) == whole


def framed(version: int, body: bytes) -> bytes:
    """A checkpoint whose checksum is right."""
    return struct.pack("<8sI32sQ", b"DDAKFCKP", version, hashlib.sha256(body).digest(), len(body)) + body


def test_one_without_answers_is_that_of_an_earlier_version():
    state = pb.SessionSnapshot(data=b"state")
    assert unpack(framed(1, state.SerializeToString())) == Checkpoint(state)
    with pytest.raises(DamagedCheckpoint, match="version is 3"):
        unpack(framed(3, b""))


def test_unknown_urls_are_refused(metrics):
    with pytest.raises(InvalidConfig, match="checkpoint_url"):
        Checkpoints("nothing://there", "here", 2, metrics)


async def test_a_full_disk_keeps_the_last_snapshot_in_memory(small_disk, opened, metrics):
    def up():
        return metrics.registry.get_sample_value("ddakf_store_up", {"part": "checkpoints"})

    checkpoints = opened(str(small_disk))
    checkpoints.save(7, snapshot(1, size=300_000))
    assert checkpoints.flush(PATIENCE)
    fill(small_disk)
    checkpoints.save(7, snapshot(2, size=300_000))
    while not checkpoints.condition.problem:
        assert not checkpoints.flush(0.05)
    assert up() == 0
    assert "No space" in checkpoints.condition.problem
    assert await checkpoints.newest(7) == snapshot(2, size=300_000)
    (first,) = files(small_disk)
    while list(first.parent.iterdir()) != [first]:  # nothing unfinished is left between two attempts
        assert not checkpoints.flush(0.01)
    (small_disk / "ballast").unlink()
    assert checkpoints.flush(PATIENCE)
    assert up() == 1
    assert checkpoints.condition.problem == ""
    assert await checkpoints.newest(7) == snapshot(2, size=300_000)


async def test_a_disk_with_room_again_counts_as_working_though_nothing_is_left_to_write(small_disk, opened, monkeypatch):
    """The session whose checkpoint found no room has ended, and an idle one writes none."""
    monkeypatch.setattr("ddakf_service.store.files.checkpoints._LONGEST_PAUSE", 0.5)
    checkpoints, size = opened(str(small_disk)), 300_000
    for uid in (7, 8):
        checkpoints.save(uid, snapshot(1, size))
        assert checkpoints.flush(PATIENCE)
    fill(small_disk)
    checkpoints.save(7, snapshot(2, size))
    while not checkpoints.condition.problem:
        assert not checkpoints.flush(0.05)
    checkpoints.delete(7)
    assert checkpoints.flush(PATIENCE)
    begun = time.monotonic()
    (small_disk / "ballast").unlink()
    while checkpoints.condition.problem:
        assert time.monotonic() < begun + PATIENCE, "the problem stays"
        time.sleep(0.05)
    assert await checkpoints.newest(8) == snapshot(1, size)
    assert len(files(small_disk)) == 1


def test_what_cannot_be_deleted_keeps_nothing_from_being_written(opened, tmp_path, monkeypatch):
    checkpoints = opened(str(tmp_path))

    def refuse(*_, **__):
        raise PermissionError("not yours")

    monkeypatch.setattr(checkpoints._files, "rm", refuse)
    checkpoints.delete(7)
    while "not yours" not in checkpoints.condition.problem:
        assert not checkpoints.flush(0.01)
    checkpoints.save(8, snapshot(1))
    while not files(tmp_path):
        assert not checkpoints.flush(0.01)
    monkeypatch.undo()
    assert checkpoints.flush(PATIENCE)
    assert [unpack(path.read_bytes()) for path in files(tmp_path)] == [snapshot(1)]


def test_a_process_killed_while_it_writes_leaves_a_whole_checkpoint(tmp_path):
    """Repeated, with kills at different moments."""
    program = f"""
import itertools
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.store.files.checkpoints import Checkpoint, Checkpoints
from ddakf_service.observability.metrics import Metrics
checkpoints = Checkpoints({str(tmp_path)!r}, "here", 2, Metrics())
checkpoints.open()
for number in itertools.count():
    checkpoints.save(7, Checkpoint(pb.SessionSnapshot(data=number.to_bytes(4, "little") * 500_000)))
    checkpoints.flush(60)
    print(number, flush=True)
"""
    with subprocess.Popen([sys.executable, "-c", program], stdout=subprocess.PIPE) as process:
        for _ in range(5):
            last = int(process.stdout.readline())
        process.kill()
    found = Checkpoints(str(tmp_path), "here", 2, Metrics())._read_newest(7)
    assert int.from_bytes(found.snapshot.data[:4], "little") >= last
