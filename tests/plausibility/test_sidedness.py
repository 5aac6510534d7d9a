"""The side that a cloud was seen from: found where there is one, from any direction, and nowhere else."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.config import Sidedness
from ddakf.evaluation.sensors import Sensor
from ddakf.garment import model
from ddakf.plausibility import sidedness
from ddakf.types import View
from tests.stages.scenes import FPS, scan, turn
from tests.tracker_runs import SAMPLE, SHIRT, assert_same

AREA = model.build(SHIRT).area
CONFIG = Sidedness()
UP = np.array([0.0, 1.0, 0.0])
BLIND = dataclasses.replace(Config(), sidedness=Sidedness(estimate=False))


def captured(k, view="front", **sensor):
    """Points and origin of the sample's frame k."""
    return Sensor(view, **sensor).capture(SAMPLE, k, np.random.default_rng([1, k]))


def looked(points):
    return sidedness.look(np.asarray(points, np.float32), AREA, View(), CONFIG)


def degrees_apart(side, toward):
    return np.degrees(np.arccos(np.clip(np.dot(side, toward) / np.linalg.norm(toward), -1, 1)))


@pytest.mark.parametrize("heading", [0, 70, 160, 250])
@pytest.mark.parametrize("sensor", [{}, {"outliers": 0.1}, {"noise": 0.01, "drop": 0.5}, {"segmented": False}], ids=str)
def test_the_side_of_one_camera_is_found_from_everywhere(heading, sensor):
    for k in (1, 60, 120):
        points, eye = captured(k, **sensor)
        middle = points.mean(axis=0)
        view = looked((points - middle) @ turn(heading).T)
        assert view.one_sided
        assert degrees_apart(view.side, turn(heading) @ (eye - middle)) < 40


@pytest.mark.parametrize("view", ["full", "ring4"])
@pytest.mark.parametrize("sensor", [{}, {"outliers": 0.1}, {"points": 800}, {"occlude": (0, 999)}], ids=str)
def test_a_cloud_from_all_sides_has_no_side(view, sensor):
    for k in range(1, 150, 15):
        assert not looked(captured(k, view, **sensor).points).one_sided


def test_looks_are_averaged_and_outlive_a_single_one():
    points, _ = captured(5)
    full, _ = captured(5, "full")
    view = sidedness.look(points, AREA, View(), CONFIG)
    assert view.wait == CONFIG.interval - 1
    half = np.concatenate([points, full[::12]])  # a few points of the hidden side
    assert sidedness.look(half, AREA, view, CONFIG).one_sided
    for _ in range(3):
        view = sidedness.look(full, AREA, view, CONFIG)
    assert not view.one_sided


def test_a_threshold_of_zero_finds_no_side():
    cloud = np.zeros((500, 3), np.float32)  # of one layer if there ever was one
    assert sidedness.look(cloud, AREA, View(), CONFIG).one_sided
    assert not sidedness.look(cloud, AREA, View(), dataclasses.replace(CONFIG, one_sided=0.0)).one_sided


def test_a_wrong_end_is_left_when_the_cloud_bulges_to_the_other():
    points, eye = captured(5)
    view = looked(points)
    turned = view._replace(side=tuple(-np.array(view.side)), bulge=0.2 * view.bulge)
    mended = sidedness.look(points, AREA, turned, CONFIG)
    assert degrees_apart(mended.side, eye - points.mean(axis=0)) < 30
    assert mended.bulge > 0


def test_a_sheet_has_one_layer_itself():
    x, y = np.meshgrid(np.arange(20), np.arange(20), indexing="ij")
    corner = (x[:-1, :-1] * 20 + y[:-1, :-1]).ravel()
    faces = np.concatenate([np.stack([corner, corner + 20, corner + 1], 1), np.stack([corner + 1, corner + 20, corner + 21], 1)])
    sheet = Mesh(0.03 * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], 1).astype(float), faces)
    lying = Mesh(sheet.vertices[:, [0, 2, 1]], sheet.faces)
    assert all(sidedness.sides(model.build(each), CONFIG, UP).sheet for each in (sheet, lying))
    tracker = Tracker(sheet)
    for k in range(3):
        assert not tracker.step(scan(sheet.vertices, sheet, 2000, seed=k), timestamp=k / FPS).warnings


def cone(width):
    """A skirt of 60 cm with a waist of 20 and a hem of ``width`` metres across."""
    ring, column = np.meshgrid(np.arange(21), np.arange(48), indexing="ij")
    radius, turned = 0.1 + (width / 2 - 0.1) * ring / 20, 2 * np.pi * column / 48
    vertices = np.stack([radius * np.sin(turned), -0.03 * ring, radius * np.cos(turned)], axis=2).reshape(-1, 3)
    corner, beside = (ring * 48 + column)[:-1].ravel(), (ring * 48 + (column + 1) % 48)[:-1].ravel()
    faces = np.concatenate([np.stack([corner, corner + 48, beside], 1), np.stack([beside, corner + 48, beside + 48], 1)])
    return Mesh(vertices, faces)


def test_a_wide_skirt_is_no_sheet_and_its_side_is_found_along_level_directions():
    skirt = cone(1.2)
    sides = sidedness.sides(model.build(skirt), CONFIG, UP)
    assert sides.level
    assert not sides.sheet
    assert not sidedness.sides(model.build(cone(0.5)), CONFIG, UP).level
    for front in (False, True):
        tracker = Tracker(skirt)
        for k in range(3):
            points = scan(skirt.vertices, skirt, 4000, seed=k)
            result = tracker.step(points[points[:, 2] > 0] if front else points, timestamp=k / FPS)
        assert [each.code for each in result.warnings] == ["sensor_origin_missing"] * front


def run(frames, config=None, view="front", given=True):
    """RMSE of each frame, metres, and the results."""
    tracker, errors, results = Tracker(SHIRT, config=config), [], []
    tracker.reset(SAMPLE.garment_vertices[0])
    for k in range(1, frames + 1):
        points, eye = captured(k, view, points=5000)
        results.append(tracker.step(points, timestamp=k / FPS, sensor_origin=eye if given else None))
        errors.append(np.sqrt(np.square(results[-1].vertices - SAMPLE.garment_vertices[k]).sum(axis=1).mean()))
    return np.array(errors), results


def test_a_withheld_origin_costs_little():
    given, _ = run(20)
    withheld, results = run(20, given=False)
    _, unsure = run(20, BLIND, given=False)
    assert withheld.mean() < 1.3 * given.mean()
    assert min(result.reliability for result in results) > 0.8, "the side is known, though nobody told it"
    assert max(result.reliability for result in unsure) < 0.5, "what is not known is not trusted"
    assert min(result.sigma.mean() for result in unsure) > CONFIG.blind_error
    for result in (*results, *unsure):
        (warning,) = result.warnings
        assert (warning.code, warning.field) == ("sensor_origin_missing", "sensor_origin")
        assert "one side" in warning.message


def test_without_a_side_the_result_is_the_same_to_the_bit():
    for mine, other in zip(run(10, view="full", given=False)[1], run(10, BLIND, view="full", given=False)[1], strict=True):
        assert_same(mine, other)
        assert mine.warnings == other.warnings == ()


def test_the_side_survives_a_snapshot():
    tracker, results = Tracker(SHIRT), []
    for k in range(1, 12):
        results.append(tracker.step(captured(k).points, timestamp=k / FPS))
        if k == 3:
            other = Tracker.restore(tracker.snapshot())
    for k in range(4, 12):
        result = other.step(captured(k).points, timestamp=k / FPS)
        assert_same(result, results[k - 1])
        assert result.warnings == results[k - 1].warnings
