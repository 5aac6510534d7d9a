"""A body carries, holds and keeps out, and a baseline that is told it is better where the cloud shows nothing."""

import numpy as np
import pytest

from ddakf.evaluation.baselines.body_support import BodySupport, NoSupport, support_of
from ddakf.evaluation.metrics import rmse_mm
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.sensors.virtual_sensor import sample_surface
from ddakf.evaluation.trials.methods import make_baseline
from ddakf.mesh import Mesh
from tests.evaluation.baselines.shapes import moved, tube

TOLD = ("kf", "icp", "pf", "opt-ed", "nicp")


@pytest.fixture(scope="module")
def garment():
    return tube()


@pytest.fixture(scope="module")
def body(garment):
    """The garment's own surface, 2 cm farther inside and closed at neither end."""
    return Mesh(garment.vertices * [0.9, 1, 0.85], garment.faces)


def frame(points, body_vertices, k=1):
    return CapturedFrame(k, k / 30, points, None, body_vertices)


def test_the_body_carries_by_its_own_motion(garment, body):
    support = BodySupport(body, garment.vertices)
    turned = moved(body.vertices, 0.2, [0.1, 0.02, 0])
    carried = support.begin(frame(np.zeros((0, 3)), turned), garment.vertices)
    assert carried == pytest.approx(moved(garment.vertices, 0.2, [0.1, 0.02, 0]), abs=1e-3)
    assert support.place == pytest.approx(carried, abs=1e-3)
    back = support.begin(frame(np.zeros((0, 3)), body.vertices, 2), carried)
    assert back == pytest.approx(garment.vertices, abs=1e-3)


def test_nothing_stays_inside_and_nothing_outside_moves(garment, body):
    support = BodySupport(body, garment.vertices)
    support.begin(frame(np.zeros((0, 3)), body.vertices), garment.vertices)
    assert np.array_equal(support.outside(garment.vertices), garment.vertices)
    shrunk = garment.vertices * [0.8, 1, 0.75]
    middle = (garment.vertices[:, 1] > 0.1) & (garment.vertices[:, 1] < 0.5)
    out = support.outside(shrunk)
    depth = np.linalg.norm(out - shrunk, axis=1)[middle]
    assert depth.min() > 0.01
    assert np.linalg.norm(support.outside(out) - out, axis=1).max() < 1e-3


def test_the_hold_fades_with_the_distance_from_the_body_and_is_of_hidden_vertices(garment):
    near, far = (BodySupport(Mesh(garment.vertices * [s, 1, s], garment.faces), garment.vertices) for s in (0.97, 0.6))
    assert near.weight.mean() > 1.5 * far.weight.mean()
    matched = np.arange(garment.n_vertices) % 2
    assert not near.held(matched)[matched > 0].any()
    assert near.held(matched)[matched == 0].all()


def test_without_a_body_nothing_happens(garment):
    support = support_of(None, garment.vertices)
    assert isinstance(support, NoSupport)
    assert support.begin(frame(garment.vertices, None), garment.vertices) is garment.vertices
    assert support.outside(garment.vertices) is garment.vertices
    told = BodySupport(Mesh(0.9 * garment.vertices, garment.faces), garment.vertices)
    assert told.begin(frame(garment.vertices, None), garment.vertices) is garment.vertices
    assert not told.weight.any(), "a frame without a body holds nothing"


@pytest.mark.slow
@pytest.mark.parametrize("name", TOLD)
def test_a_baseline_that_is_told_the_body_follows_what_it_does_not_see(name, garment, body):
    """Seen from the front alone, the garment turns with its body, whose back swells by half."""

    def posed(vertices, k):
        swollen = np.where(vertices[:, 2:] < 0, vertices * [1, 1, 1 + 0.04 * k], vertices)
        return moved(swollen, 0.05 * k, [0.01 * k, 0, 0])

    errors = {}
    for known in (None, body):
        method, rng = make_baseline(name), np.random.default_rng(0)
        method.start(garment, garment.vertices, known)
        for k in range(1, 13):
            truth = posed(garment.vertices, k)
            points = sample_surface(truth, garment.faces, 4000, rng)
            points = points[points[:, 2] > 0.02]
            pose = None if known is None else posed(body.vertices, k)
            estimate = method.step(CapturedFrame(k, k / 30, points, np.array([0.0, 0.3, 3.0]), pose))
        errors[known is not None] = rmse_mm(estimate, truth)
    assert errors[True] < 0.75 * errors[False]
    assert errors[True] < 0.6 * rmse_mm(garment.vertices, truth)


@pytest.mark.slow
@pytest.mark.parametrize("name", [*TOLD, "icp-rigid"])
def test_no_baseline_leaves_the_garment_inside_a_body_that_it_is_told(name, garment, body):
    method = make_baseline(name)
    method.start(garment, garment.vertices, body)
    cloud = (garment.vertices * [0.8, 1, 0.75]).astype(np.float32)  # of a wrong surface, inside the body
    support = BodySupport(body, garment.vertices)
    for k in range(1, 4):
        estimate = method.step(frame(cloud, body.vertices, k))
        support.begin(frame(cloud, body.vertices, k), estimate)
    assert np.linalg.norm(support.outside(estimate) - estimate, axis=1).max() < 4e-3, "at the rim the normals are not exact"
