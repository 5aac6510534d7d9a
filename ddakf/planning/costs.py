"""Costs of the parts of a frame: a running mean and deviation each, learned in frames with a budget.

The estimator is that of TCP's round-trip time (Jacobson 1988, "Congestion avoidance and control"): a bound that is rarely
exceeded, from two running means.
"""

from __future__ import annotations

import statistics
from collections.abc import Mapping

from ddakf.planning.work import Costs, Rate
from ddakf.types import Model

GAIN = 0.125  # of the running means
DEVIATIONS = 2.0  # above the mean: the bound
OVERRUNS, OVERRUN_SHARE = 5.0, 0.01  # searches that may exceed their budgets: a few at once, and one frame in a hundred
SAME_KIND = 0.25  # of the mean, above which the time of a search is that of a whole one
SPARE_POINTS = 3000  # whose preprocessing costs about as much as that of an empty cloud
LEAST = 1e-9  # seconds; a clock may be coarse
SPEED = ("points", "probe", "first", "end")  # parts of every frame, which tell how fast the processor is


def typical(model: Model) -> Costs:
    """Costs before any was measured, of a busy processor of 2024, seconds."""
    thousands = len(model.cluster) / 1000
    means = {
        "search": 0.05,
        "points": 2e-7,
        "probe": 4e-4 + 8e-5 * thousands,
        "clusters": 3e-3,
        "first": 1.2e-3 + 8e-4 * thousands,
        "later": 8e-4 + 6e-4 * thousands,
        "end": 1.5e-3 + 5e-4 * thousands,
    }
    return Costs(**{name: Rate(mean, 0.25 * mean) for name, mean in means.items()}, overruns=OVERRUNS)


def bound(rate: Rate) -> float:
    """Seconds that a unit of work rarely exceeds."""
    return rate.mean + DEVIATIONS * rate.deviation


def learn(costs: Costs, measured: Mapping[str, float], model: Model) -> Costs:
    """The costs after a frame.

    Args:
        costs: before.
        measured: seconds of a unit of work, by the names of the costs. Parts never measured are typical ones of a processor as
            fast as this one is in the others, in their median.
        model: of the garment.
    """
    rates = {name: _followed(getattr(costs, name), seconds) for name, seconds in measured.items()}
    now, guessed = costs._replace(**rates), typical(model)
    speeds = [rate.mean / getattr(guessed, name).mean for name in SPEED if (rate := getattr(now, name)).known]
    speed = statistics.median(speeds) if speeds else 1.0
    unknown = [name for name in Costs._fields[:-1] if not getattr(now, name).known]
    return now._replace(**{name: _scaled(getattr(guessed, name), speed) for name in unknown})


def _scaled(rate: Rate, factor: float) -> Rate:
    return Rate(factor * rate.mean, factor * rate.deviation)


def _followed(rate: Rate, seconds: float) -> Rate:
    seconds = max(seconds, LEAST)
    if not rate.known:
        return Rate(seconds, 0.25 * seconds, True)
    off = seconds - rate.mean
    return Rate(rate.mean + GAIN * off, rate.deviation + GAIN * (abs(off) - rate.deviation), True)
