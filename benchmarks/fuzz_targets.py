"""Fuzz targets: readers of external bytes, each with valid examples to mutate and the errors that it may raise.

A target takes any bytes. The first ones of a codec's are the sizes that the message around the payload declares.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from ddakf_api import API_VERSION, codec
from ddakf_api.arrays import pack, pack_mesh, unpack
from ddakf_api.errors import ServiceError
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.store.files import checkpoints
from ddakf_service.streaming.frame_bounds import require_frame_within_bounds
from ddakf_service.streaming.frame_message import FrameMessage
from ddakf_service.transports.dialect import reading
from ddakf_service.transports.track_requests import read_track_request
from ddakf_service.workers.compute.tracker_host import TrackerHost
from ddakf_service.workers.messages import decode
from ddakf_service.workers.messages.wire import frame_request_head, unpack_result
from ddakf_service.workers.pool import Limits
from google.protobuf import json_format
from google.protobuf.message import DecodeError

import ddakf
from ddakf import snapshot
from ddakf.commands import warmup
from ddakf.errors import DdakfError

LIMITS = Limits(max_points=2_000, max_vertices=200, max_faces=400, max_body_vertices=200, max_image_pixels=4_096)
REFUSALS = (ServiceError, DdakfError, DecodeError, checkpoints.DamagedCheckpoint, RecursionError)
_SIZES = struct.Struct("<HH")
_RNG = np.random.default_rng(0)


class Target(NamedTuple):
    """A reader of bytes."""

    run: Callable[[bytes], object]
    seeds: list[bytes]


def all_targets() -> dict[str, Callable[[], Target]]:
    """Factories of the targets by name; one may take a second."""
    clouds = {f"cloud {name}": lambda name=name: _cloud(name) for name in codec.CODECS}
    images = {f"image {name}": lambda name=name: _image(name) for name in codec.DEPTH_CODECS}
    return {
        **clouds,
        **images,
        "packed array": _packed_array,
        "depth image": _depth_image,
        "frame": _frame,
        "requests as JSON": _requests_as_json,
        "session": _session,
        "reset": _reset,
        "snapshot": _snapshot,
        "snapshot inside": _snapshot_inside,
        "checkpoint": _checkpoint,
    }


def _cloud(name: str) -> Target:
    decoder = codec.DracoDecoder(LIMITS.max_points) if name == "draco" else None

    def run(data: bytes) -> None:
        count, step = _SIZES.unpack(data[:4].ljust(4, b"\0"))
        cloud = pb.PointCloud(codec=codec.CODECS[name], point_count=count, step=step * 1e-5, data=data[4:])
        points = codec.decode(cloud, max_points=LIMITS.max_points, draco_decoder=decoder)
        assert points.shape == (count, 3)
        assert np.isfinite(points).all()

    seeds = []
    for count in (1, 60, 400):
        points = _RNG.normal(size=(count, 3)) * 0.3
        seeds.append(_SIZES.pack(count, 50) + codec.encode(points, name, step=0.0005).cloud.data)
    return Target(run, seeds)


def _image(name: str) -> Target:
    def run(data: bytes) -> None:
        width, height = _SIZES.unpack(data[:4].ljust(4, b"\0"))
        image = pb.DepthImage(encoding=pb.DEPTH_ENCODING_UINT16_MILLIMETRES, width=width, height=height, data=data[4:])
        image.compression = image.mask_compression = codec.DEPTH_CODECS[name]
        image.intrinsics.fx = image.intrinsics.fy = 50
        back = codec.decode_depth(image, max_pixels=LIMITS.max_image_pixels)
        assert back.depth.shape == (height, width)

    seeds = []
    for shape in ((1, 1), (7, 5), (40, 60)):
        depth = (_RNG.integers(900, 1100, shape) * (_RNG.random(shape) < 0.8)).astype(np.uint16)
        seeds.append(_SIZES.pack(shape[1], shape[0]) + codec.encode_depth(depth, (50, 50, 2, 2), codec=name).data)
    return Target(run, seeds)


def _packed_array() -> Target:
    def run(data: bytes) -> None:
        message = pb.PackedArray.FromString(data)
        components = 3 if len(message.offset) == 3 else None
        array = unpack(message, components, field="array", max_items=1_000)
        assert len(array) <= 1_000

    values = _RNG.normal(size=(20, 3))
    encodings = [value for value in pb.ArrayEncoding.values() if value]
    return Target(run, [pack(np.abs(values), encoding, step=0.001).SerializeToString() for encoding in encodings])


def _sheet() -> tuple[np.ndarray, np.ndarray]:
    """(36, 3) vertices, metres, and (50, 3) faces."""
    x, y = np.meshgrid(np.arange(6), np.arange(6), indexing="ij")
    vertices = 0.03 * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    corner = (x[:-1, :-1] * 6 + y[:-1, :-1]).ravel()
    below = np.stack([corner, corner + 6, corner + 1], axis=1)
    above = np.stack([corner + 1, corner + 6, corner + 7], axis=1)
    return vertices, np.concatenate([below, above])


def _creation() -> pb.CreateSessionRequest:
    vertices, faces = _sheet()
    session = pb.Session(garment=pack_mesh(vertices, faces), body=pack_mesh(vertices - [0, 0, 0.05], faces))
    return pb.CreateSessionRequest(api_version=API_VERSION, session=session, session_id="fuzz")


def _frames() -> list[pb.Frame]:
    vertices, _ = _sheet()
    frames = []
    for name in codec.CODECS:
        colors = _RNG.integers(0, 256, vertices.shape, np.uint8) if name != "raw" else None
        cloud = codec.encode(vertices, name, colors=colors).cloud
        cloud.ClearField("crc32")
        frames.append(pb.Frame(sequence_number=1, capture_time=1.0, point_cloud=cloud, display_time=1.1))
    frames[0].body_vertices = (vertices - [0, 0, 0.05]).astype("<f4").tobytes()
    frames[1].sensors.add(origin=pb.Vector3(z=1.0))
    frames[2].sensors.extend([pb.Sensor(origin=pb.Vector3(z=1.0), point_count=18)] * 2)
    frames.extend(pb.Frame(sequence_number=1, capture_time=1.0, depth_image=image) for image in _depth_images())
    return frames


def _depth_images() -> list[pb.DepthImage]:
    depth = np.full((24, 32), 1000, np.uint16)
    mask = np.zeros(depth.shape, bool)
    mask[8:16, 10:22] = True
    pose = np.array([[1, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 1.0]])
    more = {"pose": pose, "mask": mask, "confidence": np.full(depth.shape, 200, np.uint8), "min_confidence": 100}
    images = [codec.encode_depth(depth, (100, 100, 15.5, 11.5), codec=name, **more) for name in codec.DEPTH_CODECS]
    colors = _RNG.integers(0, 256, (*depth.shape, 3), np.uint8)
    return [*images, codec.encode_depth(depth * 1e-3, (100, 100, 15.5, 11.5), colors=colors, **more)]


def _depth_image() -> Target:
    def run(data: bytes) -> None:
        frame = pb.Frame(depth_image=pb.DepthImage.FromString(data))
        _require_within_bounds(FrameMessage.of(frame))
        arguments = decode.step_arguments(frame, LIMITS, None)
        assert len(arguments["points"]) <= LIMITS.max_image_pixels
        assert arguments["colors"] is None or arguments["colors"].shape == arguments["points"].shape

    return Target(run, [image.SerializeToString() for image in _depth_images()])


def _require_within_bounds(frame: FrameMessage) -> None:
    require_frame_within_bounds(frame, LIMITS.max_points, LIMITS.max_image_pixels, LIMITS.max_body_vertices)


def _computing() -> TrackerHost:
    warmup.warm()  # which would count as the time and the memory of an input
    compute = TrackerHost(LIMITS)
    compute.open("fuzz", _creation().SerializeToString())
    return compute


def _frame() -> Target:
    compute = _computing()
    options = pb.ResultOptions(include_covariance=True, include_velocities=True, vertex_encoding=pb.ARRAY_ENCODING_QUANTISED_16)

    def run(data: bytes) -> None:
        request = read_track_request(data)
        is_frame = isinstance(request, FrameMessage)
        frame = request if is_frame else FrameMessage.of(pb.Frame())
        _require_within_bounds(frame)
        compute.reset("fuzz", b"")  # or one frame far in the future would have all that follow refused
        given = options if is_frame or not request.HasField("start") else request.start.result_options
        content = b"".join((frame_request_head(given.SerializeToString(), LIMITS.max_points), frame.data))
        result = pb.Result.FromString(b"".join(unpack_result(compute.frame("fuzz", content))))
        vertices = unpack(result.vertices, 3, field="vertices", max_items=LIMITS.max_vertices)
        assert np.isfinite(vertices).all()

    seeds = [pb.TrackRequest(frame=frame).SerializeToString() for frame in _frames()]
    start = pb.Start(name="sessions/fuzz", api_version=API_VERSION, result_options=options)
    return Target(run, [*seeds, pb.TrackRequest(start=start).SerializeToString()])


def _requests_as_json() -> Target:
    """What a browser sends: frames over a WebSocket, creations over REST."""

    def run(data: bytes) -> None:
        kind = pb.CreateSessionRequest if b"garment" in data else pb.TrackRequest
        reading.read(data, kind)

    requests = [*(pb.TrackRequest(frame=frame) for frame in _frames()), _creation()]
    return Target(run, [json_format.MessageToJson(request).encode() for request in requests])


def _session() -> Target:
    warmup.warm()
    compute = TrackerHost(LIMITS)

    def run(data: bytes) -> None:
        compute.open("fuzz", data)
        compute.close("fuzz", b"")

    plain = _creation()
    configured = _creation()
    configured.session.config_json, configured.session.fabric, configured.clean = '{"associate": {"iterations": 2}}', "silk", True
    return Target(run, [plain.SerializeToString(), configured.SerializeToString()])


def _reset() -> Target:
    compute = _computing()
    vertices, _ = _sheet()
    request = pb.ResetSessionRequest(name="sessions/fuzz", vertices=pack(vertices), velocities=pack(0 * vertices))
    return Target(lambda data: compute.reset("fuzz", data), [request.SerializeToString()])


def _tracker() -> ddakf.Tracker:
    warmup.warm()
    vertices, faces = _sheet()
    tracker = ddakf.Tracker(ddakf.Mesh(vertices, faces), body=ddakf.Mesh(vertices - [0, 0, 0.05], faces))
    tracker.step(vertices, timestamp=0.0, colors=_RNG.integers(0, 256, vertices.shape, np.uint8))
    return tracker


def _restored(data: bytes) -> None:
    tracker = decode.tracker_from_snapshot(data, LIMITS)
    later = tracker.step(_sheet()[0], timestamp=(tracker._track.time or 0.0) + 1.0)
    assert np.isfinite(later.vertices).all()


def _snapshot() -> Target:
    tracker = _tracker()
    return Target(_restored, [tracker.snapshot(), tracker.snapshot(compressed=False)])


def _snapshot_inside() -> Target:
    """The archive inside a snapshot, with a checksum that is right."""

    def run(data: bytes) -> None:
        body = zlib.compress(data, 1)
        _restored(snapshot.sealed(body))

    return Target(run, [zlib.decompress(_tracker().snapshot()[16:])])


def _checkpoint() -> Target:
    state = pb.SessionSnapshot(session=pb.Session(name="sessions/fuzz"), data=bytes(64))
    whole = checkpoints.pack(checkpoints.Checkpoint(state, (b"an answer",)))
    return Target(lambda data: checkpoints.unpack(data), [whole])
