"""Picture of the reliability of a run, docs/reliability.png: ``python benchmarks/reliability_picture.py [--out FILE.png]``.

The sample from one camera with its body; in a third of the frames half of the garment is hidden. Above the reliability, in the
middle the error and the one that the tracker expects, below the sigma of both halves. The notebook of examples/ draws the same.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

import ddakf
from ddakf import data
from ddakf.evaluation.drawing.diagrams import COLOURS, STYLES, figure
from ddakf.evaluation.sensors import Sensor

PICTURE = Path(__file__).resolve().parents[1] / "docs/reliability.png"
FRAMES, HIDDEN = 60, range(20, 40)  # of the sample, and those in which the half with x > 0 is hidden
MIDDLE = 0.02  # m: vertices farther to that side at the start are of the hidden half


def measured() -> tuple[dict[str, np.ndarray], dict[str, np.ndarray], np.ndarray]:
    """By frame: error and expected error, and mean sigma of both halves, by name and in mm; and the reliability."""
    sequence, camera, rng = data.sample(), Sensor("front"), np.random.default_rng(1)
    body = ddakf.Mesh(sequence.body_vertices[0], sequence.body_faces)
    tracker = ddakf.Tracker(ddakf.Mesh(sequence.template, sequence.garment_faces), body=body)
    tracker.reset(vertices=sequence.garment_vertices[0])
    hidden, rows = sequence.garment_vertices[0][:, 0] > MIDDLE, []
    for k in range(1, FRAMES):
        cloud = camera.capture(sequence, k, rng)
        points = cloud.points[cloud.points[:, 0] < 0] if k in HIDDEN else cloud.points
        step = {"timestamp": k / 30, "sensor_origin": cloud.sensor_origin, "body_vertices": sequence.body_vertices[k]}
        result = tracker.step(points, **step)
        rmse = np.sqrt(np.square(result.vertices - sequence.garment_vertices[k]).sum(axis=1).mean())
        rows.append((rmse, result.reliability, result.sigma[hidden].mean(), result.sigma[~hidden].mean()))
    rmse, reliability, of_hidden, of_other = np.array(rows).T
    expected = ddakf.Config().reliability.half_error * np.sqrt(1.0 / reliability - 1.0)
    errors = {"error": 1e3 * rmse, "expected by the tracker": 1e3 * expected}
    return errors, {"half that is hidden for a while": 1e3 * of_hidden, "other half": 1e3 * of_other}, reliability


def draw(path: Path) -> None:
    """Draws the three diagrams one below the other."""
    errors, sigmas, reliability = measured()
    drawn, frames = figure(7.2, 5.6), np.arange(1, FRAMES)
    panels = drawn.subplots(3, 1, sharex=True)
    labels = "reliability", "RMSE, mm", "mean sigma, mm"
    for axes, label, curves in zip(panels, labels, ({"": reliability}, errors, sigmas), strict=True):
        axes.axvspan(HIDDEN.start, HIDDEN.stop, alpha=0.15, color="0.4", linewidth=0)
        for number, (name, values) in enumerate(curves.items()):
            axes.plot(frames, values, color=COLOURS[number], linestyle=STYLES[number], label=name)
        axes.set(ylabel=label, ylim=(0, 1 if label == "reliability" else None))
        if len(curves) > 1:
            axes.legend(loc="upper left", frameon=False)
    panels[0].text(0.5 * (HIDDEN.start + HIDDEN.stop), 0.1, "half of the garment is hidden", ha="center", color="0.3")
    panels[-1].set(xlabel="frame", xlim=(1, FRAMES - 1))
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path, dpi=110)


def main(argv: list[str] | None = None) -> int:
    """Draws, and names the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=PICTURE)
    arguments = parser.parse_args(argv)
    draw(arguments.out)
    print(arguments.out)
    return 0


if __name__ == "__main__":
    sys.exit(main())
