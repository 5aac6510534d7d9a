"""Synchronous streams: frames in, results out, over a real socket."""

import logging
import threading
import time
from collections.abc import AsyncIterator, Iterator
from types import SimpleNamespace
from typing import Literal, get_overloads, get_type_hints

import numpy as np
import pytest
from ddakf_api import transport
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import CODECS, AsyncSession, Frame, FrameError, Result, Session, connect, errors

from . import fake_server


@pytest.mark.parametrize(("session", "answers"), [(Session, Iterator), (AsyncSession, AsyncIterator)])
def test_refused_frames_are_answers_only_where_they_are_asked_for(session, answers):
    """For a type checker, which otherwise finds no vertices in what a loop over the results gets."""
    raising, yielding = map(get_type_hints, get_overloads(session.track))
    assert (raising["on_error"], raising["return"]) == (Literal["raise"], answers[Result])
    assert yielding["return"] == answers[Result | FrameError]


def test_frames_in_results_out(service, mesh, frames):
    vertices, faces = mesh
    with connect(service.target) as client, client.create_session(vertices, faces, flow="lossless") as session:
        results = list(session.track(frames(20)))
        assert f"sessions/{session.session_id}" in service.sessions
    assert service.sessions == {}
    assert [r.sequence for r in results] == list(range(1, 21))
    assert [r.timestamp for r in results] == [i / 30 for i in range(20)]
    for i, result in enumerate(results):
        assert np.abs(result.vertices - (vertices + np.array([i / 100, 0, 0]))).max() < 0.0003
    last = results[-1]
    assert (last.state, last.reliability, last.paper_score, last.coverage) == ("tracking", 0.75, 0.5, 0.25)
    assert (last.applied, last.dropped, last.rejected) == (20, 0, 0)
    assert last.vertices.dtype == last.sigma.dtype == last.vertex_reliability.dtype == np.float32
    assert last.observed.tolist() == [True, False, True, False]
    assert last.timings["total"] == 0.001
    assert last.velocities is None
    assert last.covariance is None
    assert all(r.latency > 0 for r in results)


@pytest.mark.parametrize("codec", CODECS)
def test_every_codec_by_its_name(service, mesh, frames, codec):
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless", codec=codec) as session:
        results = list(session.track(frames(3)))
    assert {f.point_cloud.codec for f in service.frames} == {CODECS[codec]}
    assert np.abs(results[2].vertices - (mesh[0] + [0.02, 0, 0])).max() < 0.0003


def test_frames_of_every_kind(service, mesh, frames):
    points, body = frames(1)[0][0], np.zeros((5, 3))
    several = np.where(np.arange(200)[:, None] % 4 == 0, [0.0, 0, 3], [0.0, 0, 6])
    made = [
        Frame(points, 0.1),
        Frame(points, 0.2, sensor_origin=np.array([0, 0, 3])),
        (points, 0.3, several, body),
        SimpleNamespace(points=points.astype(np.float32), timestamp=np.float64(0.4), body_vertices=body),
        Frame(np.empty((0, 3)), 0.5),
    ]
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        results = list(session.track(made, velocities=True, covariance=True))
    assert [r.timings["sensors"] for r in results] == [0, 1, 2, 0, 0]
    assert [r.timings["body"] for r in results] == [0, 0, 5, 5, 0]
    assert results[1].vertex_reliability[0] == pytest.approx(1)
    assert results[2].vertex_reliability[0] == pytest.approx((3 / 4 + 6 * 3 / 4) / 3)
    assert results[0].velocities.shape == (4, 3)
    assert results[0].covariance[0].tolist() == [[1, 2, 3], [2, 4, 5], [3, 5, 6]]


def test_lossless_mode_slows_the_source(service, mesh, frames):
    service.delay = 0.01
    pulled, lead = [0], []

    def source():
        for frame in frames(30):
            pulled[0] += 1
            yield frame

    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        for result in session.track(source()):
            lead.append(pulled[0] - result.sequence)
    assert len(lead) == 30
    assert max(lead) <= 4 + 2  # the limit of the server in flight, one in the slot, one in the source
    assert service.most_waiting <= 4


def test_realtime_mode_sends_the_newest_frame_and_counts_the_others(service, mesh, frames):
    service.delay = 0.03

    def camera():
        for frame in frames(60):
            time.sleep(0.003)
            yield frame

    with connect(service.target) as client, client.create_session(*mesh) as session:
        results = list(session.track(camera()))
    sequences = [r.sequence for r in results]
    assert sequences == sorted(set(sequences))
    assert sequences[-1] == 60
    assert len(results) < 40
    assert results[-1].applied + results[-1].dropped == 60


def test_a_second_stream_continues_the_sequence_numbers(service, mesh, frames):
    with connect(service.target) as client:
        session = client.create_session(*mesh, session_id="kept", flow="lossless")
        list(session.track(frames(3)))
        with client.open_session("kept", flow="lossless") as again:
            assert [r.sequence for r in again.track(frames(2))] == [4, 5]
        assert "sessions/kept" in service.sessions


def test_slow_sources_and_slow_readers_cause_no_timeout(service, mesh, frames):
    def source():
        for frame in frames(2):
            time.sleep(1.25)
            yield frame

    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        assert len(list(session.track(source(), timeout=1))) == 2
        for _ in session.track(frames(1), timeout=1):
            time.sleep(1.25)


def test_leaving_the_loop_ends_stream_and_threads(service, mesh, frames):
    def endless():
        for frame in frames(10_000):
            time.sleep(0.001)
            yield frame

    def at_work() -> list[threading.Thread]:
        return [t for t in threading.enumerate() if "_Stream" in repr(getattr(t, "_target", None))]

    source = endless()
    with connect(service.target) as client, client.create_session(*mesh) as session:
        stream = session.track(source)
        next(stream)
        assert at_work()
        stream.close()
        assert next(source)  # no other thread runs the generator
        assert session.info().applied > 0
    assert service.sessions == {}
    for thread in at_work():
        thread.join(5)
        assert not thread.is_alive()


def test_notices_are_logged_or_passed_to_the_caller(service, mesh, frames, caplog):
    notices = []
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        service.notice = pb.Notice(kind=pb.NOTICE_KIND_SLOW_DOWN, message="too fast", value=12.0)
        list(session.track(frames(2), on_notice=notices.append))
        service.notice = pb.Notice(kind=pb.NOTICE_KIND_DRAINING, message="stopping")
        with caplog.at_level(logging.WARNING, "ddakf_client"):
            list(session.track(frames(2)))
    assert [(n.kind, n.message, n.value) for n in notices] == [("slow_down", "too fast", 12.0)]
    assert "draining: stopping" in caplog.text


@pytest.mark.slow
@pytest.mark.parametrize("permitted", [True, False])
def test_pings_on_a_silent_stream_are_permitted_by_the_server(mesh, frames, monkeypatch, permitted):
    """A server that does not permit them is the control: the pings are really sent."""

    def source():
        yield frames(1)[0]
        time.sleep(4.5)  # gRPC pings at most once a second, and a server tolerates two pings

    monkeypatch.setattr(transport, "CLIENT_KEEPALIVE_SECONDS", 0.05)
    if not permitted:
        monkeypatch.setattr(fake_server, "server_options", list)
    server, target = fake_server.start(fake_server.FakeService())
    try:
        with connect(target) as client:
            stream = client.create_session(*mesh).track(source(), resume=0)
            if permitted:
                assert len(list(stream)) == 1
            else:
                with pytest.raises(errors.Unavailable, match="Too many pings"):
                    list(stream)
    finally:
        server.stop(0).wait()
