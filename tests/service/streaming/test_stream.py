"""Track stream: flow modes, counters, takeover, pings."""

from __future__ import annotations

import contextlib
import itertools
import queue

import grpc
import numpy as np
import pytest
from ddakf_api.errors import (
    FailedPrecondition,
    InvalidArgument,
    InvalidFrame,
    SessionBusy,
    SessionNotFound,
    StreamTakenOver,
    VersionMismatch,
    from_rpc_error,
)
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame

from ..conftest import TIMEOUT, Talk, eventually, frame_of, held, is_free, make_sheet, request_of, workers

FRAMES = 60


@pytest.fixture(scope="module")
def frames():
    """Frames of a sheet large enough that tracking takes longer than sending."""
    sheet = make_sheet(40, 0.01)
    return sheet, [request_of(frame_of(sheet, i)) for i in range(1, FRAMES + 1)]


@pytest.fixture
def large_session(api, frames):
    name = api.create(frames[0]).name
    yield name
    api.delete(name)


def results_of(responses) -> list[pb.Result]:
    return [response.result for response in responses if response.HasField("result")]


def test_lossless_answers_every_frame_in_order(api, large_session, frames):
    responses = list(api.track(large_session, frames[1]))
    assert responses[0].started.flow_mode == pb.FLOW_MODE_LOSSLESS
    assert responses[0].started.last_sequence_number == 0
    results = results_of(responses)
    assert [result.sequence_number for result in results] == list(range(1, FRAMES + 1))
    assert [result.frames_applied for result in results] == list(range(1, FRAMES + 1))
    assert results[-1].frames_dropped == 0


def test_in_lossless_flow_a_frame_that_is_refused_at_a_glance_is_answered_in_its_turn(service, api, sheet):
    name = api.create(sheet, limits=pb.SessionLimits(max_points=len(sheet.vertices))).name
    with Talk(api, name) as talk:
        talk.ask(frame_of(sheet, 1))
        with held(workers(service.pid)):
            for number in (2, 3, 4, 5):
                talk.send(frame_of(make_sheet(20) if number == 4 else sheet, number))
            talk.await_arrival()
        told = itertools.islice((answer for answer in talk.answers if not answer.HasField("notice")), 4)
        answers = [getattr(answer, answer.WhichOneof("message")) for answer in told]
        assert [answer.sequence_number for answer in answers] == [2, 3, 4, 5]
        assert answers[2].error.field == "point_cloud.point_count"
        assert [answer.frames_rejected for answer in answers] == [0, 0, 1, 1]
        talk.end()
    api.delete(name)


def test_realtime_drops_what_is_overtaken_and_counts_it(api, large_session, frames):
    responses = list(api.track(large_session, frames[1], pb.FLOW_MODE_REALTIME))
    numbers = [result.sequence_number for result in results_of(responses)]
    statistics = api.get(large_session).statistics
    assert numbers == sorted(set(numbers))
    assert numbers[-1] == FRAMES, "the newest frame wins"
    assert statistics.frames_dropped > 0
    assert statistics.frames_applied == len(numbers)
    assert statistics.frames_applied + statistics.frames_dropped == FRAMES


def test_a_reader_that_sleeps_holds_up_nothing_in_realtime(api, large_session, frames):
    """It reads nothing until all its frames are tracked or dropped."""

    def taken() -> int:
        statistics = api.get(large_session).statistics
        return statistics.frames_applied + statistics.frames_dropped

    stream = api.track(large_session, frames[1], pb.FLOW_MODE_REALTIME)
    assert next(stream).HasField("started")
    eventually(lambda: taken() >= FRAMES - 1)  # the newest may wait for room in the line
    assert results_of(stream)[-1].sequence_number == FRAMES


def test_a_stream_resumes_after_the_last_applied_frame(api, session, sheet):
    list(api.track(session, [request_of(frame_of(sheet, i)) for i in (1, 2)]))
    started = next(api.track(session, [])).started
    assert started.last_sequence_number == 2
    assert started.last_capture_time == pytest.approx(2 / 30)


def test_only_every_nth_result_has_arrays(api, session, sheet):
    options = pb.ResultOptions(every_nth=3, include_covariance=True)
    requests = [request_of(frame_of(sheet, i)) for i in range(1, 8)]
    results = results_of(api.track(session, requests, result_options=options))
    assert [result.frames_applied for result in results] == list(range(1, 8))
    assert all(result.reliability > 0 for result in results)
    for name in ("vertices", "sigma", "vertex_reliability", "observed", "covariance"):
        assert [result.HasField(name) for result in results] == [False, False, True, False, False, True, False]


