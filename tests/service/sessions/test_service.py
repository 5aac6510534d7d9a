"""Session operations over gRPC and REST, with the same meaning."""

from __future__ import annotations

import base64
import json
import uuid

import numpy as np
import pytest
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack, pack_mesh, unpack
from ddakf_api.errors import (
    FailedPrecondition,
    InvalidArgument,
    InvalidConfig,
    SessionExists,
    SessionNotFound,
    VersionMismatch,
)
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame, connect
from google.protobuf import json_format

import ddakf
from ddakf import data
from ddakf.evaluation.metrics import rmse_mm
from ddakf.evaluation.sensors import Sensor

from ..conftest import Api, Talk, eventually, frame_of, make_sheet, request_of


def test_life_over_grpc(api, sheet):
    session = api.create(sheet, "shirt-1", labels={"who": "me"}, fabric="silk")
    assert session.name == "sessions/shirt-1"
    assert (session.garment_vertex_count, session.garment_face_count) == (len(sheet.vertices), len(sheet.faces))
    assert not session.HasField("garment")
    full = api.call("GetSession", pb.GetSessionRequest(name=session.name, view=pb.SESSION_VIEW_FULL))
    assert full.garment == pack_mesh(*sheet)
    listed = api.call("ListSessions", pb.ListSessionsRequest(labels={"who": "me"}))
    assert [s.name for s in listed.sessions] == [session.name]
    api.delete(session.name)
    with pytest.raises(SessionNotFound, match="deleted"):
        api.get(session.name)


def test_life_over_rest(http, sheet):
    garment = {"vertices": sheet.vertices.tolist(), "faces": sheet.faces.tolist()}
    body = {"session": {"garment": garment}, "session_id": "shirt-2"}
    created = http.post("/v1/sessions", json=body)
    assert created.status_code == 201
    assert created.headers["location"] == "/v1/sessions/shirt-2"
    assert created.json()["garment_vertex_count"] == len(sheet.vertices)
    got = http.get("/v1/sessions/shirt-2").json()
    assert got["state"] == "SESSION_STATE_IDLE"
    assert json.loads(got["config_json"]) == ddakf.Config().to_dict()
    assert "sessions/shirt-2" in [s["name"] for s in http.get("/v1/sessions").json()["sessions"]]
    assert http.post("/v1/sessions", json=body).status_code == 409
    assert http.delete("/v1/sessions/shirt-2").status_code == 204
    assert http.get("/v1/sessions/shirt-2").status_code == 404


def test_a_mesh_as_base64_is_the_same_mesh(http, api, sheet):
    packed = pack_mesh(*sheet)
    mesh = {
        "vertices": {"encoding": "ARRAY_ENCODING_FLOAT64", "data": base64.b64encode(packed.vertices.data).decode()},
        "faces": {"encoding": "ARRAY_ENCODING_UINT32", "data": base64.b64encode(packed.faces.data).decode()},
    }
    name = http.post("/v1/sessions", json={"session": {"garment": mesh, "body": mesh}}).json()["name"]
    full = json_format.Parse(http.get(f"/v1/{name}", params={"view": "SESSION_VIEW_FULL"}).text, pb.Session())
    assert full.garment == full.body == packed
    assert full.body_vertex_count == len(sheet.vertices)
    api.delete(name)


def test_both_sides_report_the_last_frame(api, http, session, sheet):
    responses = list(api.track(session, (request_of(frame_of(sheet, i)) for i in (1, 2, 3))))
    last = responses[-1].result
    over_grpc = api.get(session).statistics
    over_rest = json_format.Parse(http.get(f"/v1/{session}").text, pb.Session())
    for field in ("reliability", "paper_score", "coverage", "frames_applied", "frames_dropped", "frames_rejected"):
        assert getattr(over_grpc, field) == getattr(last, field) == getattr(over_rest.statistics, field)
    assert over_grpc.last_sequence_number == 3
    assert over_grpc.last_capture_time == pytest.approx(0.1)
    assert over_grpc.frame_rate > 0
    assert over_rest.state == pb.SESSION_STATE_IDLE


