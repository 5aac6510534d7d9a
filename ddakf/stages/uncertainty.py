"""Posterior of every vertex after the fusion update, the calibrated covariance, and the bounds of both (paper, section 2.7).

The recursion stores, as in the paper, one block per vertex: the covariance of a vertex given its neighbours, A_ii^-1. That is
overconfident as an answer to "how wrong may this vertex be", since the neighbours are not known either, and a garment that has
slid along its own surface stays there, which no frame shows again. What is reported therefore comes from a second recursion,
over patches of vertices: the covariance of the error that the tracker's own update leaves and carries on, its drift. It gives
each covariance its shape; :mod:`ddakf.stages.error_size` its sizes.
"""

from __future__ import annotations

from threading import Lock
from typing import NamedTuple

import numpy as np
from threadpoolctl import ThreadpoolController

from ddakf.appearance import colour
from ddakf.config import NearestPoint, Uncertainty
from ddakf.kernels import uncertainty as kernels
from ddakf.kernels.reliability import strains
from ddakf.kernels.uncertainty import MeasuredPlanes, PatchSums
from ddakf.planning import omission
from ddakf.stages import error_size, predict
from ddakf.stages.error_size import PatchEvidence
from ddakf.stages.fuse import condition, inverse_blocks, invert
from ddakf.types import Drift, Estimate, Posterior, Problem, State, variances

# A matrix of a few hundred rows is slower on many threads, and on busy cores very much so. Their number is the process's: of
# trackers in several threads, the first that is done would set it back for the others.
_BLAS, _LIMITING = ThreadpoolController(), Lock()


def posterior(problem: Problem, estimate: Estimate) -> Posterior:
    """The garment after the update: mean and stored covariance of every vertex, the calibrated covariance, and the drift."""
    state = predict.learned(problem, _conditioned(problem, estimate), estimate.learnable)
    covariance, drift = marginals(problem, estimate, state)
    tangential2 = colour.conditioned(problem, estimate, covariance)
    if problem.blind:
        covariance = covariance + problem.config.sidedness.blind_error**2 * np.eye(3)
    widening = omission.widening(problem, estimate)
    if widening > 1.0:
        covariance = _capped(widening**2 * covariance, problem.config.uncertainty)
    return Posterior(state, covariance, drift, tangential2)


def _conditioned(problem: Problem, estimate: Estimate) -> State:
    """Mean and stored covariance of every vertex, within the bounds.

    A frame in which nothing was measured, or whose fit was rejected, keeps the prior's covariance.
    """
    prior, limits = problem.prior, problem.config.uncertainty
    if estimate.state is not None:
        return bound(estimate.state, limits)
    if estimate.rejected or not estimate.observed.any():
        return bound(prior._replace(position=estimate.position), limits)
    covariance = inverse_blocks(estimate.system.D)
    kernels.replace_indefinite(covariance, prior.P_pp)  # of a mesh torn beyond what its equations can carry
    return bound(condition(prior, estimate.position, covariance, estimate.evidence.R), limits)


def marginals(problem: Problem, estimate: Estimate, state: State) -> tuple[np.ndarray, Drift]:
    """(V, 3, 3) calibrated covariance of each position, square metres, and the drift after this frame.

    Of the paper's preset, the stored blocks.

    Args:
        problem: the frame, with the drift after the last one.
        estimate: finished.
        state: the posterior.
    """
    model, limits, planes = problem.model, problem.config.uncertainty, estimate.planes
    if estimate.state is not None:
        return state.P_pp, problem.last.drift
    weight = np.zeros_like(planes.weight) if estimate.rejected else planes.weight
    evidence = _evidence(problem, estimate, weight, state.position)
    coupling = Coupling(estimate.system.B, float(variances(state.P_pp).mean()), estimate.clearance is not None)
    drift = advance(problem, evidence, coupling)
    n = len(model.likeness)
    blocks = drift.covariance.reshape(n, 3, n, 3)
    shared = (1.0 + limits.vertex_share) * blocks[np.arange(n), :, np.arange(n)].astype(np.float64)
    slip2 = limits.strain_reach**2 * 0.5 * (evidence.strain2 + np.average(evidence.strain2, weights=evidence.size))
    shared += (slip2 + limits.floor_sd**2)[:, None, None] * np.eye(3)
    covariance = np.empty((len(weight), 3, 3))
    measured = MeasuredPlanes(weight, planes.normal, planes.variance, evidence.isotropic)
    kernels.vertex_covariances(shared, 2.0 * evidence.bend, model.patch, measured, covariance)
    found = error_size.evidence(problem, estimate, state.position, evidence)
    drift = drift._replace(hem2=found.hem)
    covariance = error_size.resized(problem, state.position, covariance, error_size.sizes(problem, estimate, found))
    return _capped(covariance, limits), drift