def test_results_come_in_the_encodings_asked_for(api, session, sheet):
    count = len(sheet.vertices)
    options = pb.ResultOptions(
        vertex_encoding=pb.ARRAY_ENCODING_FLOAT64,
        sigma_encoding=pb.ARRAY_ENCODING_FLOAT16,
        reliability_encoding=pb.ARRAY_ENCODING_QUANTISED_8,
        include_velocities=True,
        include_covariance=True,
    )
    (result,) = results_of(api.track(session, [request_of(frame_of(sheet, 1))], result_options=options))
    sizes = {field.name: len(value.data) for field, value in result.ListFields() if isinstance(value, pb.PackedArray)}
    assert sizes == {
        "vertices": 24 * count,
        "sigma": 2 * count,
        "vertex_reliability": count,
        "observed": count,
        "velocities": 12 * count,
        "covariance": 24 * count,
    }
    assert {"total", "queue", "decode", "encode", "server"} <= set(result.timings)


def test_one_point_cloud_of_several_sensors(api, session, sheet):
    frame = frame_of(sheet, 1, codec_name="raw")
    for x, count in ((-1.0, 44), (1.0, len(sheet.vertices) - 44)):
        frame.sensors.append(pb.Sensor(origin=pb.Vector3(x=x, z=1.0), point_count=count))
    assert results_of(api.track(session, [request_of(frame)]))


def test_an_empty_cloud_is_a_frame_without_measurements(api, session, sheet):
    empty = pb.Frame(sequence_number=2, capture_time=0.1, point_cloud=pb.PointCloud())
    first, second = results_of(api.track(session, [request_of(frame_of(sheet, 1)), request_of(empty)]))
    sigma = [np.frombuffer(result.sigma.data, "<f4").mean() for result in (first, second)]
    assert sigma[1] > sigma[0]
    assert second.coverage == 0


def test_a_second_stream_is_refused_or_takes_over(api, session, sheet):
    with Talk(api, session) as first:
        first.ask(frame_of(sheet, 1))
        with pytest.raises(SessionBusy, match="takeover"):
            next(api.track(session, []))
        second = list(api.track(session, [request_of(frame_of(sheet, 2))], takeover=True))
        assert second[0].started.last_sequence_number == 1
        assert second[1].result.sequence_number == 2
        with pytest.raises(StreamTakenOver):
            list(first.answers)


def test_a_refused_takeover_leaves_the_stream(api, session, sheet):
    with Talk(api, session) as first:
        first.ask(frame_of(sheet, 1))
        with pytest.raises(InvalidArgument, match="flow_mode"):
            list(api.track(session, [], flow=99, takeover=True))
        with pytest.raises(InvalidArgument, match="vertex_encoding"):
            list(api.track(session, [], result_options=pb.ResultOptions(vertex_encoding=99), takeover=True))
        assert first.ask(frame_of(sheet, 2))[-1].result.sequence_number == 2
        first.end()


def test_a_takeover_that_was_given_up_leaves_the_session_usable(service, api, session, sheet):
    """The caller gives up while the old stream's frame is in the worker."""
    with Talk(api, session) as first:
        first.ask(frame_of(sheet, 1))
        with held(workers(service.pid)):
            first.send(frame_of(sheet, 2))
            first.await_arrival()
            begin = pb.TrackRequest(start=pb.Start(name=session, api_version="1.0", takeover=True))
            takeover = api.stub.Track(iter([begin]), timeout=TIMEOUT)
            with pytest.raises(StreamTakenOver):
                list(first.answers)
            takeover.cancel()
        assert next(api.track(session, [])).started.last_sequence_number == 2


@pytest.mark.parametrize("flow", [pb.FLOW_MODE_REALTIME, pb.FLOW_MODE_LOSSLESS])
@pytest.mark.parametrize("rate", [100.0, 0.0])
def test_a_frame_that_waits_for_its_rate_goes_on_when_the_rate_is_raised(api, sheet, flow, rate):
    """At the first rate it would wait longer than any call of these tests."""
    name = api.create(sheet, limits=pb.SessionLimits(max_frame_rate=1e-3)).name
    with Talk(api, name, flow=flow) as talk:
        talk.ask(frame_of(sheet, 1))
        talk.send(frame_of(sheet, 2))
        change = pb.Session(name=name, limits=pb.SessionLimits(max_frame_rate=rate))
        api.call("UpdateSession", pb.UpdateSessionRequest(session=change, update_mask={"paths": ["limits"]}))
        assert next(answer for answer in talk.answers if answer.HasField("result")).result.sequence_number == 2
        talk.end()
    api.delete(name)


def test_a_client_is_told_that_its_frame_takes_long(service, api, session, sheet):
    """The worker hangs; the client must not take the wait for a dead connection."""
    with Talk(api, session) as talk:
        talk.ask(frame_of(sheet, 1))
        with held(workers(service.pid)):
            talk.send(frame_of(sheet, 2))
            notices = [next(talk.answers).notice for _ in range(2)]
        assert [notice.kind for notice in notices] == [pb.NOTICE_KIND_WAITING] * 2
        assert 0 < notices[0].value < notices[1].value
        result = next(answer for answer in talk.answers if answer.HasField("result"))
        assert result.result.sequence_number == 2


