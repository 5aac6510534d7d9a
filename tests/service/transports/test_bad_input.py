"""Invalid input: one sentence that names the field; the state stays unchanged."""

from __future__ import annotations

import json
import struct
from typing import NamedTuple

import numpy as np
import pytest
from ddakf_api import API_VERSION, codec
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import ERRORS
from ddakf_api.v1 import tracking_pb2 as pb

from ..conftest import Sheet, frame_of, make_sheet, request_of, workers

SHEET = make_sheet()
V = len(SHEET.vertices)


class Bad(NamedTuple):
    """An invalid frame and the words of its error."""

    spoil: object
    name: str
    field: str
    words: tuple[str, ...] = ()


def cloud(frame: pb.Frame, **fields) -> None:
    for name, value in fields.items():
        setattr(frame.point_cloud, name, value)


def raw(frame: pb.Frame, points: np.ndarray) -> None:
    data = points.astype("<f4").tobytes()
    frame.point_cloud.CopyFrom(pb.PointCloud(codec=pb.POINT_CODEC_RAW_FLOAT32, point_count=len(points), data=data))


def non_finite(frame: pb.Frame) -> None:
    points = SHEET.vertices.copy()
    points[3, 1] = np.nan
    raw(frame, points)


def flipped(frame: pb.Frame) -> None:
    data = bytearray(frame.point_cloud.data)
    data[len(data) // 2] ^= 0xFF
    frame.point_cloud.data = bytes(data)


def bomb(frame: pb.Frame) -> None:
    """A few bytes that declare a gigabyte."""
    header = b"\x28\xb5\x2f\xfd" + bytes([0b11100000]) + struct.pack("<Q", 1 << 30)
    cloud(frame, data=header + b"\x01\x00\x00")


def body(frame: pb.Frame, count: int) -> None:
    frame.body_vertices = np.zeros((count, 3), "<f4").tobytes()


def depth(frame: pb.Frame, **changes) -> None:
    """A depth image of four pixels at one metre."""
    frame.depth_image.CopyFrom(codec.encode_depth(np.ones((2, 2), np.float32), (100, 100, 0.5, 0.5), codec="none"))
    for name, value in changes.items():
        if name == "intrinsics":
            frame.depth_image.intrinsics.CopyFrom(value)
        else:
            setattr(frame.depth_image, name, value)


def at(frame: pb.Frame, time: float) -> None:
    frame.capture_time = time


BAD_FRAMES = {
    "non-finite points": Bad(non_finite, "CodecError", "point_cloud.data", ("finite", "1")),
    "truncated payload": Bad(lambda f: cloud(f, data=f.point_cloud.data[:-7]), "CodecError", "point_cloud.data"),
    "flipped bits": Bad(flipped, "CodecError", "point_cloud.data"),
    "no payload at all": Bad(lambda f: f.ClearField("payload"), "InvalidFrame", "payload", ("point_cloud", "neither")),
    "no payload but points": Bad(lambda f: cloud(f, data=b""), "CodecError", "point_cloud.data"),
    "decompression bomb": Bad(bomb, "CodecError", "point_cloud.data"),
    "raw of half a point": Bad(
        lambda f: cloud(f, codec=pb.POINT_CODEC_RAW_FLOAT32, data=b"\0" * (12 * V - 6)),
        "CodecError",
        "point_cloud.data",
        (str(12 * V), str(12 * V - 6)),
    ),
    "unknown codec": Bad(lambda f: cloud(f, codec=99), "CodecError", "point_cloud.codec", ("99",)),
    "Draco that is none": Bad(lambda f: cloud(f, codec=pb.POINT_CODEC_DRACO), "CodecError", "point_cloud.data", ("DRACO",)),
    "depth image without pixels": Bad(lambda f: f.depth_image.SetInParent(), "CodecError", "depth_image"),
    "depth image of gigabytes": Bad(
        lambda f: depth(f, width=60_000, height=60_000, data=b""), "CodecError", "depth_image", ("2097152", "60000 x 60000")
    ),
    "depth image without intrinsics": Bad(
        lambda f: depth(f, intrinsics=pb.Intrinsics()), "InvalidFrame", "depth_image.intrinsics", ("above 0",)
    ),
    "depth image and sensors": Bad(
        lambda f: (depth(f), f.sensors.append(pb.Sensor(origin=pb.Vector3(z=1)))), "InvalidFrame", "sensors"
    ),
    "depth of 20 km": Bad(lambda f: depth(f, data=np.full(4, 2e4, "<f4").tobytes()), "InvalidFrame", "depth_image"),
    "display before capture": Bad(lambda f: setattr(f, "display_time", 1e-3), "InvalidFrame", "display_time", ("-0.0656667",)),
    "display in a second": Bad(lambda f: setattr(f, "display_time", 1.1), "InvalidFrame", "display_time", ("0.5 s",)),
    "display at no time": Bad(lambda f: setattr(f, "display_time", float("nan")), "InvalidFrame", "display_time"),
    "5 million points": Bad(
        lambda f: raw(f, np.zeros((5_000_000, 3), np.float32)),
        "InvalidFrame",
        "point_cloud.point_count",
        ("500000", "5000000"),
    ),
    "more points than declared": Bad(lambda f: cloud(f, point_count=3), "CodecError", "point_cloud.data"),
    "step that is not finite": Bad(lambda f: cloud(f, step=float("nan")), "CodecError", "point_cloud.step"),
    "time going backwards": Bad(lambda f: at(f, 0.01), "InvalidFrame", "capture_time", ("0.01",)),
    "sequence number twice": Bad(lambda f: setattr(f, "sequence_number", 1), "InvalidFrame", "sequence_number"),
    "the last number of all": Bad(
        lambda f: setattr(f, "sequence_number", 2**64 - 1), "InvalidFrame", "sequence_number", ("2^63", str(2**64 - 1))
    ),
    "a number of 64 bits": Bad(lambda f: setattr(f, "sequence_number", 2**63), "InvalidFrame", "sequence_number"),
    "body of another size": Bad(lambda f: body(f, V + 1), "InvalidFrame", "body_vertices", (str(V), str(V + 1))),
    "body of half a vertex": Bad(lambda f: setattr(f, "body_vertices", b"\0" * 18), "InvalidFrame", "body_vertices"),
    "sensor without a place": Bad(lambda f: f.sensors.append(pb.Sensor()), "InvalidFrame", "sensors[0]"),
    "sensor at infinity": Bad(
        lambda f: f.sensors.append(pb.Sensor(origin=pb.Vector3(x=float("inf")))), "InvalidFrame", "sensors[0].origin"
    ),
    "runs that do not add up": Bad(
        lambda f: f.sensors.extend([pb.Sensor(origin=pb.Vector3(z=1), point_count=1)] * 2),
        "InvalidFrame",
        "sensors.point_count",
        (str(V),),
    ),
}


@pytest.fixture
def dressed(api):
    """A session with a body."""
    name = api.create(SHEET, body=pack_mesh(SHEET.vertices - np.array([0, 0, 0.05]), SHEET.faces)).name
    yield name
    api.delete(name)


@pytest.mark.parametrize("case", BAD_FRAMES)
def test_a_bad_frame_changes_nothing(api, dressed, case):
    bad = BAD_FRAMES[case]
    spoilt = frame_of(SHEET, 2)
    bad.spoil(spoilt)
    snapshot = pb.SnapshotSessionRequest(name=dressed)
    list(api.track(dressed, [request_of(frame_of(SHEET, 1))]))
    before = api.call("SnapshotSession", snapshot).data
    responses = list(api.track(dressed, [request_of(spoilt)]))
    refusal = responses[-1].frame_error
    assert api.call("SnapshotSession", snapshot).data == before
    assert (refusal.error.name, refusal.error.field) == (bad.name, bad.field)
    assert all(word in refusal.error.message for word in bad.words), refusal.error.message
    assert refusal.error.message
    assert "\n" not in refusal.error.message
    assert refusal.sequence_number == spoilt.sequence_number
    assert refusal.frames_rejected == 1
    (good,) = [r.result for r in api.track(dressed, [request_of(frame_of(SHEET, 3))]) if r.HasField("result")]
    assert good.frames_applied == 2
    assert good.frames_rejected == 1


def test_a_bad_frame_does_not_end_the_stream(api, session, sheet):
    spoilt = frame_of(sheet, 2)
    flipped(spoilt)
    requests = [request_of(f) for f in (frame_of(sheet, 1), spoilt, frame_of(sheet, 3))]
    kinds = [response.WhichOneof("message") for response in api.track(session, requests)]
    assert kinds == ["started", "result", "frame_error", "result"]


def changed(**parts) -> Sheet:
    return SHEET._replace(**parts)


def with_vertex(value: float) -> np.ndarray:
    vertices = SHEET.vertices.copy()
    vertices[5, 0] = value
    return vertices


BAD_MESHES = {
    "index out of range": (changed(faces=np.where(SHEET.faces == 3, 9999, SHEET.faces)), "garment.faces", ("9999",)),
    "vertex that is not finite": (changed(vertices=with_vertex(np.nan)), "garment.vertices", ("finite", "1")),
    "infinite vertex": (changed(vertices=with_vertex(np.inf)), "garment.vertices", ("finite", "1")),
    "no area": (changed(vertices=SHEET.vertices * 0), "garment", ("area",)),
    "no faces": (changed(faces=SHEET.faces[:0]), "garment", ("face",)),
    "no vertices": (Sheet(SHEET.vertices[:0], SHEET.faces[:0]), "garment", ()),
    "unreferenced vertices": (
        changed(vertices=np.concatenate([SHEET.vertices, SHEET.vertices + 1])),
        "garment",
        (f"{V} unreferenced", "clean=true"),
    ),
    "duplicate faces": (changed(faces=np.concatenate([SHEET.faces, SHEET.faces[:2]])), "garment", ("2 duplicate",)),
    "too many vertices": (make_sheet(320), "garment.vertices", ("100000", str(320**2))),
}


def create_request(mesh: Sheet) -> pb.CreateSessionRequest:
    garment = pb.Mesh(
        vertices=pb.PackedArray(encoding=pb.ARRAY_ENCODING_FLOAT64, data=mesh.vertices.astype("<f8").tobytes()),
        faces=pb.PackedArray(encoding=pb.ARRAY_ENCODING_UINT32, data=mesh.faces.astype("<u4").tobytes()),
    )
    return pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment=garment))


