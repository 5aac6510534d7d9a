"""Posterior of every vertex after the fusion update, the calibrated covariance, and the bounds of both (paper, section 2.7).

The recursion stores, as in the paper, one block per vertex: the covariance of a vertex given its neighbours, A_ii^-1. That is
overconfident as an answer to "how wrong may this vertex be", since the neighbours are not known either, and a garment that has
slid along its own surface stays there, which no frame shows again. What is reported therefore comes from a second recursion,
over patches of vertices: the covariance of the error that the tracker's own update leaves and carries on, its drift. It gives
each covariance its shape; :mod:`ddakf.stages.error_size` its sizes.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ddakf.appearance import colour
from ddakf.config import NearestPoint, Uncertainty
from ddakf.config.stages import USUAL_RATE
from ddakf.garment.slippage import fold_height, has_limbs, least_seen_turn, some_faces
from ddakf.kernels import surface_points as point_kernels
from ddakf.kernels import uncertainty as kernels
from ddakf.kernels.normals import vertex_normals
from ddakf.kernels.reliability import strains
from ddakf.kernels.rigid_motion import moments
from ddakf.kernels.uncertainty import MeasuredPlanes, PatchMeans, PatchSums
from ddakf.physics.size import rest_length
from ddakf.planning import omission
from ddakf.stages import error_size, predict
from ddakf.stages.error_size import PatchStatistics
from ddakf.stages.fuse import condition, inverse_blocks, invert
from ddakf.types import Drift, Estimate, Posterior, Problem, State, variances

LEAST_TURNED = 16  # least number of seen vertices that show a rigid motion
TINY = 1e-12  # m^2/rad^2, of a point, which no turn moves
STEADY = np.radians(5.0)  # rad/s, largest turn that noise gives the estimate of a garment at rest
LEAST_SEEN = 0.25  # share of the garment, below which seeing less does not hide more of its turns
MOST_TURNED = 2.0  # rad, largest turn that nothing shows: beyond it the other side would be as likely
SHORTEST = 1.0 / 120.0  # s, shortest step of frames whose innovations are motion; of closer frames they are noise


def posterior(problem: Problem, estimate: Estimate) -> Posterior:
    """The garment after the update: mean and stored covariance of every vertex, the calibrated covariance, and the drift."""
    state = predict.learn_acceleration(problem, _stored_state(problem, estimate), estimate.learnable)
    covariance, drift = marginals(problem, estimate, state)
    tangential2 = colour.lower_covariance(problem, estimate, covariance)
    turned2, turn = 0.0, max(drift.unseen_turn, drift.behind)
    if turn > 0.0:
        turned2 = _add_turn(problem, state.position, turn, covariance)
        covariance = cap(covariance, problem.config.uncertainty)
    if problem.lacks_place(estimate.observed):
        blind = covariance + problem.config.sidedness.blind_error**2 * np.eye(3)
        covariance = cap(blind, problem.config.uncertainty)
    if problem.last.sensors is not None:
        covariance = cap(covariance + problem.last.sensors.common2 * np.eye(3), problem.config.uncertainty)
    found = Posterior(state, covariance, drift, tangential2, turned2)
    return widen(problem, estimate, found, omission.widening(problem, estimate))


def widen(problem: Problem, estimate: Estimate, posterior: Posterior, factor: float) -> Posterior:
    """The posterior with calibrated standard deviations that are larger by a factor of 1 or more, within the bounds.

    The stored blocks, which the paper's preset reports, stay.
    """
    if factor == 1.0 or estimate.state is not None:
        return posterior
    return posterior._replace(covariance=cap(factor**2 * posterior.covariance, problem.config.uncertainty))


def _stored_state(problem: Problem, estimate: Estimate) -> State:
    """Mean and stored covariance of every vertex, within the bounds.

    A frame in which nothing was measured, or whose fit was rejected, keeps the prior's covariance.
    """
    prior, limits = problem.prior, problem.config.uncertainty
    if estimate.state is not None:
        return bound(estimate.state, limits)
    if estimate.rejected or not estimate.observed.any():
        return bound(prior._replace(position=estimate.position), limits)
    covariance = inverse_blocks(estimate.system.D)
    kernels.replace_indefinite(covariance, prior.P_pp)  # a torn mesh has equations that cannot be inverted
    return bound(condition(prior, estimate.position, covariance, estimate.terms.R), limits)


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
        return state.P_pp.copy(), problem.last.drift
    weight = np.zeros_like(planes.weight) if estimate.rejected else planes.weight
    normal = np.empty_like(state.position)
    vertex_normals(state.position, model.faces, normal)
    patches = _patch_statistics(problem, estimate, weight, Surface(state.position, normal))
    stored2 = kernels.mean_and_largest_trace(state.P_pp)[0] / 3.0
    coupling = Coupling(_elastic(problem, estimate), stored2, estimate.clearance is not None)
    drift = advance(problem, patches, coupling)
    strain2 = patches.means.strain2
    slip2 = limits.strain_reach**2 * 0.5 * (strain2 + _mean(strain2, patches.size)) + limits.floor_sd**2
    covariance, share = np.empty((len(weight), 3, 3)), 1.0 + limits.vertex_share
    measured = MeasuredPlanes(weight, planes.normal, planes.variance, patches.isotropic)
    kernels.vertex_covariances(drift.covariance, share, slip2, 2.0 * patches.means.bend, model.patch, measured, covariance)
    found = error_size.evidence(problem, estimate, state.position, patches)
    covariance = error_size.resized(covariance, normal, error_size.sizes(problem, estimate, found))
    drift = _turned(problem, estimate, Surface(state.position, normal), found.slip, drift._replace(hem2=found.hem))
    return cap(covariance, limits), drift


def _turned(problem: Problem, estimate: Estimate, surface: Surface, slip: float, drift: Drift) -> Drift:
    """The drift with how far the garment may be turned, unnoticed.

    A smooth surface of revolution, such as a plain skirt, may turn with its wearer, and noise may turn the estimate: the cloud is
    the same. Folds show that it turns, but not how far: they may stay where they are while cloth passes through them. The faster
    a turn and the less of the garment is seen, the farther the estimate may be behind it. Without a body it stays behind. On a
    body the waistband holds, so that the rest is behind by less, and no longer than errors take to fade. Legs and sleeves show a
    turn, and so do colours. A start to which several headings were alike leaves an angle as well.

    Args:
        problem: the frame.
        estimate: finished.
        surface: the posterior.
        slip: see ``SizeEvidence``.
        drift: after this frame, its turns those of the last one.
    """
    model, limits, dt = problem.model, problem.config.uncertainty, problem.dt
    angle, rate, on_body = drift.unseen_turn, drift.turning, estimate.clearance is not None
    if problem.coloured or has_limbs(model.mesh):
        return drift._replace(turning=0.0, behind=0.0)
    turn, seen = least_seen_turn(*surface, some_faces(model.faces), model.boundary), float(estimate.observed.mean())
    if seen > 0.0:
        now, memory = _turned_by(turn.moved, surface.position - problem.motion_start) / max(dt, SHORTEST), limits.turn_lag
        if on_body:
            now = abs(now)
            memory = limits.return_time if now < rate else memory
        rate += -math.expm1(-dt / memory) * (now - rate)
    lag = (limits.turn_lag_on_body if on_body else limits.turn_lag) / max(seen, LEAST_SEEN) * (1.0 - turn.share)
    behind = min(max(lag * (abs(rate) - STEADY), 0.0), MOST_TURNED)
    if on_body:
        return drift._replace(turning=rate, behind=behind)
    if seen > 0.0:
        angle = max(angle, behind)
    if slip + error_size.BALL > 1.0 / limits.turn_share:
        folds = fold_height(*surface, (model.start, model.neighbour), model.edge_length)
        unseen = max(0.0, 1.0 - folds / limits.smooth_folds) * max(0.0, 1.0 - turn.share / limits.turn_share)
        angle += np.radians(limits.turn_rate) * unseen * min(dt, problem.config.predict.longest_step)
    return drift._replace(unseen_turn=min(float(angle), MOST_TURNED), turning=rate, behind=0.0)


def _turned_by(moved: np.ndarray, displacement: np.ndarray) -> float:
    """Radians of the turn that moves vertices by (V, 3) ``moved`` per radian, in their (V, 3) displacements, shifts aside."""
    about = moved - moved.mean(axis=0)
    return float((about * displacement).sum() / max(np.square(about).sum(), TINY))


def _add_turn(problem: Problem, position: np.ndarray, angle: float, covariance: np.ndarray) -> float:
    """Adds to (V, 3, 3) that cloth may have slid along the surface, as by a turn of ``angle``. Returns the mean trace, m^2.

    The surface itself is seen, so that the turn's part along the normals is left out. Cloth that turns does not turn rigidly.
    """
    model, normal = problem.model, np.empty_like(position)
    vertex_normals(position, model.faces, normal)
    moved = angle * least_seen_turn(position, normal, some_faces(model.faces), model.boundary).moved
    beside2 = problem.config.uncertainty.turn_spread**2 * np.square(moved).sum(axis=1)
    moved -= np.einsum("va,va->v", moved, normal)[:, None] * normal
    covariance += moved[:, :, None] * moved[:, None, :] + beside2[:, None, None] * np.eye(3)
    return float((np.square(moved).sum(axis=1) + 3.0 * beside2).mean())


def _elastic(problem: Problem, estimate: Estimate) -> np.ndarray:
    """(2E, 12) blocks of the coupling of patches by the cloth alone, without that of points on a face between two patches."""
    model, planes, B = problem.model, estimate.planes, estimate.system.B
    if planes.points is None:
        return B
    n, measured = len(estimate.position), np.zeros((len(model.mesh.edges), 12), np.float32)
    point_kernels.add_points(model.rings, planes.points, planes.information, np.zeros((n, 3, 3)), measured, np.zeros((n, 4)))
    entry, B = model.crossing[:, 0], B.copy()
    B[entry] -= measured[model.edge[entry]]
    return B


def cap(covariance: np.ndarray, limits: Uncertainty) -> np.ndarray:
    """(V, 3, 3) covariance with a trace of at most 3 ceiling_sd^2; the array itself is scaled."""
    scale = _scale(covariance, limits.ceiling_sd)
    if scale is not None:
        covariance *= scale**2
    return covariance


def _mean(values: np.ndarray, weights: np.ndarray) -> float:
    """Mean of (L,) values, weighted."""
    return float(values @ weights) / float(weights.sum())


class Coupling(NamedTuple):
    """How the update couples the patches, and what it stores."""

    B: np.ndarray  # (2E, 12) blocks of the coupling, see System
    stored2: float  # m^2, mean variance of the stored blocks
    on_body: bool  # whether the body is known


def advance(problem: Problem, patches: PatchStatistics, coupling: Coupling) -> Drift:
    """The covariance of what the update leaves of the error, and of what it adds.

    The update moves the patches by (C + M)^-1 M times what the measurements see of their error, C what couples the patches and M
    the measurements' information. So an error e, grown by what the prediction missed, becomes F e with F = I - (C + M)^-1 M, to
    which the noise of the measurements adds (C + M)^-1 M (C + M)^-1: a covariance analysis of the gain that is used, whether or
    not it is the best one (Gelb 1974, "Applied optimal estimation", section 7.2). It knows that what is hidden is dragged along,
    and drags along what is seen. It does not know that cloth and body pull errors back, which stay as large as they are after a
    few seconds: errors fade, the sooner the more of the garment is seen and the more reliable it is.

    Args:
        problem: the frame, with the drift after the last one.
        patches: of this frame.
        coupling: of the patches.
    """
    model, limits, drift = problem.model, problem.config.uncertainty, problem.last.drift
    growth2, speed2, missed = _growth(problem, patches, coupling)
    covariance = np.empty_like(drift.covariance)
    kernels.grow(drift.covariance, remaining(problem, patches), model.likeness, growth2, limits.ceiling_sd, covariance)
    if patches.observed.any():
        covariance = _updated(problem, covariance, patches, coupling.B)
    return drift._replace(covariance=covariance, speed2=speed2, stored2=coupling.stored2, missed=missed)


def remaining(problem: Problem, patches: PatchStatistics) -> float:
    """Share of the errors' covariance that has not faded since the last frame; of a garment that may be lost, all."""
    rate = problem.health.reliability * patches.observed.sum() / patches.size.sum() / problem.config.uncertainty.return_time
    return math.exp(-2.0 * rate * problem.dt)


