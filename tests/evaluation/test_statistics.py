"""Tests and intervals against values by hand, against SciPy, and against their nominal rates."""

import json

import numpy as np
import pytest
from scipy.stats import bootstrap, permutation_test

from ddakf.evaluation import statistics

RNG = np.random.default_rng


def test_spread_of_seeded_runs_by_hand():
    assert statistics.spread([1.0, 2.0, 4.0, 5.0]) == pytest.approx((3, np.sqrt(10 / 3), 4))
    assert statistics.spread([2.0, None, float("nan")]) == (2, None, 1)
    assert statistics.spread([]) == (None, None, 0)


def test_clips_are_disjoint_and_lose_no_frame():
    assert statistics.clips(59) == [slice(0, 59)]
    assert statistics.clips(120) == [slice(0, 60), slice(60, 120)]
    assert statistics.clips(149) == [slice(0, 60), slice(60, 149)], "29 frames are no clip"
    assert statistics.clips(150) == [slice(0, 60), slice(60, 120), slice(120, 150)]
    assert statistics.clips(5) == [slice(0, 5)]
    assert statistics.clips(0) == []


# The test -----------------------------------------------------------------------------------------------------------


def test_sign_flips_by_hand():
    # of the eight sums +-1 +-2 +-4, only 7 and -7 are as far from zero as 7; 5, 7, -5 and -7 as far as 5
    assert statistics.sign_flips([1, 2, 4]) == (0.25, 0.25, True)
    assert statistics.sign_flips([-1, 2, 4]) == (0.5, 0.25, True)
    assert statistics.sign_flips([0.1, -0.3, 0.2]) == (1, 0.25, True), "a sum of zero is the least far of all"
    assert statistics.sign_flips([1, 2, 4, 0]) == (0.25, 0.25, True), "no difference is no evidence"
    assert statistics.sign_flips([]) == statistics.sign_flips([0, 0]) == (1, 1, True)
    assert statistics.sign_flips([3]) == (1, 1, True)


def against_scipy(sums, n_resamples=np.inf):
    mean = permutation_test((sums,), lambda x, axis: x.mean(axis=axis), permutation_type="samples", n_resamples=n_resamples,
                            vectorized=True, rng=RNG(5))  # fmt: skip
    return mean.pvalue


@pytest.mark.parametrize("groups", [2, 5, 8, 13])
def test_sign_flips_agree_with_scipy(groups):
    for shift in (0.0, 0.5, 1.0):
        sums = RNG([groups, int(10 * shift)]).normal(shift, 1, groups)
        p, smallest, exact = statistics.sign_flips(sums)
        assert exact
        assert smallest == 2 ** (1 - groups)
        assert p == pytest.approx(against_scipy(sums))


def test_random_flips_agree_with_all_of_them():
    sums = RNG(3).normal(0.5, 1, 18)
    signs = 1 - 2 * (np.arange(2**18)[:, None] >> np.arange(18) & 1)
    truth = np.mean(np.abs(signs @ sums) >= abs(sums.sum()) - 1e-12)
    p, smallest, exact = statistics.sign_flips(sums)
    assert not exact
    assert p == pytest.approx(truth, abs=4 * np.sqrt(truth * (1 - truth) / statistics.RANDOM_FLIPS))
    assert (p, smallest, exact) == statistics.sign_flips(sums), "the seed is fixed"
    p, smallest, _ = statistics.sign_flips(np.ones(40))
    assert p == smallest == 1 / 100_001, "never zero"


def test_sign_flips_are_wrong_as_often_as_they_say():
    rng = RNG(0)
    p = np.array([statistics.sign_flips(rng.laplace(size=8))[0] for _ in range(1000)])
    assert np.mean(p <= 0.05) == pytest.approx(6 / 128, abs=0.02)  # p comes in steps of 2 / 2^8


# A comparison -------------------------------------------------------------------------------------------------------


def scores(values):
    return dict(zip("abcdefghijklmnopqrstuvwxyz", values, strict=False))


def test_signs_are_flipped_per_sequence():
    theirs = RNG(1).uniform(5, 6, 8)
    result = statistics.compare(scores(theirs - 1 - 0.1 * np.arange(8)), scores(theirs))
    assert (result.n, result.dropped, result.p, result.p_smallest, result.verdict) == (8, 0, 2**-7, 2**-7, "better")
    assert result.gain == pytest.approx(1 + 0.1 * 3.5)
    assert 1 < result.gain_low < result.gain < result.gain_high < 1.7


def test_an_interval_that_holds_zero_is_never_better():
    unsure = of(0.001)._replace(gain_low=-0.1)
    assert (unsure.verdict, unsure._replace(gain_low=0.1).verdict) == ("n.s.", "better")
    alike = statistics.compare(scores(np.zeros(8)), scores(RNG(2).normal(1.0, 1.0, 8)))
    assert (alike.gain_low > 0) == (alike.effect_low > 0), "the two intervals agree about zero"


def test_too_few_units_are_called_so():
    five = statistics.compare(scores(np.zeros(5)), scores(np.ones(5) + np.arange(5)))
    assert (five.p, five.p_smallest, five.verdict) == (0.0625, 0.0625, "n too small")
    none = statistics.compare(scores([None, 1.0]), scores([1.0, float("nan")]))
    assert (none.n, none.dropped, none.p, none.gain, none.verdict) == (0, 2, None, None, "n too small")
    eight = statistics.compare(scores(np.zeros(8)), scores([1.0, -1] * 4))
    assert (eight.p, eight.verdict) == (1, "n.s.")


