"""Tests and intervals against values by hand, against SciPy, and against their nominal rates."""

import json

import numpy as np
import pytest
from scipy.stats import nct, permutation_test

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


def test_clip_means_by_hand():
    values = [*range(60), *[None] * 30, *[7.0] * 30]
    assert statistics.clip_means(values) == pytest.approx([29.5, 7])
    assert np.isnan(statistics.clip_means([None] * 60)).all()


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


def test_signs_are_flipped_per_sequence_where_there_are_eight():
    sequences, clip = np.repeat([f"s{k}" for k in range(8)], 4), np.tile([0, 0, 1, 1], 8)  # two clips in two views each
    theirs = RNG(1).uniform(5, 6, 32)
    result = statistics.compare(theirs - 1 - 0.1 * np.arange(32), theirs, sequences, clip)
    assert (result.n, result.groups, result.flipped, result.dependence) == (32, 8, "sequence", None)
    assert (result.p, result.p_smallest, result.verdict) == (2**-7, 2**-7, "better")
    assert result.gain == pytest.approx(1 + 0.1 * 15.5)
    seven = statistics.compare(theirs[:28] - 1, theirs[:28], sequences[:28], clip[:28])
    assert (seven.groups, seven.flipped) == (14, "clip")


def test_signs_are_flipped_per_clip_where_sequences_are_few():
    sequences, clip = np.repeat(["a", "b", "c"], 4), np.tile([0, 0, 1, 1], 3)
    result = statistics.compare(np.arange(12.0), np.arange(12.0) - 1, sequences, clip)
    assert (result.n, result.groups, result.flipped) == (12, 6, "clip"), "views of a clip go together"
    assert result.dependence == statistics.DEPENDENCE
    assert (result.p, result.verdict) == (2**-5, "worse")
    single = statistics.compare([1.0, 2.0], [2.0, 3.5], ["a", "b"], [0, 0])
    assert (single.flipped, single.dependence) == ("sequence", None), "one clip each"


def test_too_few_units_are_called_so():
    five = statistics.compare(np.zeros(5), np.ones(5) + np.arange(5), list("abcde"), [0] * 5)
    assert (five.p, five.p_smallest, five.verdict) == (0.0625, 0.0625, "n too small")
    none = statistics.compare([None, 1.0], [1.0, float("nan")], ["a", "b"], [0, 0])
    assert (none.n, none.dropped, none.p, none.gain, none.verdict) == (0, 2, None, None, "n too small")
    eight = statistics.compare(np.zeros(8), [1.0, -1] * 4, list("abcdefgh"), [0] * 8)
    assert (eight.p, eight.verdict) == (1, "n.s.")


def test_higher_may_be_better():
    one, other = np.linspace(0.9, 1, 8), np.linspace(0.7, 0.9, 8)
    units = (list("abcdefgh"), [0] * 8)
    assert statistics.compare(one, other, *units, better="higher").verdict == "better"
    assert statistics.compare(one, other, *units, better="lower").verdict == "worse"
    assert statistics.compare(one, other, *units, better="higher").effect > 0


def test_a_comparison_becomes_json():
    result = statistics.compare(np.zeros(3), np.ones(3), list("abc"), [0] * 3)
    assert result.effect is None, "equal gains have no standard deviation"
    assert json.loads(json.dumps(result.as_json(), allow_nan=False))["verdict"] == "n too small"


# The size of the effect ---------------------------------------------------------------------------------------------


def test_effect_by_hand():
    g, low, high = statistics.effect([1.0, 2.0, 3.0, 4.0, 5.0])
    d = 3 / np.sqrt(2.5)
    assert g == pytest.approx(d * np.sqrt(2 / np.pi)), "J(4) = Gamma(2) / (sqrt(2) Gamma(3/2))"
    root = np.sqrt(5)
    assert nct.cdf(root * d, 4, root * np.array([low, high])) == pytest.approx([0.975, 0.025], abs=1e-6)
    assert statistics.effect([-1.0, -2.0, -3.0, -4.0, -5.0]) == pytest.approx((-g, -high, -low), abs=1e-5)
    assert statistics.effect([1.0, 2.0]) == statistics.effect([1.0, 1.0, 1.0]) == (None, None, None)


@pytest.mark.parametrize(("groups", "size"), [(5, 1.0), (12, 0.3)])
def test_intervals_hold_the_truth_as_often_as_they_say(groups, size):
    rng = RNG(groups)
    found = np.array([statistics.effect(rng.normal(size, 1, groups)) for _ in range(2000)])
    assert np.mean((found[:, 1] <= size) & (size <= found[:, 2])) == pytest.approx(0.95, abs=0.015)
    assert found[:, 0].mean() == pytest.approx(size, abs=0.05), "nearly unbiased"


def test_intervals_bear_heavy_tails():
    rng = RNG(0)
    found = np.array([statistics.effect(1 + rng.laplace(size=8) / np.sqrt(2)) for _ in range(2000)])
    assert 0.88 < np.mean((found[:, 1] <= 1) & (found[:, 2] >= 1)) < 0.95


# A family -----------------------------------------------------------------------------------------------------------


def test_holm_by_hand():
    assert statistics.holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert statistics.holm([0.5, None, 0.9]) == pytest.approx([1, None, 1])
    assert statistics.holm([]) == []


def of(p, smallest=0.001, gain=1.0):
    return statistics.Comparison(10, 0, 10, "sequence", None, gain, 1.0, 0.5, 1.5, p, smallest, True)


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
