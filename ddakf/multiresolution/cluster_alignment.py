"""Cluster alignment, stages B to F on clusters of the garment that move rigidly, before the vertices do one by one.

Passes over all vertices converge slowly where large parts turn or travel: rotations are fitted and held, and conjugate gradients
carry a correction a few edges far. The same problem, restricted to rigid motions of a few dozen clusters, has a few hundred
unknowns and is solved exactly. It only gives the first estimate of the passes that follow; the prior stays the prediction.
"""

from __future__ import annotations

from itertools import islice
from typing import NamedTuple

import numpy as np

from ddakf.body import contact
from ddakf.config import PlaneAssociation
from ddakf.config.stages import USUAL_RATE
from ddakf.kernels import cluster_alignment as kernels
from ddakf.kernels.cluster_alignment import ClusterFrames, SampleNoise, SamplePlanes, SeamStiffness
from ddakf.kernels.normals import vertex_normals
from ddakf.physics import rigidity
from ddakf.planning.work import Work
from ddakf.stages import associate, fuse, robust
from ddakf.stages.grid import nearest_vertices
from ddakf.types import Estimate, Problem, variances

EDGE_STRETCH = 0.577  # 4 A / (3 l^2) of an equilateral triangle: stretch of an edge in units of the stretch of its faces
MOST = 0.7  # of the vertices; one camera sees half of a garment
RIDGE = 1e-6  # of the mean diagonal: a cluster that nothing holds


class Pulling(NamedTuple):
    """P points of the cloud, each with the vertex nearest to it."""

    vertex: np.ndarray  # (P,) int32
    planes: SamplePlanes  # the points with their normals


def align(problem: Problem) -> Estimate:
    """The estimate before the first pass over all vertices: the prediction, or where the clusters went from there.

    Nothing is done while the prediction is good, see :func:`_needed`; and by the paper's association, which has no normals. A
    budget may leave passes out.
    """
    begun, config, clusters = fuse.begin(problem), problem.config, problem.model.clusters
    coarse, floor = config.coarse, None
    if problem.cloud.empty or coarse.iterations == 0 or not isinstance(config.associate, PlaneAssociation):
        return begun
    gates = list(islice(associate.gates(problem), coarse.iterations))
    estimate = _measured(problem, begun, clusters.probe, gates[0])
    if not _needed(problem, estimate):
        return estimate  # its planes need not be sought again
    if problem.effort.passes < 1:
        return estimate._replace(work=Work(unaligned=True))
    if problem.body is not None and config.physics.collision > 0:
        begun = begun._replace(contacts=contact.nearest_from_last(problem, begun.position))
        floor = contact.planes(problem.body, begun.contacts, config.physics)
    work, variance = Work(), max(float(np.median(variances(problem.prior.R))), config.adapt.lowest_sd**2)
    for gate in gates:
        estimate = _measured(problem, estimate, clusters.sample, gate)
        motion, center = _solve(problem, estimate, floor, gate, variance)
        if not np.isfinite(motion).all():
            return begun
        moved = np.empty_like(estimate.position)
        step = kernels.move(estimate.position, clusters.nearest, clusters.share, center, motion, gate, moved)
        for term in (estimate.rest, estimate.motion):
            rigidity.turn(term, moved, problem.model, config.physics.rotation_steps)
        estimate = estimate._replace(position=moved)
        converged = step < coarse.tolerance
        work = Work(clusters=work.clusters + 1, unaligned=not converged and problem.effort.passes < coarse.iterations)
        if converged:
            break
    return begun._replace(position=estimate.position, work=work)


def _measured(problem: Problem, estimate: Estimate, vertex: np.ndarray, gate: float) -> Estimate:
    """The estimate with the measurements of some vertices."""
    only = np.zeros(len(estimate.position), bool)
    only[vertex] = True
    measurement = associate.associate(problem, estimate, gate, only=only)
    return estimate._replace(terms=estimate.terms._replace(measurement=measurement))


def _needed(problem: Problem, estimate: Estimate) -> bool:
    """Whether passes are: innovations along the normals are large, of the whole garment or of a cluster, such as a raised arm.

    A cluster that moves drags hidden ones along, so that it decides only where most of the garment is seen.
    """
    coarse, measurement, vertex = problem.config.coarse, estimate.terms.measurement, problem.model.clusters.probe
    found = vertex[measurement.found[vertex]]
    if len(found) == 0:
        return False
    y = np.einsum("va,va->v", measurement.normal[found], measurement.target[found] - estimate.position[found])
    if float(y @ y) > coarse.least_innovation**2 * len(y):
        return True
    cluster = problem.model.cluster[found]
    squares, count = np.bincount(cluster, y * y), np.bincount(cluster)
    large = squares > coarse.least_cluster_innovation**2 * (count + 1)  # one vertex alone tells little
    return len(found) > MOST * len(vertex) and bool(large.any())