def _updated(problem: Problem, P: np.ndarray, patches: PatchStatistics, B: np.ndarray) -> np.ndarray:
    """F P F' + G M G with G = (C + M)^-1 and F = I - G M, which is F (P F' - G) + G; P where G cannot be had."""
    coarse = np.empty(P.shape, np.float32)
    least = problem.config.uncertainty.least_information
    kernels.couple_patches(B, problem.model.crossing, patches.means.information, least, coarse)
    updated = np.empty_like(P)
    return updated if kernels.update_errors(P, invert(coarse), patches.means.information, updated) else P


def _growth(problem: Problem, patches: PatchStatistics, coupling: Coupling) -> tuple[np.ndarray, float, np.ndarray]:
    """(L,) m^2 that each patch's error grows by in this frame in each direction, and the running means of what predictions miss.

    The first of these, of the innovations, leaves out what all patches have in common; the second does not, nor the body's part.

    Where a patch is seen, what the prediction missed is its innovation, and elsewhere that of the rest of the garment. What is
    not seen may have moved unlike what is: by a share of the motion that the body does not explain. When nothing is seen,
    predictions go on missing as much, and a garment without a body goes where the prediction's own variance says.
    """
    drift, dt, limits = problem.last.drift, problem.dt, problem.config.uncertainty
    seen, innovation2, motion2 = patches.observed / patches.size, patches.means.innovation2, patches.means.motion2
    enough = patches.observed.sum() > limits.least_coverage * patches.size.sum()
    if not enough:
        lost2 = 0.0 if coupling.on_body else max(coupling.stored2 - drift.stored2, 0.0)
        return np.full(len(seen), lost2 + drift.speed2 * dt**2 / 3.0 + limits.growth_sd**2), drift.speed2, drift.missed
    common = _mean(innovation2, patches.observed)
    old = limits.innovation_memory if drift.speed2 > 0.0 else 0.0
    apart2 = max(dt, SHORTEST) ** 2
    speed2 = old * drift.speed2 + (1.0 - old) * common / apart2
    missed = old * drift.missed + (1.0 - old) * patches.missed / apart2
    per_patch = common + 0.5 * seen * (innovation2 - common)
    moved = 0.5 * (motion2 + _mean(motion2, patches.size))
    moved *= max(1.0, 1.0 / (USUAL_RATE * dt))  # successive steps within 1/30 s are alike, so that their errors add up
    grown = limits.missed_share**2 * per_patch + limits.unseen_motion**2 * (1.0 - seen) * moved
    return grown / 3.0 + limits.growth_sd**2, speed2, missed


