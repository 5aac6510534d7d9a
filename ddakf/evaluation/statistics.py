"""Comparison of methods: paired permutation test, effect size, correction for several tests; ``docs/metrics.md``, Statistics.

The unit is the sequence; of FAUST the subject. Clips, views and seeds of one sequence share garment, body and motion, so that its
score is their mean. Units are paired: all methods have scores of the same ones.
"""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Mapping, Sequence
from functools import lru_cache
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import gammaln

CLIP = 60  # frames
ENUMERATED = 16  # groups of which all flips are tried, 2^16 at most
RANDOM_FLIPS, SEED = 100_000, 1  # a standard error of 0.0007 at p = 0.05
RESAMPLES = 10_000  # of the bootstrap
LEVEL = 0.05  # of the tests; intervals hold with probability 1 - LEVEL
BLIND = ("clothfit", "still", "carried")  # methods that use no cloud
LOST_MM = 100.0  # RMSE of a run: the width of a sleeve, so that vertices are on another part of the garment

# Scores -------------------------------------------------------------------------------------------------------------


class Spread(NamedTuple):
    """Mean and spread of a score over seeded runs."""

    mean: float | None  # None without a run
    sd: float | None  # with n - 1 in the denominator; None with fewer than two runs
    n: int  # runs that have the score


def spread(values: Iterable[float | None]) -> Spread:
    """Mean and standard deviation over the runs that have a value; None and NaN are no values."""
    found = _finite(values)
    mean = float(found.mean()) if len(found) else None
    return Spread(mean, float(found.std(ddof=1)) if len(found) > 1 else None, len(found))


def finite_mean(values: Iterable[float | None]) -> float:
    """Mean of the values that are finite numbers; NaN where there is none."""
    found = _finite(values)
    return float(found.mean()) if len(found) else float("nan")


def clips(count: int, length: int = CLIP) -> list[slice]:
    """The disjoint clips of ``count`` frames; a rest of less than half a clip belongs to the last one."""
    starts = [k for k in range(0, count, length) if k == 0 or count - k >= length / 2]
    return [slice(first, last) for first, last in pairwise([*starts, count])]


def _finite(values: Iterable[float | None]) -> np.ndarray:
    array = np.array([np.nan if value is None else value for value in values], np.float64)
    return array[np.isfinite(array)]


# Two methods --------------------------------------------------------------------------------------------------------


class Comparison(NamedTuple):
    """One method against another on the same sequences."""

    n: int  # sequences that both have a score of
    dropped: int  # sequences that only one of them, or none, has a score of
    gain: float | None  # mean over the sequences of how much better the first is, in the unit of the score
    gain_low: float | None  # 95 % interval of the gain, by a bootstrap over sequences
    gain_high: float | None
    effect: float | None  # Hedges' g of the sequences' gains
    effect_low: float | None  # 95 % interval of the effect, by the same bootstrap
    effect_high: float | None
    p: float | None  # two-tailed
    p_smallest: float  # smallest p that the number of sequences allows
    exact: bool  # all flips were tried
    p_holm: float | None = None  # see :func:`corrected`
    p_holm_smallest: float | None = None

    @property
    def verdict(self) -> str:
        """``better``, ``worse``, ``n.s.`` or, where no data could have been significant, ``n too small``.

        A small p beside an interval that holds zero is ``n.s.``.
        """
        return self._verdict(self.p, self.p_smallest)

    @property
    def verdict_holm(self) -> str | None:
        """The same by the corrected p; None before :func:`corrected`."""
        return None if self.p_holm_smallest is None else self._verdict(self.p_holm, self.p_holm_smallest)

    def _verdict(self, p: float | None, smallest: float) -> str:
        if smallest > LEVEL:
            return "n too small"
        if p is None or p > LEVEL or self.gain_low is None or self.gain_low <= 0.0 <= self.gain_high:
            return "n.s."
        return "better" if self.gain > 0 else "worse"

    def as_json(self) -> dict:
        """The fields and both verdicts."""
        return self._asdict() | {"verdict": self.verdict, "verdict_holm": self.verdict_holm}