@pytest.mark.parametrize("case", BAD_MESHES)
def test_a_bad_mesh_is_refused_alike_by_both(api, http, case):
    mesh, field, words = BAD_MESHES[case]
    with pytest.raises(ERRORS["InvalidMesh"]) as caught:
        api.call("CreateSession", create_request(mesh))
    error = caught.value
    assert error.field == field
    assert all(word in error.message for word in words), error.message
    body = json.dumps({"garment": {"vertices": mesh.vertices.tolist(), "faces": mesh.faces.tolist()}})
    answer = http.post("/v1/sessions", content=body)
    assert answer.status_code == 422
    expected = {"name": "InvalidMesh", "field": field, "expected": error.expected, "got": error.got}
    assert answer.json()["error"] == {**expected, "message": error.message, "retry_after": 0.0}


GARMENT = {"vertices": SHEET.vertices.tolist(), "faces": SHEET.faces.tolist()}
BAD_BODIES = {
    "no JSON": (b"{", 422, "body"),
    "no object": (b"[]", 422, "body"),
    "no garment": ({}, 422, "garment"),
    "unknown field": ({"garment": GARMENT, "colour": "red"}, 422, "colour"),
    "vertices of two numbers": ({"garment": {**GARMENT, "vertices": [[0, 1]]}}, 422, "garment.vertices"),
    "faces that are no integers": ({"garment": {**GARMENT, "faces": [[0, 1, 2.5]]}}, 422, "garment.faces"),
    "faces below zero": ({"garment": {**GARMENT, "faces": [[0, 1, -2]]}}, 422, "garment.faces"),
    "faces beyond 32 bits": ({"garment": {**GARMENT, "faces": [[0, 1, 2**40]]}}, 422, "garment.faces"),
    "unknown encoding": (
        {"garment": {**GARMENT, "vertices": {"encoding": "float8", "data": ""}}},
        422,
        "garment.vertices.encoding",
    ),
    "no base64": (
        {"garment": {**GARMENT, "vertices": {"encoding": "float32", "data": "?"}}},
        422,
        "garment.vertices.data",
    ),
    "half a vertex": (
        {"garment": {**GARMENT, "vertices": {"encoding": "float32", "data": "AAAAAAAA"}}},
        422,
        "garment.vertices.data",
    ),
    "unknown stage": ({"garment": GARMENT, "config": {"magic": {}}}, 422, "config.magic"),
    "half a character": ({"garment": GARMENT, "config": {"\ud800": {}}}, 422, "config_json"),
    "value out of range": ({"garment": GARMENT, "config": {"predict": {"damping": -1}}}, 422, "config.predict.damping"),
    "unknown fabric": ({"garment": GARMENT, "fabric": "steel"}, 422, "fabric"),
    "bad id": ({"garment": GARMENT, "session_id": "../etc"}, 422, "session_id"),
    "another version": ({"garment": GARMENT, "api_version": "9.0"}, 400, "api_version"),
    "limit below zero": ({"garment": GARMENT, "limits": {"idle_timeout": -1}}, 422, "limits.idle_timeout"),
}