class Surface(NamedTuple):
    """The garment after the update."""

    position: np.ndarray  # (V, 3) m
    normal: np.ndarray  # (V, 3) unit


def _patch_statistics(problem: Problem, estimate: Estimate, weight: np.ndarray, surface: Surface) -> PatchStatistics:
    """The statistics of a frame: ``weight`` (V,) of its measurements, and the posterior ``surface``."""
    model, planes, limits = problem.model, estimate.planes, problem.config.uncertainty
    # where an unseen part is assumed to be: moved rigidly with what is seen, or, on a body, with the body
    still, missed = surface.position, surface.position - problem.prior.position
    if problem.carried is None:
        still = _turned_with(problem.motion_start, surface.position, weight > 0.0)
    elif problem.last.body.velocity is not None:  # the body's change of velocity is part of what was missed
        missed = missed + problem.carried - problem.dt * problem.last.body.velocity
    n, ring_strain = len(model.likeness), np.empty(len(weight))
    sums = PatchSums(*map(np.empty, ((n,), (n,), (n, 6), (n, 3), (n, 4), (n, 4), (n,), (n,))))
    means = PatchMeans(*map(np.empty, ((n, 6), (n,), (n,), (n,), (n,), (n,))))
    isotropic = isinstance(problem.config.associate, NearestPoint)
    strains(surface.position, model.start, model.neighbour, rest_length(problem), ring_strain)
    measured = MeasuredPlanes(weight, planes.normal, planes.variance, isotropic)
    prior = problem.prior.position
    kernels.sum_by_patch(surface.position, still, prior, surface.normal, model.patch, ring_strain, measured, sums)
    if planes.points is not None and weight.any():  # of a rejected fit none are used
        point_kernels.add_information(model.rings, planes.points, planes.information, model.patch, sums.information)
    kernels.patch_means(sums, limits.plane_persistence, limits.least_bend, means)
    missed = missed[weight > 0.0]
    return PatchStatistics(sums.size, sums.observed, means, ring_strain, isotropic, missed.T @ missed / max(len(missed), 1))


def _turned_with(before: np.ndarray, after: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """(V, 3) metres: vertices ``before``, moved by the rigid motion of the ``seen`` (V,) to ``after`` (Kabsch 1976)."""
    sums = np.empty((1, 16))
    moments(before, after, seen, np.zeros(len(seen), np.int32), sums)
    count, means = sums[0, 0], sums[0, 1:] / max(sums[0, 0], 1.0)
    if count < LEAST_TURNED:
        return before
    middle, there = means[:3], means[3:6]
    u, _, vt = np.linalg.svd(means[6:].reshape(3, 3).T - np.outer(there, middle))
    rotation = u * [1.0, 1.0, np.sign(np.linalg.det(u @ vt))] @ vt
    return before @ rotation.T + (there - rotation @ middle)


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
    if kernels.mean_and_largest_trace(covariance)[1] <= 3.0 * ceiling_sd**2:
        return None
    return np.minimum(1.0, ceiling_sd / np.sqrt(variances(covariance)))[:, None, None]
