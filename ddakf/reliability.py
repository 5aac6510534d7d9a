"""Stage G, reliability (paper, section 2.6): the paper's s_k, the product's score, and the tracker's state."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ddakf.config import PaperReliability, Reliability
from ddakf.fuse import Update
from ddakf.kernels import reliability as kernels
from ddakf.kernels.associate import vertex_normals
from ddakf.model import Model
from ddakf.types import State, TrackerState

EVIDENCE_POINTS = 800  # of a cloud that are held against the surface
REACH = 0.10  # m: a point farther from every vertex says nothing about the surface
FOREIGN = 0.15  # share of points beyond it, above which a cloud is of more than the garment
NEAR = 0.04  # m: of such a cloud a point farther from every vertex, or beyond a hem, says nothing
SPEED_MEMORY, MISFIT_MEMORY, UNSEEN_MEMORY = 1.0, 0.5, 0.3  # s
ONE_SECOND = 1.0  # s: time over which an unseen part's travel adds up
SEARCH_EVERY = 5  # frames, at first; then after 10, 20, 40 ...
LONGEST_GAP = 3.0  # times the spacing of the frames before
LONGEST_BOOKED = 0.3  # s: a gap before a bad frame longer than frames usually are apart is no part of a loss


class Health(NamedTuple):
    """What the tracker remembers about its own quality."""

    state: TrackerState = "initializing"
    physics_lambda: float = 1.0
    poor_for: float = 0.0  # s of sensor time with points, but without a fit
    empty_for: float = 0.0  # s of empty clouds
    doubtful: bool = False  # there is a fit, but hardly of this garment
    frames_unplaced: int = 0  # frames with points that have been searched since there was a fit
    spacing: float = 0.0  # s between the last two frames
    # what the predicted error remembers
    speed2: float = 0.0  # m^2/s^2, mean squared velocity
    usual_strain: float = 10.0  # least RMS strain so far
    misfit: float = 0.0  # m^2
    offset: float = 0.0  # m^2, of the last cloud
    unseen: float = 0.0  # m^2

    @property
    def unplaced(self) -> bool:
        """Where the garment is has not been seen lately: before the first fit, lost, out of sight or without a fit."""
        return self.state in ("initializing", "lost") or self.poor_for > 0.0 or self.empty_for > 0.0 or self.doubtful

    @property
    def search_due(self) -> bool:
        """Whether it is looked for: a search takes as long as several frames, and a stream of nonsense must not stall."""
        rounds, rest = divmod(self.frames_unplaced, SEARCH_EVERY)
        return self.unplaced and rest == 0 and rounds & (rounds - 1) == 0

    def interrupted(self, dt: float) -> bool:
        """Whether ``dt`` seconds since the last frame are a gap: long, and longer than frames of this stream are apart."""
        return dt > max(LONGEST_BOOKED, LONGEST_GAP * self.spacing) and self.spacing > 0.0


def paper_score(innovation: np.ndarray, R: np.ndarray, found: np.ndarray) -> float:
    """s_k = exp(-1/N_v sum_i |y_i|^2 / trace(R_i)), section 2.6; vertices without a measurement contribute y = 0.

    A frame without any measurement has no innovation to judge by; its score is 0.

    Args:
        innovation: (V, 3) y, metres.
        R: (V, 3, 3) square metres.
        found: (V,) bool.
    """
    if not found.any():
        return 0.0
    energy = np.einsum("va,va->v", innovation, innovation) / np.einsum("vaa->v", R)
    return float(np.exp(-energy[found].sum() / len(found)))


class Evidence(NamedTuple):
    """What a frame says about its own error: contributions to its mean square, square metres but for their weights."""

    misfit: float  # of the cloud from the surface along its normals, over the last half second
    offset: float  # the same in all directions, this frame: a sleeve that lies elsewhere
    strain: float  # squared RMS strain beyond the least so far, times the edge length squared: a wrong fit is crumpled
    correction: float  # mean squared correction of the prediction in the patch where it is largest
    unseen: float  # share of the garment without measurements times its squared travel, remembered for UNSEEN_MEMORY
    unmatched: float  # share of the vertices that a sensor may see without a measurement, times REACH^2


# fitted: benchmarks/reliability.py --fit prints them
WEIGHTS = Evidence(misfit=9.8, offset=18.0, strain=2100.0, correction=0.18, unseen=0.035, unmatched=0.079)


def evidence(
    health: Health, update: Update, position: np.ndarray, velocity: np.ndarray, prior: np.ndarray, points: np.ndarray,
    dt: float, model: Model,
) -> tuple[Evidence, Health]:  # fmt: skip
    """What speaks for and against a frame, and the memory of it.

    Args:
        health: after the last frame.
        update: the finished update.
        position, velocity: (V, 3) of the posterior, metres and metres per second, relative to the body where it carries.
        prior: (V, 3) predicted position, metres.
        points: (N, 3) the cloud as it came, metres.
        dt: seconds since the last frame.
        model: the garment.
    """
    used = update.weight > 0
    speed2 = _follow(health.speed2, float(np.einsum("va,va->", velocity, velocity)) / len(velocity), dt, SPEED_MEMORY)
    travel2 = (1.0 - float(used.mean())) * speed2 * min(dt, LONGEST_BOOKED) * ONE_SECOND
    misfit, offset = health.misfit, health.offset
    if len(points):
        normal = np.empty_like(position)
        vertex_normals(position, model.faces, normal)
        stride = max(1, len(points) // EVIDENCE_POINTS)
        along, offset = kernels.misfit(
            points, stride, position, normal, model.cluster, model.n_clusters, REACH, model.boundary[:, 0], FOREIGN, NEAR
        )
        misfit = _follow(misfit, along, dt, MISFIT_MEMORY)
    strain = kernels.strain(position, model.start, model.neighbour, model.rest_edge)
    health = health._replace(
        speed2=speed2,
        usual_strain=min(health.usual_strain, strain),
        misfit=misfit,
        offset=offset,
        unseen=health.unseen * math.exp(-dt / UNSEEN_MEMORY) + travel2,
    )
    move2 = np.einsum("va,va->v", position - prior, position - prior)
    patch_move2 = np.bincount(model.cluster, move2, model.n_clusters) / np.bincount(model.cluster, minlength=model.n_clusters)
    return Evidence(
        misfit=misfit,
        offset=offset,
        strain=(model.edge_length * (strain - health.usual_strain)) ** 2,
        correction=float(patch_move2.max()),
        unseen=health.unseen,
        unmatched=REACH**2 * float((update.measurement.visible & ~used).mean()),
    ), health


def _follow(old: float, new: float, dt: float, memory: float) -> float:
    return old + (1.0 - math.exp(-dt / memory)) * (new - old)


def predicted_error(found: Evidence, weights: Evidence = WEIGHTS) -> float:
    """Metres: the RMSE that the evidence predicts."""
    return math.sqrt(sum(weight * value for weight, value in zip(weights, found, strict=True)))


def score(error: float, config: Reliability | PaperReliability) -> float:
    """The product's score in [0, 1]: 1 / (1 + (e / e_half)^2) of the predicted error, metres."""
    return 1.0 / (1.0 + (error / config.half_error) ** 2)


