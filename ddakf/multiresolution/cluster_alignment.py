"""Stages B to F at the coarse level: clusters of the garment move rigidly, before the vertices do one by one.

Passes over all vertices converge slowly where large parts turn or travel: rotations are fitted and held, and conjugate gradients
carry a correction a few edges far. The same problem, restricted to rigid motions of a few dozen clusters, has a few hundred
unknowns and is solved exactly. It only gives the first estimate of the passes that follow; the prior stays the prediction.
"""

from __future__ import annotations

from itertools import islice

import numpy as np
from scipy.linalg.lapack import spotrf, spotrs

from ddakf.body.contact import BodyContact
from ddakf.config import Config, PlaneAssociation
from ddakf.garment.model import Model
from ddakf.kernels import cluster_alignment as kernels
from ddakf.physics import rigidity
from ddakf.stages import associate, robust
from ddakf.stages.associate import Measurement
from ddakf.stages.fuse import BLAS, Update
from ddakf.stages.preprocess import Cloud
from ddakf.stages.uncertainty import variances
from ddakf.types import State

EDGE_STRETCH = 0.577  # 4 A / (3 l^2) of an equilateral triangle: stretch of an edge in units of the stretch of its faces
CONTACT_SD = 0.004  # m, of the body's surface where a cluster is pushed out
RIDGE = 1e-6  # of the mean diagonal: a cluster that nothing holds


def align(
    update: Update, prior: State, cloud: Cloud, body_vertices: np.ndarray | None, contact: BodyContact | None,
    physics_lambda: float, model: Model, config: Config,
) -> Update:  # fmt: skip
    """The estimate before the first pass over all vertices: the prediction, or where the clusters went from there.

    Nothing is done while the prediction is good, the innovations along the normals below ``least_innovation``; and by the paper's
    association, which has no normals.

    Args:
        update: as it begins.
        prior: the prediction.
        cloud: the preprocessed points.
        body_vertices: (B, 3) metres, what may hide the garment from a sensor, or None.
        contact: the body, or None.
        physics_lambda: of stage G.
        model, config: of the tracker.
    """
    coarse, sample, probe = config.coarse, model.clusters.sample, model.clusters.probe
    if cloud.empty or coarse.iterations == 0 or not isinstance(config.associate, PlaneAssociation):
        return update
    gates = list(islice(associate.gates(cloud, config.associate), coarse.iterations))
    position, measurement = prior.position, update.measurement
    measurement = _measured(probe, position, measurement, cloud, body_vertices, gates[0], model, config)
    if not _needed(measurement, position, probe, coarse.least_innovation):
        return update._replace(measurement=measurement)  # its planes need not be sought again
    variance = max(float(np.median(variances(prior.R))), config.adapt.lowest_sd**2)
    floor = None if contact is None else contact.planes(position, config.physics)
    for gate in gates:
        measurement = _measured(sample, position, measurement, cloud, body_vertices, gate, model, config)
        weight = robust.weigh(measurement, position, prior.P_pp, prior.R, config.robust)
        motion, center = _solve(
            update, position, prior.position, measurement, weight, variance, floor, physics_lambda, model, config
        )
        if not np.isfinite(motion).all():
            return update
        moved = np.empty_like(position)
        step = kernels.move(position, model.clusters.nearest, model.clusters.share, center, motion, gate, moved)
        position = moved
        for term in (update.rest, update.motion):
            rigidity.turn(term, position, model)
        if step < coarse.tolerance:
            break
    return update._replace(position=position)


def _measured(vertex: np.ndarray, position, last: Measurement, cloud: Cloud, body_vertices, gate, model: Model, config: Config):
    """The measurements of some vertices."""
    only = np.zeros(len(position), bool)
    only[vertex] = True
    return associate.associate(position, last, cloud, body_vertices, model, gate, config.associate, only=only)


def _needed(measurement: Measurement, position: np.ndarray, vertex: np.ndarray, least: float) -> bool:
    """Whether passes are: the RMS innovation of some vertices along the normals is above ``least`` metres."""
    found = vertex[measurement.found[vertex]]
    y = np.einsum("va,va->v", measurement.normal[found], measurement.target[found] - position[found])
    return len(y) > 0 and float(y @ y) > least**2 * len(y)


def _solve(update, position, predicted, measurement, weight, variance, floor, physics_lambda, model: Model, config: Config):
    """(K, 6) rotation vector and translation of each cluster about its centre (K, 3): Gauss-Newton of the MAP problem."""
    clusters, physics, k = model.clusters, config.physics, model.n_clusters
    A, b, center = np.zeros((6 * k, 6 * k)), np.zeros(6 * k), np.empty((k, 3))
    kernels.centers(position, model.cluster, center)
    stands_for = len(position) / len(clusters.sample)
    kernels.add_planes(
        position, predicted, clusters.sample, model.cluster, center, measurement.target, measurement.normal, weight, variance,
        config.associate.tangential_sd**2, 1.0 / config.coarse.prior_sd**2, stands_for, A, b,
    )  # fmt: skip
    if floor is not None:
        point, normal = floor
        inside = np.einsum("va,va->v", normal, point - position) > 0
        kernels.add_planes(
            position, position, clusters.sample, model.cluster, center, point, normal, inside.astype(float), CONTACT_SD**2,
            np.inf, 0.0, stands_for, A, b,
        )  # fmt: skip
    kernels.add_seams(
        position, model.cluster, center, clusters.seam, update.rest.source, update.rest.rotation,
        clusters.weakening * update.rest.weight, update.motion.source, update.motion.rotation,
        clusters.weakening * update.motion.weight,
        clusters.weakening * EDGE_STRETCH * physics_lambda * physics.stretch * physics.fabric.stretch, physics.strain_scale, A, b,
    )  # fmt: skip
    A[np.diag_indices(6 * k)] += RIDGE * np.trace(A) / (6 * k)
    with BLAS.limit(limits=1, user_api="blas"):
        factor, failed = spotrf(A.astype(np.float32), lower=1)
        motion = np.full(6 * k, np.nan) if failed else spotrs(factor, b.astype(np.float32), lower=1)[0]
    return motion.astype(np.float64).reshape(k, 6), center