def compare(
    ours: Mapping[Hashable, float | None],
    theirs: Mapping[Hashable, float | None],
    better: Literal["lower", "higher"] = "lower",
) -> Comparison:
    """A two-tailed paired permutation test by sign flips of whole sequences, with the size of the effect.

    Args:
        ours, theirs: scores of two methods by sequence, means over its views and seeds; None or NaN for a missing one.
        better: which way the score goes.
    """
    units = list(dict.fromkeys([*ours, *theirs]))
    one, other = (np.array([np.nan if part.get(unit) is None else part[unit] for unit in units], np.float64)
                  for part in (ours, theirs))  # fmt: skip
    gains = one - other if better == "higher" else other - one
    gains = gains[np.isfinite(gains)]
    p, smallest, exact = sign_flips(gains)
    found = len(gains) > 0
    return Comparison(
        len(gains), len(units) - len(gains), float(gains.mean()) if found else None, *interval(gains), *effect(gains),
        p if found else None, smallest, exact,
    )  # fmt: skip


def sign_flips(sums: Sequence[float]) -> tuple[float, float, bool]:
    """The probability that random signs give a sum as far from zero as the one that is.

    Under the hypothesis that neither method is better, a sequence's gain is as likely as its negative. Fisher 1935; flips of
    whole groups: Winkler et al. 2014, "Permutation inference for the general linear model".

    Args:
        sums: (g,) gain of each sequence.

    Returns:
        Two-tailed p: exact up to :data:`ENUMERATED` gains that are not zero, else (b + 1) / (m + 1) with b of m random flips as
        far (Phipson and Smyth 2010); the smallest p that their number allows; and True if p is exact.
    """
    sums = np.asarray(sums, np.float64)
    sums = sums[sums != 0]
    far = np.abs(sums.sum()) - 1e-12 * np.abs(sums).sum()  # sums in another order are not the same to the last bit
    g = len(sums)
    if g == 0:
        return 1.0, 1.0, True
    if g <= ENUMERATED:  # one sign stays: a flip of all changes no distance
        signs = 1 - 2 * (np.arange(2 ** (g - 1))[:, None] >> np.arange(g) & 1)
        return float((np.abs(signs @ sums) >= far).mean()), 2.0 ** (1 - g), True
    rng, as_far = np.random.default_rng(SEED), 0
    for part in np.array_split(np.arange(RANDOM_FLIPS), 20):
        signs = 1.0 - 2.0 * rng.integers(0, 2, (len(part), g))
        as_far += int((np.abs(signs @ sums) >= far).sum())
    return (as_far + 1) / (RANDOM_FLIPS + 1), 1 / (RANDOM_FLIPS + 1), False


def resampled(values: np.ndarray) -> np.ndarray:
    """(RESAMPLES, n) the values (n,) drawn with replacement: the bootstrap (Efron 1979), with a fixed seed."""
    return np.asarray(values)[_drawn(len(values), RESAMPLES)]


@lru_cache(maxsize=4)
def _drawn(n: int, times: int) -> np.ndarray:
    return np.random.default_rng(SEED).integers(0, n, (times, n))


def interval(values: Sequence[float]) -> tuple[float | None, float | None]:
    """95 % interval of the mean of (n,) values, by percentiles of the bootstrap; None with fewer than three values."""
    values = np.asarray(values, np.float64)
    if len(values) < 3:
        return None, None
    low, high = np.percentile(resampled(values).mean(axis=1), [50 * LEVEL, 100 - 50 * LEVEL])
    return float(low), float(high)