def _capped(covariance: np.ndarray, limits: Uncertainty) -> np.ndarray:
    """(V, 3, 3) covariance with a trace of at most 3 ceiling_sd^2; the array itself is scaled."""
    scale = _scale(covariance, limits.ceiling_sd)
    if scale is not None:
        covariance *= scale**2
    return covariance


class Coupling(NamedTuple):
    """How the update couples the patches, and what it stores."""

    B: np.ndarray  # (2E, 12) blocks of the coupling, see System
    stored2: float  # m^2, mean variance of the stored blocks
    on_body: bool  # a body is known that the garment is on


def advance(problem: Problem, evidence: PatchEvidence, coupling: Coupling) -> Drift:
    """The covariance of what the update leaves of the error, and of what it adds.

    The update moves the patches by (C + M)^-1 M times what the measurements see of their error, C what couples the patches and M
    the measurements' information. So an error e, grown by what the prediction missed, becomes F e with F = I - (C + M)^-1 M, to
    which the noise of the measurements adds (C + M)^-1 M (C + M)^-1: a covariance analysis of the gain that is used, whether or
    not it is the best one (Gelb 1974, "Applied optimal estimation", section 7.2). It knows that what is hidden is dragged along,
    drags along what is seen, and does not come back of its own.

    Args:
        problem: the frame, with the drift after the last one.
        evidence: of this frame.
        coupling: of the patches.
    """
    model, limits, drift = problem.model, problem.config.uncertainty, problem.last.drift
    growth2, speed2 = _growth(problem, evidence, coupling)
    root = np.sqrt(growth2).astype(np.float32)
    covariance = drift.covariance.copy()
    added = root[:, None] * model.likeness * root
    for a in range(3):
        covariance[a::3, a::3] += added
    ceiling = np.float32(limits.ceiling_sd / np.sqrt(max(float(covariance.diagonal().max()), 1e-12)))
    if ceiling < 1.0:
        covariance *= ceiling**2
    if evidence.observed.any():
        covariance = _updated(problem, covariance, evidence, coupling.B)
    return drift._replace(covariance=covariance, speed2=speed2, stored2=coupling.stored2)


def _updated(problem: Problem, P: np.ndarray, evidence: PatchEvidence, B: np.ndarray) -> np.ndarray:
    """F P F' + G M G with G = (C + M)^-1 and F = I - G M, which is F (P F' - G) + G; P where G cannot be had."""
    coarse = np.empty(P.shape, np.float32)
    least = problem.config.uncertainty.least_information
    kernels.couple_patches(B, problem.model.crossing, evidence.information, least, coarse)
    G = invert(coarse)
    if not np.isfinite(G).all():
        return P
    F = np.empty_like(G)
    kernels.error_transition(G, evidence.information.astype(np.float32), F)
    with _LIMITING, _BLAS.limit(limits=1, user_api="blas"):
        updated = F @ (P @ F.T - G) + G
    return 0.5 * (updated + updated.T)


