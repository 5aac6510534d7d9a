"""Properties of every baseline: it follows the garment, stays in place without points, and ignores hidden surfaces."""

import sys
from dataclasses import replace

import numpy as np
import pytest

from ddakf.errors import InvalidArgument, NotApplicable
from ddakf.evaluation.metrics import normal_rmse_mm, rmse_mm
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.sensors.virtual_sensor import sample_surface
from ddakf.evaluation.splits import NO_LABELS, RecordingLabels
from ddakf.evaluation.trials.methods import BASELINES, make_baseline, method_factory
from tests.evaluation.baselines.shapes import moved, tube, widened

pytestmark = pytest.mark.slow

METHODS = ("kf", "icp", "icp-rigid", "pf", "opt-ed", "nicp")
SHAPED = ("icp", "opt-ed", "nicp")  # all that is not rigid, knows a surface, and no chance
FITTED_MM = 1.0  # what an embedded deformation leaves of a shape


@pytest.fixture(scope="module")
def garment():
    return tube()


def made(name, garment, vertices):
    try:
        method = make_baseline(name)
    except NotApplicable as absent:
        pytest.skip(str(absent))
    method.start(garment, vertices, None)
    return method


def clouds(garment, pose, frames, seed=0):
    """Surface points of pose(k) for the frames after the start."""
    rng = np.random.default_rng(seed)
    return [sample_surface(pose(k), garment.faces, 4000, rng) for k in range(1, frames + 1)]


@pytest.mark.parametrize("name", [name for name in METHODS if name != "kf"])
def test_it_follows_a_rigid_motion(name, garment):
    method = made(name, garment, garment.vertices)

    def pose(k):
        return moved(garment.vertices, 0.012 * k, [0.010 * k, 0.003 * k, 0])

    for k, points in enumerate(clouds(garment, pose, 8), 1):
        estimate = method.step(CapturedFrame(0, k / 30, points))
    assert rmse_mm(garment.vertices, pose(8)) > 80
    assert rmse_mm(estimate, pose(8)) < 15


@pytest.mark.parametrize("name", SHAPED)
def test_it_follows_a_deformation(name, garment):
    method = made(name, garment, garment.vertices)

    def pose(k):
        return widened(garment.vertices, 0.02 * k)

    for k, points in enumerate(clouds(garment, pose, 8), 1):
        estimate = method.step(CapturedFrame(0, k / 30, points))
    assert normal_rmse_mm(estimate, pose(8), garment.faces) < 0.5 * normal_rmse_mm(garment.vertices, pose(8), garment.faces)


@pytest.mark.parametrize("name", METHODS)
def test_without_points_it_stays_where_it_starts(name, garment):
    start = widened(garment.vertices, 0.1) + 1.0
    method = made(name, garment, start)
    first = method.step(CapturedFrame(0, 0.1, np.zeros((0, 3), np.float32)))
    assert rmse_mm(first, start) < FITTED_MM
    assert np.allclose(method.step(CapturedFrame(0, 0.2, np.zeros((0, 3), np.float32))), first, atol=1e-9)


@pytest.mark.parametrize("name", METHODS)
def test_points_out_of_reach_do_not_pull(name, garment):
    method = made(name, garment, garment.vertices)
    for k in range(1, 4):
        estimate = method.step(CapturedFrame(0, k / 30, (garment.vertices + [5.0, 0, 0]).astype(np.float32)))
    assert rmse_mm(estimate, garment.vertices) < 10


@pytest.mark.parametrize("name", METHODS)
def test_the_same_frames_give_the_same_result(name, garment):
    results = []
    for _ in range(2):
        method = made(name, garment, garment.vertices)
        for k, points in enumerate(clouds(garment, lambda k: widened(garment.vertices, 0.02 * k), 3), 1):
            result = method.step(CapturedFrame(0, k / 30, points))
        results.append(result)
    assert results[0].shape == garment.vertices.shape
    assert np.allclose(*results, atol=1e-9)


