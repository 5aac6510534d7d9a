"""Comparison of methods: paired permutation test, effect size, correction for several tests; ``docs/metrics.md``, Statistics.

The unit is a disjoint clip of a sequence in one view. Its score is the mean over the seeded runs, since seeds vary the noise and
not the motion. Units are paired: all methods have scores of the same ones.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import gammaln, nctdtrinc

CLIP = 60  # frames
LEAST_SEQUENCES = 8  # from here on signs are flipped per sequence: the smallest p is 2^-7
ENUMERATED = 16  # groups of which all flips are tried, 2^16 at most
RANDOM_FLIPS, SEED = 100_000, 1  # a standard error of 0.0007 at p = 0.05
LEVEL = 0.05  # of the tests; intervals hold with probability 1 - LEVEL
LOST_MM = 100.0  # RMSE of a run: the width of a sleeve, so that vertices are on another part of the garment
DEPENDENCE = "clips of one sequence share garment, body and kind of motion: p is too small if their gains go together"

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


def clips(count: int, length: int = CLIP) -> list[slice]:
    """The disjoint clips of ``count`` frames; a rest of less than half a clip belongs to the last one."""
    starts = [k for k in range(0, count, length) if k == 0 or count - k >= length / 2]
    return [slice(first, last) for first, last in pairwise([*starts, count])]


def clip_means(values: Sequence[float | None], length: int = CLIP) -> np.ndarray:
    """(n,) mean of a score per frame over each of :func:`clips`; NaN where no frame has the score."""
    parts = [_finite(values[part]) for part in clips(len(values), length)]
    return np.array([part.mean() if len(part) else np.nan for part in parts])


def _finite(values: Iterable[float | None]) -> np.ndarray:
    array = np.array([np.nan if value is None else value for value in values], np.float64)
    return array[np.isfinite(array)]


# Two methods --------------------------------------------------------------------------------------------------------


class Comparison(NamedTuple):
    """One method against another on the same units."""

    n: int  # units that both have a score of
    dropped: int  # units that only one of them, or none, has a score of
    groups: int  # of units, whose signs are flipped together
    flipped: Literal["sequence", "clip"]  # content of a group; the views of a clip are always in one group
    dependence: str | None  # between groups, in a sentence
    gain: float | None  # mean over the units of how much better the first is, in the unit of the score
    effect: float | None  # Hedges' g of the groups' mean gains
    effect_low: float | None  # 95 % confidence interval of the standardised mean gain
    effect_high: float | None
    p: float | None  # two-tailed
    p_smallest: float  # smallest p that the number of groups allows
    exact: bool  # all flips were tried
    p_holm: float | None = None  # see :func:`corrected`
    p_holm_smallest: float | None = None

    @property
    def verdict(self) -> str:
        """``better``, ``worse``, ``n.s.`` or, where no data could have been significant, ``n too small``."""
        return _verdict(self.gain, self.p, self.p_smallest)

    @property
    def verdict_holm(self) -> str | None:
        """The same by the corrected p; None before :func:`corrected`."""
        return None if self.p_holm_smallest is None else _verdict(self.gain, self.p_holm, self.p_holm_smallest)

    def as_json(self) -> dict:
        """The fields and both verdicts."""
        return self._asdict() | {"verdict": self.verdict, "verdict_holm": self.verdict_holm}


def compare(
    ours: Sequence[float | None],
    theirs: Sequence[float | None],
    sequences: Sequence[Hashable],
    clip: Sequence[Hashable],
    better: Literal["lower", "higher"] = "lower",
) -> Comparison:
    """A two-tailed paired permutation test by sign flips, with the size of the effect.

    Args:
        ours, theirs: (n,) scores of two methods per unit, means over the seeds; None or NaN for a missing one.
        sequences: (n,) the sequence of each unit.
        clip: (n,) the number of the clip within its sequence; a clip's views share it.
        better: which way the score goes.

    Returns:
        Signs are flipped per sequence where at least :data:`LEAST_SEQUENCES` have a pair of scores, or all have one clip only;
        otherwise per clip, and ``dependence`` says so.
    """
    one, other = (np.array([np.nan if x is None else x for x in scores], np.float64) for scores in (ours, theirs))
    gain = one - other if better == "higher" else other - one
    paired = np.flatnonzero(np.isfinite(gain))
    whole, parts = (defaultdict(list) for _ in range(2))
    for k in paired:
        whole[sequences[k]].append(gain[k])
        parts[sequences[k], clip[k]].append(gain[k])
    by_sequence = len(whole) >= LEAST_SEQUENCES or len(whole) == len(parts)
    groups = list((whole if by_sequence else parts).values())
    p, smallest, exact = sign_flips([sum(group) for group in groups])
    return Comparison(
        len(paired), len(gain) - len(paired), len(groups),
        "sequence" if by_sequence else "clip", None if by_sequence else DEPENDENCE,
        float(gain[paired].mean()) if len(paired) else None, *effect([np.mean(group) for group in groups]),
        p if groups else None, smallest, exact,
    )  # fmt: skip


def sign_flips(sums: Sequence[float]) -> tuple[float, float, bool]:
    """The probability that random signs give a sum as far from zero as the one that is.

    Under the hypothesis that neither method is better, a group's gain is as likely as its negative. Fisher 1935; flips of whole
    groups: Winkler et al. 2014, "Permutation inference for the general linear model".

    Args:
        sums: (g,) total gain of each group.

    Returns:
        Two-tailed p: exact up to :data:`ENUMERATED` groups that are not zero, else (b + 1) / (m + 1) with b of m random flips as
        far (Phipson and Smyth 2010); the smallest p that the number of groups allows; and True if p is exact.
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


def effect(gains: Sequence[float]) -> tuple[float | None, float | None, float | None]:
    """The mean gain in standard deviations of the gains, nearly unbiased, with its confidence interval.

    Args:
        gains: (g,) mean gain of each group, taken as independent and normal.

    Returns:
        Hedges' g = J d_z, with d_z = mean / SD and J = Gamma(f / 2) / (sqrt(f / 2) Gamma((f - 1) / 2)), f = g - 1 (Hedges 1981);
        and the bounds on the population's mean / SD between which the noncentral t distribution puts sqrt(g) d_z with 95 %
        (Steiger and Fouladi 1997; Cumming and Finch 2001). None with fewer than three groups, or when all gains are equal.
    """
    gains = np.asarray(gains, np.float64)
    f = len(gains) - 1
    if f < 2 or np.ptp(gains) <= 1e-12 * np.abs(gains).max():
        return None, None, None
    d, root = float(gains.mean() / gains.std(ddof=1)), np.sqrt(len(gains))
    unbiased = d * np.exp(gammaln(f / 2) - gammaln((f - 1) / 2)) / np.sqrt(f / 2)
    low, high = (nctdtrinc(f, q, root * d) / root for q in (1 - LEVEL / 2, LEVEL / 2))
    return float(unbiased), float(low), float(high)


def _verdict(gain: float | None, p: float | None, smallest: float) -> str:
    if smallest > LEVEL:
        return "n too small"
    if p is None or p > LEVEL:
        return "n.s."
    return "better" if gain > 0 else "worse"


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
    blind: Iterable[str] = ("clothfit",),
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
