"""Rate at which frames arrive."""

import pytest
from ddakf_service.streaming.rate_limit import ArrivalRate


def rate_of(times) -> float:
    rate = ArrivalRate()
    for moment in times:
        rate.arrived(moment)
    return rate.value


def test_no_rate_is_known_before_the_second_frame():
    assert rate_of([]) == rate_of([3.0]) == 0.0


def test_a_steady_rate_is_that_of_the_frames():
    assert rate_of(k / 30 for k in range(20)) == pytest.approx(30.0)


def test_frames_that_arrive_in_pairs_have_the_rate_of_their_mean():
    assert rate_of(k // 2 / 15 for k in range(200)) == pytest.approx(30.0, rel=0.1)


def test_a_pause_is_no_interval():
    assert rate_of([0.0, 0.1, 9.0]) == 0.0
    assert rate_of([0.0, 0.1, 9.0, 9.05]) == pytest.approx(20.0)


def test_frames_at_the_same_moment_have_a_finite_rate():
    assert rate_of([1.0, 1.0, 1.0]) == 0.0
    assert rate_of([0.0, 1e-9]) == 1000.0
