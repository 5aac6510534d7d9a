"""The synchronous client against a real socket."""

import gc
import logging
import threading
import time
from datetime import UTC, datetime
from types import SimpleNamespace

import grpc
import numpy as np
import pytest
from ddakf_api import transport
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import CODECS, Frame, FrameError, Limits, connect, errors

from . import fake_server
from .fake_server import CREATED


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
    assert all(0 < r.latency < 5 for r in results)


@pytest.mark.parametrize("codec", CODECS)
def test_every_codec_by_its_name(service, mesh, frames, codec):
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless", codec=codec) as session:
        results = list(session.track(frames(3)))
    assert {f.point_cloud.codec for f in service.frames} == {CODECS[codec]}
    assert np.abs(results[2].vertices - (mesh[0] + [0.02, 0, 0])).max() < 0.0003


def test_a_mesh_object_a_body_and_the_rest_of_a_session(service, mesh):
    garment = SimpleNamespace(vertices=mesh[0], faces=mesh[1])
    with (
        connect(service.target, api_key="secret") as client,
        client.create_session(
            garment,
            body=mesh,
            config={"associate": {"gate": 0.2}},
            fabric="cotton",
            clean=True,
            labels={"shop": "3"},
            limits=Limits(max_points=500),
            session_id="mine",
        ) as session,
    ):
        info = session.info()
        assert session.vertex_map.tolist() == [0, 1, 2, 3]
    sent = service.requests[0]
    assert sent.session.HasField("body")
    assert sent.clean
    assert sent.request_id
    assert sent.session.limits.max_points == 500
    assert info.name == "sessions/mine"
    assert (info.session_id, info.state, info.labels, info.fabric) == ("mine", "idle", {"shop": "3"}, "cotton")
    assert info.config == {"associate": {"gate": 0.2}}
    assert info.create_time == datetime.fromtimestamp(CREATED, UTC)
    assert (info.n_vertices, info.n_faces) == (4, 2)
    assert set(service.keys) == {"Bearer secret"}


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


def test_lossless_holds_the_source_back(service, mesh, frames):
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
    assert max(lead) <= 4 + 2  # in flight as the server said, one in the slot, one in the source's hand
    assert service.most_waiting <= 4


def test_realtime_takes_the_newest_and_counts_the_rest(service, mesh, frames):
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
    assert np.median([r.latency for r in results]) < 0.5


def test_the_numbers_of_a_second_stream_go_on(service, mesh, frames):
    with connect(service.target) as client:
        session = client.create_session(*mesh, session_id="kept", flow="lossless")
        list(session.track(frames(3)))
        with client.open_session("kept", flow="lossless") as again:
            assert [r.sequence for r in again.track(frames(2))] == [4, 5]
        assert "sessions/kept" in service.sessions


def test_refused_frames_raise_or_are_yielded(service, mesh, frames):
    service.refused = {3}
    with connect(service.target) as client:
        session = client.create_session(*mesh, flow="lossless")
        with pytest.raises(errors.InvalidFrame, match="points: expected something else, got this") as refusal:
            list(session.track(frames(5)))
        assert refusal.value.sequence == 3
        with client.create_session(*mesh, flow="lossless") as session:
            answers = list(session.track(frames(5), on_error="yield"))
    assert [type(a).__name__ for a in answers] == ["Result", "Result", "FrameError", "Result", "Result"]
    assert answers[2].sequence == 3
    assert isinstance(answers[2].error, errors.InvalidFrame)


def test_frames_that_cannot_be_sent_raise_or_are_yielded(service, mesh, frames):
    made = frames(5)
    made[1] = (np.full((2, 3), np.nan), 0.5)
    made[3] = "a string"
    with connect(service.target) as client:
        session = client.create_session(*mesh, flow="lossless")
        with pytest.raises(errors.CodecError, match="finite") as refusal:
            list(session.track(made))
        assert refusal.value.sequence == 2
        with client.create_session(*mesh, flow="lossless") as session:
            answers = list(session.track(made, on_error="yield"))
    assert {a.sequence for a in answers if isinstance(a, FrameError)} == {2, 4}
    assert [a.sequence for a in answers if not isinstance(a, FrameError)] == [1, 3, 5]


