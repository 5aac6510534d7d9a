"""Segmentation by the body: which points of a whole person are the garment's."""

from __future__ import annotations

import numpy as np

from ddakf.body.contact import BodyContact
from ddakf.garment.model import Model
from ddakf.kernels import skin_removal as kernels
from ddakf.stages.frame_input import Frame
from ddakf.stages.preprocess import vertex_grid

SKIN = 0.010  # m: a point so near to the body may be its skin, about three standard deviations of a sensor's noise
ON_CLOTH = 0.008  # m, and EDGES: a point farther from every vertex does not lie on the garment
BESIDE = 0.10  # m, and EDGES: skin within it stays in the cloud, which shows that a hem does not end there
EDGES = 0.75
PERSON = 0.15  # share of skin, above which a cloud is of a whole person
CELLS = 32  # at most along each axis of the grid of vertices


def cloth(now: Frame, position: np.ndarray, contact: BodyContact | None, model: Model, off: float) -> Frame:
    """The frame without the points of :func:`skin`; arguments as there."""
    bare = skin(now.points, position, contact, model, off)
    return now.only(~bare) if bare.any() else now


def of_person(now: Frame, mine: Frame) -> bool:
    """Whether more than :data:`PERSON` of a frame's points were skin: ``mine`` is what :func:`cloth` left of ``now``."""
    return len(now.points) - len(mine.points) > PERSON * len(now.points)


def skin(points: np.ndarray, position: np.ndarray, contact: BodyContact | None, model: Model, off: float) -> np.ndarray:
    """(N,) bool: points that lie on the body and not on the garment.

    A garment lies on the body as well, so that a point is skin only where the garment is not expected.

    Args:
        points: (N, 3) metres.
        position: (V, 3) predicted vertices, metres.
        contact: the body in its pose of this frame; without one no point is skin.
        model: the garment.
        off: metres from the garment that a point must be to be skin, :data:`ON_CLOTH` or :data:`BESIDE`.
    """
    if contact is None or not contact.present or len(points) == 0:
        return np.zeros(len(points), bool)
    bare = apart(points, position, off + EDGES * model.edge_length)
    bare[bare] = contact.within(points[bare].astype(np.float64), SKIN)
    return bare


def apart(points: np.ndarray, position: np.ndarray, radius: float) -> np.ndarray:
    """(N,) bool: (N, 3) points farther than ``radius`` from all (V, 3) vertices, metres."""
    grid = vertex_grid(position, radius, CELLS)
    out = np.empty(len(points), bool)
    kernels.apart(points, grid.vertices, grid.start, grid.origin, grid.cell, grid.dims, radius, out)
    return out
