"""History: sums are right at every resolution, from memory, from the database and from both."""

from __future__ import annotations

from typing import NamedTuple

import pytest
from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.store.tables.database import Database
from ddakf_service.store.tables.history import History
from ddakf_service.store.tables.session_record import new_uid

from ..conftest import PATIENCE


class Clock:
    """Seconds since 1970, set by the test."""

    def __init__(self, now: float):
        self.now = now

    def __call__(self) -> float:
        return self.now


class Parts(NamedTuple):
    """A history on a database, with a clock that starts at a round number, and a session that starts with it."""

    database: Database
    history: History
    clock: Clock
    uid: int
    created: int

    async def query(self, start: int | None = None, end: int | None = None, **fields) -> pb.SessionHistory:
        request = pb.GetSessionHistoryRequest(name="sessions/watched", **fields)
        for name, seconds in (("start_time", start), ("end_time", end)):
            if seconds is not None:
                getattr(request, name).seconds = seconds
        return await self.history.query(request, self.uid, self.created)

    def track_every_second(self, seconds: int) -> None:
        """One frame per second from the start."""
        for second in range(seconds):
            self.clock.now = self.created + second
            track(self.history, self.uid, 1)


@pytest.fixture
def parts(opened, url) -> Parts:
    def attach(database):
        made.append(History(database, 1e9, clock))

    made, clock = [], Clock(1_700_000_000.0)
    database = opened(url, attach=attach)
    parts = Parts(database, made[0], clock, new_uid(), int(clock.now))
    parts.history.state(parts.uid, pb.SESSION_STATE_INITIALIZING)
    return parts


def track(history: History, uid: int, count: int, reliability: float = 0.5, latency: float = 0.01) -> None:
    for _ in range(count):
        history.applied(uid, pb.Result(reliability=reliability, paper_score=0.25, coverage=0.75), latency)


async def test_a_second_is_one_sample(parts):
    _, history, clock, uid, _ = parts
    track(history, uid, 3, reliability=0.5, latency=0.01)
    track(history, uid, 1, reliability=0.1, latency=0.05)
    history.count(uid, "dropped", 4)
    history.count(uid, "late")
    history.count(uid, "rejected", 2)
    (sample,) = (await parts.query()).samples
    assert sample.start_time.seconds == int(clock.now)
    assert (sample.frames_applied, sample.frames_dropped, sample.frames_late, sample.frames_rejected) == (4, 4, 1, 2)
    assert sample.reliability == pytest.approx(0.4)
    assert sample.least_reliability == pytest.approx(0.1)
    assert (sample.paper_score, sample.coverage) == (0.25, 0.75)
    assert (sample.latency, sample.greatest_latency) == pytest.approx((0.02, 0.05))


@pytest.mark.parametrize("written", ["nothing", "half", "all"])
async def test_any_resolution_holds_every_frame(parts, written):
    database, history, clock, uid, _ = parts
    start = int(clock.now)
    for second in range(40):
        clock.now = start + second
        if second % 7 != 3:  # seconds without a frame have no sample
            track(history, uid, 1 + second % 3, reliability=second / 40)
        if written == "all" or (written == "half" and second < 20):
            assert database.flush(PATIENCE)
    fine = await parts.query()
    assert fine.resolution == 1
    assert [s.start_time.seconds - start for s in fine.samples] == [s for s in range(40) if s % 7 != 3]
    for step in (3, 10, 100):
        coarse = await parts.query(resolution=step)
        assert coarse.resolution == step
        for sample in coarse.samples:
            begin = sample.start_time.seconds
            within = [s for s in fine.samples if begin <= s.start_time.seconds < begin + step]
            assert sample.frames_applied == sum(s.frames_applied for s in within)
            mean = sum(s.reliability * s.frames_applied for s in within) / sample.frames_applied
            assert sample.reliability == pytest.approx(mean)
            assert sample.least_reliability == min(s.least_reliability for s in within)
        assert sum(s.frames_applied for s in coarse.samples) == sum(s.frames_applied for s in fine.samples)


async def test_never_more_samples_than_asked_for(parts):
    parts.track_every_second(101)
    for most in (1, 2, 7, 50, 101):
        answer = await parts.query(max_samples=most)
        assert 0 < len(answer.samples) <= most
        assert sum(s.frames_applied for s in answer.samples) == 101