def test_listing_by_pages_and_state(api, http, sheet):
    names = [api.create(sheet, labels={"page": "yes"}).name for _ in range(3)]
    first = http.get("/v1/sessions", params={"labels": "page=yes", "page_size": 2, "states": "SESSION_STATE_IDLE"}).json()
    params = {"labels": "page=yes", "page_size": 2, "states": "SESSION_STATE_IDLE", "page_token": first["next_page_token"]}
    second = http.get("/v1/sessions", params=params).json()
    assert [s["name"] for s in first["sessions"] + second["sessions"]] == names
    assert second["next_page_token"] == ""
    changed = http.get("/v1/sessions", params=params | {"states": "SESSION_STATE_TRACKING"})
    assert (changed.status_code, changed.json()["error"]["field"]) == (422, "page_token")
    with pytest.raises(InvalidArgument, match="page_token"):
        api.call("ListSessions", pb.ListSessionsRequest(page_token="garbage"))
    assert http.get("/v1/sessions", params={"labels": "page=yes", "states": "SESSION_STATE_LOST"}).json()["sessions"] == []
    assert http.get("/v1/sessions", params={"states": "happy"}).json()["error"]["field"] == "states"
    for name in names:
        api.delete(name)


def test_lists_leave_out_what_takes_kilobytes(service, api, http, sheet):
    """A dashboard asks every second. Of a session alone it is there, live; ended sessions are listed as live ones."""
    with connect(service.grpc) as client:
        labels = {"list": "short"}
        name = client.create_session(*sheet, config={"associate": {"wide_gate": 0.3}}, clean=True, labels=labels).name
        whole = api.get(name)
        assert json.loads(whole.config_json)["associate"]["wide_gate"] == 0.3
        assert whole.HasField("vertex_map")
        short = pb.Session()
        short.CopyFrom(whole)
        short.ClearField("config_json")
        short.ClearField("vertex_map")

        def listed(state: str) -> tuple[pb.Session, pb.Session]:
            """Over gRPC and over REST."""
            request = pb.ListSessionsRequest(labels=labels, states=[pb.SessionState.Value(state)])
            over_rest = http.get("/v1/sessions", params={"labels": "list=short", "states": state}).text
            answers = api.call("ListSessions", request), json_format.Parse(over_rest, pb.ListSessionsResponse())
            return tuple(session for answer in answers for session in answer.sessions)

        for session in listed("SESSION_STATE_IDLE"):
            session.expire_time.CopyFrom(short.expire_time)
            session.checkpoint_time.CopyFrom(short.checkpoint_time)
            assert session == short
        assert [info.config for info in client.sessions(labels=labels)] == [None]
        assert client.open_session(name).info().config["associate"]["wide_gate"] == 0.3
        api.delete(name)
        over_grpc, over_rest = eventually(lambda: listed("SESSION_STATE_CLOSED"))
        assert over_grpc == over_rest
        assert (over_grpc.garment_vertex_count, over_grpc.config_json) == (len(sheet.vertices), "")
        assert not over_grpc.HasField("vertex_map")


def test_a_taken_or_malformed_id_is_refused(api, session, sheet):
    with pytest.raises(SessionExists):
        api.create(sheet, session.removeprefix("sessions/"))
    with pytest.raises(InvalidArgument, match="session_id"):
        api.create(sheet, "No Spaces")


def test_updating_labels_and_limits(api, session):
    before = api.get(session)
    change = pb.Session(name=session, labels={"a": "b"}, limits=pb.SessionLimits(max_points=10, idle_timeout=1e9))
    after = api.call("UpdateSession", pb.UpdateSessionRequest(session=change))
    assert dict(after.labels) == {"a": "b"}
    assert after.limits.max_points == 10
    assert after.limits.idle_timeout == before.limits.idle_timeout, "lowered to what the server allows"
    assert after.etag != before.etag
    with pytest.raises(InvalidArgument, match="update_mask"):
        api.call("UpdateSession", pb.UpdateSessionRequest(session=pb.Session(name=session, state=pb.SESSION_STATE_LOST)))


