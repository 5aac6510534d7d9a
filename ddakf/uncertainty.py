"""Posterior of every vertex after the fusion update, the calibrated covariance, and the bounds of both (paper, section 2.7).

The recursion stores, as in the paper, one block per vertex: the covariance of a vertex given its neighbours, A_ii^-1. That is
overconfident as an answer to "how wrong may this vertex be", since the neighbours are not known either. The reported covariance
adds what the patch around the vertex does not know, the two-level approximation of the inverse: Sigma_i = A_ii^-1 +
(P' A P)^-1 of the vertex's cluster, P interpolating clusters to vertices.
"""

from __future__ import annotations

import numpy as np

from ddakf.config import Config, Uncertainty
from ddakf.fuse import Update, condition, inverse_blocks, invert
from ddakf.kernels import fuse as kernels
from ddakf.model import Model
from ddakf.types import State


def posterior(update: Update, prior: State, config: Config) -> State:
    """Mean and stored covariance of every vertex, within the bounds.

    A frame in which nothing was measured, or whose fit was rejected, keeps the prior's covariance.
    """
    if update.state is not None:
        return bound(update.state, config.uncertainty)
    if update.rejected or not (update.weight > 0).any():
        return bound(prior._replace(position=update.position), config.uncertainty)
    covariance = inverse_blocks(update.system.D)
    covariance = _or(covariance, prior.P_pp)
    return bound(condition(prior, update.position, covariance, update.R), config.uncertainty)


def marginals(update: Update, state: State, model: Model, config: Config) -> np.ndarray:
    """(V, 3, 3) calibrated covariance of each position, square metres; of the paper's preset, the stored blocks.

    What the MAP problem treats as independent is not: a patch of n vertices shares the error of its prediction, neighbouring
    plane fits share points, and the cloth's model is wrong in the same way from frame to frame. The prior therefore counts
    once per patch, and the measurements and the coupling are divided by one global constant each. Contact does not count: a
    bound says where a vertex is not.
    """
    if update.state is not None or update.rejected:
        return state.P_pp
    limits, system, planes = config.uncertainty, update.system, update.planes
    size = np.bincount(model.cluster, minlength=model.n_clusters)[model.cluster]
    kept = 1.0 / limits.correlated_coupling
    D = kept * (system.D - system.unary) + system.unary - _contact_blocks(update)
    local = inverse_blocks(D)
    kernels.discount(
        D, update.information, 1.0 - 1.0 / size,
        planes.weight, planes.normal, planes.variance, planes.tangential, 1.0 - 1.0 / limits.correlated_measurements,
    )  # fmt: skip
    coarse = np.empty((3 * model.n_clusters, 3 * model.n_clusters))
    kernels.coarsen(D, np.float32(kept) * system.B, model.start, model.neighbour, model.cluster, coarse)
    patch = invert(coarse).reshape(model.n_clusters, 3, model.n_clusters, 3)
    patch = patch[np.arange(model.n_clusters), :, np.arange(model.n_clusters)]
    covariance = local + patch[model.cluster]
    covariance = _or(covariance, state.P_pp)
    covariance += limits.floor_sd**2 * np.eye(3)
    return _scale(covariance, limits.ceiling_sd) ** 2 * covariance


def _contact_blocks(update: Update) -> np.ndarray:
    """(V, 3, 3) 1/m^2, what the contacts added to the diagonal blocks."""
    touching, blocks = update.energies.collision, np.zeros_like(update.system.unary)
    if touching is not None:
        kernels.add_single(*touching, update.energies.stiffness[-1], blocks, np.zeros((len(blocks), 4)))
    return blocks


def _or(covariance: np.ndarray, fallback: np.ndarray) -> np.ndarray:
    """(V, 3, 3): where a block is not positive definite, of a mesh torn beyond what its equations can carry, the fallback."""
    a, b, c = (covariance[:, k, k] for k in range(3))
    d, e, f = covariance[:, 0, 1], covariance[:, 0, 2], covariance[:, 1, 2]
    with np.errstate(over="ignore", invalid="ignore"):
        minor = a * b - d * d
        determinant = a * (b * c - f * f) - d * (d * c - e * f) + e * (d * f - b * e)
        good = (a > 0) & (minor > 0) & (determinant > 0) & np.isfinite(covariance).all(axis=(1, 2))
    return np.where(good[:, None, None], covariance, fallback)


def bound(state: State, limits: Uncertainty) -> State:
    """The state with trace(P_pp) at most 3 ceiling_sd^2 and trace(P_uu) at most 3 ceiling_speed_sd^2.

    Each block row and column is scaled, a congruence, so that P_i stays positive definite.
    """
    s, t = _scale(state.P_pp, limits.ceiling_sd), _scale(state.P_uu, limits.ceiling_speed_sd)
    return state._replace(P_pp=s * s * state.P_pp, P_pu=s * t * state.P_pu, P_uu=t * t * state.P_uu)


def _scale(covariance: np.ndarray, ceiling_sd: float) -> np.ndarray:
    """(V, 1, 1) factor on the standard deviations that keeps the trace at 3 ceiling_sd^2 or less."""
    return np.minimum(1.0, ceiling_sd / np.sqrt(np.trace(covariance, axis1=1, axis2=2) / 3))[:, None, None]
