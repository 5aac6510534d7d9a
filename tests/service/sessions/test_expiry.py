"""Expiry: idle sessions, sessions left by their client, sessions at the end of their lifetime."""

from __future__ import annotations

import asyncio
import itertools
import math
import time

import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import SessionExpired
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.metrics import Metrics
from ddakf_service.sessions import service
from ddakf_service.sessions.session import Session
from ddakf_service.settings import Settings
from ddakf_service.store.store import Store

from ..conftest import TIMEOUT, Talk, eventually, frame_of, request_of

pytestmark = pytest.mark.slow


def why(api, name: str) -> str:
    """Reason of a session's expiry; empty while it is live."""
    try:
        api.get(name)
    except SessionExpired as error:
        return str(error)
    return ""


@pytest.mark.parametrize("seconds", [1e9, 1e12, math.inf])
def test_a_server_may_let_sessions_wait_for_ever(seconds):
    limits = pb.SessionLimits(idle_timeout=seconds, departure_timeout=seconds)
    message = Session("shirt", pb.Session(), pb.Session(), limits).message()
    assert message.HasField("expire_time") == (seconds < 1e12), "which no date says"


def test_an_idle_session_expires(api, http, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(idle_timeout=0.5)).name
    assert "0.5 s" in eventually(lambda: why(api, name))
    answer = http.get(f"/v1/{name}")
    assert (answer.status_code, answer.json()["error"]["name"]) == (410, "SessionExpired")


def test_a_session_that_its_client_has_left_waits_and_expires(api, sheet):
    """The departure timeout does not run while a stream is open, or before the first one."""
    limits = pb.SessionLimits(departure_timeout=2)
    left, waiting, open_still = (api.create(sheet, limits=limits).name for _ in range(3))
    talk = Talk(api, open_still)
    list(api.track(left, [request_of(frame_of(sheet, 1))]))
    again = list(api.track(left, [request_of(frame_of(sheet, 2))]))
    assert again[0].started.last_sequence_number == 1, "within the window it comes back to what it left"
    assert "did not return within 2 s" in eventually(lambda: why(api, left))
    assert [api.get(name).name for name in (waiting, open_still)] == [waiting, open_still]
    talk.end()
    assert eventually(lambda: why(api, open_still))
    api.delete(waiting)


def test_a_lifetime_ends_even_a_busy_session(api, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(max_lifetime=1.0)).name

    def endless():
        for number in itertools.count(1):
            time.sleep(0.05)
            yield request_of(frame_of(sheet, number))

    with pytest.raises(SessionExpired, match="its lifetime of 1 s"):
        list(api.track(name, endless()))
    assert "its lifetime" in why(api, name)


def test_a_client_whose_frames_are_all_refused_is_there_still(api, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(idle_timeout=2)).name

    def bad_frames():
        for number in range(1, 10):
            time.sleep(0.3)
            yield pb.TrackRequest(frame=pb.Frame(sequence_number=number, point_cloud=pb.PointCloud(point_count=3)))

    responses = list(api.track(name, bad_frames()))
    assert [response.HasField("frame_error") for response in responses[1:]] == [True] * 9
    api.delete(name)


async def test_one_session_that_cannot_be_closed_keeps_no_other_from_expiring(monkeypatch, request):
    """A worker that fails at the end of a session."""
    monkeypatch.setattr(service, "_EXPIRY_INTERVAL", 0.01)

    class Pool:
        async def open(self, session_id, request, memory):
            return pb.Session(name=session_id).SerializeToString()

        def count_memory(self, session_id, memory):
            pass

        async def snapshot(self, session_id):
            return b""

        async def close(self, session_id):
            raise RuntimeError("no")

    settings, metrics = Settings(data_dir="none"), Metrics()
    store = Store(settings, metrics)
    request.addfinalizer(store.close)
    mine = service.Sessions(Pool(), settings, metrics, store)
    for name in ("first", "other"):
        await mine.create(pb.CreateSessionRequest(api_version=API_VERSION, session_id=name))
    for session in mine._catalog:
        session.last_active -= 1e6
    expiry = asyncio.create_task(mine.expire_idle())
    async with asyncio.timeout(TIMEOUT):
        while len(mine._catalog):
            assert not expiry.done()
            await asyncio.sleep(0.01)
    expiry.cancel()
    for name in ("first", "other"):
        with pytest.raises(SessionExpired):
            await mine.get(f"sessions/{name}")
