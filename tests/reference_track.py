"""Reference track: what the tracker answered on short runs of the sample when the file beside this one was written.

``python -m tests.reference_track`` writes it anew, after a change that shall alter results.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from ddakf import Config, FrameResult, Mesh, Tracker
from ddakf.data import sample
from ddakf.evaluation.sensors import Sensor

REFERENCE = Path(__file__).with_suffix(".json")
FIRST, GROUPS = 24, 12  # a fast part of the sample; groups of vertices that are averaged, so that one of them matters little
SAMPLE = sample()
GAP = 0.5  # s, after which the garment is searched

RUNS = {
    "full": Sensor("full", 5000),
    "front": Sensor("front", 5000),
    "front, body": Sensor("front", 5000),
    "ring, few points, body": Sensor("ring4", 1600),
    "person, body": Sensor("front", 8000, segmented=False),
    "paper": Sensor("full", 5000),
    "accelerated": Sensor("full", 3000),
    "search": Sensor("full", 3000),
    "gap, body": Sensor("full", 3000),
    "nothing seen, body": Sensor("full", 3000),
    "far away": Sensor("full", 3000),
    "uneven template": Sensor("full", 3000),
}
CONFIGS = {
    "paper": Config.paper(),
    "accelerated": Config.from_dict({"predict": {"type": "ConstantAcceleration"}}),
}
FRAMES = {"person, body": 3, "search": 3, "gap, body": 3, "uneven template": 2}


def results(name: str) -> list[FrameResult]:
    """The results of a run."""
    tracker, rng, found = _tracker(name), np.random.default_rng(7), []
    count = FRAMES.get(name, 4)
    for k in range(1, count + 1):
        cloud = RUNS[name].capture(SAMPLE, FIRST + k, rng)
        points, late = cloud.points, GAP if name == "gap, body" and k == count else 0.0
        if name == "nothing seen, body" and k in (2, 3):
            points = points[:0]
        if name == "far away" and k > 2:
            points = points + np.float32([0.0, 0.0, 0.6])
        if name == "search":
            points = points + np.float32([0.15, 0.0, -0.1])
        body = SAMPLE.body_vertices[FIRST + k] if "body" in name and not (name == "nothing seen, body" and k == 3) else None
        origin = None if len(points) == 0 or name == "search" else cloud.sensor_origin
        found.append(tracker.step(points, timestamp=k / 30 + late, sensor_origin=origin, body_vertices=body))
    return found


def _tracker(name: str) -> Tracker:
    body = Mesh(SAMPLE.body_vertices[FIRST], SAMPLE.body_faces) if "body" in name else None
    garment, place = Mesh(SAMPLE.template, SAMPLE.garment_faces), SAMPLE.garment_vertices[FIRST].astype(np.float64)
    if name == "uneven template":
        faces = garment.faces[::2]
        (a, b, c), centre = faces.T, garment.n_vertices + np.arange(len(faces))
        split = np.concatenate([np.stack(face, axis=1) for face in ((a, b, centre), (b, c, centre), (c, a, centre))])
        garment = Mesh(_with_centres(garment.vertices, faces), np.concatenate([garment.faces[1::2], split]))
        place = _with_centres(place, faces)
    tracker = Tracker(garment, body=body, config=CONFIGS.get(name))
    if name != "search":
        tracker.reset(place)
    return tracker


def _with_centres(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return np.concatenate([vertices, vertices[faces].mean(axis=1)])


def summary(result: FrameResult) -> dict:
    """Means over groups of neighbouring vertices, and the numbers of the frame."""
    groups = np.array_split(np.arange(len(result.vertices)), GROUPS)

    def means(values: np.ndarray) -> list:
        return [np.asarray(values[group].mean(axis=0)).tolist() for group in groups]

    return {
        "vertices": means(result.vertices),
        "velocities": means(result.velocities),
        "sd": means(np.sqrt(np.diagonal(result.covariance, axis1=1, axis2=2))),
        "shear": means(result.covariance[:, [0, 1, 2], [1, 2, 0]] / np.square(result.sigma)[:, None]),
        "vertex_reliability": means(result.vertex_reliability),
        "observed": means(result.observed.astype(float)),
        "scores": [result.reliability, result.paper_score, result.coverage],
        "state": result.state,
    }


def main() -> None:
    text = {name: [summary(result) for result in results(name)] for name in RUNS}
    rounded = json.loads(json.dumps(text), parse_float=lambda number: round(float(number), 8))
    REFERENCE.write_text(json.dumps(rounded, separators=(",", ":")) + "\n")


if __name__ == "__main__":
    main()
