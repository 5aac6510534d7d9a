"""Frame reader: agrees with the generated class on every message that it accepts, and accepts all ordinary frames."""

from __future__ import annotations

import numpy as np
import pytest
from ddakf_api import codec
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.streaming.frame_message import LARGE_FIELDS, FrameMessage
from ddakf_service.streaming.frame_reader import read_frame
from ddakf_service.transports.track_requests import read_track_request
from google.protobuf.message import DecodeError
from hypothesis import given, settings
from hypothesis import strategies as st

POINTS = np.random.default_rng(0).uniform(-1, 1, (8000, 3))
DEPTH = np.random.default_rng(1).uniform(1, 2, (240, 320)).astype(np.float32)
POSE = np.eye(4)[:3]

doubles = st.floats(allow_nan=False)
vectors = st.builds(pb.Vector3, x=doubles, y=doubles, z=doubles)
poses = st.builds(pb.Pose, matrix=st.lists(doubles, max_size=13))
uint32 = st.integers(0, 2**32 - 1)
sensors = st.one_of(
    st.builds(pb.Sensor, origin=vectors, point_count=uint32), st.builds(pb.Sensor, pose=poses), st.just(pb.Sensor())
)
clouds = st.builds(
    pb.PointCloud, codec=st.integers(0, 9), point_count=uint32, data=st.binary(max_size=300), step=doubles, origin=vectors,
    crc32=st.none() | uint32, colors=st.binary(max_size=100),
)  # fmt: skip
images = st.builds(
    pb.DepthImage, encoding=st.integers(0, 3), compression=st.integers(0, 9), width=uint32, height=uint32,
    data=st.binary(max_size=300), intrinsics=st.builds(pb.Intrinsics, fx=doubles, cy=doubles), pose=poses, depth_scale=doubles,
    mask=st.binary(max_size=200), confidence=st.binary(max_size=200), min_confidence=uint32,
    colors=st.binary(max_size=100),
)  # fmt: skip
common = {
    "sequence_number": st.integers(0, 2**64 - 1),
    "capture_time": doubles,
    "sensors": st.lists(sensors, max_size=66),
    "body_vertices": st.binary(max_size=100),
    "deadline": doubles,
    "display_time": doubles,
}
frames = st.one_of(
    st.builds(pb.Frame, **common),
    st.builds(pb.Frame, point_cloud=clouds, **common),
    st.builds(pb.Frame, depth_image=images, **common),
)


def parsed(data: bytes) -> FrameMessage:
    """The frame by the generated class, with the sizes of its large fields."""
    frame = pb.TrackRequest.FromString(data).frame
    message = FrameMessage.of(frame)
    if message.measurement is None:
        return message
    names = LARGE_FIELDS[message.measurement]
    return message._replace(sizes={name: len(getattr(getattr(frame, message.measurement), name)) for name in names})


def require_same(data: bytes, read: FrameMessage) -> None:
    assert pb.TrackRequest.FromString(data).WhichOneof("message") == "frame"
    expected = parsed(data)
    assert read[1:-1] == expected[1:-1]
    assert read.sizes in ({}, expected.sizes)
    assert pb.Frame.FromString(read.data) == pb.Frame.FromString(expected.data)


@settings(deadline=None)
@given(frames)
def test_every_frame_of_few_sensors_is_read(frame):
    data = pb.TrackRequest(frame=frame).SerializeToString()
    read = read_frame(data)
    assert (read is None) == (len(frame.sensors) > 64)
    if read is not None:
        require_same(data, read)
        assert read.sizes == parsed(data).sizes


