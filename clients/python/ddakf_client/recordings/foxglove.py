"""Foxglove: frames and results as documents of its schemas, in JSON. Time is that of capture."""

from __future__ import annotations

import base64
import json

import numpy as np
from ddakf_api import codec
from ddakf_api.errors import ServiceError
from ddakf_api.v1 import tracking_pb2 as pb

from ddakf_client.results import Result

_MAX_POINTS = 10_000_000  # of a frame that the server has accepted already
_FLOAT32 = 7  # foxglove.PackedElementField
_WORLD = "world"
_POINT = '{"x":%.5f,"y":%.5f,"z":%.5f}'
_GOOD, _BAD = np.array([0.16, 0.60, 0.66]), np.array([0.76, 0.16, 0.33])  # colours of reliability 1 and 0
_SHADES = [json.dumps(dict(zip("rgba", [*shade, 1.0], strict=True))) for shade in np.linspace(_BAD, _GOOD, 101).round(3).tolist()]

_TIME = {"type": "object", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}}
_ANY = {"type": "object"}
POINT_CLOUD = {
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "frame_id": {"type": "string"},
        "pose": _ANY,
        "point_stride": {"type": "integer"},
        "fields": {"type": "array", "items": _ANY},
        "data": {"type": "string", "contentEncoding": "base64"},
    },
}
SCENE_UPDATE = {
    "type": "object",
    "properties": {"deletions": {"type": "array", "items": _ANY}, "entities": {"type": "array", "items": _ANY}},
}
NUMBERS = {
    "type": "object",
    "properties": {
        "timestamp": _TIME,
        "state": {"type": "string"},
        **{name: {"type": "number"} for name in ("reliability", "paper_score", "coverage", "mean_sigma")},
        **{name: {"type": "integer"} for name in ("sequence", "applied", "dropped", "rejected")},
        "seconds": {"type": "object", "additionalProperties": {"type": "number"}},
    },
}


def point_cloud(frame: pb.Frame) -> str | None:
    """The cloud of a frame; None: a depth image, or a codec that this machine cannot decode."""
    if frame.WhichOneof("payload") != "point_cloud":
        return None
    try:
        points = codec.decode(frame.point_cloud, max_points=_MAX_POINTS)
    except ServiceError:
        return None
    fields = [{"name": name, "offset": 4 * i, "type": _FLOAT32} for i, name in enumerate("xyz")]
    data = base64.b64encode(points.astype("<f4").tobytes()).decode()
    place = {"frame_id": _WORLD, "pose": _IDENTITY, "point_stride": 12, "fields": fields}
    return json.dumps({"timestamp": _time(frame.capture_time), **place, "data": data})


def indices(faces: np.ndarray) -> str:
    """The faces of all garments of a recording, for :func:`garment`."""
    return json.dumps(faces.ravel().tolist())


def garment(result: Result, indices: str) -> str | None:
    """The garment as triangles coloured by reliability; None: the result has no arrays.

    Its many small objects are written as text: as dictionaries they would take longer than a frame.
    """
    if not len(result.vertices):
        return None
    places = tuple(result.vertices.astype(np.float64).ravel().tolist())
    shades = np.rint(100.0 * np.clip(result.vertex_reliability, 0.0, 1.0)).astype(int).tolist()
    mesh = (
        f'{{"pose":{json.dumps(_IDENTITY)},"points":[{",".join([_POINT] * len(shades)) % places}],'
        f'"color":{json.dumps(dict.fromkeys("rgba", 1.0))},"colors":[{",".join([_SHADES[shade] for shade in shades])}],'
        f'"indices":{indices}}}'
    )
    entity = {"id": "garment", "frame_id": _WORLD, "timestamp": _time(result.timestamp), "lifetime": _time(0.0)}
    entity |= {name: [] for name in ("metadata", "arrows", "cubes", "spheres", "cylinders", "lines", "texts", "models")}
    return f'{{"deletions":[],"entities":[{json.dumps(entity | {"frame_locked": False})[:-1]},"triangles":[{mesh}]}}]}}'


def numbers(result: Result) -> str:
    """Everything of a result but its arrays."""
    mean_sigma = float(np.mean(result.sigma)) if len(result.sigma) else 0.0
    values = {name: getattr(result, name) for name in ("sequence", "state", "reliability", "paper_score", "coverage")}
    counters = {name: getattr(result, name) for name in ("applied", "dropped", "rejected")}
    values |= {"mean_sigma": mean_sigma, **counters, "seconds": dict(result.timings)}
    return json.dumps({"timestamp": _time(result.timestamp), **values})


_IDENTITY = {"position": dict.fromkeys("xyz", 0.0), "orientation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}


def _time(seconds: float) -> dict[str, int]:
    whole = int(seconds // 1)
    return {"sec": whole, "nsec": int((seconds - whole) * 1e9)}

