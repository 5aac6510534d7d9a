"""Stage G, reliability (paper, section 2.6): the paper's s_k, the product's score, and the tracker's state."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.config import PaperReliability, Reliability
from ddakf.fuse import Update
from ddakf.types import State, TrackerState

LONGEST_BOOKED = 0.3  # s: a gap before a bad frame longer than frames usually are apart is no part of a loss


class Health(NamedTuple):
    """What the tracker remembers about its own quality."""

    state: TrackerState = "initializing"
    physics_lambda: float = 1.0
    poor_for: float = 0.0  # s of sensor time with points, but without a fit
    empty_for: float = 0.0  # s of empty clouds
    frames_unplaced: int = 0  # frames with points since the start or the loss


def paper_score(innovation: np.ndarray, R: np.ndarray, found: np.ndarray) -> float:
    """s_k = exp(-1/N_v sum_i |y_i|^2 / trace(R_i)), section 2.6; vertices without a measurement contribute y = 0.

    A frame without any measurement has no innovation to judge by; its score is 0.

    Args:
        innovation: (V, 3) y, metres.
        R: (V, 3, 3) square metres.
        found: (V,) bool.
    """
    if not found.any():
        return 0.0
    energy = np.einsum("va,va->v", innovation, innovation) / np.trace(R, axis1=1, axis2=2)
    return float(np.exp(-energy[found].sum() / len(found)))


def score(covariance: np.ndarray, normalised: np.ndarray, expected: int, config) -> float:
    """The product's score in [0, 1]: 1 / (1 + (e / e_half)^2) with e the error that the frame's own evidence predicts.

    e^2 is the mean of trace(P_i), times the mean normalised innovation squared where that is larger than its expectation, over
    the squared share of the visible vertices that found a measurement.

    Args:
        covariance: (V, 3, 3) posterior, square metres.
        normalised: (K,) squared residuals of the used measurements over the trace of R.
        expected: number of vertices that a sensor may see.
        config: the scale.
    """
    nis = max(1.0, 3.0 * float(np.mean(normalised))) if len(normalised) else 1.0
    share = min(1.0, max(len(normalised) / expected, 1e-3)) if expected else 1.0
    error2 = float(np.trace(covariance, axis1=1, axis2=2).mean()) * nis / share**2
    return 1.0 / (1.0 + error2 / config.half_error**2)


def vertex_reliability(sigma: np.ndarray, weight: np.ndarray, config: Reliability | PaperReliability) -> np.ndarray:
    """(V,) in [0, 1]: 1 / (1 + 3 sigma^2 / e_half^2); a measurement that was weighted down counts as much less."""
    trust = np.where(weight > 0, 0.5 + 0.5 * weight, 1.0)
    return trust / (1.0 + 3.0 * np.square(sigma / config.half_error))


class Verdict(NamedTuple):
    """Stage G's answer for a frame."""

    health: Health
    reliability: float
    paper_score: float
    coverage: float
    vertex_reliability: np.ndarray  # (V,)


def judge(
    health: Health, update: Update, posterior: State, covariance: np.ndarray, prior: State, n_points: int, dt: float,
    config: Reliability | PaperReliability,
) -> Verdict:  # fmt: skip
    """Scores a frame and moves the tracker's state on.

    Args:
        health: after the last frame.
        update: the finished update.
        posterior, prior: states of this frame.
        covariance: (V, 3, 3) calibrated, square metres.
        n_points: in the cloud as it came.
        dt: seconds of sensor time since the last frame.
        config: ``Reliability`` or ``PaperReliability``.
    """
    used = update.weight > 0
    coverage = float(used.mean())
    s_k = paper_score(update.measurement.innovation(prior.position), update.R, update.measurement.found)
    residual = update.measurement.innovation(posterior.position)[used]
    normalised = np.einsum("va,va->v", residual, residual) / np.maximum(np.trace(update.R[used], axis1=1, axis2=2), 1e-12)
    reliability = score(covariance, normalised, int(update.measurement.visible.sum()), config)
    moved = advance(
        health, s_k if isinstance(config, PaperReliability) else reliability, coverage, n_points, update.rejected, dt, config
    )
    sigma = np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3)
    return Verdict(moved, reliability, s_k, coverage, vertex_reliability(sigma, update.weight, config))


def advance(
    health: Health, score: float, coverage: float, n_points: int, rejected: bool, dt: float,
    config: Reliability | PaperReliability,
) -> Health:  # fmt: skip
    """The state after a frame.

    Args:
        health: after the last frame.
        score: of this frame; s_k for the paper.
        coverage: share of the vertices observed.
        n_points: in the cloud.
        rejected: the fit was thrown away.
        dt: seconds of sensor time since the last frame.
        config: thresholds.
    """
    if isinstance(config, PaperReliability):
        low = score < config.threshold
        return Health("recovering" if low else "tracking", config.recovery_lambda if low else 1.0)
    dt = min(dt, LONGEST_BOOKED)
    if n_points == 0:
        # no points say nothing about the fit; only a long silence is a loss
        health = health._replace(empty_for=health.empty_for + dt)
        return health._replace(state="lost") if health.empty_for >= config.lost_after_empty else health
    poor_for = health.poor_for + dt if rejected or coverage < config.lost_coverage else 0.0
    if poor_for >= config.lost_after or (health.state == "lost" and poor_for > 0):
        unplaced = health.frames_unplaced + 1 if health.state in ("lost", "initializing") else 0
        return Health("lost", 1.0, poor_for, 0.0, unplaced)
    if health.state == "initializing" and poor_for > 0:
        return health._replace(poor_for=poor_for, empty_for=0.0, frames_unplaced=health.frames_unplaced + 1)
    threshold = config.recovery_above if health.state == "recovering" else config.recovery_below
    recovering = score < threshold or poor_for > 0
    return Health(
        "recovering" if recovering else "tracking", config.recovery_lambda if recovering else 1.0, poor_for, 0.0
    )
