"""Decoding in a worker: messages of the contract as meshes, configuration and frame arguments of the tracker.

Every length is checked against its limit before memory is allocated; errors name the field of the message.
"""

from __future__ import annotations

import json
from contextlib import contextmanager

import numpy as np
from ddakf_api import codec
from ddakf_api.arrays import FLOATS, unpack, unpack_mesh
from ddakf_api.errors import InvalidConfig, InvalidFrame, InvalidMesh, InvalidSnapshot, first_line
from ddakf_api.v1 import tracking_pb2 as pb

import ddakf
from ddakf import errors as library
from ddakf import snapshot
from ddakf.files import depth as depths

from ..pool import Limits
from .fields import field_of_frame

_MAX_CONFIG_CHARACTERS = 1 << 16
_MAX_PREDICTION = 0.5  # s between capture and display: a longer time is no latency and cannot be predicted


def garment(request: pb.CreateSessionRequest, max_vertices: int, max_faces: int) -> tuple[ddakf.Mesh, np.ndarray | None]:
    """The garment mesh, and with ``clean`` the vertex map (V,) of the repair."""
    if not request.session.HasField("garment"):
        raise InvalidMesh(field="garment", expected="a mesh", got="nothing")
    vertices, faces = unpack_mesh(request.session.garment, field="garment", max_vertices=max_vertices, max_faces=max_faces)
    with _with_mesh_fields("garment"):
        return ddakf.Mesh.cleaned(vertices, faces) if request.clean else (ddakf.Mesh(vertices, faces), None)


def body(session: pb.Session, max_vertices: int, max_faces: int) -> ddakf.Mesh | None:
    """The body mesh, if any."""
    if not session.HasField("body"):
        return None
    vertices, faces = unpack_mesh(session.body, field="body", max_vertices=max_vertices, max_faces=max_faces)
    with _with_mesh_fields("body"):
        return ddakf.Mesh(vertices, faces)


def config(session: pb.Session) -> ddakf.Config:
    """The tracker's configuration: the defaults, overridden by ``config_json``, then by ``fabric``."""
    configuration = ddakf.Config.from_dict(_config_values(session.config_json))
    return configuration.with_fabric(ddakf.Fabric.named(session.fabric)) if session.fabric else configuration


def changed_config(change: pb.UpdateSessionRequest, present: ddakf.Config) -> ddakf.Config:
    """A configuration after a change of ``config_json``, of ``fabric``, or of both.

    A new configuration keeps the fabric unless it names one. A fabric that is named as changed, and empty, is the default.
    """
    session, paths = change.session, change.update_mask.paths
    if "config_json" not in paths:
        return present.with_fabric(ddakf.Fabric.named(session.fabric) if session.fabric else ddakf.Fabric())
    changed = config(session)
    if "fabric" in paths or "fabric" in _config_values(session.config_json).get("physics", {}):
        return changed
    return changed.with_fabric(present.physics.fabric)


def _config_values(text: str) -> dict:
    if len(text) > _MAX_CONFIG_CHARACTERS:
        raise InvalidConfig(field="config_json", expected=f"at most {_MAX_CONFIG_CHARACTERS} characters", got=str(len(text)))
    try:
        values = json.loads(text) if text else {}
        json.dumps(values, ensure_ascii=False).encode()  # a lone surrogate is no text
    except (ValueError, RecursionError) as error:
        raise InvalidConfig(field="config_json", expected="a JSON object", got=first_line(error)) from None
    return values


def tracker_from_snapshot(data: bytes, limits: Limits) -> ddakf.Tracker:
    """The tracker of a snapshot. Meshes beyond the limits of a new session are rejected before anything is built."""
    numbers, arrays = snapshot.unpack(data)
    for name, maximum, elements in (
        ("garment_V", limits.max_vertices, "garment vertices"),
        ("garment_F", limits.max_faces, "garment faces"),
        ("body_V", limits.max_body_vertices, "body vertices"),
        ("body_F", limits.max_faces, "body faces"),
    ):
        count = np.size(arrays[name]) // 3 if name in arrays else 0
        if count > maximum:
            raise InvalidSnapshot(field="data", expected=f"at most {maximum} {elements}", got=str(count))
    return snapshot.build(numbers, arrays, ddakf.Tracker)


