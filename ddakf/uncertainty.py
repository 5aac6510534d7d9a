"""Position covariance of every vertex after the fusion update, and the bounds it is kept in (paper, section 2.7).

The conditional covariance of a vertex given its neighbours, A_ii^-1, is overconfident where the neighbours are unknown too. The
two-level approximation of the inverse adds what the patch around it does not know: Sigma_i = A_ii^-1 + (P' A P)^-1 of the
vertex's cluster, P interpolating clusters to vertices.
"""

from __future__ import annotations

import numpy as np

from ddakf.config import Config, Uncertainty
from ddakf.fuse import Update, condition, invert
from ddakf.kernels import fuse as kernels
from ddakf.model import Model
from ddakf.types import State


def posterior(update: Update, prior: State, model: Model, config: Config) -> State:
    """Mean and covariance of every vertex, within the bounds.

    A frame in which nothing was measured, or whose fit was rejected, keeps the prior's covariance.
    """
    if update.state is not None:
        return bound(update.state, config.uncertainty)
    if update.rejected or not (update.weight > 0).any():
        return bound(prior._replace(position=update.position), config.uncertainty)
    covariance = marginals(update, model, config.uncertainty)
    return bound(condition(prior, update.position, covariance, update.R), config.uncertainty)


def marginals(update: Update, model: Model, config: Uncertainty) -> np.ndarray:
    """(V, 3, 3) approximate marginal covariances of the positions, square metres.

    Errors of a prediction and of plane fits are shared by neighbours: on the coarse level a cluster of n vertices counts its
    prior once, not n times, and ``correlated_measurements`` neighbouring planes as one.
    """
    system, planes, n_clusters = update.system, update.planes, model.n_clusters
    size = np.bincount(model.cluster, minlength=n_clusters)
    D = system.D.copy()
    kernels.discount(
        D, update.information, 1.0 - 1.0 / size[model.cluster],
        planes.weight, planes.normal, planes.variance, planes.tangential, 1.0 - 1.0 / config.correlated_measurements,
    )  # fmt: skip
    coarse = np.empty((3 * n_clusters, 3 * n_clusters))
    kernels.coarsen(D, system.B, model.start, model.neighbour, model.cluster, coarse)
    patch = invert(coarse).reshape(n_clusters, 3, n_clusters, 3)
    patch = patch[np.arange(n_clusters), :, np.arange(n_clusters)]
    local = np.empty_like(system.D)
    kernels.invert_blocks(system.D, local)
    scale = np.where(planes.weight > 0, config.observed_scale, config.hidden_scale)
    covariance = scale[:, None, None] * (local + patch[model.cluster])
    return covariance + config.floor_sd**2 * np.eye(3)


def bound(state: State, config: Uncertainty) -> State:
    """The state with trace(P_pp) at most 3 ceiling_sd^2 and trace(P_uu) at most 3 ceiling_speed_sd^2.

    Each block row and column is scaled, a congruence, so that P_i stays positive definite.
    """
    s = np.minimum(1.0, config.ceiling_sd / np.sqrt(np.trace(state.P_pp, axis1=1, axis2=2) / 3))[:, None, None]
    t = np.minimum(1.0, config.ceiling_speed_sd / np.sqrt(np.trace(state.P_uu, axis1=1, axis2=2) / 3))[:, None, None]
    return state._replace(P_pp=s * s * state.P_pp, P_pu=s * t * state.P_pu, P_uu=t * t * state.P_uu)
