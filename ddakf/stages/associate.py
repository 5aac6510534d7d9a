"""Stage B, association (paper, section 2.3): one measurement of the cloud per vertex, and heights of points above faces."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from ddakf.config import NearestPoint, PlaneAssociation
from ddakf.kernels import associate as kernels
from ddakf.kernels import hem as hem_kernels
from ddakf.kernels import surface_points as point_kernels
from ddakf.kernels.associate import FAR_AWAY, NO_SURFEL, FoundPlanes, PlaneSearch
from ddakf.kernels.hem import CloudEnds, Tube
from ddakf.kernels.normals import vertex_normals
from ddakf.kernels.surface_points import NO_FACE, Agreement, FoundFaces
from ddakf.kernels.visibility import VisibilityLimits, mark_visible
from ddakf.stages.grid import nearest_vertices
from ddakf.types import Estimate, Hem, Measurement, Problem, Surfels

FACE_REACH = 1.25  # edges: distance within which a point has a vertex of the face beneath it
RIM_COSINE = 0.5  # cosine between normal and direction to the camera: seen vertices with a smaller one are the rim
RIM_REACH = 0.04  # m across the view, within which the nearest point of a seen vertex is sought
RIM_FLOOR = 0.003  # m, least gap of the other seen vertices that the gap of the rim is compared with
RIM_WHOLE, RIM_NONE = 1.9, 2.5  # ratio of the two gaps: hems count fully below the first, not at all above the second
RIM_MOST = 1.5  # vertices of the rim over the others, above which the ratio counts less: the garment is seen along itself
RIM_MEMORY = 0.3  # s, time constant of the ratio's running mean
NEAR_CELLS = 3.99  # longest search radius in the small cells of a dense cloud, in cells: four rings


def gates(problem: Problem) -> Iterator[float]:
    """Search radius of each pass that the budget allows, one at least, metres: wide, then narrowing. The paper makes one."""
    match problem.config.associate:
        case PlaneAssociation() as config:
            passes = 1 if problem.cloud.empty else config.most_passes(problem.dt)
            for k in range(int(min(passes, max(problem.effort.passes, 1)))):
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
        only: (V,) bool, vertices that are measured; None: all. Hems and points on faces are left out where it is given.
    """
    position, cloud, model = estimate.position, problem.cloud, problem.model
    match problem.config.associate:
        case PlaneAssociation():
            normal = np.empty_like(position)
            target, plane, distance, searched_at = (a.copy() for a in estimate.terms.measurement[:4])
            vertex_normals(position, model.faces, normal)
            seen, judged_at = _known(problem, estimate) or (_visible(problem, position, normal), position)
            eligible = seen if only is None else seen & only
            if not cloud.empty:
                _find_planes(problem, gate, (position, normal, eligible), FoundPlanes(target, plane, distance, searched_at))
            if only is not None:
                return Measurement(target, plane, distance, searched_at, seen, None, judged_at)
            hem = _hem(problem, (position, normal, seen), estimate.terms.measurement.hem)
            points = _surface_points(problem, estimate)
            return Measurement(target, plane, distance, searched_at, seen, hem, judged_at, points=points)
        case NearestPoint():
            n = len(position)
            target, distance = np.zeros((n, 3)), np.full(n, -1.0)
            if not cloud.empty:
                kernels.nearest_points(position, cloud.points, cloud.grid, gate, target, distance)
            return Measurement(target, None, distance, position, np.ones(n, bool))


def _find_planes(problem: Problem, gate: float, where: tuple[np.ndarray, np.ndarray, np.ndarray], found: FoundPlanes) -> None:
    """Updates the planes of the eligible vertices: of the nearest surfels, or of sparser ones for a vertex far from all of them.

    The cells of a dense cloud are small, and within a wide gate there are thousands.

    Args:
        problem: the frame.
        gate: search radius, metres.
        where: (V, 3) positions, (V, 3) unit normals, (V,) eligible.
        found: in and out.
    """
    cloud, config, (position, normal, eligible) = problem.cloud, problem.config.associate, where

    def search(surfels: Surfels, radius: float, vertices: tuple, planes: FoundPlanes) -> None:
        lateral_gate = config.lateral_gate * float(np.sqrt(problem.model.area / surfels.planes.shape[1]))
        least_motion = config.reassociation_motion * surfels.grid.cell
        limits = PlaneSearch(radius, config.normal_cosine, config.normal_distance, cloud.oriented, least_motion, lateral_gate)
        kernels.nearest_planes(*vertices, *surfels, limits, planes)

    near = gate if cloud.sparse is None else min(gate, NEAR_CELLS * cloud.surfel_grid.cell)
    search(Surfels(cloud.surfels, cloud.surfel_grid), near, where, found)
    if near < gate:
        far = np.flatnonzero(eligible & (found.distance == NO_SURFEL))
        beyond = FoundPlanes(*(array[far] for array in found))
        beyond.searched_at[:] = FAR_AWAY
        search(cloud.sparse, gate, (position[far], normal[far], np.ones(len(far), bool)), beyond)
        for array, new in zip(found, beyond, strict=True):
            array[far] = new


