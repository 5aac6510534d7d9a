"""Encoding in a worker: results and sessions of the tracker as messages of the contract."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING

import numpy as np
from ddakf_api.arrays import pack, pack_mesh
from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb

from .fields import field_of_frame

if TYPE_CHECKING:  # the network process reads the encodings below, without the tracker
    import ddakf
    from ddakf.results import FrameResult, InputWarning

_UPPER_TRIANGLE = ((0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2))

# Encodings that a client may choose, per array; the first is the default.
_VERTEX_ENCODINGS = (pb.ARRAY_ENCODING_FLOAT32, pb.ARRAY_ENCODING_FLOAT64, pb.ARRAY_ENCODING_QUANTISED_16)
_SIGMA_ENCODINGS = (pb.ARRAY_ENCODING_FLOAT32, pb.ARRAY_ENCODING_FLOAT16)
_RELIABILITY_ENCODINGS = (pb.ARRAY_ENCODING_FLOAT32, pb.ARRAY_ENCODING_QUANTISED_8)
_RELIABILITY_STEP = 1 / 255
_EXTENT_FACTOR = 1.5  # extent that 16-bit vertices cover, over the template's largest side
RESULT_ENCODINGS = sorted({*_VERTEX_ENCODINGS, *_SIGMA_ENCODINGS, *_RELIABILITY_ENCODINGS})


def configuration(config: ddakf.Config) -> pb.Session:
    """The full configuration of a tracker, and the name of its fabric."""
    return pb.Session(config_json=json.dumps(config.to_dict()), fabric=config.physics.fabric.name)


def session_message(tracker: ddakf.Tracker, vertex_map: np.ndarray | None = None) -> pb.Session:
    """Description of a new session for the server: configuration, meshes, counts, vertex map, time of its last frame."""
    garment, body = tracker.garment, tracker.body
    described = configuration(tracker.config)
    session = pb.Session(
        config_json=described.config_json,
        fabric=described.fabric,
        garment=pack_mesh(garment.vertices, garment.faces),
        garment_vertex_count=garment.n_vertices,
        garment_face_count=garment.n_faces,
        statistics=pb.SessionStatistics(last_capture_time=tracker.timestamp or 0.0),
    )
    if body is not None:
        session.body.CopyFrom(pack_mesh(body.vertices, body.faces))
        session.body_vertex_count = body.n_vertices
    if vertex_map is not None:
        session.vertex_map.CopyFrom(pack(vertex_map, pb.ARRAY_ENCODING_UINT32))
    return session


def require_known_encodings(options: pb.ResultOptions) -> None:
    """Rejects encodings that an array of the results cannot have, when a stream is opened."""
    for field, allowed in (
        ("vertex_encoding", _VERTEX_ENCODINGS),
        ("sigma_encoding", _SIGMA_ENCODINGS),
        ("reliability_encoding", _RELIABILITY_ENCODINGS),
    ):
        encoding = getattr(options, field)
        if encoding and encoding not in allowed:
            names = " or ".join(pb.ArrayEncoding.Name(e) for e in allowed)
            known = encoding in pb.ArrayEncoding.values()
            got = pb.ArrayEncoding.Name(encoding) if known else f"unknown encoding {encoding}"
            raise InvalidArgument(field=f"result_options.{field}", expected=names, got=got)


def result_numbers(frame: pb.Frame, result: FrameResult) -> pb.Result:
    """The result of a frame without its arrays, and without the server's counters and queueing time."""
    return pb.Result(
        sequence_number=frame.sequence_number,
        capture_time=frame.capture_time,
        state=pb.TrackerState.Value(f"TRACKER_STATE_{result.state.upper()}"),
        reliability=result.reliability,
        paper_score=result.paper_score,
        coverage=result.coverage,
        timings=result.timings,
        display_time=frame.display_time or frame.capture_time,
        warnings=[_warning_message(warning, frame) for warning in result.warnings],
        usage=pb.Usage(widening=result.usage.widening, working_vertices=result.usage.working_vertices),
    )


def _warning_message(warning: InputWarning, frame: pb.Frame) -> pb.Warning:
    """A warning of the tracker, its field named as in the frame."""
    code = pb.WarningCode.Value(f"WARNING_CODE_{warning.code.upper()}")
    return pb.Warning(code=code, field=field_of_frame(warning.field, frame), message=warning.message)


def result_arrays(result: FrameResult, options: pb.ResultOptions, garment: ddakf.Mesh) -> pb.Result:
    """The result of a frame with its arrays alone, in the encodings of the options."""
    vertex_encoding = options.vertex_encoding or _VERTEX_ENCODINGS[0]
    step = _vertex_step(garment) if vertex_encoding == pb.ARRAY_ENCODING_QUANTISED_16 else None
    message = pb.Result(
        vertices=pack(result.vertices, vertex_encoding, step=step),
        sigma=pack(result.sigma, options.sigma_encoding or _SIGMA_ENCODINGS[0]),
        vertex_reliability=pack(
            result.vertex_reliability, options.reliability_encoding or _RELIABILITY_ENCODINGS[0], step=_RELIABILITY_STEP
        ),
        observed=pack(result.observed, pb.ARRAY_ENCODING_BOOL),
    )
    if options.include_velocities:
        message.velocities.CopyFrom(pack(result.velocities))
    if options.include_covariance:
        message.covariance.CopyFrom(pack(result.covariance[:, *_UPPER_TRIANGLE]))
    return message


def _vertex_step(garment: ddakf.Mesh) -> float:
    """Metres per step of 16-bit vertices: 65,536 steps cover 1.5 times the template's largest side."""
    return _EXTENT_FACTOR * float(np.ptp(garment.vertices, axis=0).max()) / 0xFFFF
