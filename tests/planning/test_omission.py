"""Omission: the factor for what was left out."""

import math

import pytest

from ddakf import Config
from ddakf.planning import omission
from ddakf.planning.work import Effort, Work
from tests.planning.test_plan import run

NOTHING = Work()


class Finished:
    """A problem and an estimate, as far as the omission reads them."""

    def __init__(self, points=1.0, work=NOTHING, passes=8, finished=True, empty=False, dt=1 / 30):
        self.config, self.effort, self.work = Config(), Effort(planned=True, points=points), work
        self.passes, self.finished, self.cloud = passes, finished, self
        self.empty, self.dt = empty, dt


@pytest.mark.parametrize(
    ("finished", "growths"),
    [
        (Finished(), {}),
        (Finished(points=0.25), {"points": 2}),
        (Finished(work=Work(clusters=1, unaligned=True)), {"clusters": 1}),
        (Finished(passes=3, finished=False), {"passes": 1}),
        (Finished(passes=8, finished=False), {}),
        (Finished(passes=8, finished=False, dt=0.1), {"passes": 1}),
        (Finished(passes=1, finished=False, empty=True), {}),
    ],
)
def test_each_part_grows_the_error_by_its_own_factor(finished, growths):
    rule = finished.config.omission
    expected = math.exp(sum(getattr(rule, f"{name}_growth") * count for name, count in growths.items()))
    assert omission.widening(finished, finished) == pytest.approx(expected)


def test_nothing_is_left_out_without_a_budget():
    assert all(result.usage.widening == 1.0 for result in run(None)[1])
