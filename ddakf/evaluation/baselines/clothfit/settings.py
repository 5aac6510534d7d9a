"""Settings of ClothFit: of its answers, of the stretches of recordings, and of the training."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass(frozen=True)
class AnswerSettings:
    """Settings of the network's answers; the defaults are the best of ``benchmarks/results/tuning.json``.

    Attributes:
        gate: LENGTH of change since the start at which the still vectors count by half; used in training, too.
        caution: how much less the committee answers where its members differ, see :class:`.network.Committee`.
        smoothing: averages of a vertex's offset with its neighbours'.
    """

    gate: float = 1.0
    caution: float = 4.0
    smoothing: int = 4


TUNED = AnswerSettings()


@dataclass(frozen=True)
class Stretches:
    """Stretches into which a recording is cut.

    Attributes:
        count: of stretches, which begin at even distances and overlap.
        frames: of each, at most.
        every: stride of the frames that give examples; the motion is tracked through all.
        vertices: of each, chosen at random.
        shortest: frames; a recording needs one more.
    """

    count: int = 8
    frames: int = 75
    every: int = 3
    vertices: int = 400
    shortest: int = 30


@dataclass(frozen=True)
class TrainingSettings:
    """Settings of the training.

    Attributes:
        cut: of every recording.
        rehearsed: of every rehearsal.
        members: of the committee, M; each learns from all recordings but every M-th.
        hidden: width of the two hidden layers.
        steps: of each, on the project's own recordings.
        tuning_steps: after them, on those and external recordings, half of each batch from either.
        batch: examples of a step, as many from each recording.
        rate, tuning_rate: of learning, at the most; it rises and falls over the steps of either.
        decay: of the weights (AdamW).
        robust: LENGTH; larger errors count linearly.
        gate: of :class:`AnswerSettings`.
        seed: of everything.
    """

    cut: Stretches = field(default_factory=Stretches)
    rehearsed: Stretches = field(default_factory=lambda: Stretches(count=3, frames=70, vertices=250))
    members: int = 4
    hidden: int = 96
    steps: int = 1000
    tuning_steps: int = 300
    batch: int = 2048
    rate: float = 3e-3
    tuning_rate: float = 5e-4
    decay: float = 1e-2
    robust: float = 0.2
    gate: float = AnswerSettings.gate
    seed: int = 0
