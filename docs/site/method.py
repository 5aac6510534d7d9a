"""Figure of a frame's way through the stages, from the sample: ``python docs/site/method.py docs/method.png``.

The sample is tracked for two seconds from one camera with its body. The next frame is drawn with its prediction, the vertices
that it measures, their uncertainty and their reliability, from the camera's side and from behind.
"""

import sys

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection

import ddakf
from ddakf import data
from ddakf.evaluation.sensors import Sensor

FRAME = 60
FRONT, BEHIND = -0.5, np.pi - 0.5  # turns about the vertical, radians
HALF = 0.34  # m, half a panel's side
LIGHT = np.array([0.3, 0.4, 0.87])


def tracked():
    """The frame's cloud, the prediction and the result."""
    sequence, camera, rng = data.sample(), Sensor("front"), np.random.default_rng(1)
    body = ddakf.Mesh(sequence.body_vertices[0], sequence.body_faces)
    tracker = ddakf.Tracker(ddakf.Mesh(sequence.template, sequence.garment_faces), body=body)
    tracker.reset(vertices=sequence.garment_vertices[0])
    result = predicted = None
    for k in range(1, FRAME + 1):
        cloud = camera.capture(sequence, k, rng)
        predicted = tracker.predicted(result, 1 / sequence.fps).vertices if result else None
        inputs = {"sensor_origin": cloud.sensor_origin, "body_vertices": sequence.body_vertices[k]}
        result = tracker.step(cloud.points, timestamp=sequence.timestamp(k), **inputs)
    return sequence, cloud.points, predicted, result


def turned(points: np.ndarray, angle: float) -> np.ndarray:
    """(N, 3) points as seen after a turn: right, up, toward the viewer."""
    c, s = np.cos(angle), np.sin(angle)
    return points @ np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]])


def paint(axes, vertices: np.ndarray, faces: np.ndarray, values: np.ndarray | None, angle: float, scale) -> None:
    """Draws a mesh back to front with flat light, coloured by values of its vertices or grey."""
    seen = turned(vertices, angle)[faces]
    normals = np.cross(seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True) + 1e-12
    light = np.minimum(0.45 + 0.55 * np.abs(normals @ LIGHT), 1.0)[:, None]
    plain = np.tile([0.72, 0.75, 0.8, 1.0], (len(faces), 1))
    colours = plain if values is None else plt.get_cmap(scale[0])((values[faces].mean(axis=1) - scale[1]) / (scale[2] - scale[1]))
    colours = np.hstack([colours[:, :3] * light, np.ones_like(light)])
    order = np.argsort(seen[:, :, 2].mean(axis=1))
    axes.add_collection(PolyCollection(seen[order][:, :, :2], facecolors=colours[order], edgecolors="none", antialiased=False))


def key(figure, column: int, scale) -> None:
    """Draws the colours of a column below it: of the ends of a scale, or of hidden and measured vertices."""
    name, low, high = scale
    values = np.linspace(low, high, 256) if low == 0 else np.array([0.0, 1.0])
    labels = {0: f"{low:g}", 1: f"{high:g}"} if low == 0 else {0.25: "hidden", 0.75: "measured"}
    axes = figure.add_axes((0.025 + 0.2425 * (column + 0.25), 0.055, 0.2425 / 2, 0.018))
    axes.imshow(plt.get_cmap(name)((values - low) / (high - low))[None], aspect="auto", extent=(0, 1, 0, 1))
    axes.set_yticks([])
    axes.set_xticks(list(labels), list(labels.values()), fontsize=9)
    axes.tick_params(length=0)


def main(out: str) -> None:
    sequence, points, predicted, result = tracked()
    faces = sequence.garment_faces
    panels = (
        ("A  prediction, and the cloud", predicted, None, None),
        ("B  measured vertices", result.vertices, result.observed.astype(float), ("viridis", -0.3, 1.2)),
        ("F  sigma after the fusion, mm", result.vertices, 1e3 * result.sigma, ("RdYlBu_r", 0.0, 25.0)),
        ("G  reliability", result.vertices, result.vertex_reliability, ("RdYlBu", 0.0, 1.0)),
    )
    figure, grid = plt.subplots(2, 4, figsize=(12, 6.7))
    for column, (title, vertices, values, scale) in enumerate(panels):
        for axes, angle in zip(grid[:, column], (FRONT, BEHIND), strict=True):
            paint(axes, vertices, faces, values, angle, scale)
            if values is None:
                x, y, _ = turned(points.astype(np.float64), angle).T
                if angle == FRONT:
                    axes.scatter(x, y, s=0.4, color="#0f766e", linewidths=0)
            x, y, _ = turned(vertices, angle).T.mean(axis=1)
            axes.set(aspect="equal", xlim=(x - HALF, x + HALF), ylim=(y - HALF, y + HALF))
            axes.axis("off")
        grid[0, column].set_title(title, fontsize=11)
        if scale:
            key(figure, column, scale)
    figure.text(0.01, 0.74, "from the camera's side", rotation=90, va="center", fontsize=9, color="0.4")
    figure.text(0.01, 0.3, "from behind", rotation=90, va="center", fontsize=9, color="0.4")
    figure.subplots_adjust(left=0.025, right=0.995, top=0.95, bottom=0.08, wspace=0.02, hspace=0.02)
    figure.savefig(out, dpi=96)


if __name__ == "__main__":
    main(sys.argv[1])