def test_a_bad_frame_names_its_field_and_the_stream_goes_on(service, mesh, frames, bad_frame):
    made, (bad, field) = frames(3), bad_frame
    made[1] = bad
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        answers = list(session.track(made, on_error="yield"))
        with pytest.raises(errors.InvalidFrame, match=rf"^{field}: expected .*, got ") as refusal:
            list(session.track(made))
    refused = [a for a in answers if isinstance(a, FrameError)]
    assert [a.sequence for a in answers if not isinstance(a, FrameError)] == [1, 3]
    assert [(a.sequence, a.error.field, type(a.error)) for a in refused] == [(2, field, type(refusal.value))]
    assert refusal.value.field == field
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("error", [ValueError("ragged"), errors.InvalidFrame("of the camera"), SystemExit(3)])
@pytest.mark.parametrize("on_error", ["raise", "yield"])
def test_the_very_error_of_the_source_reaches_the_caller(service, mesh, frames, error, on_error):
    def source():
        yield from frames(1)
        raise error

    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(type(error)) as raised:
            list(session.track(source(), on_error=on_error, timeout=3))
        assert raised.value is error


def test_all_frames_refused_in_realtime_do_not_stop_the_stream(service, mesh, frames):
    service.refused, service.delay = set(range(1, 100)), 0.002
    with connect(service.target) as client, client.create_session(*mesh) as session:
        answers = list(session.track(frames(99), on_error="yield", timeout=2))
    assert answers[-1].sequence == 99


def test_an_error_of_the_source_comes_through(service, mesh, frames):
    def source():
        yield from frames(2)
        raise OSError("the camera was unplugged")

    with (
        connect(service.target) as client,
        client.create_session(*mesh, flow="lossless") as session,
        pytest.raises(OSError, match="unplugged"),
    ):
        list(session.track(source()))
    assert service.sessions == {}


def test_a_lost_worker_is_a_retryable_error(service, mesh, frames):
    service.lost_from = 3
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(errors.WorkerLost, match="was killed") as lost:
            list(session.track(frames(5)))
        assert lost.value.retryable
        assert lost.value.retry_after == 1.5


def test_a_silent_server_runs_into_the_timeout(service, mesh, frames):
    service.silent_from = 2
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        begun = time.monotonic()
        with pytest.raises(errors.DeadlineExceeded, match=r"no answer to frame 2 within 0\.3 s"):
            list(session.track(frames(3), timeout=0.3))
        assert time.monotonic() - begun < 2
        service.starts = False
        with pytest.raises(errors.DeadlineExceeded, match=r"no answer to the start of the stream within 0\.2 s"):
            list(session.track(frames(3), timeout=0.2))


@pytest.mark.parametrize("flow", ["lossless", "realtime"])
def test_a_stream_that_ends_early_is_an_error(service, mesh, frames, flow):
    service.ends_at = 2
    with (
        connect(service.target) as client,
        client.create_session(*mesh, flow=flow) as session,
        pytest.raises(errors.Unavailable, match="the server ended the stream before"),
    ):
        list(session.track(frames(9)))


def test_slow_sources_and_slow_readers_are_no_timeout(service, mesh, frames):
    def source():
        for frame in frames(3):
            time.sleep(0.25)
            yield frame

    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        assert len(list(session.track(source(), timeout=0.15))) == 3
        for _ in session.track(frames(3), timeout=0.15):
            time.sleep(0.25)


