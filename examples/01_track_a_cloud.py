"""Track a garment through point clouds from all around, in this process.

python examples/01_track_a_cloud.py
"""

import numpy as np

import ddakf
from ddakf import data
from ddakf.evaluation import metrics
from ddakf.evaluation.sensors import Sensor

FRAMES = 12

# The bundled sample is a simulated T-shirt with its truth; a virtual scanner makes clouds of it (3 mm noise).
sequence = data.sample()
scanner, rng = Sensor("full", points=10_000), np.random.default_rng(1)

garment = ddakf.Mesh(sequence.template, sequence.garment_faces)  # the rest shape
tracker = ddakf.Tracker(garment)
tracker.reset(vertices=sequence.garment_vertices[0])  # where the garment is now

for frame in range(1, FRAMES):
    cloud = scanner.capture(sequence, frame, rng)
    result = tracker.step(cloud.points, timestamp=sequence.timestamp(frame))
    truth = sequence.garment_vertices[frame]
    print(
        f"frame {frame:2d}  {result.state:12s}  reliability {result.reliability:.2f}"
        f"  error {metrics.rmse_mm(result.vertices, truth):5.1f} mm"
        f"  sigma {1e3 * np.median(result.sigma):4.1f} mm  {1e3 * result.timings['total']:5.1f} ms"
    )