def _growth(problem: Problem, evidence: PatchEvidence, coupling: Coupling) -> tuple[np.ndarray, float]:
    """(L,) m^2 that each patch's error grows by in this frame in each direction, and the running mean of the innovations.

    Where a patch is seen, what the prediction missed is its innovation, and elsewhere that of the rest of the garment. What is
    not seen may have moved unlike what is: by a share of the motion that the body does not explain. When nothing is seen,
    predictions go on missing as much, and a garment without a body goes where the prediction's own variance says.
    """
    drift, dt, limits = problem.last.drift, problem.dt, problem.config.uncertainty
    seen = evidence.observed / evidence.size
    enough = evidence.observed.sum() > limits.least_coverage * evidence.size.sum()
    if not enough:
        lost2 = 0.0 if coupling.on_body else max(coupling.stored2 - drift.stored2, 0.0)
        return np.full(len(seen), lost2 + drift.speed2 * dt**2 / 3.0 + limits.growth_sd**2), drift.speed2
    common = float(np.average(evidence.innovation2, weights=evidence.observed))
    old = limits.innovation_memory
    speed2 = common / dt**2 if drift.speed2 == 0.0 else old * drift.speed2 + (1.0 - old) * common / dt**2
    missed = common + 0.5 * seen * (evidence.innovation2 - common)
    moved = 0.5 * (evidence.motion2 + np.average(evidence.motion2, weights=evidence.size))
    grown = limits.missed_share**2 * missed + limits.unseen_motion**2 * (1.0 - seen) * moved
    return grown / 3.0 + limits.growth_sd**2, speed2


def _evidence(problem: Problem, estimate: Estimate, weight: np.ndarray, position: np.ndarray) -> PatchEvidence:
    """The evidence of a frame: ``weight`` (V,) of its measurements, posterior ``position`` (V, 3), metres."""
    model, planes, limits = problem.model, estimate.planes, problem.config.uncertainty
    # an unseen part moved as is known: not at all, or, with a body to ride on, as it did
    still = problem.motion_start if problem.carried is None else position
    n, ring_strain = len(model.likeness), np.empty(len(position))
    shapes = PatchSums((n,), (n,), (n, 6), (n, 3), (n, 4), (n, 4), (n,))
    size, observed, information, facing, motion, innovation, strain2 = sums = PatchSums(*map(np.empty, shapes))
    isotropic = isinstance(problem.config.associate, NearestPoint)
    strains(position, model.start, model.neighbour, model.rest_length, ring_strain)
    measured_planes = MeasuredPlanes(weight, planes.normal, planes.variance, isotropic)
    kernels.sum_by_patch(position, still, problem.prior.position, model.patch, ring_strain, measured_planes, sums)
    measured = np.maximum(observed, 1.0)
    bend = 1.0 - np.square(facing / measured[:, None]).sum(axis=1)
    return PatchEvidence(
        size=size,
        observed=observed,
        information=information / (limits.plane_persistence * measured)[:, None],
        bend=np.maximum(bend, limits.least_bend),
        motion2=_about_mean(motion, size),
        innovation2=_about_mean(innovation, observed),
        strain2=strain2 / size,
        strain=ring_strain,
        isotropic=isotropic,
    )


def _about_mean(sums: np.ndarray, count: np.ndarray) -> np.ndarray:
    """(L,) mean squared distance from the mean vector of all patches, from sums (L, 4) of vectors and squares."""
    mean = sums[:, :3].sum(axis=0) / max(count.sum(), 1.0)
    about = sums[:, 3] - 2.0 * sums[:, :3] @ mean + count * (mean @ mean)
    return np.maximum(about, 0.0) / np.maximum(count, 1.0)


def bound(state: State, limits: Uncertainty) -> State:
    """The state with trace(P_pp) at most 3 ceiling_sd^2 and trace(P_uu) at most 3 ceiling_speed_sd^2.

    Each block row and column is scaled, a congruence, so that P_i stays positive definite.
    """
    s, t = _scale(state.P_pp, limits.ceiling_sd), _scale(state.P_uu, limits.ceiling_speed_sd)
    if s is None and t is None:
        return state
    s, t = 1.0 if s is None else s, 1.0 if t is None else t
    return state._replace(P_pp=s * s * state.P_pp, P_pu=s * t * state.P_pu, P_uu=t * t * state.P_uu)


def _scale(covariance: np.ndarray, ceiling_sd: float) -> np.ndarray | None:
    """(V, 1, 1) factor on the standard deviations that keeps the trace at 3 ceiling_sd^2 or less; None where it is."""
    variance = variances(covariance)
    if variance.max() <= ceiling_sd**2:
        return None
    return np.minimum(1.0, ceiling_sd / np.sqrt(variance))[:, None, None]