def test_leaving_the_loop_ends_stream_and_threads(service, mesh, frames):
    def endless():
        for frame in frames(10_000):
            time.sleep(0.001)
            yield frame

    before = threading.active_count()
    source = endless()
    with connect(service.target) as client, client.create_session(*mesh) as session:
        stream = session.track(source)
        next(stream)
        stream.close()
        assert next(source)  # nobody else is in the generator any more
        assert session.info().applied > 0
    assert service.sessions == {}
    gc.collect()
    deadline = time.monotonic() + 5
    while threading.active_count() > before + 8 and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not [t for t in threading.enumerate() if "_Stream" in repr(getattr(t, "_target", None))]


def test_notices_are_logged_or_handed_over(service, mesh, frames, caplog):
    notices = []
    with connect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        service.notice = pb.Notice(kind=pb.NOTICE_KIND_SLOW_DOWN, message="too fast", value=12.0)
        list(session.track(frames(2), on_notice=notices.append))
        service.notice = pb.Notice(kind=pb.NOTICE_KIND_DRAINING, message="stopping")
        with caplog.at_level(logging.WARNING, "ddakf_client"):
            list(session.track(frames(2)))
    assert [(n.kind, n.message, n.value) for n in notices] == [("slow_down", "too fast", 12.0)]
    assert "draining: stopping" in caplog.text


def test_session_calls(service, mesh):
    with connect(service.target) as client:
        for name in ("alpha", "beta-1", "beta-2"):
            client.create_session(*mesh, session_id=name, labels={"group": name[0]})
        assert [s.session_id for s in client.sessions()] == ["alpha", "beta-1", "beta-2"]
        assert [s.session_id for s in client.sessions(labels={"group": "b"})] == ["beta-1", "beta-2"]
        session = client.open_session("alpha")
        assert session.reset(mesh[0], velocities=np.zeros((4, 3))).state == "initializing"
        assert session.update(labels={"a": "b"}).labels == {"a": "b"}
        with client.restore_session(session.snapshot(), session_id="other") as restored:
            assert restored.name == "sessions/other"
        session.delete()
        with pytest.raises(errors.SessionNotFound, match="there is no sessions/alpha"):
            session.info()
        with pytest.raises(errors.SessionExists) as exists:
            client.create_session(*mesh, session_id="beta-1")
        assert exists.value.field == "session_id"
        assert client.server_info().fabrics == ("cotton",)


