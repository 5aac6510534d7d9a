"""Penalties of a session whose frames exceed their limit: slowed, isolated, ended; its neighbours are served."""

from __future__ import annotations

import time

import httpx
import pytest
from ddakf_api.errors import FrameTooCostly
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.metrics import Metrics
from ddakf_service.sessions.limits.penalties import Penalties
from ddakf_service.sessions.recovery.durability import Irrecoverable
from ddakf_service.sessions.session import Session
from ddakf_service.settings import Settings

from ...conftest import Api, Talk, eventually, frame_of, is_running, request_of, running, workers


class Pool:
    """Records the isolated sessions."""

    def __init__(self):
        self.isolated: list[str] = []

    async def isolate(self, session_id):
        self.isolated.append(session_id)


@pytest.fixture
def ended():
    return []


@pytest.fixture
def pool():
    return Pool()


@pytest.fixture
def penalties(pool, ended):
    settings = Settings(costly_slow_after=2, costly_isolate_after=3, costly_end_after=5, data_dir="none")
    return Penalties(settings, pool, Metrics(), lambda session, reason: ended.append(reason))


@pytest.fixture
def session():
    return Session("costly", pb.Session(), pb.Session(), pb.SessionLimits(idle_timeout=10, max_frame_rate=30.0))


async def test_a_session_is_slowed_then_isolated_then_ended(penalties, pool, session, ended):
    rates = [penalties.frame_rate(session)]
    for _ in range(4):
        await penalties.frame_given_up(session)
        rates.append(penalties.frame_rate(session))
    assert rates == [30.0, 30.0, 1.0, 1.0, 1.0]
    assert pool.isolated == ["costly", "costly"]
    with pytest.raises(Irrecoverable) as caught:
        await penalties.frame_given_up(session)
    assert [caught.value.reason] == ended
    assert isinstance(ended[0], FrameTooCostly)


async def test_a_hundred_tracked_frames_undo_a_costly_one(penalties, session):
    for _ in range(2):
        await penalties.frame_given_up(session)
    for _ in range(99):
        penalties.frame_tracked(session)
        assert session.costly_frames > 1
    for _ in range(101):
        penalties.frame_tracked(session)
    assert session.costly_frames == pytest.approx(0.0)
    assert penalties.frame_rate(session) == 30.0


@pytest.fixture(scope="module")
def strict(tmp_path_factory):
    """A service in which every frame is too costly."""
    arguments = ["--workers", "1", "--spare-workers", "0", "--frame-limit", "1e-6"]
    arguments += ["--costly-slow-after", "2", "--costly-isolate-after", "3", "--costly-end-after", "5"]
    with running(arguments, tmp_path_factory.mktemp("strict")) as service:
        yield service


@pytest.mark.slow
def test_a_client_learns_of_each_step_from_the_refusal_to_the_end(strict, sheet):
    api = Api(strict.grpc)
    costly, neighbour = api.create(sheet).name, api.create(sheet).name
    shared = workers(strict.pid)
    with Talk(api, costly) as talk:
        for number in range(1, 5):
            *notices, answer = talk.ask(frame_of(sheet, number))
            assert answer.frame_error.error.name == "FrameTooCostly"
            assert "processor time" in answer.frame_error.error.message
            assert answer.frame_error.frames_rejected == number
            kinds = [response.notice.kind for response in notices if response.HasField("notice")]
            assert (pb.NOTICE_KIND_SLOW_DOWN in kinds) == (number == 2)
        (isolated,) = set(workers(strict.pid)) - set(shared)
        statistics = api.get(costly).statistics
        assert (statistics.frames_applied, statistics.last_sequence_number, statistics.frames_rejected) == (0, 0, 4)
        talk.send(frame_of(sheet, 5))
        with pytest.raises(FrameTooCostly, match="has ended: 5 frames exceeded"):
            list(talk.answers)
    with pytest.raises(FrameTooCostly, match="has ended"):
        api.get(costly)
    assert api.get(neighbour).statistics.frames_rejected == 0
    eventually(lambda: not is_running(isolated))
    metrics = httpx.get(strict.http + "/metrics").text
    assert 'ddakf_frames_total{outcome="costly"} 5.0' in metrics
    for penalty in ("slowed", "isolated", "ended"):
        assert f'ddakf_session_penalties_total{{penalty="{penalty}"}} 1.0' in metrics
    api.delete(neighbour)


@pytest.mark.slow
def test_frames_that_wait_already_are_slowed_too(strict, sheet):
    """All frames are sent at once; the fourth and the fifth, with which the session ends, wait a second each."""
    api = Api(strict.grpc)
    name, begun = api.create(sheet).name, time.monotonic()
    with pytest.raises(FrameTooCostly, match="has ended: 5 frames exceeded"):
        list(api.track(name, [request_of(frame_of(sheet, number)) for number in range(1, 8)]))
    assert time.monotonic() - begun > 2.0