@settings(deadline=None, max_examples=500)
@given(st.data())
def test_a_damaged_frame_is_read_as_the_generated_class_reads_it_or_not_at_all(data):
    whole = bytearray(pb.TrackRequest(frame=data.draw(frames)).SerializeToString())
    for _ in range(data.draw(st.integers(1, 4))):
        place = data.draw(st.integers(0, max(len(whole) - 1, 0)))
        match data.draw(st.sampled_from(["change", "cut", "insert", "repeat"])):
            case "change":
                whole[place : place + 1] = data.draw(st.binary(min_size=1, max_size=1))
            case "cut":
                del whole[place:]
            case "insert":
                whole[place:place] = data.draw(st.binary(max_size=12))
            case "repeat":
                whole += whole[place:]
    damaged = bytes(whole)
    if (read := read_frame(damaged)) is not None:
        require_same(damaged, read)


@settings(deadline=None)
@given(st.binary(max_size=60))
def test_arbitrary_bytes_are_read_as_the_generated_class_reads_them_or_not_at_all(content):
    frame = b"\x12" + bytes([len(content)]) + content
    for data in (content, frame):
        if (read := read_frame(data)) is not None:
            require_same(data, read)


@pytest.mark.parametrize("frame", [
    pb.Frame(sequence_number=7, capture_time=0.5, point_cloud=codec.encode(POINTS, "raw").cloud,
             sensors=[pb.Sensor(origin=pb.Vector3(x=1))]),
    pb.Frame(sequence_number=7, deadline=0.1, point_cloud=codec.encode(POINTS, "morton-zstd", step=1e-6).cloud),
    pb.Frame(sequence_number=7, depth_image=codec.encode_depth(DEPTH, (200, 200, 160, 120), pose=POSE, codec="none")),
    pb.Frame(sequence_number=7, body_vertices=bytes(120_000)),
])  # fmt: skip
def test_frames_of_the_codecs_are_handed_on_as_they_came(frame):
    data = pb.TrackRequest(frame=frame).SerializeToString()
    for read in (read_frame(data), read_track_request(data)):
        assert read.data == frame.SerializeToString()
        require_same(data, read)


UNUSUAL = {
    "an unknown field": pb.Frame(sequence_number=1).SerializeToString() + b"\x98\x06\x01",
    "a repeated field": b"\x08\x01\x08\x02",
    "both measurements": pb.Frame(point_cloud=pb.PointCloud(point_count=1)).SerializeToString()
    + pb.Frame(depth_image=pb.DepthImage(width=2)).SerializeToString(),
    "another wire type": b"\x09" + bytes(8),
    "a group": b"\x0b\x0c",
    "a large enum": b"\x82\x01\x06\x08\xff\xff\xff\xff\x0f",
}


@pytest.mark.parametrize("content", UNUSUAL.values(), ids=UNUSUAL)
@pytest.mark.parametrize("filling", [0, 1 << 17])
def test_unusual_frames_are_parsed(content, filling):
    content += pb.Frame(body_vertices=bytes(filling)).SerializeToString()
    data = pb.TrackRequest(ping=pb.Ping(token=1)).SerializeToString() + _field(2, content)
    for request in (data, _field(2, content)):
        assert read_frame(request) is None
        read, frame = read_track_request(request), pb.TrackRequest.FromString(request).frame
        assert read[1:] == FrameMessage.of(frame)[1:]
        assert pb.Frame.FromString(read.data) == frame


@pytest.mark.parametrize(
    "request_", [pb.TrackRequest(), pb.TrackRequest(start=pb.Start(name="n" * 70_000)), pb.TrackRequest(ping=pb.Ping(token=3))]
)
def test_other_requests_stay_messages(request_):
    assert read_track_request(request_.SerializeToString()) == request_


@pytest.mark.parametrize("filling", [0, 1 << 17])
def test_a_cut_off_frame_cannot_be_read(filling):
    data = pb.TrackRequest(frame=pb.Frame(sequence_number=5, body_vertices=bytes(filling))).SerializeToString()
    with pytest.raises(DecodeError):
        read_track_request(data[:-1])


def _field(number: int, content: bytes) -> bytes:
    """A field of bytes."""
    size, length = bytearray(), len(content)
    while length > 0x7F:
        size.append(length & 0x7F | 0x80)
        length >>= 7
    return bytes([number << 3 | 2, *size, length]) + content
