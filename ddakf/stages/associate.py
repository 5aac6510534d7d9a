"""Stage B, association (paper, section 2.3): one measurement of the cloud per vertex."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ddakf.config import NearestPoint, PlaneAssociation
from ddakf.kernels import associate as kernels
from ddakf.kernels import hem as hem_kernels
from ddakf.kernels.associate import FoundPlanes, PlaneSearch, VisibilityLimits
from ddakf.kernels.hem import CloudEnds, Tube
from ddakf.types import Estimate, Hem, Measurement, Problem


def gates(problem: Problem, done: int = 0) -> Iterator[float]:
    """Search radius of each pass inside the frame, metres: wide first, then narrowing. The paper makes one pass.

    Of ``done`` passes that were made already, the rest, and at least one.
    """
    match problem.config.associate:
        case PlaneAssociation() as config:
            passes = 1 if problem.cloud.empty else config.iterations
            for k in range(min(done, passes - 1), passes):
                yield max(config.narrow_gate, config.wide_gate * config.narrowing**k)
        case NearestPoint(gate=gate):
            yield gate


def associate(problem: Problem, estimate: Estimate, gate: float, only: np.ndarray | None = None) -> Measurement:
    """Measurements for the vertices at the estimate.

    Vertices that hardly moved since the pass before keep their plane.

    Args:
        problem: the frame, with its cloud.
        estimate: where the vertices are, and their last measurement.
        gate: search radius, metres.
        only: (V,) bool, vertices that are measured; None: all. Hems are left out where it is given.
    """
    position, cloud, model = estimate.position, problem.cloud, problem.model
    match problem.config.associate:
        case PlaneAssociation() as config:
            normal = np.empty_like(position)
            target, plane, distance, searched_at = (a.copy() for a in estimate.evidence.measurement[:4])
            kernels.vertex_normals(position, model.faces, normal)
            seen = _visible(problem, position, normal) if problem.visible is None else problem.visible
            eligible = seen if only is None else seen & only
            if not cloud.empty:
                beside = config.beside * float(np.sqrt(model.area / cloud.surfels.shape[1]))
                still = config.still * cloud.cell
                search = PlaneSearch(gate, config.normal_cosine, config.turned, cloud.oriented, still, beside)
                planes = FoundPlanes(target, plane, distance, searched_at)
                kernels.nearest_planes(position, normal, eligible, cloud.surfels, cloud.surfel_grid, search, planes)
            hem = None if only is not None else _hem(problem, position, normal, seen)
            return Measurement(target, plane, distance, searched_at, seen, hem)
        case NearestPoint():
            n = len(position)
            target, distance = np.zeros((n, 3)), np.full(n, -1.0)
            if not cloud.empty:
                kernels.nearest_points(position, cloud.points, cloud.grid, gate, target, distance)
            return Measurement(target, None, distance, position, np.ones(n, bool))


def visible(problem: Problem, position: np.ndarray) -> np.ndarray:
    """(V,) bool: vertices at ``position`` (V, 3) that a sensor may see, by plane association."""
    normal = np.empty_like(position)
    kernels.vertex_normals(position, problem.model.faces, normal)
    return _visible(problem, position, normal)


def _visible(problem: Problem, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(V,) bool, of vertices with these unit normals (V, 3)."""
    found, cloud, config = np.ones(len(position), bool), problem.cloud, problem.config.associate
    if cloud.oriented:
        vertices = problem.frame.body_vertices
        body = np.empty((0, 3)) if vertices is None else vertices
        cell = config.occluder_cell * problem.model.edge_length
        limits = VisibilityLimits(cell, config.hidden_depth, config.facing_cosine)
        kernels.mark_visible(position, normal, body, cloud.surfels, cloud.origin, cloud.sensor, limits, found)
    return found


def _hem(problem: Problem, position: np.ndarray, normal: np.ndarray, seen: np.ndarray) -> Hem | None:
    """The end of the cloud beside each vertex of a boundary at ``position`` (V, 3), its unit ``normal`` (V, 3)."""
    model, cloud, config = problem.model, problem.cloud, problem.config.associate
    n = len(model.boundary)
    if cloud.empty or n == 0 or config.hem_reach == 0:
        return None
    direction, offset, found = ends = CloudEnds(np.zeros((n, 3)), np.zeros(n), np.zeros(n, bool))
    tube = Tube(config.hem_reach, config.hem_width, config.hem_depth)
    hem_kernels.ends_of_cloud(position, normal, seen, model.boundary, cloud.points, cloud.grid, tube, ends)
    return Hem(direction, offset, found * np.square(np.maximum(1.0 - np.square(offset / config.hem_reach), 0.0)))
