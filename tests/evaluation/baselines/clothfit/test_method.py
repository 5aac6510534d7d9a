"""ClothFit follows the body, and needs one."""

import numpy as np
import pytest

from ddakf.errors import NotApplicable
from ddakf.evaluation.baselines.clothfit.method import ClothFit
from ddakf.evaluation.baselines.clothfit.network import Committee, Network
from ddakf.evaluation.baselines.clothfit.settings import TUNED, AnswerSettings
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.trials.methods import make_baseline
from tests.evaluation.baselines.clothfit.scene import BODY, GARMENT, bent, turn
from tests.evaluation.baselines.clothfit.test_network import committee

NO_POINTS, NOTHING = np.zeros((0, 3)), Committee((Network.zero(),))


def started(network, settings=TUNED):
    method = make_baseline("carried") if network is NOTHING else ClothFit(lambda: network, settings)
    method.start(GARMENT, GARMENT.vertices, BODY)
    return method


def test_a_zero_network_carries_the_garment_with_the_body():
    method, motion = started(NOTHING), turn(0.3) @ turn(0.2, "x")
    for k in range(1, 4):
        estimate = method.step(CapturedFrame(0, k / 30, NO_POINTS, None, BODY.vertices @ motion.T + [0, 0.1 * k, 0]))
    assert estimate == pytest.approx(GARMENT.vertices @ motion.T + [0, 0.3, 0], abs=1e-9)


def test_smoothing_evens_out_what_neighbours_do():
    frame, (i, j) = CapturedFrame(0, 0.1, NO_POINTS, None, bent(BODY.vertices, 0.3)), GARMENT.edges.T
    carried, rough, smooth = (
        started(network, AnswerSettings(caution=0.0, smoothing=rounds)).step(frame)
        for network, rounds in ((NOTHING, 0), (committee(), 0), (committee(), 2))
    )
    uneven = [np.square((estimate - carried)[i] - (estimate - carried)[j]).sum() for estimate in (rough, smooth)]
    assert 0 < uneven[1] < 0.9 * uneven[0]


def test_the_cloud_changes_nothing():
    points = np.random.default_rng(0).normal(size=(500, 3))
    one, two = (started(committee()).step(CapturedFrame(0, 1 / 30, cloud, None, BODY.vertices)) for cloud in (NO_POINTS, points))
    assert np.array_equal(one, two)


def test_without_a_body_it_says_so_before_anything_is_trained():
    def never():
        raise AssertionError("asked for networks")

    with pytest.raises(NotApplicable, match="no body is given"):
        ClothFit(never).start(GARMENT, GARMENT.vertices, None)
    with pytest.raises(NotApplicable, match="no body is given"):
        started(NOTHING).step(CapturedFrame(0, 0.0, NO_POINTS))


def test_a_new_start_forgets():
    method, fresh = started(committee()), started(committee())
    method.step(CapturedFrame(0, 0.1, NO_POINTS, None, BODY.vertices + 0.1))
    method.start(GARMENT, GARMENT.vertices, BODY)
    frame = CapturedFrame(0, 0.2, NO_POINTS, None, BODY.vertices)
    assert np.array_equal(method.step(frame), fresh.step(frame))
