"""Oversized requests, in bytes or in elements, are rejected before memory is allocated."""

from __future__ import annotations

import json
import sys
import threading
import time

import numpy as np
import pytest
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import InvalidArgument, InvalidFrame, MessageTooLarge, ResourceExhausted
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.streaming.frame_bounds import require_frame_within_bounds
from ddakf_service.streaming.frame_message import FrameMessage
from ddakf_service.transports import bounded_parsing
from ddakf_service.transports.dialect.reading import parsed, read
from google.protobuf.message import DecodeError

from ..conftest import frame_of, make_sheet, request_of
from .websockets_client import START, line


def test_a_message_above_the_limit_leaves_the_session(api, session, sheet):
    list(api.track(session, [request_of(frame_of(sheet, 1))]))
    huge = frame_of(sheet, 2)
    huge.body_vertices = b"\0" * (65 << 20)
    with pytest.raises(ResourceExhausted, match="larger than max"):
        list(api.track(session, [request_of(huge)]))
    started = next(api.track(session, [], takeover=True)).started
    assert started.last_sequence_number == 1


def test_a_body_above_the_limit_is_cut_off(http):
    def endless():
        for _ in range(40):
            yield b" " * (1 << 20)

    answer = http.post("/v1/sessions", content=endless())
    assert answer.status_code == 413
    assert answer.json()["error"]["field"] == "body"


@pytest.mark.parametrize(
    "body",
    [
        b'{"labels":{' + b",".join(b'"%x":1' % i for i in range(70_000)) + b"}}",
        b'{"config":{"a":' + b"[" * (1 << 20),
        b'{"garment":{"vertices":[[' + b"1," * 3_000_000 + b"1]]}}",
    ],
    ids=["members", "lists", "numbers"],
)
def test_a_body_of_countless_parts_is_refused_before_they_are_made(http, body):
    answer = http.patch("/v1/sessions/nobody", content=body)
    assert (answer.status_code, answer.json()["error"]["name"]) == (413, "MessageTooLarge")


def test_a_list_of_as_many_rows_as_a_mesh_has_is_read_in_order():
    rows = [[i, i + 1, i + 2] for i in range(20_001)]
    mesh = read(json.dumps({"vertices": rows, "faces": rows}), pb.Mesh)
    assert np.array_equal(np.frombuffer(mesh.vertices.data, "<f8").reshape(-1, 3), rows)
    assert np.array_equal(np.frombuffer(mesh.faces.data, "<u4").reshape(-1, 3), rows)


def test_other_threads_run_while_a_list_of_numbers_is_parsed():
    """The parser of the standard library keeps the interpreter from its first number to its last."""
    parsing, turns, interval = threading.Event(), [], sys.getswitchinterval()
    text = json.dumps([1.5, 2] * 200_000)

    def run_beside() -> None:
        parsing.wait()
        while parsing.is_set():
            turns.append(None)
            time.sleep(0)

    beside = threading.Thread(target=run_beside)
    beside.start()
    sys.setswitchinterval(1e-4)
    try:
        parsing.set()
        assert parsed(text, pb.Mesh) == [1.5, 2] * 200_000
    finally:
        parsing.clear()
        sys.setswitchinterval(interval)
        beside.join()
    assert len(turns) > 20


COUNTLESS = [
    pb.TrackRequest(frame=pb.Frame(sensors=[pb.Sensor()] * 40_000)),
    pb.TrackRequest(frame=pb.Frame(sensors=[pb.Sensor(pose=pb.Pose(matrix=[0.0] * 10_000))])),
    pb.CreateSessionRequest(session=pb.Session(labels={str(i): "" for i in range(20_000)})),
    pb.ListSessionsRequest(states=[pb.SESSION_STATE_IDLE] * 80_000),
    pb.UpdateSessionRequest(update_mask={"paths": ["labels"] * 20_000}),
]


