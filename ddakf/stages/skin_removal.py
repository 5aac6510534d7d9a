"""Preprocessing, skin removal: points of a whole person that lie on the body and not on the garment."""

from __future__ import annotations

import numpy as np

from ddakf.body import contact
from ddakf.kernels import skin_removal as kernels
from ddakf.stages.grid import vertex_grid
from ddakf.types import FrameInput, Problem

CELLS = 32  # at most along each axis of the grid of vertices: coarser cells change the time of a search, not its result


def remove_skin(frame: FrameInput, problem: Problem, position: np.ndarray, margin: float) -> FrameInput:
    """The frame without the points of :func:`skin`; arguments as there."""
    removed = skin(frame.points, problem, position, margin)
    return frame.only(~removed) if removed.any() else frame


def skin(points: np.ndarray, problem: Problem, position: np.ndarray, margin: float) -> np.ndarray:
    """(N,) bool: points that lie on the body and not on the garment.

    A garment lies on the body as well, so that a point is skin only where the garment is not expected. Where the body's pose is
    not known no point is skin.

    Args:
        points: (N, 3) metres.
        problem: the body in its pose of this frame, and the garment.
        position: (V, 3) predicted vertices, metres.
        margin: metres from the garment that a point must be to be skin, ``cloth_distance`` or ``hem_distance``.
    """
    if problem.body is None or len(points) == 0:
        return np.zeros(len(points), bool)
    config = problem.config.skin_removal
    removed = apart(points, position, margin + config.edge_share * problem.model.edge_length)
    removed[removed] = contact.within(problem.body, points[removed].astype(np.float64), config.skin_distance)
    return removed


def apart(points: np.ndarray, position: np.ndarray, radius: float) -> np.ndarray:
    """(N,) bool: (N, 3) points farther than ``radius`` from all (V, 3) vertices, metres."""
    vertices, _, grid = vertex_grid(position, radius, CELLS)
    far = np.empty(len(points), bool)
    kernels.far_from_vertices(points, vertices, grid, radius, far)
    return far