def _known(problem: Problem, estimate: Estimate) -> tuple[np.ndarray, np.ndarray] | None:
    """The visible vertices (V,) as they were judged, and the positions (V, 3) at which they were.

    None before, and once the garment has moved by ``visibility_motion`` metres (RMS) since.
    """
    last = estimate.terms.measurement
    if last.visible is None:
        return None
    step = estimate.position - last.judged_at
    still = np.einsum("va,va->", step, step) < problem.config.associate.visibility_motion**2 * len(step)
    return (last.visible, last.judged_at) if still else None


def _visible(problem: Problem, position: np.ndarray, normal: np.ndarray) -> np.ndarray:
    """(V,) bool, of vertices with these unit normals (V, 3)."""
    found, cloud, config = np.ones(len(position), bool), problem.cloud, problem.config.associate
    if cloud.oriented:
        body = np.empty((0, 3)) if problem.body is None else problem.body.vertices
        cell = config.occluder_cell * problem.model.edge_length
        limits = VisibilityLimits(cell, config.hidden_depth, config.facing_cosine)
        mark_visible(position, normal, body, cloud.surfels, cloud.origin, cloud.sensor, limits, found)
    return found


def _hem(problem: Problem, vertices: tuple[np.ndarray, np.ndarray, np.ndarray], last: Hem | None) -> Hem | None:
    """The end of the cloud beside each vertex of a boundary.

    Where a camera's mask is too narrow the cloud ends before the cloth does, at hems as at the rim. The wider the gap beside the
    rim, the less the ends count. Without a body, which holds the garment too, they count all the same.

    Args:
        problem: the frame.
        vertices: (V, 3) positions and (V, 3) unit normals, (V,) seen.
        last: of the pass before.
    """
    position, normal, seen = vertices
    model, cloud, config = problem.model, problem.cloud, problem.config.associate
    n = len(model.boundary)
    if cloud.empty or n == 0 or config.hem_reach == 0:
        return None
    direction, offset, found = ends = CloudEnds(np.zeros((n, 3)), np.zeros(n), np.zeros(n, bool))
    spacing = math.sqrt(model.area / cloud.points.shape[1])
    width = min(max(config.hem_width, config.hem_spacings * spacing), config.hem_reach)
    tube = Tube(config.hem_reach, width, config.hem_depth)
    hem_kernels.ends_of_cloud(position, normal, seen, model.boundary, cloud.points, cloud.grid, tube, ends)
    weight = found * np.square(np.maximum(1.0 - np.square(offset / config.hem_reach), 0.0))
    if problem.body is None or not cloud.oriented or len(cloud.sensor) > 1:
        return Hem(direction, offset, weight)
    gap = _rim_gap(problem, vertices) if last is None else last.rim_gap
    belief = min(max((RIM_NONE - gap) / (RIM_NONE - RIM_WHOLE), 0.0), 1.0)
    return Hem(direction, offset, belief * weight, belief, gap)


def _rim_gap(problem: Problem, vertices: tuple[np.ndarray, np.ndarray, np.ndarray]) -> float:
    """Running mean of the gap between rim and cloud over that of the other seen vertices, across the view; as :func:`_hem`."""
    cloud, before, gaps, (position, normal, seen) = problem.cloud, problem.health.rim_gap, np.empty(2), vertices
    eye = cloud.sensor[0] - cloud.origin
    rim, others = hem_kernels.gaps_across_view(
        position - cloud.origin, normal, seen, cloud.points, eye, RIM_COSINE, RIM_REACH, gaps
    )
    now = float(gaps[0]) / max(float(gaps[1]), RIM_FLOOR) * min(RIM_MOST * others / max(rim, 1), 1.0)
    gain = 1.0 if problem.health.state == "initializing" else -math.expm1(-problem.dt / RIM_MEMORY)
    return before + gain * (now - before)


def _surface_points(problem: Problem, estimate: Estimate) -> FoundFaces | None:
    """Points of the cloud on the faces beneath them: around the nearest vertex in the first pass, then around the last face."""
    cloud, config, model, position = problem.cloud, problem.config.associate, problem.model, estimate.position
    if cloud.sample is None:
        return None
    n, last = len(cloud.sample.point), estimate.terms.measurement.points
    if last is None:
        reach = FACE_REACH * model.edge_length
        vertex, _ = nearest_vertices(cloud.sample.point, position, reach)
        face = np.full(n, NO_FACE)
    else:
        vertex, face = np.full(n, -1, np.int32), last.face.copy()
    found = FoundFaces(face, np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, bool))
    agreement = Agreement(config.normal_cosine, config.points_beside)
    point_kernels.faces_beneath(position, model.rings, vertex, cloud.sample, agreement, found)
    return found
