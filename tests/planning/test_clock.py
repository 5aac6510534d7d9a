"""Clock of a frame: seconds of stages, what is left of a budget, the limit."""

import pytest

from ddakf.errors import FrameTooCostly
from ddakf.planning import clock as module
from ddakf.planning.clock import Clock


@pytest.fixture
def now(monkeypatch):
    """Processor seconds, to be set."""
    value = [0.0]
    monkeypatch.setattr(module.time, "thread_time", lambda: value[0])
    return value


def test_what_is_left_shrinks_with_the_work(now):
    clock = Clock(0.02)
    with clock("input"):
        now[0] += 0.005
    assert clock.left() == pytest.approx(0.015)


def test_a_stage_costs_what_it_takes_after_it_was_planned(now):
    clock = Clock(1.0)
    with clock("preprocess"):
        now[0] += 0.1  # of another stage
        clock.left()
        now[0] += 0.3
    assert clock.spent("preprocess") == pytest.approx([0.3])


def test_the_runs_of_stages_are_added_up_each(now):
    clock = Clock(1.0)
    for seconds in (0.1, 0.2):
        with clock("associate"):
            now[0] += seconds
        with clock("fuse"):
            now[0] += 2 * seconds
    assert clock.spent("associate", "fuse") == pytest.approx([0.3, 0.6])


def test_the_limit_is_checked_at_the_end_of_a_stage(now):
    clock, ended = Clock(limit=0.1), []

    def stage():
        with clock("fuse"):
            now[0] += 0.2
            ended.append("fuse")

    with pytest.raises(FrameTooCostly, match=r"used 0.2 s of processor time up to fuse, 0.1 s are allowed"):
        stage()
    assert ended == ["fuse"]
