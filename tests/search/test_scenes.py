"""Relocalization in a cloud of a whole scene: wall, table, a neighbour and who passes draw no garment away."""

from dataclasses import replace

import numpy as np
import pytest

from ddakf import Mesh, Tracker
from ddakf.data import sample
from ddakf.evaluation.sensors import Sensor
from ddakf.search import relocalize
from tests.stages.scenes import FPS, rms

SAMPLE = sample()
SHIRT = Mesh(SAMPLE.template, SAMPLE.garment_faces)
FIRST, PASSING = 30, 30  # frame of the start, and frames that it takes to pass
SQUARE = np.array([[0, 1, 2], [0, 2, 3]])


def square(middle, width, height):
    """A rectangle that faces +z: (4, 3) vertices, metres."""
    return np.asarray(middle) + 0.5 * np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * [width, height, 0]


def scene(name, away):
    """The sample, its body joined by what else is seen; a door passes so many metres in front of the garment's middle."""
    shirt, body = SAMPLE.garment_vertices, SAMPLE.body_vertices
    middle = shirt[FIRST].mean(axis=0)
    if name == "somebody beside":
        more = np.concatenate([body, shirt], axis=1) + np.array([0.7, 0.0, 0.05], np.float32)
        faces = np.concatenate([SAMPLE.body_faces, SAMPLE.garment_faces + body.shape[1]])
    elif name == "a door passes":
        across = np.linspace(-0.9, 0.9, PASSING)[np.clip(np.arange(len(SAMPLE)) - FIRST, 0, PASSING - 1)]
        more, faces = np.stack([square(middle + [x, 0.0, away], 0.8, 2.0) for x in across]), SQUARE
    else:
        shift, width, height = {"wall": ([0, 0, -0.9], 3.0, 2.4), "table": ([0, -0.15, 0.45], 0.8, 0.25)}[name]
        more, faces = np.tile(square(middle + shift, width, height), (len(SAMPLE), 1, 1)), SQUARE
    joined = np.concatenate([body, more], axis=1).astype(np.float32)
    return replace(SAMPLE, body_vertices=joined, body_faces=np.concatenate([SAMPLE.body_faces, faces + body.shape[1]]))


def tracker_at(start, with_body):
    tracker = Tracker(SHIRT, body=Mesh(SAMPLE.body_vertices[FIRST], SAMPLE.body_faces) if with_body else None)
    tracker.reset(vertices=start)
    return tracker


def errors(tracker, name, frames, away=0.6):
    """Distance of the garment from the truth in each of some frames, metres RMS."""
    seen, camera = scene(name, away), Sensor("front", 40_000, segmented=False)
    for k in range(FIRST + 1, FIRST + 1 + frames):
        cloud = camera.capture(seen, k, np.random.default_rng(k))
        body = None if tracker.body is None else SAMPLE.body_vertices[k]
        result = tracker.step(cloud.points, timestamp=k / FPS, sensor_origin=cloud.sensor_origin, body_vertices=body)
        yield rms(result.vertices - SAMPLE.garment_vertices[k])


@pytest.mark.parametrize("with_body", [True, False], ids=["body", "alone"])
@pytest.mark.parametrize("name", ["wall", "table", "somebody beside"])
def test_a_garment_in_its_place_is_not_searched_in_a_scene(monkeypatch, name, with_body):
    tracker = tracker_at(SAMPLE.garment_vertices[FIRST], with_body)
    monkeypatch.setattr(relocalize, "_best_fit", None)
    assert next(errors(tracker, name, 1)) < 0.01


@pytest.mark.parametrize("off", [[0.06, 0.0, 0.06], [0.45, 0.0, 0.0]], ids=["6 cm", "toward the neighbour"])
def test_a_garment_is_found_on_its_body_and_not_on_a_neighbour_who_wears_the_same(off):
    *_, last = errors(tracker_at(SAMPLE.garment_vertices[FIRST] + off, True), "somebody beside", 6)
    assert last < 0.02


def test_without_a_body_a_garment_in_its_place_stays_there_beside_a_neighbour():
    assert max(errors(tracker_at(SAMPLE.garment_vertices[FIRST], False), "somebody beside", 4)) < 0.02


@pytest.mark.parametrize("away", [0.6, 0.9])
def test_a_door_that_passes_in_front_takes_no_worn_garment_along(away):
    tracker = tracker_at(SAMPLE.garment_vertices[FIRST], True)
    assert max(errors(tracker, "a door passes", PASSING + 5, away)) < 0.04


def test_a_garment_that_is_hidden_after_a_gap_is_as_uncertain_as_without_points():
    """A door is in front of it when frames come again."""
    k, sigma = FIRST + PASSING // 2, []
    cloud = Sensor("front", 40_000, segmented=False).capture(scene("a door passes", 0.9), k, np.random.default_rng(k))
    for points in (cloud.points, cloud.points[:0]):
        tracker = tracker_at(SAMPLE.garment_vertices[FIRST], False)
        list(errors(tracker, "wall", 3))
        sigma.append(tracker.step(points, timestamp=k / FPS + 0.5, sensor_origin=cloud.sensor_origin).sigma.mean())
    assert sigma[0] > 0.9 * sigma[1]