def test_higher_may_be_better():
    one, other = np.linspace(0.9, 1, 8), np.linspace(0.7, 0.9, 8)
    assert statistics.compare(scores(one), scores(other), better="higher").verdict == "better"
    assert statistics.compare(scores(one), scores(other), better="lower").verdict == "worse"
    assert statistics.compare(scores(one), scores(other), better="higher").effect > 0


def test_a_comparison_becomes_json():
    result = statistics.compare(scores(np.zeros(3)), scores(np.ones(3)))
    assert result.effect is None, "equal gains have no standard deviation"
    assert json.loads(json.dumps(result.as_json(), allow_nan=False))["verdict"] == "n too small"


# The size of the effect ---------------------------------------------------------------------------------------------


def test_effect_by_hand():
    g, low, high = statistics.effect([1.0, 2.0, 3.0, 4.0, 5.0])
    assert g == pytest.approx(3 / np.sqrt(2.5) * np.sqrt(2 / np.pi)), "J(4) = Gamma(2) / (sqrt(2) Gamma(3/2))"
    assert low < g < high
    assert statistics.effect([-1.0, -2.0, -3.0, -4.0, -5.0]) == pytest.approx((-g, -high, -low))
    assert statistics.effect([1.0, 2.0]) == statistics.effect([1.0, 1.0, 1.0]) == (None, None, None)


def test_the_interval_agrees_with_scipys_bootstrap():
    values = RNG(7).lognormal(size=20)
    reference = bootstrap((values,), np.mean, method="percentile", n_resamples=20_000, rng=RNG(8)).confidence_interval
    assert statistics.interval(values) == pytest.approx(tuple(reference), abs=0.05)
    assert statistics.interval([1.0, 2.0]) == (None, None)


@pytest.mark.parametrize("draw", [RNG(5).normal, lambda _, sd, size: RNG(6).laplace(0, sd / np.sqrt(2), size)])
def test_intervals_hold_the_truth_nearly_as_often_as_they_say(draw, monkeypatch):
    monkeypatch.setattr(statistics, "RESAMPLES", 1000)
    samples = 1 + draw(0, 1, 500 * 22).reshape(500, 22)
    found = np.array([statistics.interval(sample) for sample in samples])
    assert 0.90 < np.mean((found[:, 0] <= 1) & (found[:, 1] >= 1)) < 0.97


def test_a_ratio_is_the_geometric_mean_over_sequences_that_both_have():
    found = statistics.ratio(scores([1.0, 2.0, 4.0, 7.0]), scores([2.0, 2.0, 16.0, None]))
    assert (found.mean, found.n) == (pytest.approx(2.0), 3)
    assert 1.0 <= found.low < 2.0 < found.high <= 4.0
    back = statistics.ratio(scores([2.0, 2.0, 16.0]), scores([1.0, 2.0, 4.0]))
    assert (back.mean, back.low, back.high) == pytest.approx((0.5, 1 / found.high, 1 / found.low))
    assert statistics.ratio({}, {}) == (None, None, None, 0)


# A family -----------------------------------------------------------------------------------------------------------


def test_holm_by_hand():
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert statistics.holm([0.5, None, 0.9]) == pytest.approx([1, None, 1])
    assert statistics.holm([]) == []


def of(p, smallest=0.001, gain=1.0):
    bounds = sorted((0.5 * gain, 1.5 * gain))
    return statistics.Comparison(10, 0, gain, *bounds, gain, *bounds, p, smallest, True)


def test_a_family_may_be_too_large_for_its_units():
    family = statistics.corrected({"a": of(0.02, 1 / 64), "b": of(0.03, 1 / 64), "c": of(0.5, 1 / 64), "d": of(None, 1.0)})
    assert family["a"].p_holm == pytest.approx(0.06)
    assert family["a"].verdict == "better"
    assert family["a"].p_holm_smallest == pytest.approx(3 / 64)
    assert family["a"].verdict_holm == "n.s."
    assert family["d"].verdict_holm == "n too small"
    four = statistics.corrected({name: of(1 / 64, 1 / 64) for name in "abcd"})
    assert {comparison.verdict for comparison in four.values()} == {"better"}
    assert {comparison.verdict_holm for comparison in four.values()} == {"n too small"}, "4 / 64"


def test_runs_are_lost_beyond_a_limit():
    assert statistics.lost([4.0, 99.0, 101.0, None, float("nan"), float("inf")]) == [False, False, True, True, True, True]


def test_rivals_use_the_cloud_and_are_not_lost():
    family = statistics.corrected(
        {"kf": of(0.01), "icp": of(0.001), "pf": of(0.4), "clothfit": of(0.2, gain=-1), "nicp": of(0.001)}
    )
    rmse = {"kf": [300.0, 200, 20], "icp": [30.0, 40, 200], "pf": [9.0, 8, 9], "clothfit": [9.0, 9, 9], "nicp": []}
    standing = statistics.standing(family, rmse)
    assert (standing.rivals, standing.lost, standing.blind, standing.absent) == (["icp", "pf"], ["kf"], ["clothfit"], ["nicp"])
    assert (standing.better, standing.significantly, standing.better_than_every) == (["icp", "pf"], ["icp"], True)
    beaten = statistics.standing(family | {"pf": of(0.4, gain=-1)}, rmse)
    assert beaten.better_than_every is False
    assert statistics.standing(family, {"kf": rmse["kf"]}).better_than_every is None, "no rival, no claim"