def effect(gains: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """The mean gain in standard deviations of the gains, nearly unbiased, with its interval.

    Args:
        gains: (n,) gain of each sequence.

    Returns:
        Hedges' g = J d_z, with d_z = mean / SD and J = Gamma(f / 2) / (sqrt(f / 2) Gamma((f - 1) / 2)), f = n - 1 (Hedges 1981);
        and the percentiles of g over a bootstrap of the sequences. None with fewer than three, or when all gains are equal.
    """
    gains = np.asarray(gains, np.float64)
    f = len(gains) - 1
    if f < 2 or np.ptp(gains) <= 1e-12 * np.abs(gains).max():
        return None, None, None
    unbiased = np.exp(gammaln(f / 2) - gammaln((f - 1) / 2)) / np.sqrt(f / 2)
    drawn = resampled(gains)
    sd = drawn.std(axis=1, ddof=1)
    sd = np.maximum(sd, 1e-12 * np.abs(gains).max())  # a sample of one sequence alone
    low, high = np.percentile(unbiased * drawn.mean(axis=1) / sd, [50 * LEVEL, 100 - 50 * LEVEL])
    return float(unbiased * gains.mean() / gains.std(ddof=1)), float(low), float(high)


class Ratio(NamedTuple):
    """Error of another method over that of the first."""

    mean: float | None  # geometric, over the sequences
    low: float | None  # 95 % interval by a bootstrap over sequences
    high: float | None
    n: int  # sequences


def ratio(ours: Mapping[Hashable, float | None], theirs: Mapping[Hashable, float | None]) -> Ratio:
    """The geometric mean over the sequences of another method's error over that of the first: no sequence counts for more."""
    logs = [np.log(theirs[unit] / ours[unit]) for unit in ours if ours[unit] and theirs.get(unit)]
    if not logs:
        return Ratio(None, None, None, 0)
    low, high = (None if bound is None else float(np.exp(bound)) for bound in interval(logs))
    return Ratio(float(np.exp(np.mean(logs))), low, high, len(logs))


# Many methods -------------------------------------------------------------------------------------------------------


def holm(p: Sequence[float | None]) -> list[float | None]:
    """p adjusted for a family of tests, in the order given (Holm 1979): with p_(1) <= ... <= p_(m), the k-th is
    max_{j <= k} min(1, (m - j + 1) p_(j)). None stays None and is no test."""
    tested = [k for k, value in enumerate(p) if value is not None]
    adjusted, least = list(p), 0.0
    for rank, k in enumerate(sorted(tested, key=lambda k: p[k])):
        least = max(least, min(1.0, (len(tested) - rank) * p[k]))
        adjusted[k] = least
    return adjusted


def corrected(family: Mapping[str, Comparison]) -> dict[str, Comparison]:
    """The comparisons of one table with Holm's p beside their own, and the smallest that the family could have given."""
    adjusted = holm([comparison.p for comparison in family.values()])
    smallest = holm([None if comparison.p is None else comparison.p_smallest for comparison in family.values()])
    return {
        name: comparison._replace(p_holm=p, p_holm_smallest=1.0 if least is None else least)
        for (name, comparison), p, least in zip(family.items(), adjusted, smallest, strict=True)
    }


def lost(rmse_mm: Iterable[float | None]) -> list[bool]:
    """True for each run that lost the garment: an RMSE above :data:`LOST_MM`, or none because the method failed.

    The limit is the same for all methods, not a multiple of the best: a good method must not make another one count as lost."""
    return [not _follows(value) for value in rmse_mm]


def _follows(rmse_mm: float | None) -> bool:
    return rmse_mm is not None and bool(np.isfinite(rmse_mm)) and rmse_mm <= LOST_MM


class Standing(NamedTuple):
    """Rank of a method among the others by one score."""

    rivals: list[str]  # that use the cloud, ran, and were not lost
    lost: list[str]  # in more than half of their runs
    blind: list[str]  # that use no cloud
    absent: list[str]  # without any run
    better: list[str]  # rivals with the worse mean
    significantly: list[str]  # of these, with a corrected p below LEVEL

    @property
    def better_than_every(self) -> bool | None:
        """True if the method is better than every rival in the mean; None without a rival."""
        return len(self.better) == len(self.rivals) if self.rivals else None


def standing(
    comparisons: Mapping[str, Comparison],
    rmse_mm: Mapping[str, Sequence[float | None]],
    blind: Iterable[str] = BLIND,
) -> Standing:
    """Rank of a method among the others.

    Args:
        comparisons: of the method with each other one, by its name, from :func:`corrected`.
        rmse_mm: of the runs of each other method in the same cells, by which lost runs are judged for any score.
        blind: methods that use no cloud.
    """
    absent = [name for name in comparisons if len(rmse_mm.get(name, ())) == 0]
    blind = [name for name in blind if name in comparisons and name not in absent]
    following = [name for name in comparisons if name not in absent and name not in blind]
    gone = [name for name in following if np.mean(lost(rmse_mm[name])) > 0.5]
    rivals = [name for name in following if name not in gone]
    better = [name for name in rivals if comparisons[name].gain is not None and comparisons[name].gain > 0]
    return Standing(rivals, gone, blind, absent, better, [n for n in better if comparisons[n].verdict_holm == "better"])