@pytest.mark.parametrize("end", [1_700_000_002, 1 << 31, 1 << 39, (1 << 40) - 1])
async def test_any_end_is_answered_at_once(parts, end):
    parts.track_every_second(2)
    for most in (0, 1, 2, 10_000):
        answer = await parts.query(end=end, max_samples=most)
        assert 0 < len(answer.samples) <= (most or 500)
        assert sum(s.frames_applied for s in answer.samples) == 2


async def test_a_single_sample_is_no_finer_than_asked_for(parts):
    parts.track_every_second(101)
    for resolution in (1, 3, 7, 100, 1000):
        answer = await parts.query(max_samples=1, resolution=resolution)
        assert len(answer.samples) == 1
        assert answer.resolution >= resolution


async def test_a_span_holds_its_seconds_alone(parts):
    parts.track_every_second(10)
    assert parts.database.flush(PATIENCE)
    answer = await parts.query(start=parts.created + 2, end=parts.created + 5)
    assert [s.start_time.seconds - parts.created for s in answer.samples] == [2, 3, 4]


async def test_states_are_recorded_when_they_change(parts):
    database, history, clock, uid, _ = parts
    states = (pb.SESSION_STATE_INITIALIZING, pb.SESSION_STATE_TRACKING, pb.SESSION_STATE_TRACKING, pb.SESSION_STATE_LOST)
    for state in states:
        history.state(uid, state)
        clock.now += 10
    database.flush(PATIENCE)
    history.close(uid, pb.SESSION_STATE_CLOSED)
    answer = await parts.query()
    wanted = [pb.SESSION_STATE_INITIALIZING, pb.SESSION_STATE_TRACKING, pb.SESSION_STATE_LOST, pb.SESSION_STATE_CLOSED]
    assert [change.state for change in answer.state_changes] == wanted
    assert [change.time.seconds - parts.created for change in answer.state_changes] == [0, 10, 30, 40]
    later = await parts.query(start=int(clock.now) - 5)
    assert [change.state for change in later.state_changes] == wanted[2:]  # the one in force, and the one that follows


async def test_a_clock_that_is_set_back_overwrites_nothing(parts):
    _, history, clock, uid, _ = parts
    track(history, uid, 2)
    clock.now += 1
    track(history, uid, 2)
    clock.now -= 1
    track(history, uid, 2)
    clock.now += 2
    assert sum(s.frames_applied for s in (await parts.query()).samples) == 6


async def test_a_clock_that_is_set_back_hides_nothing(parts):
    _, history, clock, uid, _ = parts
    clock.now += 50
    track(history, uid, 2)
    clock.now -= 100
    assert sum(s.frames_applied for s in (await parts.query()).samples) == 2


async def test_what_makes_no_sense_is_refused(parts):
    for bad, field in (
        ({"start": parts.created + 10, "end": parts.created}, "end_time"),
        ({"resolution": -1.0}, "resolution"),
        ({"resolution": float("nan")}, "resolution"),
        ({"start": -1}, "start_time"),
    ):
        with pytest.raises(InvalidArgument) as caught:
            await parts.query(**bad)
        assert caught.value.field == field


async def test_old_rows_are_forgotten(opened, url):
    async def count() -> tuple[int, int]:
        answer = await histories[-1].query(pb.GetSessionHistoryRequest(), uid, 0.0)
        return len(answer.samples), len(answer.state_changes)

    histories, uid = [], new_uid()
    database = opened(url, attach=lambda database: histories.append(History(database, 100.0, Clock(1000.0))))
    histories[0].state(uid, pb.SESSION_STATE_IDLE)
    track(histories[0], uid, 1)
    histories[0].close(uid, pb.SESSION_STATE_CLOSED)
    assert database.flush(PATIENCE)
    assert await count() == (1, 2)
    database.close()
    later = opened(url, attach=lambda database: histories.append(History(database, 100.0, Clock(2000.0))))
    later.close()  # behind the chores of the start
    opened(url, attach=lambda database: histories.append(History(database, 100.0, Clock(2000.0))))
    assert await count() == (0, 0)


async def test_nothing_is_kept_of_a_session_that_has_ended(parts):
    """The result of a frame may arrive after its session's end."""
    track(parts.history, parts.uid, 1)
    parts.history.close(parts.uid, pb.SESSION_STATE_EXPIRED)
    track(parts.history, parts.uid, 1)
    parts.history.count(parts.uid, "dropped")
    assert parts.database.flush(PATIENCE)
    assert not parts.history._buffers
    answer = await parts.query()
    assert [sample.frames_applied for sample in answer.samples] == [1]
    assert [change.state for change in answer.state_changes] == [pb.SESSION_STATE_INITIALIZING, pb.SESSION_STATE_EXPIRED]
