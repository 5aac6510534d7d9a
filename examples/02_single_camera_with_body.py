"""Track from one depth camera: the body predicts the half of the garment that the camera does not see.

python examples/02_single_camera_with_body.py
"""

import numpy as np

import ddakf
from ddakf import data
from ddakf.evaluation import metrics
from ddakf.evaluation.sensors import Sensor

FIRST, LAST = 30, 46  # the arms swing

sequence = data.sample()
camera, rng = Sensor("front"), np.random.default_rng(1)
clouds = [camera.capture(sequence, frame, rng) for frame in range(FIRST + 1, LAST)]

garment = ddakf.Mesh(sequence.template, sequence.garment_faces)
body = ddakf.Mesh(sequence.body_vertices[FIRST], sequence.body_faces)  # in its pose at the start


def track(with_body: bool) -> tuple[float, float]:
    """RMSE in mm of the measured vertices and of the others."""
    tracker = ddakf.Tracker(garment, body=body if with_body else None)
    tracker.reset(vertices=sequence.garment_vertices[FIRST])
    seen, hidden = [], []
    for frame, cloud in enumerate(clouds, FIRST + 1):
        result = tracker.step(
            cloud.points,
            timestamp=sequence.timestamp(frame),
            sensor_origin=cloud.sensor_origin,  # without it the back would be pulled onto the front
            body_vertices=sequence.body_vertices[frame] if with_body else None,
        )
        truth = sequence.garment_vertices[frame]
        seen.append(metrics.rmse_mm(result.vertices[result.observed], truth[result.observed]))
        hidden.append(metrics.rmse_mm(result.vertices[~result.observed], truth[~result.observed]))
    return float(np.mean(seen)), float(np.mean(hidden))


for name, with_body in (("without the body", False), ("with the body", True)):
    seen, hidden = track(with_body)
    print(f"{name:16s}  measured vertices {seen:5.1f} mm   hidden vertices {hidden:5.1f} mm")
