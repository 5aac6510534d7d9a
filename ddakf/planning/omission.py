"""Widening of sigma, which the predicted error follows, for the work that a budget left out of a frame."""

from __future__ import annotations

import math
from typing import NamedTuple

from ddakf.config import PlaneAssociation
from ddakf.types import Estimate, Problem


class Omitted(NamedTuple):
    """Work that was left out of a frame."""

    points: float  # halvings of the cloud
    clusters: int  # cluster alignment
    passes: int  # passes at full size after the last one


def omitted(problem: Problem, estimate: Estimate) -> Omitted:
    """What was left out of a frame.

    Args:
        problem: the frame, with the effort that preprocessing had.
        estimate: after the last pass.
    """
    rule = problem.config.associate
    unfinished = problem.effort.planned and isinstance(rule, PlaneAssociation) and not estimate.finished
    more = unfinished and not problem.cloud.empty and estimate.passes < rule.most_passes(problem.dt)
    return Omitted(-math.log2(problem.effort.points), int(estimate.work.unaligned), int(more))


def widening(problem: Problem, estimate: Estimate) -> float:
    """Factor by which errors grow for what was left out; 1 where nothing was. Arguments as :func:`omitted`."""
    rule = problem.config.omission
    growths = (getattr(rule, f"{name}_growth") for name in Omitted._fields)
    return math.exp(sum(growth * count for growth, count in zip(growths, omitted(problem, estimate), strict=True)))
