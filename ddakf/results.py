"""Result of a step: the garment after one frame, and what was wrong with the input. V vertices; metres, seconds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

TrackerState = Literal["initializing", "tracking", "recovering", "lost"]
WarningCode = Literal[
    "sensor_origin_missing",
    "nothing_in_reach",
    "whole_person",
    "length_unit",
    "garment_size",
    "time_unit",
    "stale_clock",
    "clock_jump",
    "upside_down",
    "heading_uncertain",
    "wrong_up",
    "split_seams",
    "mirrored",
    "points_behind_sensor",
    "narrow_mask",
    "body_apart",
    "body_off",
    "sensors_off",
]


class InputWarning(NamedTuple):
    """A sign that the input is wrong, although it could be tracked."""

    code: WarningCode
    field: str  # of the input that is probably wrong: an argument of Tracker.step, "garment", or "config.start.up"
    message: str  # one sentence, with the numbers that gave it away


class Usage(NamedTuple):
    """Processor time of a frame, and what its budget left out."""

    seconds: float = 0.0  # of the calling thread
    prediction: float = 0.0  # s of these, of stage A and the search
    budget: float | None = None  # s; None: none was given
    widening: float = 1.0  # factor on sigma and on the predicted error for the work that was left out; 1: none
    working_vertices: int = 0  # that were tracked; the garment's others are carried along


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The garment after one frame.

    Attributes:
        vertices: (V, 3) positions, metres.
        velocities: (V, 3) metres per second.
        covariance: (V, 3, 3) position covariance, square metres.
        sigma: (V,) sqrt(trace(covariance) / 3), metres.
        vertex_reliability: (V,) in [0, 1].
        observed: (V,) bool, measured in this frame; none where the frame was rejected.
        reliability: the frame's score in [0, 1]; high means low error.
        paper_score: s_k of the paper, section 2.6.
        coverage: share of the vertices that were observed.
        state: what the tracker is doing.
        timings: seconds per stage, by the stage's name, and "total".
        warnings: signs of wrong input, at most one of each code.
        usage: processor time, budget, and what that left out.
    """

    vertices: np.ndarray
    velocities: np.ndarray
    covariance: np.ndarray
    sigma: np.ndarray
    vertex_reliability: np.ndarray
    observed: np.ndarray
    reliability: float
    paper_score: float
    coverage: float
    state: TrackerState
    timings: dict[str, float] = field(default_factory=dict)
    warnings: tuple[InputWarning, ...] = ()
    usage: Usage = field(default_factory=Usage)