def test_another_configuration_and_fabric_while_frames_are_tracked(api, session, sheet):
    """The tracker continues: frame number and time of the last frame still count."""

    def update(**change):
        return api.call("UpdateSession", pb.UpdateSessionRequest(session=pb.Session(name=session, **change)))

    talk = Talk(api, session)
    assert talk.ask(frame_of(sheet, 1))[-1].result.frames_applied == 1
    between = [update(config_json='{"associate": {"wide_gate": 0.05}}'), update(fabric="silk")]
    with pytest.raises(InvalidConfig, match="fabric"):
        update(fabric="iron", labels={"never": "set"})
    assert talk.ask(frame_of(sheet, 2))[-1].result.frames_applied == 2
    talk.end()
    first, second = (json.loads(answer.config_json) for answer in between)
    assert first["associate"]["wide_gate"] == second["associate"]["wide_gate"] == 0.05
    assert first["physics"] != second["physics"] == ddakf.Config().with_fabric(ddakf.Fabric.named("silk")).to_dict()["physics"]
    after = api.get(session)
    assert (after.fabric, dict(after.labels), after.config_json) == ("silk", {}, between[1].config_json)


def test_an_update_of_what_another_has_changed_meanwhile_is_refused(api, session):
    seen = api.get(session).etag
    change = pb.UpdateSessionRequest(session=pb.Session(name=session, etag=seen, labels={"mine": "1"}))
    after = api.call("UpdateSession", change)
    with pytest.raises(FailedPrecondition, match="etag") as caught:
        api.call("UpdateSession", change)
    assert caught.value.field == "etag"
    change.session.etag = after.etag
    assert api.call("UpdateSession", change).etag not in (seen, after.etag)


def test_a_session_tells_its_memory_and_when_it_expires(api, sheet):
    limits = pb.SessionLimits(idle_timeout=50, max_lifetime=20, departure_timeout=1e6, max_frame_rate=7, max_points=1000)
    small = api.create(sheet, limits=limits)
    large = api.create(make_sheet(40, 0.01))
    assert small.limits.departure_timeout == 50, "at most the idle timeout"
    assert small.limits.max_frame_rate == 7
    assert small.expire_time.ToNanoseconds() - small.create_time.ToNanoseconds() == pytest.approx(20e9, abs=1e9)
    assert 0 < small.statistics.memory_bytes < large.statistics.memory_bytes
    for name in (small.name, large.name):
        api.delete(name)


@pytest.mark.parametrize(
    ("field", "wrong"),
    [
        ("session.name", pb.Session(name="sessions/mine")),
        ("labels", pb.Session(labels={"": "nothing"})),
    ],
)
def test_a_new_session_takes_nothing_silently(api, sheet, field, wrong):
    request = pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment=pack_mesh(*sheet)))
    request.session.MergeFrom(wrong)
    with pytest.raises(InvalidArgument) as refused:
        api.call("CreateSession", request)
    assert refused.value.field == field


def test_an_unknown_view_is_refused(api, session):
    with pytest.raises(InvalidArgument, match="view: expected SESSION_VIEW_BASIC"):
        api.call("GetSession", pb.GetSessionRequest(name=session, view=9))


@pytest.mark.parametrize("states", [[0], [99], [pb.SESSION_STATE_IDLE, pb.SESSION_STATE_CLOSED]])
def test_sessions_of_no_state_or_of_both_kinds_are_not_listed(api, states):
    with pytest.raises(InvalidArgument, match="states: expected states of"):
        api.call("ListSessions", pb.ListSessionsRequest(states=states))


