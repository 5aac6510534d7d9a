"""Methods of other packages name a missing package, and follow the garment where it is installed."""

import sys

import numpy as np
import pytest

from ddakf.errors import NotApplicable
from ddakf.evaluation.metrics import normal_rmse_mm
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.sensors.virtual_sensor import sample_surface
from ddakf.evaluation.trials.methods import make_baseline
from tests.evaluation.baselines.shapes import tube

PACKAGES = {"open3d-arap": "open3d", "trimesh-nricp": "trimesh", "probreg-cpd": "probreg"}


@pytest.fixture(scope="module")
def garment():
    return tube(16, 10)


def made(name, garment):
    try:
        method = make_baseline(name)
    except NotApplicable as absent:
        pytest.skip(str(absent))
    method.start(garment, garment.vertices, None)
    return method


@pytest.mark.parametrize("name", PACKAGES)
def test_without_its_package_it_says_what_to_install(name, monkeypatch):
    monkeypatch.setitem(sys.modules, PACKAGES[name], None)
    with pytest.raises(NotApplicable, match=f"needs {PACKAGES[name]}.*pip install"):
        make_baseline(name)


@pytest.mark.parametrize("name", PACKAGES)
def test_it_comes_nearer_to_a_surface_that_moved(name, garment):
    truth = garment.vertices + [0.02, 0, 0.02]
    points = sample_surface(truth, garment.faces, 2000, np.random.default_rng(0)).astype(np.float32)
    estimate = made(name, garment).step(CapturedFrame(0, 0.1, points))
    assert normal_rmse_mm(estimate, truth, garment.faces) < 0.6 * normal_rmse_mm(garment.vertices, truth, garment.faces)


@pytest.mark.parametrize("name", PACKAGES)
def test_without_points_it_stays_where_it_is(name, garment):
    assert np.array_equal(made(name, garment).step(CapturedFrame(0, 0.1, np.zeros((0, 3), np.float32))), garment.vertices)


def test_a_part_that_nobody_sees_is_not_left_to_chance(garment):
    """Open3D would solve a singular system: the garment stays where it is."""
    method = made("open3d-arap", garment)
    estimate = method.step(CapturedFrame(0, 0.1, garment.vertices + [5.0, 0, 0]))
    assert np.array_equal(estimate, garment.vertices)
