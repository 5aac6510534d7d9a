"""Stage G, reliability (paper, section 2.6): the paper's s_k, the product's score, and the tracker's state."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ddakf.config import ErrorEvidence, FrameError, PaperReliability, Reliability
from ddakf.kernels import reliability as kernels
from ddakf.kernels.preprocess import bounds, crop
from ddakf.results import InputWarning
from ddakf.stages import skin_removal
from ddakf.stages.grid import nearest_vertices, spread_rows
from ddakf.types import Estimate, FrameInput, Health, Measurement, Posterior, Problem, variances

IN_VIEW = 0.7  # share of visible vertices, above which sensors see the garment all around; one camera sees half
SHOWN = 0.75  # share of the visible vertices that a cloud shows at least, if the garment is in its place
BESIDE = 0.5  # m from the garment's box, beyond which points are of the room
ENOUGH = 100  # least number of points that can show that a cloud is of the garment alone
FARTHEST_CELL = 10_000  # farthest cell of clumps along an axis, so that the number of a cell fits into an int64


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
    return float(np.exp(-kernels.squared_innovations(innovation, R, found) / len(found)))


def widening(unexplained: float, config: FrameError) -> float:
    """Factor, 1 or more, on the errors of a surface that misses the cloud.

    Args:
        unexplained: share of the points, in clumps, that no vertex is near, over the last half second; see :func:`misfit`.
        config: the law.
    """
    return (1.0 + unexplained / config.unexplained_scale) ** config.unexplained_power


def beside(frame: FrameInput, position: np.ndarray) -> FrameInput:
    """The frame without walls and what else is far from a garment at (V, 3) ``position``, metres; all where little is near."""
    lower, upper, chosen = np.empty(3), np.empty(3), np.empty(len(frame.points), np.int32)
    bounds(position, BESIDE, lower, upper)
    near = chosen[: crop(frame.points, lower, upper, chosen)]
    return frame.only(near) if ENOUGH <= len(near) < len(chosen) else frame


def sample(frame: FrameInput, config: ErrorEvidence) -> FrameInput:
    """Some of a frame's points, spread over all: the configured number, and less than twice as many."""
    n = len(frame.points)
    return frame.only(spread_rows(n, n // max(1, n // config.points)))


def missing(measurement: Measurement) -> bool:
    """Whether the cloud does not show much of a garment that would be in view of all its sensors where it is thought to be."""
    visible, found = measurement.visible, np.count_nonzero(measurement.found)
    seen = 0 if visible is None else np.count_nonzero(visible)
    return bool(seen > IN_VIEW * len(measurement.found) and found < SHOWN * seen)


def misfit(problem: Problem, health: Health, points: np.ndarray, position: np.ndarray, absent: bool = False) -> Health:
    """The memory after points were compared with the vertices nearest to them.

    A cloud of a whole person always has points that no garment explains, and so has one from which skin or colours have removed
    only a part of them. Of such a cloud those do not speak of an offset that are nearest to a boundary or farther than
    ``unexplained_distance``, and those count as unexplained that are within ``reach`` and not nearest to a boundary: the others
    come and go with the wearer. Where a part of the garment is absent from the cloud, such as sleeves that are thought to be
    elsewhere, the unexplained points may be that part. Of a relocalized garment that still settles nothing good is known from
    before, so the frame alone counts; of a first frame's unexplained points as well, and of those of a frame that lacks what
    explained such points in others.

    Args:
        problem: the frame.
        health: after the last frame.
        points: (N, 3) metres, N > 0.
        position: (V, 3) metres.
        absent: see :func:`missing`.
    """
    model, dt, config = problem.model, problem.dt, problem.config.evidence
    near, longest = config.explained_within(model.edge_length), config.reach
    nearest, away = nearest_vertices(points, position, config.reach)
    centred, outside = points - position.mean(axis=0), away > near
    share = clumped(centred[outside], config) / len(points)
    first = health.least_unexplained == 1.0  # nothing has been compared before
    # a few points form no clumps, whatever they are of
    least = min(health.least_unexplained, share) if first or len(points) >= ENOUGH else health.least_unexplained
    remembered = least
    if _explains_less(problem):
        least, remembered = share, health.least_unexplained
    removed = 1.0 - len(problem.garment.points) / len(problem.frame.points)
    foreign = least > config.foreign_rest and least + removed > config.foreign_share
    boundary, left_out = np.zeros((2, len(position)), bool)
    boundary[model.boundary[:, 0]] = True
    if foreign and not absent:
        share = clumped(centred[outside & (nearest >= 0) & ~boundary[nearest]], config) / len(points)
    if foreign or np.count_nonzero(nearest < 0) > config.foreign_share * len(points):
        longest, left_out = near, boundary
    offset = kernels.squared_offset(points, position, nearest, away, longest, left_out, model.cluster, model.n_clusters)
    memory = 0.0 if health.settling else config.memory
    return health._replace(
        offset=_follow(health.offset, offset, dt, memory),
        unexplained=_follow(health.unexplained, share, dt, 0.0 if first else memory),
        least_unexplained=remembered,
    )


def _explains_less(problem: Problem) -> bool:
    """Whether the frame lacks the body's pose or the colours, by which skin and other clothes were told apart in others."""
    last, frame = problem.last, problem.frame
    if frame.body_vertices is None and last.anchor is not None and not np.array_equal(last.body.vertices, last.anchor.bound.pose):
        return True  # the body came with earlier frames, as it has left its first pose
    return frame.colors is None and last.palette is not None


def clumped(points: np.ndarray, config: ErrorEvidence) -> int:
    """Number of (N, 3) points in cells with ``clump_points`` or more; metres."""
    if len(points) < config.clump_points:
        return 0
    cell = np.floor(np.clip(points / config.clump_size, -FARTHEST_CELL, FARTHEST_CELL)).astype(np.int64)
    _, count = np.unique(cell @ [4 * FARTHEST_CELL**2, 2 * FARTHEST_CELL, 1], return_counts=True)
    return int(count[count >= config.clump_points].sum())


def _follow(old: float, new: float, dt: float, memory: float) -> float:
    return new if memory == 0.0 else old + (1.0 - math.exp(-dt / memory)) * (new - old)


def score(error, config: Reliability | PaperReliability):
    """1 / (1 + (e / e_half)^2), in [0, 1], of a predicted error e, or an array of them, in metres."""
    return 1.0 / (1.0 + np.square(error / config.half_error))


def vertex_error(error: float, variance: np.ndarray) -> np.ndarray:
    """(V,) metres: predicted errors, of the RMS ``error`` of the frame and in proportion to the vertices' standard deviations.

    Args:
        error: of the frame, metres.
        variance: (V,) square metres, above 0.
    """
    return error * np.sqrt(variance / variance.mean())


class Verdict(NamedTuple):
    """Stage G's answer for a frame."""

    health: Health
    reliability: float
    paper_score: float
    vertex_reliability: np.ndarray  # (V,)
    widening: float = 1.0  # factor on the calibrated standard deviations, for a surface that misses the cloud
    warnings: tuple[InputWarning, ...] = ()  # of wrong input
    signs: Mapping[str, int] = {}  # of wrong input, by code: frames in a row that had them


def judge(problem: Problem, estimate: Estimate, posterior: Posterior) -> Verdict:
    """Scores a frame and moves the tracker's state on."""
    config, measurement = problem.config.reliability, estimate.terms.measurement
    coverage = float(estimate.observed.mean())
    s_k = paper_score(measurement.innovation(problem.prior.position), estimate.terms.R, measurement.found)
    near, margin = beside(problem.garment, posterior.state.position), problem.config.skin_removal.cloth_distance
    cloud = sample(near, problem.config.evidence)
    points = skin_removal.remove_skin(cloud, problem, posterior.state.position, margin).points
    health = problem.health
    if len(points):
        health = misfit(problem, health, points, posterior.state.position, missing(measurement))
    law = problem.config.frame_error
    wider = widening(health.unexplained, law)
    variance = 3.0 * variances(posterior.covariance)
    sigma = math.sqrt(variance.mean())
    error = law.sigma_share * wider * sigma
    if problem.lacks_place(estimate.observed):
        error = max(error, problem.config.sidedness.blind_error)
    errors = vertex_error(error, variance)
    reliability = float(score(error, config))
    # no search and no stiffer cloth helps against a turn that nothing shows, and size and colours are learned all the same
    seen = math.sqrt(max(1.0 - posterior.turned2 / max(sigma**2, 1e-24), 0.0))
    but_turned = float(score(seen * error, config))
    paper, enough = isinstance(config, PaperReliability), len(problem.frame.points) >= problem.config.start.least_points
    outcome = Outcome(s_k if paper else but_turned, coverage, len(points), estimate.rejected, enough)
    moved = advance(health, outcome, problem.dt, config)
    spacing = problem.last.health.spacing if problem.last.time is None else problem.dt
    gap = health.rim_gap if measurement.hem is None else measurement.hem.rim_gap
    moved = moved._replace(spacing=spacing, reliability=but_turned, rim_gap=gap)
    return Verdict(moved, reliability, s_k, score(errors, config), wider)


class Outcome(NamedTuple):
    """A frame as the state of the tracker depends on it."""

    score: float  # reliability of this frame, without the turns that nothing shows; s_k for the paper
    coverage: float  # share of the vertices observed
    n_points: int  # number of points of the cloud near the garment
    rejected: bool  # the fit was thrown away
    searchable: bool = True  # the frame has enough points for a search, also of other things than the garment


def advance(health: Health, outcome: Outcome, dt: float, config: Reliability | PaperReliability) -> Health:
    """The state after a frame.

    Args:
        health: after the last frame.
        outcome: of this frame.
        dt: seconds of sensor time since the last frame.
        config: thresholds.
    """
    score, coverage, n_points, rejected, searchable = outcome
    calm = health._replace(
        state="tracking", physics_lambda=1.0, poor_for=0.0, empty_for=0.0, frames_unplaced=0, doubtful=False
    )
    worried = calm._replace(state="recovering", physics_lambda=config.recovery_lambda)
    if isinstance(config, PaperReliability):
        return worried if score < config.threshold else calm
    dt = min(dt, config.longest_frame)
    unplaced = health.frames_unplaced + searchable if health.unplaced else 0
    if n_points == 0:
        # no points say nothing about the fit; only a long silence is a loss
        health = health._replace(empty_for=health.empty_for + dt, frames_unplaced=unplaced or health.frames_unplaced)
        if health.empty_for >= config.lost_after_empty:
            return health._replace(state="lost")
        faded = health.state == "tracking" and score < config.recovery_below
        return health._replace(state="recovering", physics_lambda=config.recovery_lambda) if faded else health
    if rejected or coverage < config.lost_coverage:
        poor_for = health.poor_for + dt
        if poor_for >= config.lost_after or health.state == "lost":
            # the search begins anew with the loss: then it tries the template too
            return calm._replace(state="lost", poor_for=poor_for, frames_unplaced=unplaced if health.state == "lost" else 0)
        state = "initializing" if health.state == "initializing" else "recovering"
        return worried._replace(state=state, poor_for=poor_for, frames_unplaced=unplaced)
    if score < config.doubt_below:
        # vertices are measured, but badly: the garment is searched, and is not yet lost
        return worried._replace(doubtful=True, frames_unplaced=unplaced)
    return worried if score < (config.recovery_above if health.state == "recovering" else config.recovery_below) else calm