@pytest.mark.parametrize("field", ["max_frame_rate", "idle_timeout", "max_lifetime", "departure_timeout"])
@pytest.mark.parametrize("value", [-1.0, float("nan"), float("inf")])
def test_a_limit_that_is_no_number_is_refused(api, session, field, value):
    change = pb.Session(name=session, limits=pb.SessionLimits(**{field: value}))
    with pytest.raises(InvalidArgument, match=field):
        api.call("UpdateSession", pb.UpdateSessionRequest(session=change))


def test_a_repeated_request_over_another_connection_creates_once(service, api, sheet):
    request = pb.CreateSessionRequest(
        api_version=API_VERSION, session=pb.Session(garment=pack_mesh(*sheet)), request_id=str(uuid.uuid4())
    )
    name = api.call("CreateSession", request).name
    other = Api(service.grpc)
    with other.channel:
        assert other.call("CreateSession", request).name == name
    api.delete(name)
    with pytest.raises(SessionNotFound, match="deleted"):
        api.call("CreateSession", request)


def test_reset_starts_again_from_given_vertices(api, session, sheet):
    moved = sheet.vertices + np.array([0.5, 0, 0])
    list(api.track(session, [request_of(frame_of(sheet, 1))]))
    request = pb.ResetSessionRequest(name=session, vertices=pack(moved, pb.ARRAY_ENCODING_FLOAT64))
    api.call("ResetSession", request)
    responses = list(api.track(session, [request_of(frame_of(sheet, 2, shift=(0.5, 0, 0)))]))
    vertices = np.frombuffer(responses[-1].result.vertices.data, "<f4").reshape(-1, 3)
    assert np.abs(vertices - moved).max() < 0.02
    with pytest.raises(InvalidArgument, match="vertices"):
        api.call("ResetSession", pb.ResetSessionRequest(name=session, vertices=pack(moved[:5])))


def test_cleaning_answers_the_vertex_map(api, http, sheet):
    vertices = np.concatenate([[[9.0, 9.0, 9.0]], sheet.vertices])
    faces = np.concatenate([sheet.faces + 1, sheet.faces[:1] + 1])
    mesh = {"vertices": vertices.tolist(), "faces": faces.tolist()}
    refused = http.post("/v1/sessions", json={"session": {"garment": mesh}})
    assert refused.status_code == 422
    message = refused.json()["error"]["message"]
    assert "1 unreferenced" in message
    assert "1 duplicate" in message
    assert "clean=true" in message
    answer = http.post("/v1/sessions", json={"session": {"garment": mesh}, "clean": True}).text
    created = json_format.Parse(answer, pb.Session())
    vertex_map = unpack(created.vertex_map, field="vertex_map", max_items=len(vertices))
    assert vertex_map.tolist() == list(range(1, len(vertices)))
    api.delete(created.name)


def test_another_major_version_is_refused(api, sheet):
    for version in ("2.0", "", "one"):
        request = pb.CreateSessionRequest(api_version=version, session=pb.Session(garment=pack_mesh(*sheet)))
        with pytest.raises(VersionMismatch, match="speaks ddakf API"):
            api.call("CreateSession", request)


@pytest.mark.slow
def test_the_sample_is_tracked(client):
    sequence = data.sample()
    rng, sensor = np.random.default_rng(0), Sensor("full", points=6000)
    garment = ddakf.Mesh(sequence.template, sequence.garment_faces)
    body = ddakf.Mesh(sequence.body_vertices[0], sequence.body_faces)
    frames = [
        Frame(sensor.capture(sequence, i, rng).points, sequence.timestamp(i), None, sequence.body_vertices[i]) for i in range(6)
    ]
    with client.create_session(garment, body=body, flow="lossless") as session:
        session.reset(sequence.garment_vertices[0])
        results = list(session.track(frames, covariance=True, velocities=True))
    assert [result.sequence for result in results] == [1, 2, 3, 4, 5, 6]
    assert results[-1].state == "tracking"
    assert results[-1].covariance.shape == (garment.n_vertices, 3, 3)
    assert rmse_mm(results[-1].vertices, sequence.garment_vertices[5]) < 15
