"""What was tuned of ClothFit."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class AnswerSettings:
    """How the network's answers are made; the defaults are the best of ``benchmarks/results/tuning.json``.

    Attributes:
        gate: LENGTH of change since the start at which vectors of what is still count by half; trained with it.
        caution: how much less the committee answers where its members differ, see :class:`.network.Committee`.
        smoothing: averages of a vertex's offset with its neighbours'.
    """

    gate: float = 1.0
    caution: float = 4.0
    smoothing: int = 4


TUNED = AnswerSettings()
