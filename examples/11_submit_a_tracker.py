"""A tracker of one's own beside DD-AKF: the garment of the start follows the cloud's centroid.

``cd examples && ddakf benchmark run --submit 11_submit_a_tracker:Centroid --json out.json`` runs it on the benchmark; this script
runs it on ten frames of the sample.
"""

import json
import os
import tempfile
from pathlib import Path

from ddakf.commands.cli import main


class Centroid:
    """Two methods are the whole interface; places are in metres, y up."""

    def start(self, garment, vertices, body):
        """A new run: a mesh whose vertices are the rest shape, (V, 3) vertices of the start, and a mesh of the body or None."""
        self.vertices, self.before = vertices, None

    def step(self, frame):
        """(V, 3) vertices for frame.points (N, 3), frame.sensor_origin, frame.timestamp (s) and frame.body_vertices or None."""
        now = frame.points.mean(axis=0)
        if self.before is not None:
            self.vertices = self.vertices + (now - self.before)
        self.before = now
        return self.vertices


if __name__ == "__main__":
    os.chdir(Path(__file__).parent)  # where the class is found
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder, "out.json")
        main(["evaluate", "sample", "--submit", "11_submit_a_tracker:Centroid", "--runs", "1", "--frames", "60:71",
              "--procs", "1", "--json", str(out)])  # fmt: skip
        errors = {cell["method"]: cell["mean"]["rmse_mm"] for cell in json.loads(out.read_text())["results"]}
    print(f"error of the centroid's garment over DD-AKF's: {errors['11_submit_a_tracker:Centroid'] / errors['ddakf']:.1f}")