def test_what_is_wrong_is_said_before_anything_is_sent(service, mesh):
    with connect(service.target) as client:
        for arguments, options, error, said in [
            ((mesh[0],), {}, errors.InvalidMesh, "garment: expected vertices and faces"),
            ((mesh[0], mesh[1] + 2), {}, errors.InvalidMesh, "garment.faces: expected indices from 0 to 3"),
            (mesh, {"body": (mesh[0], [[0, 1]])}, errors.InvalidMesh, "body.faces"),
            (mesh, {"config": {"a": float("nan")}}, errors.InvalidConfig, "config"),
            (mesh, {"config": [1]}, errors.InvalidConfig, "a dict or a ddakf.Config, got list"),
            ((mesh[0].tolist() + [[1.0]], mesh[1]), {}, errors.InvalidMesh, "garment.vertices: expected numbers"),
            ((mesh[0], [[0, 1, 2], [0, 1]]), {}, errors.InvalidMesh, "garment.faces: expected integers"),
            (mesh, {"body": mesh * 2}, errors.InvalidMesh, "body: expected vertices and faces"),
            (mesh, {"labels": {"a": 1}}, errors.InvalidArgument, "labels['a']: expected text, got int 1"),
            (mesh, {"labels": {1: "a"}}, errors.InvalidArgument, "labels: expected text as keys, got int 1"),
            (mesh, {"labels": "a"}, errors.InvalidArgument, "labels: expected a dict of text to text, got str 'a'"),
            (mesh, {"session_id": 5}, errors.InvalidArgument, "session_id: expected text, got int 5"),
            (mesh, {"session_id": "\ud800"}, errors.InvalidArgument, "session_id: expected text that UTF-8 has"),
            (mesh, {"fabric": 5}, errors.InvalidArgument, "fabric: expected text, got int 5"),
            (mesh, {"clean": "no"}, errors.InvalidArgument, "clean: expected True or False, got str 'no'"),
            (mesh, {"limits": {"max_points": 5}}, errors.InvalidArgument, "limits: expected a ddakf_client.Limits"),
            (mesh, {"limits": Limits(max_points=-1)}, errors.InvalidArgument, "limits.max_points: expected a whole"),
            (mesh, {"limits": Limits(idle_timeout="a")}, errors.InvalidArgument, "limits.idle_timeout: expected a num"),
            (mesh, {"flow": ["realtime"]}, errors.InvalidArgument, "flow: expected realtime or lossless"),
            (mesh, {"codec": "zip"}, errors.InvalidArgument, "codec: expected raw or quantised"),
            (mesh, {"flow": "fast"}, errors.InvalidArgument, "flow: expected realtime or lossless, got 'fast'"),
        ]:
            with pytest.raises(error) as refusal:
                client.create_session(*arguments, **options)
            assert said in str(refusal.value)
        assert service.requests == []
        session = client.create_session(*mesh)
        with pytest.raises(errors.InvalidArgument, match="on_error: expected raise or yield"):
            session.track([], on_error="ignore")
        for call, field in [
            (lambda: session.track([], takeover="yes"), "takeover"),
            (lambda: session.reset([[0, 0, 0], [1, 0]]), "vertices"),
            (lambda: session.reset(velocities=[["a", "b", "c"]]), "velocities"),
            (lambda: session.update(labels={"a": 1}), "labels['a']"),
            (lambda: client.restore_session("abc"), "snapshot"),
            (lambda: client.restore_session(b"", labels={"a": 1}), "labels['a']"),
            (lambda: client.restore_session(b"", session_id=5), "session_id"),
            (lambda: client.open_session(5), "session_id"),
            (lambda: list(client.sessions(labels={"a": 1})), "labels['a']"),
            (lambda: list(client.sessions(state=["idle"])), "state"),
        ]:
            with pytest.raises(errors.InvalidArgument) as refusal:
                call()
            assert refusal.value.field == field
            assert str(refusal.value).startswith(f"{field}: expected ")


def test_a_codec_that_the_server_lacks_is_refused(service, mesh):
    service.codecs = [CODECS["raw"]]
    with connect(service.target) as client, pytest.raises(errors.CodecError, match=r"one that the server has, raw"):
        client.create_session(*mesh)


def test_another_version_is_refused_in_a_sentence(service):
    service.api_version = "2.3"
    with pytest.raises(errors.VersionMismatch, match=r"this client speaks ddakf API 1\.\d+, the server '2\.3'"):
        connect(service.target)


def test_no_server_is_said_at_once():
    begun = time.monotonic()
    with pytest.raises(errors.Unavailable, match=r"127\.0\.0\.1:1 does not answer"):
        connect("127.0.0.1:1")
    assert time.monotonic() - begun < 5


