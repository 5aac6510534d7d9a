"""History over gRPC and REST from a service on a PostgreSQL that stops and restarts, and the exported spans."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from urllib.parse import quote

import pytest
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import InvalidArgument, SessionNotFound, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import aconnect
from ddakf_service.observability.tracing import STAGES
from google.protobuf import json_format

from ..conftest import TIMEOUT, Api, eventually, frame_of, request_of, running

pytest.importorskip("opentelemetry.sdk")
from ..observability.collector import Collector, attributes_of


@pytest.fixture(scope="module")
def collector():
    collector = Collector()
    yield collector
    collector.close()


@pytest.fixture(scope="module")
def arguments(tmp_path_factory, postgres):
    database, data = postgres.new_database("history"), tmp_path_factory.mktemp("data")
    few = ["--workers", "1", "--spare-workers", "0", "--trace-sample", "1"]
    return [*few, "--database-url", database, "--data-dir", str(data)]


@pytest.fixture(scope="module")
def service(tmp_path_factory, arguments, collector):
    with pytest.MonkeyPatch.context() as environment:
        environment.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", collector.endpoint)
        environment.setenv("OTEL_BSP_SCHEDULE_DELAY", "200")
        with running(arguments, tmp_path_factory.mktemp("history")) as service:
            yield service


def track(api: Api, name: str, sheet, first: int, count: int) -> list[pb.TrackResponse]:
    """The responses to frames from number `first` on, after an invalid one."""
    bad = frame_of(sheet, first)
    bad.point_cloud.data = b"?"
    frames = [bad, *(frame_of(sheet, number) for number in range(first, first + count))]
    return list(api.track(name, [request_of(frame) for frame in frames]))[1:]


def history(api: Api, name: str, **fields) -> pb.SessionHistory:
    return api.call("GetSessionHistory", pb.GetSessionHistoryRequest(name=name, **fields))


def applied(answer: pb.SessionHistory) -> int:
    return sum(sample.frames_applied for sample in answer.samples)


def states(answer: pb.SessionHistory) -> list[int]:
    return [change.state for change in answer.state_changes]


def test_both_sides_tell_the_same(api, http, session, sheet):
    results = [r.result for r in track(api, session, sheet, 1, 10) if r.HasField("result")]
    over_grpc = history(api, session)
    over_rest = json_format.Parse(http.get(f"/v1/{session}/history").text, pb.SessionHistory())
    assert applied(over_grpc) == len(results) == 10
    assert sum(sample.frames_rejected for sample in over_grpc.samples) == 1
    assert min(s.least_reliability for s in over_grpc.samples if s.frames_applied) == min(r.reliability for r in results)
    assert max(s.greatest_latency for s in over_grpc.samples) >= max(r.timings["server"] for r in results)
    assert states(over_grpc)[0] in (pb.SESSION_STATE_INITIALIZING, pb.SESSION_STATE_IDLE)
    assert pb.SESSION_STATE_TRACKING in states(over_grpc)
    assert over_rest == over_grpc
    assert (over_rest.name, over_rest.resolution) == (session, 1)
    coarse = http.get(f"/v1/{session}/history", params={"resolution": 1000}).json()
    assert coarse["resolution"] == 1000
    assert sum(int(sample["frames_applied"]) for sample in coarse["samples"]) == 10


def test_a_span_of_time_can_be_asked_for(api, http, session, sheet):
    track(api, session, sheet, 1, 3)
    now = time.time()
    for begin, end, wanted in ((now - 60, now + 60, 3), (now + 10, now + 20, 0)):
        begin, end = (datetime.fromtimestamp(t, UTC).isoformat() for t in (begin, end))
        answer = http.get(f"/v1/{session}/history", params={"start_time": begin, "end_time": end}).json()
        assert sum(int(sample["frames_applied"]) for sample in answer["samples"]) == wanted


@pytest.mark.parametrize(
    ("query", "field"),
    [
        ({"start_time": "2030-01-01T00:00:00Z", "end_time": "2020-01-01T00:00:00Z"}, "end_time"),
        ({"start_time": "1960-01-01T00:00:00Z"}, "start_time"),
        ({"start_time": "9999-12-31T23:59:59-14:00"}, "start_time"),
        ({"end_time": "soon"}, "end_time"),
        ({"resolution": "-1"}, "resolution"),
        ({"resolution": "nan"}, "resolution"),
        ({"max_samples": "-1"}, "max_samples"),
    ],
)
def test_what_makes_no_sense_is_refused(http, session, query, field):
    answer = http.get(f"/v1/{session}/history", params=query)
    assert (answer.status_code, answer.json()["error"]["field"]) == (422, field)


def test_unknown_sessions_have_none(api, http, session):
    with pytest.raises(SessionNotFound):
        history(api, "sessions/nobody-there")
    assert http.get("/v1/sessions/nobody-there/history").status_code == 404
    with pytest.raises(InvalidArgument):
        history(api, session, resolution=-1)


@pytest.mark.parametrize("session_id", ["a\0b", "\0", "x" * 5000, "\ud7ff", "A"])
def test_what_can_be_no_name_is_not_found(api, http, session_id):
    """PostgreSQL rejects such a text."""
    for method, request in (
        ("GetSession", pb.GetSessionRequest(name=f"sessions/{session_id}")),
        ("GetSessionHistory", pb.GetSessionHistoryRequest(name=f"sessions/{session_id}")),
        ("DeleteSession", pb.DeleteSessionRequest(name=f"sessions/{session_id}")),
    ):
        with pytest.raises(SessionNotFound):
            api.call(method, request)
    for path in ("", "/history", "/statistics"):
        assert http.get(f"/v1/sessions/{quote(session_id)}{path}").status_code == 404


def test_a_session_of_odd_texts_is_registered(api, service, sheet, tmp_path):
    name = api.create(sheet, labels={"a\0": "\0"}).name
    api.delete(name)
    with pytest.raises(SessionNotFound, match="deleted"):
        api.get(name)
    assert applied(history(api, name)) == 0, "the register knows it"
    session = pb.Session(garment=pack_mesh(*sheet))
    with pytest.raises(InvalidArgument) as caught:
        api.call("CreateSession", pb.CreateSessionRequest(api_version=API_VERSION, session=session, request_id="a\0b"))
    assert caught.value.field == "request_id"


async def test_the_client_library_has_it_in_columns(api, client, service, session, sheet):
    track(api, session, sheet, 1, 10)
    message = history(api, session)
    async with aconnect(service.grpc, timeout=TIMEOUT) as other:
        for columns in (client.history(session), await other.history(session, max_samples=1000)):
            assert columns.applied.tolist() == [sample.frames_applied for sample in message.samples]
            assert columns.reliability.tolist() == [sample.reliability for sample in message.samples]
            assert columns.start.tolist() == [sample.start_time.seconds for sample in message.samples]
            assert columns.states[-1].time == message.state_changes[len(columns.states) - 1].time.ToDatetime(UTC)
    none = client.history(session, end=datetime(2020, 1, 2, tzinfo=UTC), start=datetime(2020, 1, 1, tzinfo=UTC), resolution=3600)
    assert (len(none.start), none.applied.dtype, none.resolution) == (0, int, 3600)
    for bad in ({"start": datetime(2020, 1, 1)}, {"resolution": "fine"}, {"max_samples": -1}):
        with pytest.raises(InvalidArgument):
            client.history(session, **bad)


def test_past_sessions_keep_theirs(api, sheet):
    name = api.create(sheet).name
    track(api, name, sheet, 1, 5)
    live = history(api, name)
    api.delete(name)
    past = history(api, name)
    assert list(past.samples) == list(live.samples)
    assert states(past)[-1] == pb.SESSION_STATE_CLOSED
    expired = api.create(sheet, limits=pb.SessionLimits(idle_timeout=1)).name
    eventually(lambda: states(history(api, expired))[-1:] == [pb.SESSION_STATE_EXPIRED])


def test_frames_are_exported_as_spans(api, session, sheet, collector):
    def of_this_session(spans):
        return [s for s in spans if attributes_of(s).get("ddakf.session") == session.removeprefix("sessions/")]

    track(api, session, sheet, 1, 4)
    assert collector.wait_for(lambda spans: len(of_this_session(spans)) == 5, TIMEOUT)
    failed, *whole = sorted(of_this_session(collector.spans()), key=lambda span: span.status.code, reverse=True)
    assert attributes_of(failed)["ddakf.error"] == "CodecError"
    for span in whole:
        assert attributes_of(span)["ddakf.flow"] == "lossless"
        inside = [s for s in collector.spans() if s.parent_span_id == span.span_id]
        assert [s.name for s in inside] == ["queue", "decode", *STAGES, "encode"]
        assert max(s.end_time_unix_nano for s in inside) <= span.end_time_unix_nano


def test_a_database_that_goes_away_stops_nothing_and_misses_nothing(api, http, service, sheet, postgres):
    """Frames before, during and after an outage of the database: all are tracked, and all are in the history at the end."""
    name = api.create(sheet).name
    answers = track(api, name, sheet, 1, 5)
    postgres.stop()
    try:
        answers += track(api, name, sheet, 6, 5)
        other = api.create(sheet).name
        problems = eventually(lambda: http.get("/readyz").json()["problems"])
        assert "database" in problems[0]
        assert http.get("/readyz").status_code == 200
        assert http.get("/readyz").json()["status"] == "degraded"
        assert 'ddakf_store_up{part="database"} 0.0' in http.get("/metrics").text
        with pytest.raises(Unavailable, match="database"):
            history(api, name)
        answer = http.get(f"/v1/{name}/history")
        assert (answer.status_code, answer.json()["error"]["name"]) == (503, "Unavailable")
        answers += track(api, name, sheet, 11, 5)
        api.delete(other)
    finally:
        postgres.start()
    eventually(lambda: http.get("/readyz").json()["status"] == "ready")
    answers += track(api, name, sheet, 16, 5)
    assert sum(answer.HasField("result") for answer in answers) == 20
    api.delete(name)
    assert applied(history(api, name)) == 20
    assert states(history(api, other))[-1] == pb.SESSION_STATE_CLOSED
    assert "ddakf_store_dropped_total 0.0" in http.get("/metrics").text


@pytest.mark.slow
def test_the_history_goes_on_after_a_restart(api, sheet, service, arguments, tmp_path):
    """History of a live session and of an ended one. The last test: it ends the shared service."""
    ended, alive = api.create(sheet).name, api.create(sheet).name
    for name in (ended, alive):
        track(api, name, sheet, 1, 5)
    api.delete(ended)
    assert service.stop() == 0
    with running(arguments, tmp_path) as again:
        after = Api(again.grpc)
        with after.channel:
            track(after, alive, sheet, 6, 5)
            assert [applied(history(after, name)) for name in (ended, alive)] == [5, 10]
