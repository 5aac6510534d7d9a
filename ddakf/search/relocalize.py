"""Relocalization: the pose of a garment without a track, first as a rigid motion about the vertical, then registered."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ddakf.appearance import segmentation
from ddakf.config import Config, Relocalization
from ddakf.kernels.reliability import strains
from ddakf.kernels.relocalize import mean_distance
from ddakf.kernels.visibility import VisibilityLimits, mark_visible
from ddakf.physics import rigidity
from ddakf.physics.size import stretched
from ddakf.search.candidate_poses import (
    FARTHEST,
    CandidatePose,
    HeadingPrior,
    Search,
    Surface,
    candidate_poses,
    cost_in_place,
    distances,
    negative_log_posterior,
    turn_between,
    turned,
)
from ddakf.search.nonrigid_registration import NO_ORIGIN, NO_SURFELS, Target, register, rows
from ddakf.stages import skin_removal
from ddakf.stages.grid import spread_rows
from ddakf.types import Drift, FrameInput, Health, Problem, Rival, State

MOST_ROUNDS = 32  # of the search interval between searches, however long the garment has not been found
LONGEST_WAIT = 5.0  # s between them, however far the frames are apart
ON_BODY = 0.2  # m, mean distance from the body of a garment that is on it, at most
LEAST_SEEN = 0.25  # of the vertices that face a sensor; a garment of which less is seen is not where it was predicted
OUT_OF_SIGHT = -1.0  # cost of staying of a garment that something hides: there is nothing to judge it by
BODY_SAMPLES = 1500  # vertices of the body to which the garment's distance is measured


def locate(problem: Problem) -> Problem:
    """The problem with its prior laid on the cloud where the tracker has no track; otherwise unchanged.

    A cloud that lies elsewhere is searched before the first fit, after a loss, and when the garment was out of sight or without
    a fit lately. A relocalized garment is registered again in the ``settling_frames`` that follow. A search that exceeds the
    frame's budget is due in the next one. Without a body a prediction over a long step is registered as well, if it misses the
    cloud.
    """
    health, allowed = problem.health, problem.effort.search
    if not due(problem):
        return _catch_up(problem) if allowed and far_ahead(problem) else problem
    search_now = search_due(health, problem.config.relocalization) or _after_gap(problem)
    if not allowed:
        return problem._replace(health=health._replace(postponed=search_now, settling=max(health.settling - 1, 0)))
    if not search_now:
        return _settle(problem)
    return _search(problem._replace(health=health._replace(postponed=False)))


def _search(problem: Problem) -> Problem:
    """The problem with its prior where a search finds the garment; unchanged where it does not.

    A prediction that the cloud confirms is kept. Otherwise the search lays the last shape on the cloud, and beside it the
    template where that shape may be as wrong as the place. In a cloud of more than the garment, such as a whole person's, it is
    repeated with what is the garment by colour or place, as it was found.
    """
    config, rule, turn = problem.config, problem.config.relocalization, problem.config.start.to_y_up
    frame = segmentation.of_garment_colors(problem.frame, problem)
    without_skin = skin_removal.remove_skin(frame, problem, problem.prior.position, config.skin_removal.cloth_distance)
    staying = _cost_of_staying(without_skin, problem)
    if staying == OUT_OF_SIGHT:
        return problem
    if staying < rule.in_place_cost:
        return _confirm_prediction(problem)
    frame, search = _search_space(frame, problem)
    if len(frame.points) < config.start.least_points:
        return problem
    shapes, heading = _shapes(problem), _heading_prior(problem)
    fit = _best_fit(shapes, search, heading)
    if fit.cost > rule.in_place_cost:
        problem = problem._replace(overturned=_overturned(shapes[-1], search, heading))
    accepted = fit.cost <= min(rule.cost_ratio * staying, rule.highest_cost)
    place = problem.prior.position if math.isinf(fit.cost) else fit.position @ turn
    garment = _of_garment(frame, place, problem)
    if garment is not frame:
        narrowed = _best_fit(shapes, search._replace(target=_target(garment, config)), heading)
        narrowed_accepted = narrowed.cost <= min(rule.cost_ratio * staying, rule.narrowed_cost)
        if narrowed_accepted or narrowed.cost < fit.cost:
            fit, accepted = narrowed, accepted or narrowed_accepted
    return _relocalize(problem, fit) if accepted else problem


def _confirm_prediction(problem: Problem) -> Problem:
    """The problem of a garment that is where it was predicted; one that was out of sight gets the covariance of a found one.

    The covariance that has grown out of sight would let each vertex follow its own points.
    """
    if problem.health.empty_for > 0.0 or _after_gap(problem):
        return _found_at(problem, problem.prior.position, problem.prior.velocity)
    return problem


def _shapes(problem: Problem) -> list[np.ndarray]:
    """(V, 3) metres each: the shapes that are sought: the last one, and the template where that one may be torn.

    The prediction is not sought: over a gap velocities tear it.
    """
    turn = problem.config.start.to_y_up
    last = problem.motion_start @ turn.T
    unplaced = problem.health.unplaced and problem.health.state != "initializing"
    if not (unplaced or _after_gap(problem)):
        return [last]
    template = stretched(problem.model.mesh.vertices, problem.last.size) @ turn.T
    # turned as the last shape: the template's file says nothing of where the wearer faces
    return [last, turned(template, turn_between(template, last))]


def _heading_prior(problem: Problem) -> HeadingPrior:
    """How far the garment may have turned: the longer it was not seen the farther, and any way before the first fit."""
    rule, health = problem.config.relocalization, problem.health
    unseen = problem.dt + health.empty_for + health.poor_for
    doubt = rule.heading_doubt if _start_unknown(problem) else 0.0
    return HeadingPrior(math.radians(rule.heading_sd + rule.heading_rate * unseen), doubt)


def _start_unknown(problem: Problem) -> bool:
    """Whether there was no fit yet, and no start that the caller gave, which faces as the wearer does."""
    given = problem.resting is not None and problem.resting.given
    return problem.health.state == "initializing" and not given


def _relocalize(problem: Problem, fit: Fit) -> Problem:
    """The problem of a garment that is at rest where a search found it.

    Another heading that suits the garment counts, unless the caller gave the start.
    """
    position = fit.position @ problem.config.start.to_y_up
    rival = fit.rival if _start_unknown(problem) or problem.health.state != "initializing" else None
    settling = problem.config.relocalization.settling_frames
    problem = _found_at(problem, position, np.zeros_like(position))
    if rival is not None:
        drift = problem.last.drift
        drift = drift._replace(unseen_turn=max(drift.unseen_turn, rival.expected))
        problem = problem._replace(last=problem.last._replace(drift=drift))
    return problem._replace(
        motion_start=position,
        rival=rival,
        rotation=rigidity.rotations(position, problem.model),
        health=problem.health.relocalized()._replace(settling=settling),
    )


def _search_space(frame: FrameInput, problem: Problem) -> tuple[FrameInput, Search]:
    """The points of a frame that may be of the garment, and the search in them.

    A worn garment is within FARTHEST of its body, and in the mean about as near to it as predicted; elsewhere is something else,
    such as a neighbour. A body that the garment was not on before, or that a first cloud is not near, may be given wrongly: it is
    not asked.
    """
    config, prior, body = problem.config, problem.prior, problem.body
    rule, turn = config.relocalization, config.start.to_y_up
    search = Search(problem.model, _target(frame, config), config, problem.last.size)
    if body is None:
        return frame, search
    worn = search._replace(body=rows(body.vertices[spread_rows(len(body.vertices), BODY_SAMPLES)] @ turn.T))
    away = worn.off_body(prior.position @ turn.T)
    if problem.health.state == "initializing":
        doubtful = _near(frame, prior.position, rule.truncation).sum() < config.start.least_points
    else:
        doubtful = away > ON_BODY
    if doubtful:
        return frame, search
    near = _near(frame, body.vertices, FARTHEST)
    if near.any():
        worn = worn._replace(target=_target(frame.only(near), config), farthest=away + rule.off_body)
    return frame.only(near), worn


def _found_at(problem: Problem, position: np.ndarray, velocity: np.ndarray) -> Problem:
    """The problem whose prior is a garment as a search finds it, (V, 3) metres and metres per second; its R is kept."""
    sd = problem.config.relocalization.found_sd
    start = State.at(position, velocity, sd, problem.config.start.speed_sd, 1.0)
    drift = Drift.at(problem.model, sd)._replace(unseen_turn=problem.last.drift.unseen_turn)  # a search sees it no better
    last = problem.last._replace(drift=drift)
    return problem._replace(prior=start._replace(R=problem.prior.R), last=last)


def _of_garment(frame: FrameInput, position: np.ndarray, problem: Problem) -> FrameInput:
    """The frame without what is something else than the garment, if that is at (V, 3) ``position``, metres, or about there.

    Of a cloud of more than the garment are left the points in its colours, or where those are not told apart, the points near it.
    """
    config, radius = problem.config, problem.config.relocalization.narrow_distance
    if radius == 0.0:
        return frame
    near = _near(frame, position, radius)
    if near.mean() >= 1.0 - config.evidence.foreign_share or np.count_nonzero(near) < config.start.least_points:
        return frame
    coloured = segmentation.of_garment_colors(frame, problem, position)
    return frame.only(near) if coloured is frame else coloured


def _overturned(shape: np.ndarray, search: Search, prior: HeadingPrior) -> tuple[float, float] | None:
    """Metres: the costs of the best rigid poses upright and upside down, where the second is much lower; otherwise None."""
    upright, over = (candidate_poses(shape * way, search, prior)[0].cost for way in ([1, 1, 1], [1, -1, -1]))
    return (upright, over) if over < search.config.relocalization.overturned_ratio * upright else None


def due(problem: Problem) -> bool:
    """Whether :func:`locate` has something to do: a search, or a registration after one."""
    wanted = search_due(problem.health, problem.config.relocalization) or _after_gap(problem)
    return _searchable(problem) and (wanted or problem.health.settling > 0)


def far_ahead(problem: Problem) -> bool:
    """Whether :func:`locate` looks at a prediction that may miss the cloud, as its step is long and no body carries it."""
    return _searchable(problem) and problem.body is None and problem.dt > problem.config.relocalization.register_beyond


def _searchable(problem: Problem) -> bool:
    start = problem.config.start
    return start.search and len(problem.frame.points) >= start.least_points


def search_due(health: Health, config: Relocalization) -> bool:
    """Whether the frame is searched: a search takes as long as several frames, and a stream of nonsense must not stall."""
    rounds, rest = divmod(health.frames_unplaced, config.search_interval)
    longest = LONGEST_WAIT / max(config.search_interval * health.spacing, LONGEST_WAIT / MOST_ROUNDS)
    chosen = rounds & (rounds - 1) == 0 or rounds % max(int(longest), 1) == 0  # ever more rarely, and then regularly
    return health.postponed or (health.unplaced and rest == 0 and chosen)


def interrupted(health: Health, dt: float, config: Relocalization) -> bool:
    """Whether ``dt`` seconds since the last frame are a gap: long, and longer than the frames of this stream are apart."""
    return dt > max(config.shortest_gap, config.gap_ratio * health.spacing) and health.spacing > 0.0


def _after_gap(problem: Problem) -> bool:
    """Whether the frame comes after a gap of the stream."""
    return interrupted(problem.health, problem.dt, problem.config.relocalization)


def _settle(problem: Problem) -> Problem:
    """The problem of a garment that was found a few frames ago, its prior registered to the cloud."""
    prior, model, config = problem.prior, problem.model, problem.config
    health = problem.health._replace(settling=problem.health.settling - 1)
    frame = segmentation.of_garment_colors(problem.frame, problem)
    garment = skin_removal.remove_skin(frame, problem, prior.position, config.skin_removal.cloth_distance)
    if len(garment.points) == 0:
        return problem._replace(health=health)
    garment = _of_garment(garment, prior.position, problem)
    turn, settling = config.start.to_y_up, config.registration.settling()
    position = register(prior.position @ turn.T, _target(garment, config), model, settling) @ turn
    prior = _with_position(prior, position, config.relocalization.settling_sd)
    return problem._replace(prior=prior, motion_start=position, rotation=rigidity.rotations(position, model), health=health)


def _catch_up(problem: Problem) -> Problem:
    """The problem of a garment that was tracked, its prior registered to a cloud that it misses.

    What moves on its own is predicted badly over a long step, and passes over all vertices do not reach as far.
    """
    prior, model, config = problem.prior, problem.model, problem.config
    rule, turn = config.relocalization, config.start.to_y_up
    frame = segmentation.of_garment_colors(problem.frame, problem)
    staying = _cost_of_staying(frame, problem)
    if staying < rule.in_place_cost:
        return problem
    target = _target(_of_garment(frame, prior.position, problem), config)
    position = register(prior.position @ turn.T, target, model, config.registration.catching_up()) @ turn
    caught = problem._replace(prior=_with_position(prior, position, rule.settling_sd))
    if not 0.0 <= _cost_of_staying(frame, caught) <= rule.cost_ratio * staying:  # nor is it hidden there
        return problem
    return caught._replace(motion_start=position, rotation=rigidity.rotations(position, model))


def _with_position(prior: State, position: np.ndarray, sd: float) -> State:
    """The prior at a registered (V, 3) ``position``, metres, its velocity corrected by the change of the position.

    A garment is found at rest, and the fit that follows sees little more than the rest that registration left. Without this
    correction the garment would not learn its motion, and would be lost again after the last registration. The covariance stays,
    as the fit measures the same points.
    """
    noise = prior.P_pp + sd**2 * np.eye(3)
    correction = np.linalg.solve(noise, (position - prior.position)[:, :, None])
    velocity = prior.velocity + np.einsum("vba,vb->va", prior.P_pu, correction[:, :, 0])
    return prior._replace(position=position, velocity=velocity)


def _target(frame: FrameInput, config: Config) -> Target:
    """The cloud of a frame, its world turned so that y points upward."""
    return Target.from_points(frame.points, frame.sensor_origin, config.registration, config.start.to_y_up)


def _near(frame: FrameInput, vertices: np.ndarray, distance: float) -> np.ndarray:
    """(N,) bool: points within so many metres of (V, 3) vertices."""
    return ~skin_removal.apart(frame.points, vertices, distance)


def _cost_of_staying(garment: FrameInput, problem: Problem) -> float:
    """Metres: the cost of the prediction; of a cloud of more than the garment, that of :func:`_cost_of_the_seen`.

    A start that the first cloud lies on is right, however little of it is seen.
    """
    position, config = problem.prior.position, problem.config.relocalization
    if len(garment.points) == 0:
        return config.truncation
    near = _near(garment, position, config.truncation)
    if near.mean() < 1.0 - problem.config.evidence.foreign_share:
        return _cost_of_the_seen(garment, near, problem)
    target = _target(garment, problem.config)
    surface = Surface.from_garment(position @ problem.config.start.to_y_up.T, problem.model, target)
    there, back = distances(surface, target, config.cost_samples, config)
    if problem.health.state == "initializing" and there < config.partial_view_cost:
        return there
    return 0.5 * (there + back)


def _cost_of_the_seen(frame: FrameInput, near: np.ndarray, problem: Problem) -> float:
    """Metres: mean truncated distance from the vertices that nothing hides from a sensor to the cloud.

    Where hardly a vertex is left, a garment that was tracked is :data:`OUT_OF_SIGHT` until it is lost. One that was not is behind
    what it should be, and all vertices that face a sensor count.

    Args:
        frame: the cloud, of more than the garment.
        near: (N,) bool, points that are not farther than the truncation.
        problem: of the frame.
    """
    config, rule, model = problem.config.relocalization, problem.config.registration, problem.model
    scene, turn = _target(frame, problem.config), problem.config.start.to_y_up
    surface = Surface.from_garment(problem.prior.position @ turn.T, model, scene)
    asked = surface.facing(scene)  # 1 for each vertex that counts
    if scene.sensors is not None:
        limits = VisibilityLimits(rule.occluder_cell * model.edge_length, rule.hidden_depth, rule.facing_cosine)
        between = frame.points[spread_rows(len(near), rule.input_points)].astype(np.float64) @ turn.T - scene.origin
        seen = np.empty(len(asked), bool)
        mark_visible(surface.position, surface.normal, between, NO_SURFELS, NO_ORIGIN, scene.sensors, limits, seen)
        if (asked * seen).sum() >= LEAST_SEEN * asked.sum():
            asked *= seen
        elif problem.health.state in ("tracking", "recovering"):
            return OUT_OF_SIGHT
    if not near.any():
        return config.truncation
    target = _target(frame.only(near), problem.config)
    surface = surface._replace(position=surface.position + (scene.origin - target.origin))
    few, answers = rows(surface.sampled(config.cost_samples).position), np.ones(target.dense.shape[1], np.float32)
    every = max(1, len(asked) // config.cost_samples)
    return mean_distance(few, target.dense, np.ascontiguousarray(asked[::every]), answers, config.truncation)


class Fit(NamedTuple):
    """A shape that a search has laid on a cloud, in the world turned so that y points upward."""

    position: np.ndarray  # (V, 3) m
    cost: float  # m, see :func:`cost_in_place`; infinite where no candidate is on the body
    rival: Rival | None  # another heading that suits the cloud


class Trial(NamedTuple):
    """A candidate pose whose shape was registered to the cloud."""

    position: np.ndarray  # (V, 3) m, registered
    cost: float  # m, see :func:`cost_in_place`
    pose: CandidatePose  # with the cost after registration, which strain and the template's shape increase
    off_body: bool  # farther from the body than a garment that is worn
    order: float  # negative logarithm of the posterior probability of the pose


def _best_fit(shapes: list[np.ndarray], search: Search, prior: HeadingPrior) -> Fit:
    """The shape that fits the cloud best after registration.

    The wrong heading may fit as well as the right one until both are registered. Where no candidate is on the body, something
    else fits.
    """
    model, config, schedule = search.model, search.config.relocalization, search.config.registration.trial()
    trials, squared = [], np.empty(len(shapes[0]))
    rest_length = np.linalg.norm(stretched(model.rest_edge, search.size), axis=1)
    for k, shape in enumerate(shapes):
        for pose in candidate_poses(shape, search, prior)[: config.candidates]:
            position = register(pose.apply(shape), search.target, model, schedule)
            cost = cost_in_place(position, search)
            strain = math.sqrt(strains(position, model.start, model.neighbour, rest_length, squared))
            pose = pose._replace(cost=(cost + config.strain_cost * strain) * (1.0 + config.template_cost * k))
            order = negative_log_posterior(pose, config.registered_samples, prior)
            trials.append(Trial(position, cost, pose, search.off_body(position) > search.farthest, order))
    best = min(trials, key=lambda trial: (trial.off_body, trial.order))
    return Fit(best.position, math.inf if best.off_body else best.cost, _rival(best, trials, config, prior))


def _rival(best: Trial, trials: list[Trial], config: Relocalization, prior: HeadingPrior) -> Rival | None:
    """Of the other headings that by which the garment is off most, if each is right with a probability that falls with its cost.

    A garment that is alike from several sides, such as a skirt, fits in each of them. Where it was tracked before, it is less
    likely to have turned far.
    """
    rivals, tracked = [], prior.doubt == 0.0
    for trial in trials:
        pose, turn = trial.pose, turn_between(best.position, trial.position)
        if abs(math.degrees(turn)) >= config.heading_separation:
            excess = (pose.cost / max(best.pose.cost, 1e-12) - 1.0) / config.rival_excess
            if tracked:
                excess += prior.cost(pose.heading) - prior.cost(best.pose.heading)
            expected = 2.0 * math.sin(abs(turn) / 2.0) * math.exp(-max(excess, 0.0))
            rivals.append(Rival(math.degrees(turn), expected))
    return max(rivals, key=lambda rival: rival.expected, default=None)