def test_a_server_that_does_not_answer_runs_into_the_timeout(service):
    service.delay = 1.0
    with pytest.raises(errors.DeadlineExceeded, match=r"gave no answer within 0\.2 s"):
        connect(service.target, timeout=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("permitted", [True, False])
def test_pings_on_a_silent_stream_are_permitted_by_the_server(mesh, frames, monkeypatch, permitted):
    """With a server that does not expect them, as the control: that the pings are really sent."""

    def source():
        yield frames(1)[0]
        time.sleep(4.5)  # gRPC pings once a second at most, and a server bears with two pings

    monkeypatch.setattr(transport, "KEEPALIVE_SECONDS", 0.05)
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


def test_a_message_above_the_limit_is_an_error_not_a_hang(service, mesh):
    large = [Frame(np.random.default_rng(0).uniform(-1, 1, (400_000, 3)), 0.0)]
    with (
        connect(service.target, max_message_bytes=1 << 20) as client,
        client.create_session(*mesh, codec="raw") as session,
        pytest.raises(errors.ResourceExhausted),
    ):
        list(session.track(large))


def test_the_error_inside_a_context_wins_over_that_of_leaving_it(service, mesh):
    def leave_with_an_error():
        with connect(service.target) as client, client.create_session(*mesh):
            service._find = None  # from now on every call fails in the server
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        leave_with_an_error()


@pytest.mark.parametrize("forget", [0, 3])
def test_a_lost_connection_is_had_again_and_no_frame_is_left_out(outage, mesh, frames, forget):
    outage.service.delay = 0.01
    notices, sequences = [], []
    with connect(outage.target) as client, client.create_session(*mesh, flow="lossless") as session:
        for result in session.track(frames(40), on_notice=notices.append):
            sequences.append(result.sequence)
            if result.sequence in (10, 25):
                outage.strike(forget=forget)
    assert sequences == sorted(sequences)
    assert sequences[-1] == 40
    # what the server tracked without being able to say so is not asked for again
    tracked = {frame.sequence_number for frame in outage.service.frames}
    assert tracked == set(range(1, 41))
    assert [notice.kind for notice in notices] == ["resumed"] * 2
    assert all(notice.value <= forget for notice in notices)


def test_in_realtime_the_newest_frame_alone_is_sent_again(outage, mesh, frames):
    outage.service.delay = 0.01
    struck = threading.Event()

    def camera():
        for i, frame in enumerate(frames(100)):
            time.sleep(0.01)
            if i == 30:
                threading.Thread(target=outage.strike).start()
                struck.set()
            yield frame

    with connect(outage.target) as client, client.create_session(*mesh) as session:
        sequences = [result.sequence for result in session.track(camera(), on_notice=lambda _: None)]
    assert struck.is_set()
    assert sequences == sorted(set(sequences))
    assert sequences[-1] == 100


def test_a_connection_that_does_not_come_back_in_time_is_an_error(outage, mesh, frames):
    with connect(outage.target) as client:
        session = client.create_session(*mesh, flow="lossless")
        stream = session.track(frames(1000), resume=0.5)
        next(stream)
        outage.server.stop(0).wait()
        with pytest.raises(errors.Unavailable):
            list(stream)
    outage.start()
    with connect(outage.target) as client:
        stream = client.open_session(session.session_id, flow="lossless").track(frames(1000), resume=0)
        next(stream)
        outage.server.stop(0).wait()
        with pytest.raises(errors.Unavailable):
            list(stream)


def test_a_session_that_is_gone_after_the_outage_is_an_error(outage, mesh, frames):
    with connect(outage.target) as client:
        stream = client.create_session(*mesh, flow="lossless").track(frames(1000))
        next(stream)
        outage.service.sessions.clear()
        outage.strike(0)
        with pytest.raises(errors.SessionNotFound):
            list(stream)


def test_who_is_told_to_connect_elsewhere_does(outage, service, mesh, frames):
    """The session waits at the other server, which has tracked its first two frames."""
    with connect(outage.target) as client:
        session = client.create_session(*mesh, flow="lossless")
        moved = service.sessions[session.name] = pb.Session()
        moved.CopyFrom(outage.service.sessions[session.name])
        moved.statistics.last_sequence_number = 2
        outage.service.drains_at = 3
        outage.service.notice = pb.Notice(kind=pb.NOTICE_KIND_RECONNECT, message="elsewhere", target=service.target)
        sequences = [result.sequence for result in session.track(frames(6), on_notice=lambda _: None)]
        assert client.target == service.target
        assert session.info().applied == 4
    assert sequences == [1, 2, 3, 4, 5, 6]


def test_one_connection_per_server_however_often_a_client_is_moved(outage, service, monkeypatch):
    """As every stream of a client is told where to go on."""
    opened, open_channel = [], grpc.insecure_channel
    monkeypatch.setattr(grpc, "insecure_channel", lambda target, options: opened.append(target) or open_channel(target, options))
    with connect(outage.target) as client:
        for target in (service.target, service.target, outage.target, service.target):
            client.move(target)
            assert client.server_info()
    assert opened == [outage.target, service.target]
