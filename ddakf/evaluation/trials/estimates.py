"""Estimates: a method's answer for one frame, and the types of a method."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh


class FrameEstimate(NamedTuple):
    """A method's estimate for one frame. Fields that the method does not provide are None."""

    vertices: np.ndarray  # (V, 3) m
    covariance: np.ndarray | None = None  # (V, 3, 3) m^2
    observed: np.ndarray | None = None  # (V,) bool
    reliability: float | None = None
    paper_score: float | None = None
    coverage: float | None = None
    state: str | None = None
    effective_sample_size: float | None = None  # of a particle filter


Method = Callable[[CapturedFrame], FrameEstimate]
MethodFactory = Callable[[Mesh, np.ndarray, Mesh | None], Method]  # of garment, start (V, 3) in metres, and body
