"""Floor under the body (stage E, not in the paper): cloth does not hang lower than the wearer's lowest point.

No sensor shows the floor under a person who lies down, and the hidden side would hang through it. A body with feet shows it: they
stand on it, or the back lies on it. Cloth that is seen lower, such as a train, shows that the floor there is lower.
"""

from __future__ import annotations

import numpy as np

from ddakf.physics import Linearization
from ddakf.types import Bound, Problem

UPRIGHT = 0.8  # of its other extents, the height of a body that stands along the axis taken for upward, at least


def linearize(problem: Problem, position: np.ndarray) -> Linearization | None:
    """One constraint for each vertex under the floor, r = height above it in metres, below 0; None where there is none.

    Args:
        problem: the frame, with the body's pose.
        position: (V, 3) metres.
    """
    anchor, up = problem.last.anchor, problem.config.start.to_y_up[1]
    height, floor = position @ up, float((problem.body.vertices @ up).min())
    if anchor is None or height.min() >= floor or not _reaches_floor(anchor.bound, problem):
        return None
    floor = min(floor, float(height[anchor.measured].min(initial=np.inf)))
    under = np.flatnonzero(height < floor).astype(np.int32)
    jacobian = np.broadcast_to(up, (len(under), 1, 3)).copy()
    area, config = problem.model.collision.weight[under], problem.config.physics
    weight = area / (1.0 + config.collision * config.floor_sd**2 * area)  # in series with a spring, as contact that yields
    return Linearization(under[:, None], height[under] - floor, jacobian, weight)


def _reaches_floor(start: Bound, problem: Problem) -> bool:
    """The body stood at the start and reached lower than the garment: a torso alone tells nothing of the floor."""
    axes, config = problem.config.start.to_y_up, problem.config.physics
    body = start.pose @ axes.T
    extent, below = np.ptp(body, axis=0), float((start.position @ axes[1]).min() - body[:, 1].min())
    return bool(below > config.floor_below and extent[1] > UPRIGHT * max(extent[0], extent[2]))