@pytest.mark.parametrize("name", METHODS)
def test_a_new_start_forgets_what_was_before(name, garment):
    method = made(name, garment, garment.vertices)
    for k, points in enumerate(clouds(garment, lambda k: garment.vertices + 0.01 * k, 3), 1):
        method.step(CapturedFrame(0, k / 30, points))
    method.start(garment, garment.vertices, None)
    fresh = made(name, garment, garment.vertices)
    points = clouds(garment, lambda k: garment.vertices, 1)[0]
    assert np.allclose(method.step(CapturedFrame(0, 9.0, points)), fresh.step(CapturedFrame(0, 9.0, points)), atol=1e-9)


@pytest.mark.parametrize("name", METHODS)
def test_results_belong_to_the_caller(name, garment):
    points = clouds(garment, lambda k: garment.vertices + 0.002 * k, 2)
    one, other = made(name, garment, garment.vertices), made(name, garment, garment.vertices)
    one.step(CapturedFrame(0, 0.1, points[0]))[:] = 7.0
    other.step(CapturedFrame(0, 0.1, points[0]))
    assert np.allclose(one.step(CapturedFrame(0, 0.2, points[1])), other.step(CapturedFrame(0, 0.2, points[1])), atol=1e-9)


@pytest.mark.parametrize("name", ["kf", *SHAPED])
def test_what_faces_away_from_the_sensor_takes_no_point(name, garment):
    """A wall of points behind the tube: seen from the front, its back must not be drawn to them."""
    back = garment.vertices[:, 2] < -0.1
    wall = garment.vertices[back] - [0, 0, 0.03]
    pulled = {}
    for view, origin in (("blind", None), ("seeing", np.array([0, 0.3, 3.0])), ("each", np.tile([0, 0.3, 3.0], (len(wall), 1)))):
        method = made(name, garment, garment.vertices)
        method.settings = replace(method.settings, gate=0.1)  # less than the tube is deep
        estimate = method.step(CapturedFrame(0, 0.1, wall, origin))
        pulled[view] = -(estimate - garment.vertices)[back, 2].mean()
    assert pulled["blind"] > 5 * max(pulled["seeing"], 1e-6)
    assert pulled["each"] == pytest.approx(pulled["seeing"], abs=1e-6)


@pytest.mark.parametrize("name", SHAPED)
def test_a_turned_world_gives_a_turned_result(name, garment):
    points = clouds(garment, lambda k: widened(garment.vertices, 0.02 * k), 3)
    plain = made(name, garment, garment.vertices)
    turned = made(name, garment, moved(garment.vertices, 2.0, [3.0, 1.0, -2.0]))
    for k, cloud in enumerate(points, 1):
        here = plain.step(CapturedFrame(0, k / 30, cloud))
        there = turned.step(CapturedFrame(0, k / 30, moved(cloud, 2.0, [3.0, 1.0, -2.0])))
    assert rmse_mm(there, moved(here, 2.0, [3.0, 1.0, -2.0])) < 1.0


def test_baselines_go_by_name(garment):
    assert set(METHODS) <= set(BASELINES)
    with pytest.raises(InvalidArgument, match="baseline"):
        make_baseline("magic")
    step = method_factory("kf")(garment, garment.vertices, None)
    assert np.array_equal(step(CapturedFrame(1, 0.1, np.zeros((0, 3)))).vertices, garment.vertices)


def test_a_factory_hears_what_will_be_scored(monkeypatch):
    heard = []
    monkeypatch.setitem(BASELINES, "hears", heard.append)
    make_baseline("hears")
    make_baseline("hears", RecordingLabels("walk", "tshirt", "walk"))
    assert heard == [NO_LABELS, ("walk", "tshirt", "walk")]


def test_without_open3d_the_rigid_method_says_so(monkeypatch):
    monkeypatch.setitem(sys.modules, "open3d", None)
    with pytest.raises(NotApplicable, match="open3d"):
        make_baseline("icp-rigid")