@pytest.mark.parametrize("message", COUNTLESS, ids=["messages", "numbers", "entries", "enums", "texts"])
def test_a_message_of_countless_parts_is_refused_before_they_are_made(message):
    with pytest.raises(MessageTooLarge, match="message: expected at most 16384 elements, got more"):
        bounded_parsing.parse(type(message), message.SerializeToString())


def test_a_message_as_large_as_messages_are_is_the_parsers():
    pose = pb.Pose(matrix=range(12))
    frame = frame_of(make_sheet(300), 1)
    frame.sensors.extend([pb.Sensor(pose=pose, point_count=1)] * 64)
    frame.body_vertices = bytes(12 * 100_000)
    labels = {"x" * 250 + str(i): "y" * 256 for i in range(64)}
    session = pb.Session(garment=pack_mesh(*make_sheet(100)), labels=labels)
    for message in (pb.TrackRequest(frame=frame), pb.CreateSessionRequest(session=session)):
        data = message.SerializeToString()
        assert len(data) > 1 << 17
        assert bounded_parsing.parse(type(message), data) == message


@pytest.mark.parametrize("end", [b"\x0a", b"\x0a\xff", b"\xff" * 40, b"\x0a\x05a", b"\x0f"])
def test_a_message_that_is_cut_off_is_none(end):
    request = pb.TrackRequest(frame=pb.Frame(body_vertices=bytes(1 << 17)))
    with pytest.raises(DecodeError):
        bounded_parsing.parse(pb.TrackRequest, request.SerializeToString() + end)


def test_messages_of_countless_parts_are_refused_over_grpc(api, session):
    with pytest.raises(MessageTooLarge, match="elements"):
        api.call("CreateSession", COUNTLESS[2])
    with pytest.raises(MessageTooLarge, match="elements"):
        list(api.track(session, COUNTLESS[:1]))
    assert api.get(session).statistics.frames_rejected == 0


@pytest.mark.parametrize("mode", ["binary", "json"])
def test_messages_of_countless_parts_are_refused_over_websocket(service, session, mode):
    with line(service, f"{session}/stream", mode) as websocket:
        websocket.send(START)
        assert websocket.receive().HasField("started")
        websocket.send(COUNTLESS[0])
        assert websocket.ending() == (4413, "message: expected at most 16384 elements, got more")


def test_a_frame_with_a_body_beyond_all_limits_waits_for_no_worker():
    frame = pb.Frame(point_cloud=pb.PointCloud(), body_vertices=bytes(12 * 1000 + (1 << 16)))
    require_frame_within_bounds(FrameMessage.of(frame), 10, 10, 1000 + 1)
    with pytest.raises(InvalidFrame, match="frame: expected at most 65548 bytes beside the measurement, of 1 body_vertices"):
        require_frame_within_bounds(FrameMessage.of(frame), 10, 10, 1)


def test_a_frame_of_countless_sensors_is_refused_at_the_door():
    frame = pb.Frame(sensors=[pb.Sensor()] * 65)
    with pytest.raises(InvalidFrame, match="sensors: expected at most 64, got 65"):
        require_frame_within_bounds(FrameMessage.of(frame), 10, 10, 10)
    del frame.sensors[64:]
    frame.point_cloud.SetInParent()
    require_frame_within_bounds(FrameMessage.of(frame), 10, 10, 10)


@pytest.mark.parametrize("row", [[], [0.0, 0.0], [0.0, 0.0, 0.0, 0.0], ["a", "b", "c"], "row"])
def test_of_wrong_rows_the_first_is_the_error(row):
    """A body has room for millions of rows."""
    for kind, field, body in (
        (pb.ResetSessionRequest, "vertices", {"vertices": [row] * 1000}),
        (pb.CreateSessionRequest, "garment.faces", {"garment": {"vertices": [[0.0, 0.0, 0.0]], "faces": [row] * 1000}}),
    ):
        with pytest.raises(InvalidArgument) as refused:
            read(json.dumps(body), kind)
        assert refused.value.field == field
        assert len(str(refused.value)) < 200
