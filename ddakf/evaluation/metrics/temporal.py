"""Temporal metrics: flicker, variance of acceleration, and the frames that a recovery takes."""

from __future__ import annotations

import numpy as np

from ddakf.evaluation.metrics.vertex_error import MM

SMOOTHING = np.array([1, 4, 6, 4, 1]) / 16  # binomial weights of five frames: standard deviation one frame


def flicker_mm(estimates: np.ndarray, truths: np.ndarray) -> float:
    """Flicker of the error, not of the motion: sqrt(mean_{t,i} |d_{t-1,i} - 2 d_{t,i} + d_{t+1,i}|^2), d = E - T;
    millimetres per frame squared.

    Args:
        estimates, truths: (T, V, 3) consecutive frames, metres.

    Returns:
        NaN with fewer than three frames.
    """
    if len(estimates) < 3:
        return float("nan")
    second = np.diff(np.asarray(estimates, np.float64) - np.asarray(truths, np.float64), 2, axis=0)
    return float(MM * np.sqrt((second**2).sum(axis=2).mean()))


def own_flicker_mm(estimates: np.ndarray) -> float:
    """:func:`flicker_mm` of the estimate itself, for recordings without truth: sqrt(mean_{t,i} |second difference of E|^2);
    millimetres per frame squared.

    It includes the motion, so that it only compares methods on the same frames. A frozen mesh has a flicker of 0.

    Args:
        estimates: (T, V, 3) consecutive frames, metres.

    Returns:
        NaN with fewer than three frames.
    """
    return flicker_mm(estimates, np.zeros((1, 1, 3)))


def acceleration_variance_mm2(estimates: np.ndarray) -> float:
    """The flicker that the paper describes, "acceleration variance relative to a smoothed trajectory", with a formula of ours:
    mean_i sum_xyz var_t(a_i(t)), a the second difference of E - S and S the estimate smoothed in time with :data:`SMOOTHING`;
    millimetres squared per frame to the fourth power.

    It uses no truth, so that a mesh that never moves has the best value, 0. :func:`flicker_mm` does not have this weakness.

    Args:
        estimates: (T, V, 3) consecutive frames, metres. The first and the last two have no smoothed place.

    Returns:
        NaN with fewer than eight frames, which give two accelerations.
    """
    if len(estimates) < len(SMOOTHING) + 3:
        return float("nan")
    estimates, reach = np.asarray(estimates, np.float64), len(SMOOTHING) // 2
    last = len(estimates) - len(SMOOTHING) + 1
    smooth = sum(weight * estimates[k : k + last] for k, weight in enumerate(SMOOTHING))
    acceleration = np.diff(estimates[reach:-reach] - smooth, 2, axis=0)
    return float(MM**2 * acceleration.var(axis=0).sum(axis=1).mean())


def frames_until_within(error: np.ndarray, reference: np.ndarray, factor: float, hold: int = 3) -> int | None:
    """Frames until an error is within ``factor`` times a reference, and stays there for ``hold`` frames.

    Args:
        error: (n,) per frame, from the first frame after a disturbance or a start on.
        reference: (n,) of the reference run, in the same frames.
        factor: error_k <= factor * reference_k.
        hold: consecutive frames; fewer suffice at the end of the run.

    Returns:
        1 if it holds from the first frame on; None if it never does.
    """
    within = np.asarray(error) <= factor * np.asarray(reference)
    for first in range(len(within)):
        if within[first : first + hold].all():
            return first + 1
    return None
