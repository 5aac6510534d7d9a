"""Over time: restlessness, and how long a disturbance lasts."""

from __future__ import annotations

import numpy as np

from ddakf.evaluation.metrics.error import MM


def flicker_mm(estimates: np.ndarray, truths: np.ndarray) -> float:
    """Restlessness of the error, not of the motion: sqrt(mean_{t,i} |d_{t-1,i} - 2 d_{t,i} + d_{t+1,i}|^2), d = E - T;
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


def frames_until_within(error: np.ndarray, reference: np.ndarray, factor: float, hold: int = 3) -> int | None:
    """How many frames pass until an error is within ``factor`` of a reference, and stays there for ``hold`` frames.

    Args:
        error: (n,) per frame, the first one that of the first frame after a disturbance, or of a start.
        reference: (n,) of the run that it is compared with, in the same frames.
        factor: error_k <= factor * reference_k.
        hold: frames in a row; fewer at the end of the run will do.

    Returns:
        1 when it holds from the first frame on; None when it never does.
    """
    within = np.asarray(error) <= factor * np.asarray(reference)
    for first in range(len(within)):
        if within[first : first + hold].all():
            return first + 1
    return None
