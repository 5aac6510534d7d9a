"""Sidedness: whether a cloud without a sensor origin shows one side of the garment, and which.

Along the direction that it was seen from a cloud of one side has one layer, and a garment from all sides has two. A sheet has one
itself and is not judged. From above wide skirts and capes have one too: these are judged along level directions alone. The test
needs no track, so that it holds before a search and after a wrong fit. Of the two ends of that direction the sensor is where the
cloud bulges. An error of 20 degrees costs no accuracy: only what faces the sensor has to be told from what does not.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from ddakf.config import PlaneAssociation, Sidedness
from ddakf.kernels import sidedness as kernels
from ddakf.kernels.preprocess import bounds, crop
from ddakf.kernels.visibility import perpendicular_axes
from ddakf.stages.grid import spread_rows
from ddakf.types import FrameInput, Model, Problem, Setup, Sides, Track, View

BESIDE = 0.5  # least cosine between the best direction and others that are as good
STEEP = 0.5  # cosine to the vertical, below which a direction is level
FLAT = 0.9  # length of the mean normal, above which a sheet is flat; level directions see its edge


def estimate_origin(setup: Setup, last: Track, frame: FrameInput) -> tuple[FrameInput, View]:
    """The frame with the origin that its cloud was seen from, where it has none and shows one side; and what is known of that.

    Args:
        setup: constants of the tracker.
        last: after the last frame.
        frame: checked.
    """
    config, view = setup.config.sidedness, last.view
    if frame.sensor_origin is not None:
        return frame, View()
    if view.wait > 0:
        view = view._replace(wait=view.wait - 1)
    elif not setup.reference.sides.sheet:
        points = _near(frame.points, last, config)
        if len(points) >= config.least_points:
            up = setup.config.start.to_y_up[1] if setup.reference.sides.level else None
            view = look(points, setup.model.area, view, config, up)
    oriented = config.estimate and isinstance(setup.config.associate, PlaneAssociation)
    if view.one_sided and oriented and len(frame.points):
        origin = frame.points.mean(axis=0, dtype=np.float64) + config.distance * np.array(view.side)
        frame = frame._replace(sensor_origin=origin)
    return frame, view


def look(points: np.ndarray, area: float, view: View, config: Sidedness, up: np.ndarray | None = None) -> View:
    """The view after a look at (N, 3) points of a garment.

    Args:
        points: near the garment, metres.
        area: of the garment, m^2.
        view: before.
        config: of the look.
        up: (3,) unit vector, where level directions alone are judged.
    """
    (cloud, cell), axes = thinned(points, area, config), all_axes(config.directions)
    if up is not None:
        axes = axes[_level(axes, up)]
    share = hidden_shares(cloud, cell, axes, config)
    old = config.memory if view.looked else 0.0
    hidden = old * view.hidden_share + (1.0 - old) * float(share.min())
    if hidden >= (config.all_sides if view.one_sided else config.one_sided):
        return View(True, hidden, wait=config.interval - 1)
    axes = _middle(axes, share, np.array(view.side), config)
    side = old * np.array(view.side) + (1.0 - old) * axes[2]
    side /= np.linalg.norm(side)
    bulge = old * view.bulge + (1.0 - old) * kernels.bulge(cloud, axes, cell) / cell
    if bulge < 0.0:
        side, bulge = -side, -bulge
    return View(True, hidden, tuple(side.tolist()), bulge, config.interval - 1)


def sides(garment: Model, config: Sidedness, up: np.ndarray) -> Sides:
    """Sides of a garment whose upward unit vector is (3,) ``up``.

    A sheet has one layer along a level direction, or is flat. A garment that has one along a steep direction alone is judged
    along level ones.
    """
    vertices, corners, axes = garment.mesh.vertices, garment.mesh.vertices[garment.faces], all_axes(config.directions)
    points = np.concatenate([vertices, corners.mean(axis=1)]).astype(np.float32)
    share = hidden_shares(*thinned(points, garment.area, config), axes, config)
    if (every := float(share.min())) >= config.one_sided:
        return Sides(every)
    level = float(share[_level(axes, up)].min(initial=1.0))
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = np.linalg.norm(normal.sum(axis=0)) > FLAT * np.linalg.norm(normal, axis=1).sum()
    return Sides(level, True, bool(flat) or level < config.one_sided)


def hidden_from(origin: np.ndarray, problem: Problem) -> float:
    """Share of a frame's points near the garment that lie behind others, seen from (3,) ``origin``, metres; 0 of a few points."""
    points, config = np.ascontiguousarray(problem.cloud.points.T), problem.config.sidedness
    if len(points) < config.least_points:
        return 0.0
    axes, toward = np.empty((1, 3, 3)), origin - problem.cloud.origin - points.mean(axis=0)
    axes[0, 2] = toward / max(float(np.linalg.norm(toward)), 1e-9)
    perpendicular_axes(axes[0, 2], axes[0])
    return float(hidden_shares(*thinned(points, problem.model.area, config), axes, config)[0])


def _level(axes: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(D,) bool: directions that are level."""
    return np.abs(axes[:, 2] @ up) < STEEP


def thinned(points: np.ndarray, area: float, config: Sidedness) -> tuple[np.ndarray, float]:
    """At most so many of (N, 3) points as configured, relative to their middle, and the width of a cell; metres."""
    chosen = points[spread_rows(len(points), config.points)]
    return chosen - chosen.mean(axis=0), float(np.sqrt(config.points_per_cell * area / len(chosen)))


def hidden_shares(cloud: np.ndarray, cell: float, axes: np.ndarray, config: Sidedness) -> np.ndarray:
    """(D,) share of the points that are hidden along the direction of each of (D, 3, 3) axes, of what :func:`thinned` returns."""
    share = np.empty(len(axes))
    kernels.hidden_shares(cloud, axes, cell, config.gap * cell, share)
    return share


def _middle(axes: np.ndarray, share: np.ndarray, last: np.ndarray, config: Sidedness) -> np.ndarray:
    """(3, 3) axes of the middle of the directions with one layer, at the end nearer to the ``last`` (3,) side."""
    toward = axes[:, 2]
    best = toward[share.argmin()] * (-1.0 if toward[share.argmin()] @ last < 0.0 else 1.0)
    cosine = toward @ best
    alike = (share <= share.min() + config.plateau) & (np.abs(cosine) > BESIDE)
    axes = np.empty((3, 3))
    axes[2] = np.sign(cosine[alike]) @ toward[alike]
    axes[2] /= np.linalg.norm(axes[2])
    perpendicular_axes(axes[2], axes)
    return axes


@lru_cache(maxsize=8)
def all_axes(count: int) -> np.ndarray:
    """(count, 3, 3) axes of as many directions, evenly spread over the half-sphere about y: a Fibonacci lattice."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - k / count, np.pi * (1.0 + np.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - height**2)
    axes = np.empty((count, 3, 3))
    axes[:, 2] = np.column_stack([radius * np.cos(turn), height, radius * np.sin(turn)])
    for one in axes:
        perpendicular_axes(one[2], one)
    return axes


def _near(points: np.ndarray, last: Track, config: Sidedness) -> np.ndarray:
    """The points near the garment; all of them while its place is not known."""
    if last.health.unplaced:
        return points
    lower, upper, chosen = np.empty(3), np.empty(3), np.empty(len(points), np.int32)
    bounds(last.state.position, config.margin, lower, upper)
    return points[chosen[: crop(points, lower, upper, chosen)]]