def _prior_sd(problem: Problem) -> float:
    """Standard deviation of the prediction of a vertex, metres: it misses more, the longer ago the last frame was."""
    coarse = problem.config.coarse
    later = coarse.prior_sd * USUAL_RATE * problem.dt
    return max(coarse.prior_sd, min(later, coarse.longest_prior_sd))


def _solve(
    problem: Problem, estimate: Estimate, floor: tuple[np.ndarray, np.ndarray] | None, gate: float, variance: float
) -> tuple[np.ndarray, np.ndarray]:
    """(K, 6) rotation vector and translation of each cluster about its centre (K, 3): Gauss-Newton of the MAP problem.

    ``floor`` is the point and the normal, (V, 3) each, of the body's plane beside each vertex; None without a body. ``gate`` is
    the reach of points, metres, ``variance`` that of a measurement, m^2.
    """
    model, config, position, measurement = problem.model, problem.config, estimate.position, estimate.terms.measurement
    clusters, physics, k = model.clusters, config.physics, model.n_clusters
    weight = robust.weigh(problem, estimate, measurement)
    A, b, center = np.zeros((6 * k, 6 * k)), np.zeros(6 * k), np.empty((k, 3))
    kernels.centers(position, model.cluster, center)
    stands_for = len(position) / len(clusters.sample)
    frames, planes = ClusterFrames(model.cluster, center), SamplePlanes(measurement.target, measurement.normal, weight)
    noise = SampleNoise(variance, config.associate.tangential_sd**2, 1.0 / _prior_sd(problem) ** 2, stands_for)
    kernels.add_planes(position, problem.prior.position, clusters.sample, frames, planes, noise, A, b)
    vertex, planes = _pulling(problem, position, gate)
    pulled, frames_there = position[vertex], frames._replace(cluster=model.cluster[vertex])
    far = np.square(planes.target - pulled).sum(axis=1) > config.coarse.points_far**2
    for chosen, tangential in ((far, config.coarse.points_tangential_sd**2), (~far, np.inf)):
        noise = SampleNoise(variance, tangential, 0.0, config.coarse.points_weight * len(position) / max(len(vertex), 1))
        kernels.add_planes(pulled, pulled, np.flatnonzero(chosen), frames_there, planes, noise, A, b)
    if floor is not None:
        point, normal = floor
        inside = np.einsum("va,va->v", normal, point - position) > 0
        planes = SamplePlanes(point, normal, inside.astype(float))
        noise = SampleNoise(config.coarse.contact_sd**2 + contact.error2(problem.body, physics.body_sd), np.inf, 0.0, stands_for)
        kernels.add_planes(position, position, clusters.sample, frames, planes, noise, A, b)
    stretch = clusters.weakening * EDGE_STRETCH * problem.health.physics_lambda * physics.in_plane
    stiffness = SeamStiffness(clusters.weakening, stretch, physics.strain_scale)
    kernels.add_seams(position, frames, clusters.seam, estimate.rest, estimate.motion, stiffness, A, b)
    moves, factor = np.full(6 * k, np.nan), np.empty((6 * k, clusters.elimination.width), np.float32)
    if kernels.factorise(A, clusters.elimination, RIDGE * np.trace(A) / (6 * k), factor):
        kernels.substitute(factor, clusters.elimination, b, moves)
    return moves.reshape(k, 6), center


def _pulling(problem: Problem, position: np.ndarray, gate: float) -> Pulling:
    """Points that pull the vertices (V, 3) nearest to them within the gate, metres, where the normals agree.

    Vertices look for the cloud. A part of it that lies beyond them all, such as a limb that moved fast, pulls only this way. A
    point beside the surface tells nothing across its normal, since the garment may slide there. Of a cloud that always has
    points of something else, nothing pulls.
    """
    config, cloud, count = problem.config, problem.cloud, problem.config.coarse.points
    if count == 0 or problem.health.least_unexplained > config.evidence.foreign_share:
        return Pulling(np.empty(0, np.int32), SamplePlanes(np.empty((0, 3)), np.empty((0, 3)), np.empty(0)))
    stride = max(-(-cloud.surfels.shape[1] // count), 1)
    surfels = np.ascontiguousarray(cloud.surfels[:, ::stride].T[:count], np.float64)
    point, plane = surfels[:, :3] + cloud.origin, surfels[:, 3:]
    vertex, _ = nearest_vertices(point, position, gate)
    normal = np.empty_like(position)
    vertex_normals(position, problem.model.faces, normal)
    agreement = np.einsum("pa,pa->p", plane, normal[vertex])
    agreeing = agreement if cloud.oriented else np.abs(agreement)
    chosen = (vertex >= 0) & (agreeing > config.associate.normal_cosine)
    return Pulling(vertex[chosen], SamplePlanes(point[chosen], plane[chosen], np.ones(np.count_nonzero(chosen))))
