"""Warm-up session: a small sheet above a body and a first frame, tracked by a worker before it accepts sessions."""

from __future__ import annotations

import numpy as np
from ddakf_api import codec
from ddakf_api.arrays import pack_mesh
from ddakf_api.v1 import tracking_pb2 as pb


def warm_up_session() -> tuple[pb.CreateSessionRequest, pb.Frame]:
    """The creation request of a hand-sized sheet above a body, and a first frame of it."""
    side, spacing = 12, 0.02
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    sheet = spacing * np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], axis=1)
    corner = (x[:-1, :-1] * side + y[:-1, :-1]).ravel()
    faces = np.concatenate(
        [np.stack([corner, corner + side, corner + 1], 1), np.stack([corner + 1, corner + side, corner + side + 1], 1)]
    )
    below = sheet - [0, 0, 0.05]
    request = pb.CreateSessionRequest(session=pb.Session(garment=pack_mesh(sheet, faces), body=pack_mesh(below, faces)))
    frame = pb.Frame(
        sequence_number=1,
        sensors=[pb.Sensor(origin=pb.Vector3(z=1.0))],
        body_vertices=below.astype("<f4").tobytes(),
        point_cloud=codec.encode(sheet).cloud,
    )
    return request, frame