def vertex_reliability(sigma: np.ndarray, weight: np.ndarray, config: Reliability | PaperReliability) -> np.ndarray:
    """(V,) in [0, 1]: 1 / (1 + 3 sigma^2 / e_half^2); a measurement that was weighted down counts as much less."""
    trust = np.where(weight > 0, 0.5 + 0.5 * weight, 1.0)
    return trust / (1.0 + 3.0 * np.square(sigma / config.half_error))


class Verdict(NamedTuple):
    """Stage G's answer for a frame."""

    health: Health
    reliability: float
    paper_score: float
    coverage: float
    vertex_reliability: np.ndarray  # (V,)
    evidence: Evidence


def judge(
    health: Health, update: Update, posterior: State, covariance: np.ndarray, prior: State, points: np.ndarray, dt: float,
    model: Model, config: Reliability | PaperReliability,
) -> Verdict:  # fmt: skip
    """Scores a frame and moves the tracker's state on.

    Args:
        health: after the last frame.
        update: the finished update.
        posterior, prior: states of this frame.
        covariance: (V, 3, 3) calibrated, square metres.
        points: (N, 3) the cloud as it came, metres.
        dt: seconds of sensor time since the last frame.
        model: the garment.
        config: ``Reliability`` or ``PaperReliability``.
    """
    coverage = float((update.weight > 0).mean())
    s_k = paper_score(update.measurement.innovation(prior.position), update.R, update.measurement.found)
    found, health = evidence(
        health, update, posterior.position, posterior.velocity, prior.position, points, dt, model
    )
    reliability = score(predicted_error(found), config)
    moved = advance(
        health, s_k if isinstance(config, PaperReliability) else reliability, coverage, len(points), update.rejected, dt, config
    )
    sigma = np.sqrt(np.einsum("vaa->v", covariance) / 3)
    moved = moved._replace(spacing=dt)
    return Verdict(moved, reliability, s_k, coverage, vertex_reliability(sigma, update.weight, config), found)


def advance(
    health: Health, score: float, coverage: float, n_points: int, rejected: bool, dt: float,
    config: Reliability | PaperReliability,
) -> Health:  # fmt: skip
    """The state after a frame.

    Args:
        health: after the last frame.
        score: of this frame; s_k for the paper.
        coverage: share of the vertices observed.
        n_points: in the cloud.
        rejected: the fit was thrown away.
        dt: seconds of sensor time since the last frame.
        config: thresholds.
    """
    calm = health._replace(
        state="tracking", physics_lambda=1.0, poor_for=0.0, empty_for=0.0, frames_unplaced=0, doubtful=False
    )
    worried = calm._replace(state="recovering", physics_lambda=config.recovery_lambda)
    if isinstance(config, PaperReliability):
        return worried if score < config.threshold else calm
    dt = min(dt, LONGEST_BOOKED)
    if n_points == 0:
        # no points say nothing about the fit; only a long silence is a loss
        health = health._replace(empty_for=health.empty_for + dt)
        return health._replace(state="lost") if health.empty_for >= config.lost_after_empty else health
    if rejected or coverage < config.lost_coverage:
        poor_for = health.poor_for + dt
        unplaced = health.frames_unplaced + 1 if health.unplaced else 0
        if poor_for >= config.lost_after or health.state == "lost":
            # the search begins anew with the loss: what is sought then is more than the last shape
            return calm._replace(state="lost", poor_for=poor_for, frames_unplaced=unplaced if health.state == "lost" else 0)
        state = "initializing" if health.state == "initializing" else "recovering"
        return worried._replace(state=state, poor_for=poor_for, frames_unplaced=unplaced)
    if score < config.doubt_below:
        # points are measured, but not where they should be: the garment is looked for, and is not yet lost
        return worried._replace(doubtful=True, frames_unplaced=health.frames_unplaced + 1 if health.unplaced else 0)
    return worried if score < (config.recovery_above if health.state == "recovering" else config.recovery_below) else calm