@pytest.mark.parametrize("flow", [pb.FLOW_MODE_REALTIME, pb.FLOW_MODE_LOSSLESS])
def test_a_client_is_told_that_its_frame_waits_for_its_rate(api, sheet, flow):
    """Else a client whose timeout is shorter would lose the rest of a recording."""
    name = api.create(sheet, limits=pb.SessionLimits(max_frame_rate=0.2)).name
    with Talk(api, name, flow=flow) as talk:
        talk.ask(frame_of(sheet, 1))
        talk.send(frame_of(sheet, 2))
        notice = next(answer.notice for answer in talk.answers if answer.HasField("notice"))
        assert notice.kind == pb.NOTICE_KIND_WAITING
        assert "waits for its turn" in notice.message
        assert next(answer for answer in talk.answers if answer.HasField("result")).result.sequence_number == 2
        talk.end()
    api.delete(name)


def test_deleting_a_session_ends_its_stream(api, sheet):
    name = api.create(sheet).name
    with Talk(api, name) as talk:
        api.delete(name)
        with pytest.raises(SessionNotFound, match="deleted"):
            next(talk.answers)


def test_pings_are_answered(api, session):
    responses = list(api.track(session, [pb.TrackRequest(ping=pb.Ping(token=42))]))
    assert responses[1].pong.token == 42
    assert responses[1].pong.server_time > 1e9


def test_a_client_that_vanishes_frees_its_session(api, session, sheet):
    requests = queue.Queue()
    requests.put(pb.TrackRequest(start=pb.Start(name=session, api_version="1.0")))
    requests.put(request_of(frame_of(sheet, 1)))
    call = api.stub.Track(iter(requests.get, None))
    assert [next(call).WhichOneof("message") for _ in range(2)] == ["started", "result"]
    call.cancel()
    requests.put(None)
    eventually(lambda: is_free(api, session))
    assert next(api.track(session, [])).started.last_sequence_number == 1


def test_the_stream_begins_with_start(api, session, sheet):
    with pytest.raises(grpc.RpcError) as caught:
        list(api.stub.Track(iter([request_of(frame_of(sheet, 1))]), timeout=TIMEOUT))
    assert caught.value.code() is FailedPrecondition.status


def test_a_stream_of_another_version_is_refused(api, session):
    request = pb.TrackRequest(start=pb.Start(name=session, api_version="2.0"))
    with pytest.raises(grpc.RpcError) as caught:
        list(api.stub.Track(iter([request]), timeout=TIMEOUT))
    assert isinstance(from_rpc_error(caught.value), VersionMismatch)


def test_a_stream_of_no_session_is_not_found(api):
    with pytest.raises(SessionNotFound, match="nobody"):
        list(api.track("sessions/nobody", []))


@pytest.mark.parametrize("leave", ["break", "failing iterator", "refused frame"])
def test_a_session_whose_stream_was_left_takes_the_next_one(client, leave):
    """The stream is left during tracking: the frame in the worker occupies the session for a while."""
    sheet = make_sheet(40, 0.01)

    def clouds(start: float):
        for i in range(6):
            if i == 3 and leave == "failing iterator":
                raise RuntimeError("the camera broke")
            points = np.full((5, 3), np.nan) if i == 3 and leave == "refused frame" else sheet.vertices
            yield Frame(points, start + i / 30)

    error = {"failing iterator": RuntimeError, "refused frame": InvalidFrame}.get(leave)
    with client.create_session(sheet, flow="lossless") as session:
        for attempt in range(10):
            with pytest.raises(error) if error else contextlib.nullcontext():
                for _ in session.track(clouds(attempt)):
                    if leave == "break":
                        break
        assert len(list(session.track([Frame(sheet.vertices, 100.0)]))) == 1


@pytest.mark.parametrize(
    ("field", "encoding", "got"),
    [
        ("vertex_encoding", pb.ARRAY_ENCODING_UINT32, "ARRAY_ENCODING_UINT32"),
        ("sigma_encoding", 99, "unknown encoding 99"),
        ("reliability_encoding", pb.ARRAY_ENCODING_FLOAT64, "ARRAY_ENCODING_FLOAT64"),
    ],
)
def test_a_stream_whose_results_cannot_be_encoded_is_refused_at_its_start(api, session, sheet, field, encoding, got):
    requests = [request_of(frame_of(sheet, 1))]
    with pytest.raises(InvalidArgument, match=got) as refused:
        list(api.track(session, requests, result_options=pb.ResultOptions(**{field: encoding})))
    assert refused.value.field == f"result_options.{field}"
    assert api.get(session).statistics.frames_rejected == 0