@pytest.mark.parametrize("case", BAD_BODIES)
def test_a_bad_body_is_refused_with_its_field(http, case):
    body, status, field = BAD_BODIES[case]
    answer = http.post("/v1/sessions", content=body if isinstance(body, bytes) else json.dumps(body))
    error = answer.json()["error"]
    assert (answer.status_code, error["field"]) == (status, field), error
    assert error["message"]


@pytest.mark.parametrize(
    ("body", "sentence"),
    [
        ({"garment": GARMENT, "colour": "red"}, 'colour: expected no field of this name, got "red"'),
        ({"session": {"garment": GARMENT, "colour": 1}}, "colour: expected no field of this name, got 1"),
        ({"session": {"fabrik": "x"}}, 'fabrik: expected no field of this name, got "x"; did you mean fabric?'),
        ({"session": {"garment": 5}}, "garment: expected an object, got 5"),
        ({"session": [], "garment": GARMENT}, "session: expected an object, got []"),
        ({}, "garment: expected a mesh, got nothing"),
        ([], "body: expected an object, got []"),
        ({"garment": 5}, "garment: expected an object, got 5"),
        (
            {"garment": {**GARMENT, "vertices": 7}},
            "garment.vertices: expected a list of triples, or an object of encoding and data, got 7",
        ),
        ({"garment": {**GARMENT, "vertices": [[0, 1]]}}, "garment.vertices: expected three numbers in each row, got [0, 1]"),
        ({"garment": {**GARMENT, "vertices": [["a", 1, 2]]}}, 'garment.vertices: expected a number, got "a"'),
        ({"garment": {**GARMENT, "faces": [[0, 1, 2.5]]}}, "garment.faces: expected an integer, got 2.5"),
        ({"garment": GARMENT, "limits": {"max_points": "many"}}, 'limits.max_points: expected an integer, got "many"'),
        (
            {"garment": GARMENT, "limits": {"idle_timeout": -1}},
            "limits.idle_timeout: expected a positive number of seconds, got -1",
        ),
        ({"garment": GARMENT, "fabric": 7}, "fabric: expected a string, got 7"),
        ({"garment": GARMENT, "clean": "maybe"}, 'clean: expected true or false, got "maybe"'),
    ],
)
def test_a_bad_body_is_refused_in_a_sentence(http, body, sentence):
    assert http.post("/v1/sessions", json=body).json()["error"]["message"] == sentence


