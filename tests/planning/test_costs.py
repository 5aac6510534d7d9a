"""Costs of the parts of a frame: what is learned of them."""

import numpy as np
import pytest

from ddakf import Tracker
from ddakf.planning import costs
from tests.tracker_runs import TUBE

MODEL = Tracker(TUBE)._setup.model
TYPICAL = costs.typical(MODEL)


def test_a_steady_cost_is_learned():
    learned = TYPICAL
    for _ in range(60):
        learned = costs.learn(learned, {"first": 0.004}, MODEL)
    assert learned.first.mean == pytest.approx(0.004)
    assert costs.bound(learned.first) == pytest.approx(0.004, rel=0.01)


def test_an_unsteady_cost_is_rarely_above_its_bound():
    rng, learned, above = np.random.default_rng(5), TYPICAL, 0
    for _ in range(2000):
        seconds = 0.004 * rng.gamma(40.0) / 40.0  # 16 % of spread
        above += seconds > costs.bound(learned.first)
        learned = costs.learn(learned, {"first": seconds}, MODEL)
    assert above / 2000 < 0.1


@pytest.mark.parametrize("speed", [0.25, 4.0])
def test_what_was_never_measured_is_as_slow_as_the_rest(speed):
    measured = {name: speed * getattr(TYPICAL, name).mean for name in costs.SPEED}
    learned = costs.learn(TYPICAL, measured, MODEL)
    for name in ("search", "clusters", "later"):
        assert getattr(learned, name).mean == pytest.approx(speed * getattr(TYPICAL, name).mean)
        assert not getattr(learned, name).known


def test_what_was_never_measured_follows_the_processor_and_no_single_part():
    measured = {name: 2 * getattr(TYPICAL, name).mean for name in costs.SPEED}
    learned = costs.learn(TYPICAL, measured | {"probe": 0.0}, MODEL)
    assert learned.search.mean == pytest.approx(2 * TYPICAL.search.mean)
    for _ in range(60):
        learned = costs.learn(learned, {name: 2 * seconds for name, seconds in measured.items()}, MODEL)
    assert learned.search.mean == pytest.approx(4 * TYPICAL.search.mean, rel=0.01)