def step_arguments(frame: pb.Frame, limits: Limits, draco: codec.DracoDecoder) -> dict:
    """The arguments of ``Tracker.step`` for a frame."""
    if frame.WhichOneof("payload") == "depth_image":
        points, origin, colors = _unproject(frame, limits)
    else:
        points = codec.decode(frame.point_cloud, max_points=limits.max_points, draco_decoder=draco)
        colors = codec.decode_colors(frame.point_cloud)
        origin = codec.sensor_origins(frame.sensors, len(points))
    return {
        "points": points,
        "timestamp": frame.capture_time,
        "sensor_origin": origin,
        "body_vertices": _body_vertices(frame.body_vertices, limits.max_body_vertices),
        "colors": colors,
    }


def prediction_seconds(frame: pb.Frame) -> float:
    """Seconds from the frame's capture to the display of its result."""
    if frame.display_time == 0:
        return 0.0
    ahead = frame.display_time - frame.capture_time
    if not 0 <= ahead <= _MAX_PREDICTION:  # also false for a NaN
        expected = f"0, or from capture_time to {_MAX_PREDICTION} s after it"
        raise InvalidFrame(field="display_time", expected=expected, got=f"{ahead:.6g} s after it")
    return ahead


@contextmanager
def with_frame_fields(frame: pb.Frame):
    """Renames the fields in the tracker's errors to those of the frame."""
    try:
        yield
    except library.InvalidFrame as error:
        raise InvalidFrame(field=field_of_frame(error.field, frame), expected=error.expected, got=error.got) from None


def optional_array(message, field: str, max_items: int) -> np.ndarray | None:
    """(n, 3) numbers of an optional PackedArray."""
    if not message.HasField(field):
        return None
    return unpack(getattr(message, field), 3, field=field, max_items=max_items, encodings=FLOATS).astype(np.float64)


def _unproject(frame: pb.Frame, limits: Limits) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """World points (N, 3) of a depth image, metres, without flying pixels; the camera's centre (3,); their colors."""
    if frame.sensors:
        expected = "none with a depth image, which has its own pose"
        raise InvalidFrame(field="sensors", expected=expected, got=str(len(frame.sensors)))
    image = codec.decode_depth(frame.depth_image, max_pixels=limits.max_image_pixels)
    lens = depths.Intrinsics(*image.intrinsics)
    mask = depths.without_fliers(image.depth, depths.largest_step(image.depth, min(lens.fx, lens.fy)))
    if image.keep is not None:
        mask &= image.keep
    count = int(np.count_nonzero(mask))
    if count > limits.max_points:
        expected = f"at most {limits.max_points} pixels with a measurement (mask or scale it)"
        raise InvalidFrame(field="depth_image", expected=expected, got=str(count))
    colors = None if image.colors is None else image.colors[mask]
    return depths.unproject(image.depth, mask, lens, image.pose), image.pose[:, 3], colors


def _body_vertices(data: bytes, max_vertices: int) -> np.ndarray | None:
    if not data:
        return None
    if len(data) % 12:
        raise InvalidFrame(field="body_vertices", expected="float32 triples, 12 bytes each", got=f"{len(data)} bytes")
    if len(data) > 12 * max_vertices:
        raise InvalidFrame(field="body_vertices", expected=f"at most {max_vertices}", got=str(len(data) // 12))
    with np.errstate(invalid="ignore"):  # NumPy warns of a signalling NaN, which is rejected later with all others
        return np.frombuffer(data, "<f4").reshape(-1, 3).astype(np.float64)


@contextmanager
def _with_mesh_fields(name: str):
    """Renames the field "mesh" in errors to the given name."""
    try:
        yield
    except library.InvalidMesh as error:
        field = error.field.replace("mesh", name, 1)
        raise library.InvalidMesh(field, error.expected, error.got) from None