def test_text_that_is_no_json_is_refused_in_a_sentence(http):
    message = http.post("/v1/sessions", content=b"{").json()["error"]["message"]
    assert message.startswith("body: expected a CreateSessionRequest as JSON, got invalid text: Expecting property")


@pytest.mark.parametrize(
    ("path", "sentence"),
    [
        ("sessions?page_size=x", 'page_size: expected an integer, got "x"'),
        ("sessions?page_size=-1", 'page_size: expected at least 0, got "-1"'),
        ("sessions/any?view=all", "view: expected SESSION_VIEW_BASIC or SESSION_VIEW_FULL, got 'all'"),
    ],
)
def test_a_bad_query_is_refused_in_a_sentence(http, path, sentence):
    assert http.get(f"/v1/{path}").json()["error"]["message"] == sentence


def test_a_bad_configuration_over_grpc(api, sheet):
    with pytest.raises(ERRORS["InvalidConfig"], match="config_json"):
        api.create(sheet, config_json="{not json")
    with pytest.raises(ERRORS["InvalidConfig"], match="JSON"):
        api.create(sheet, config_json="[" * 60_000)


@pytest.mark.parametrize(
    "text",
    [r'{"\ud800":{}}', r'{"physics":{"\ud800":1}}', r'{"preset":"\ud800"}', '{"start":' + "1" * 5000 + "}"],
    ids=["stage", "field", "preset", "digits"],
)
def test_a_configuration_that_is_no_text_harms_no_worker(api, http, service, session, sheet, text):
    before = workers(service.pid)
    with pytest.raises(ERRORS["InvalidConfig"], match="config_json"):
        api.create(sheet, config_json=text)
    with pytest.raises(ERRORS["InvalidConfig"], match="config_json"):
        api.call("UpdateSession", pb.UpdateSessionRequest(session=pb.Session(name=session, config_json=text)))
    created = http.post("/v1/sessions", json={"session": {"garment": GARMENT, "config_json": text}})
    for answer in (created, http.patch(f"/v1/{session}", json={"config_json": text})):
        assert (answer.status_code, answer.json()["error"]["field"]) == (422, "config_json")
    assert workers(service.pid) == before


@pytest.mark.parametrize("labels", [{"a" * 300: ""}, {str(i): "" for i in range(65)}], ids=["long", "many"])
def test_labels_have_bounds(api, sheet, labels):
    with pytest.raises(ERRORS["InvalidArgument"]) as caught:
        api.create(sheet, labels=labels)
    assert caught.value.field == "labels"
