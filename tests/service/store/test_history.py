"""Seconds add up: whatever the resolution, and whether they are in memory, in the database or in both."""

from __future__ import annotations

import pytest
from ddakf_api.errors import InvalidArgument, SessionNotFound
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.store import History, Registry

from .conftest import PATIENCE, record


class Clock:
    """Seconds since 1970, as the test says."""

    def __init__(self, now: float):
        self.now = now

    def __call__(self) -> float:
        return self.now


@pytest.fixture
def parts(opened, url):
    """Database, registry, history and its clock, which begins at a round number; and one session in them."""

    def attach(database):
        registry = Registry(database, 1e9)
        made.update(registry=registry, history=History(database, registry, 1e9, clock))

    made, clock = {}, Clock(1_700_000_000.0)
    database = opened(url, attach=attach)
    session = record("watched")
    session.session.create_time.FromSeconds(int(clock.now))
    made["registry"].save(session)
    return database, made["history"], clock, session


def track(history: History, uid: int, count: int, reliability: float = 0.5, latency: float = 0.01) -> None:
    for _ in range(count):
        history.applied(uid, pb.Result(reliability=reliability, paper_score=0.25, coverage=0.75), latency)


def request(**fields) -> pb.GetSessionHistoryRequest:
    start, end = fields.pop("start", None), fields.pop("end", None)
    made = pb.GetSessionHistoryRequest(name="sessions/watched", **fields)
    if start is not None:
        made.start_time.FromSeconds(start)
    if end is not None:
        made.end_time.FromSeconds(end)
    return made


async def test_a_second_is_one_sample(parts):
    _, history, clock, session = parts
    track(history, session.uid, 3, reliability=0.5, latency=0.01)
    track(history, session.uid, 1, reliability=0.1, latency=0.05)
    history.count(session.uid, "dropped", 4)
    history.count(session.uid, "late")
    history.count(session.uid, "rejected", 2)
    (sample,) = (await history.query(request())).samples
    assert sample.start_time.seconds == int(clock.now)
    assert (sample.frames_applied, sample.frames_dropped, sample.frames_late, sample.frames_rejected) == (4, 4, 1, 2)
    assert sample.reliability == pytest.approx(0.4)
    assert sample.least_reliability == pytest.approx(0.1)
    assert (sample.paper_score, sample.coverage) == (0.25, 0.75)
    assert (sample.latency, sample.greatest_latency) == pytest.approx((0.02, 0.05))


@pytest.mark.parametrize("written", ["nothing", "half", "all"])
async def test_any_resolution_holds_every_frame(parts, written):
    database, history, clock, session = parts
    start = int(clock.now)
    for second in range(40):
        clock.now = start + second
        if second % 7 != 3:  # seconds without a frame have no sample
            track(history, session.uid, 1 + second % 3, reliability=second / 40)
        if written == "all" or (written == "half" and second < 20):
            assert database.flush(PATIENCE)
    fine = await history.query(request())
    assert fine.resolution == 1
    assert [s.start_time.seconds - start for s in fine.samples] == [s for s in range(40) if s % 7 != 3]
    for step in (3, 10, 100):
        coarse = await history.query(request(resolution=step))
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
    _, history, clock, session = parts
    start = int(clock.now)
    for second in range(101):
        clock.now = start + second
        track(history, session.uid, 1)
    for most in (1, 2, 7, 50, 101):
        answer = await history.query(request(max_samples=most))
        assert 0 < len(answer.samples) <= most
        assert sum(s.frames_applied for s in answer.samples) == 101


async def test_a_span_holds_its_seconds_alone(parts):
    database, history, clock, session = parts
    start = int(clock.now)
    for second in range(10):
        clock.now = start + second
        track(history, session.uid, 1)
    database.flush(PATIENCE)
    answer = await history.query(request(start=start + 2, end=start + 5))
    assert [s.start_time.seconds - start for s in answer.samples] == [2, 3, 4]


async def test_states_are_recorded_when_they_change(parts):
    database, history, clock, session = parts
    states = (pb.SESSION_STATE_INITIALIZING, pb.SESSION_STATE_TRACKING, pb.SESSION_STATE_TRACKING, pb.SESSION_STATE_LOST)
    for state in states:
        history.state(session.uid, state)
        clock.now += 10
    database.flush(PATIENCE)
    history.close(session.uid, pb.SESSION_STATE_CLOSED)
    answer = await history.query(request())
    wanted = [pb.SESSION_STATE_INITIALIZING, pb.SESSION_STATE_TRACKING, pb.SESSION_STATE_LOST, pb.SESSION_STATE_CLOSED]
    assert [change.state for change in answer.state_changes] == wanted
    assert [change.time.seconds - session.session.create_time.seconds for change in answer.state_changes] == [0, 10, 30, 40]
    later = await history.query(request(start=int(clock.now) - 5))
    assert [change.state for change in later.state_changes] == wanted[2:]  # the one in force, and the one that follows


async def test_a_clock_that_is_set_back_overwrites_nothing(parts):
    _, history, clock, session = parts
    track(history, session.uid, 2)
    clock.now += 1
    track(history, session.uid, 2)
    clock.now -= 1
    track(history, session.uid, 2)
    clock.now += 2
    assert sum(s.frames_applied for s in (await history.query(request())).samples) == 6


async def test_what_makes_no_sense_is_refused(parts):
    _, history, _, session = parts
    start = session.session.create_time.seconds
    for bad, field in (
        (request(start=start + 10, end=start), "end_time"),
        (request(resolution=-1.0), "resolution"),
        (request(resolution=float("nan")), "resolution"),
        (request(start=-1), "start_time"),
    ):
        with pytest.raises(InvalidArgument) as caught:
            await history.query(bad)
        assert caught.value.field == field
    with pytest.raises(SessionNotFound):
        await history.query(pb.GetSessionHistoryRequest(name="sessions/nobody"))


async def test_old_rows_are_forgotten(opened, url):
    def attach(database):
        registry = Registry(database, 1e9)
        made.update(registry=registry, history=History(database, registry, keep=100.0))

    made = {}
    database = opened(url, attach=attach)
    session = record("watched")
    session.session.create_time.FromSeconds(1000)
    made["registry"].save(session)
    made["history"]._clock = Clock(1000.0)
    track(made["history"], session.uid, 1)
    made["history"].close(session.uid, pb.SESSION_STATE_CLOSED)
    database.flush(PATIENCE)
    assert len((await made["history"].query(request(start=0, end=2000))).samples) == 1
    database.close()
    database = opened(url, attach=attach)
    database.flush(PATIENCE)
    database.close()  # behind the chores of the start
    opened(url, attach=attach)
    answer = await made["history"].query(request(start=0, end=2000))
    assert (len(answer.samples), len(answer.state_changes)) == (0, 0)
