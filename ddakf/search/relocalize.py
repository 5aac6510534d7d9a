"""Initialisation: where the garment is when the tracker does not know, first as a rigid motion about the vertical."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ddakf.kernels.associate import vertex_normals
from ddakf.kernels.reliability import strains
from ddakf.kernels.relocalize import OrientedPoints, OrientedVertices, Pairing, correspond, mean_distance
from ddakf.physics import rigidity
from ddakf.search import nonrigid_registration
from ddakf.search.nonrigid_registration import Target, rows
from ddakf.stages import skin_removal
from ddakf.stages.reliability import FOREIGN, LONGEST_BOOKED
from ddakf.types import Drift, FrameInput, Health, Model, Problem, State

HEADINGS = 8
FEW_POINTS, FEW_VERTICES = 100, 300  # of the cloud and the garment, while all headings are tried
FINE_POINTS, FINE_VERTICES = 200, 500  # for the finalists
FINALISTS = 4
# m: pairs of points and vertices farther apart are none, step by step, while all headings are tried and for the finalists
FIRST_REACHES, LAST_REACHES = np.geomspace(0.40, 0.15, 5), np.geomspace(0.15, 0.06, 4)
BESIDE, LONGEST_TURN = 0.05, 0.5  # weight of a goal beside the normal; rad, in a step
ROUNDS, OUTLIER = 1, 0.1  # towards one to one; weight of a point's belonging to nothing
ASKED, ANSWERS = 150, 2500  # points and vertices whose distance is asked for, and vertices that it may be to
DENSER = 20  # times as many points as are asked for, that the distance of a vertex may be to
TRUNCATION = 0.10  # m: points farther from the garment count as this far
NEAR = 0.015  # m: a cost in place below it is that of a garment in its place
PARTLY = 0.010  # m: a cost of the cloud alone below it is that of a start in its place, of which a part is seen
ALIKE = 0.04  # m: a cost above it is that of something else, wherever the garment is laid
GAIN = 0.8  # share of the cost in place that a found placement must stay below
FOUND_SD = 0.03  # m, of the vertices of a garment that was found
SETTLING, BENT_SD = 4, 0.01  # frames after a search in which it is bent further; m, of a vertex that was
DISTINCT = np.radians(30.0)  # between headings that are bent apart
BENT, ROUGH_STEPS, ROUGHER = 3, 10, 2  # headings of each shape that are bent, how long, and of how many times fewer vertices
STRAIN_LENGTH = 0.03  # m: what a strain of 1 costs, as the wrong heading fits only a garment that is pulled about
TEMPLATE_COST = 0.05  # by so much more the template costs than the last shape
# distances of a cost whose errors do not go together, so that it is as sharp as so many: of a rigid garment, of a bent one
INDEPENDENT_RIGID, INDEPENDENT = 6.0, 20.0
TURN_SD, TURN_RATE = np.radians(30.0), np.radians(20.0)  # rad, rad/s: how far a wearer turns at once, and while out of sight
SEARCH_EVERY = 5  # frames without a track, at first; then after 10, 20, 40 ...
LONGEST_GAP = 3.0  # times the spacing of the frames before


class Placement(NamedTuple):
    """x -> rotation x + translation, and how well garment and cloud then lie on each other."""

    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,) m
    cost: float  # m, mean truncated distance: half of it cloud to garment, half of it garment to cloud

    def apply(self, positions: np.ndarray) -> np.ndarray:
        return positions @ self.rotation.T + self.translation


class Shape(NamedTuple):
    """Vertices that may be laid on a cloud, relative to its origin."""

    position: np.ndarray  # (M, 3) m
    normal: np.ndarray  # (M, 3) unit
    share: np.ndarray  # (M,) float32 area over the mean

    @classmethod
    def of(cls, position: np.ndarray, model: Model, target: Target) -> Shape:
        normal = np.empty_like(position)
        vertex_normals(position, model.faces, normal)
        return cls(position - target.origin, normal, model.vertex_share)

    def some(self, count: int) -> Shape:
        """About so many of them."""
        every = max(1, len(self.position) // count)
        return Shape(self.position[::every], self.normal[::every], self.share[::every])

    def placed(self, rotation: np.ndarray, translation: np.ndarray) -> Shape:
        return Shape(self.position @ rotation.T + translation, self.normal @ rotation.T, self.share)

    def facing(self, target: Target) -> np.ndarray:
        """(M,) float32: 1 where it faces a sensor."""
        if target.sensors is None:
            return np.ones(len(self.position), np.float32)
        towards = target.sensors[:, None] - self.position[None]
        return (np.einsum("va,sva->sv", self.normal, towards) > 0).any(axis=0).astype(np.float32)


def places(position: np.ndarray, model: Model, target: Target, turn_sd: float = TURN_SD) -> list[Placement]:
    """Rigid motions that lay a garment on a cloud, the best first; their headings are :data:`DISTINCT` apart.

    Headings all around are tried on a few points, the best of them on more, each by soft correspondences that grow closer. Most
    garments look alike from several sides: a heading costs the more the farther it is from the present one.

    Args:
        position: (V, 3) metres.
        model: the garment.
        target: the cloud.
        turn_sd: how far it may have turned, rad.
    """
    shape = Shape.of(position, model, target)
    rough, fine = shape.some(FEW_VERTICES), shape.some(FINE_VERTICES)
    tried = []
    for angle in 2 * np.pi * np.arange(HEADINGS) / HEADINGS:
        rotation, translation = _started(rough, target, angle)
        rotation, translation = _aligned(rough, target, FEW_POINTS, rotation, translation, FIRST_REACHES, False)
        cost = _cost(rough.placed(rotation, translation), target, FEW_POINTS)
        tried.append((_negative_log_posterior(cost, INDEPENDENT_RIGID, rotation, turn_sd), len(tried), rotation, translation))
    tried.sort()
    found: list[Placement] = []
    for _, _, rotation, translation in tried[:FINALISTS]:
        rotation, translation = _aligned(fine, target, FINE_POINTS, rotation, translation, LAST_REACHES, True)
        cost = _cost(fine.placed(rotation, translation), target, ASKED)
        # of the garment in the world: x -> R (x - o) + t + o
        found.append(Placement(rotation, translation + target.origin - rotation @ target.origin, cost))
    found.sort(key=lambda placement: _negative_log_posterior(placement.cost, INDEPENDENT_RIGID, placement.rotation, turn_sd))
    apart: list[Placement] = []
    for placement in found:
        if all(np.trace(placement.rotation.T @ other.rotation) < 1 + 2 * np.cos(DISTINCT) for other in apart):
            apart.append(placement)
    return apart


def cost_in_place(position: np.ndarray, model: Model, target: Target) -> float:
    """Metres: the cost of leaving a garment where it is; arguments as for :func:`places`."""
    return _cost(Shape.of(position, model, target), target, ASKED)


def _negative_log_posterior(cost: float, independent: float, rotation: np.ndarray, turn_sd: float) -> float:
    """Distances of unknown scale (Laplace), a heading that is normal about the present."""
    heading = np.arctan2(rotation[0, 2], rotation[0, 0])
    return independent * np.log(cost) + 0.5 * (heading / turn_sd) ** 2


def _started(shape: Shape, target: Target, heading: float) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and the translation (3,) that makes the middles coincide, of the side that is seen."""
    rotation, middle = _turned(heading), np.median(target.points, axis=1)
    turned = shape.placed(rotation, np.zeros(3))
    if target.sensors is None:
        return rotation, middle - turned.position.mean(axis=0)
    # as seen from where the garment will be
    towards = target.sensors - middle
    seen = (turned.normal @ towards.T > 0).any(axis=1)
    return rotation, middle - turned.position[seen].mean(axis=0) if seen.any() else middle - turned.position.mean(axis=0)


def _aligned(
    shape: Shape, target: Target, count: int, rotation: np.ndarray, translation: np.ndarray, reaches: np.ndarray, along: bool
) -> tuple[np.ndarray, np.ndarray]:
    """A placement after a step on ``count`` of the points with each of the ``reaches``, metres; ``along`` the normals, or in all
    directions."""
    every = max(1, target.points.shape[1] // count)
    points = OrientedPoints(*target.thinned(every))
    N, M = len(points.signed), len(shape.position)
    pair, mass, goal = np.empty((N, M), np.float32), np.empty(M, np.float32), np.empty((3, M), np.float32)
    for reach in reaches:
        placed = shape.placed(rotation, translation)
        vertices = OrientedVertices(rows(placed.position), rows(placed.normal), placed.share * placed.facing(target))
        correspond(vertices, points, Pairing(reach, ROUNDS, OUTLIER), pair, mass, goal)
        if not mass.any():
            break
        solve = _towards_planes if along else _towards_points
        rotation, translation = solve(shape, placed, mass.astype(np.float64), goal.T, rotation, translation)
    return rotation, translation


def _towards_points(shape: Shape, placed: Shape, mass, goal, rotation, translation) -> tuple[np.ndarray, np.ndarray]:
    """The placement that brings vertices nearest to their goals (M, 3), with weights (M,)."""
    weight = mass / mass.sum()
    a, b = weight @ shape.position, weight @ goal
    arm, wanted = (shape.position - a) * weight[:, None], goal - b
    # the heading alone: a garment lying flat on its cloud would be no solution
    cosine = np.vdot(arm[:, 0], wanted[:, 0]) + np.vdot(arm[:, 2], wanted[:, 2])
    sine = np.vdot(arm[:, 2], wanted[:, 0]) - np.vdot(arm[:, 0], wanted[:, 2])
    rotation = _turned(np.arctan2(sine, cosine))
    return rotation, b - rotation @ a


def _towards_planes(shape: Shape, placed: Shape, mass, goal, rotation, translation) -> tuple[np.ndarray, np.ndarray]:
    """One Gauss-Newton step to goals that count along the normals: of nearly round cloth the heading gets there sooner."""
    weight = mass / mass.sum()
    middle = weight @ placed.position
    arm = placed.position - middle
    jacobian = np.zeros((len(mass), 3, 4))
    jacobian[:, 0, 0], jacobian[:, 2, 0] = arm[:, 2], -arm[:, 0]
    jacobian[:, :, 1:] = np.eye(3)
    off = goal - placed.position
    along, beside = np.einsum("ma,mab->mb", placed.normal, jacobian), np.einsum("ma,ma->m", placed.normal, off)
    A = np.einsum("m,mb,mc->bc", (1.0 - BESIDE) * weight, along, along)
    A += np.einsum("m,mab,mac->bc", BESIDE * weight, jacobian, jacobian)
    b = (1.0 - BESIDE) * (weight * beside) @ along + BESIDE * np.einsum("m,mab,ma->b", weight, jacobian, off)
    step = np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(4), b)
    more = _turned(np.clip(step[0], -LONGEST_TURN, LONGEST_TURN))
    # x -> more (R x + t - middle) + middle + step
    return more @ rotation, more @ (translation - middle) + middle + step[1:]


def _cost(shape: Shape, target: Target, count: int) -> float:
    """Metres: half the sum of :func:`_halves`."""
    return 0.5 * sum(_halves(shape, target, count))


def _halves(shape: Shape, target: Target, count: int) -> tuple[float, float]:
    """Metres each: mean truncated distance cloud to garment and, of the vertices that face a sensor, garment to cloud."""
    many, few = shape.some(ANSWERS), shape.some(count)
    points = np.ascontiguousarray(target.points[:, :: max(1, target.points.shape[1] // count)])
    dense = np.ascontiguousarray(target.dense[:, :: max(1, target.dense.shape[1] // (DENSER * count))])
    asked, answers = np.ones(points.shape[1], np.float32), np.ones(dense.shape[1], np.float32)
    there = mean_distance(points, rows(many.position), asked, many.facing(target), TRUNCATION)
    back = mean_distance(rows(few.position), dense, few.facing(target), answers, TRUNCATION)
    return there, back


def _turned(angle: float) -> np.ndarray:
    """(3, 3) rotation about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def locate(problem: Problem) -> Problem:
    """The problem with its prior laid on the cloud where the tracker has no track; otherwise as it came.

    A cloud that lies elsewhere is searched before the first fit, after a loss, and when the garment was out of sight or without
    a fit lately. What is laid on it is the last shape, and beside it the template where that shape may be as wrong as the place.
    A relocalized garment is registered further in the :data:`SETTLING` frames that follow.
    """
    prior, model, frame, health, config = problem.prior, problem.model, problem.frame, problem.health, problem.config.start
    last = problem.motion_start
    if not config.search or len(frame.points) < config.least_points:
        return problem
    after_gap = interrupted(health, problem.dt)
    if not (search_due(health) or after_gap):
        return _settled(problem) if health.settling else problem
    # the last shape and not the predicted one: over a gap velocities tear it
    sought = [last]
    if (health.unplaced and health.state != "initializing") or after_gap:
        sought.append(model.mesh.vertices)
    garment = skin_removal.remove_skin(frame, problem, prior.position, skin_removal.ON_CLOTH)
    stay = _stay(prior.position, garment, model, health.state == "initializing")
    if stay < NEAR:
        return problem
    turn_sd = TURN_SD + TURN_RATE * (problem.dt + health.empty_for + health.poor_for)
    found, cost = _best(sought, Target.of(frame.points, frame.sensor_origin), turn_sd, model)
    if cost > min(GAIN * stay, ALIKE):
        return problem
    start = State.at(found, np.zeros_like(found), FOUND_SD, config.speed_sd, 1.0)
    return problem._replace(
        prior=start._replace(R=prior.R),
        last=problem.last._replace(drift=Drift.at(model, FOUND_SD)),
        motion_start=found,
        rotation=rigidity.rotations(found, model),
        health=health.relocalized()._replace(settling=SETTLING),
    )


def search_due(health: Health) -> bool:
    """Whether the garment is looked for: a search takes as long as several frames, and a stream of nonsense must not stall."""
    rounds, rest = divmod(health.frames_unplaced, SEARCH_EVERY)
    return health.unplaced and rest == 0 and rounds & (rounds - 1) == 0


def interrupted(health: Health, dt: float) -> bool:
    """Whether ``dt`` seconds since the last frame are a gap: long, and longer than frames of this stream are apart."""
    return dt > max(LONGEST_BOOKED, LONGEST_GAP * health.spacing) and health.spacing > 0.0


def _settled(problem: Problem) -> Problem:
    """A garment that was found a few frames ago, registered further to its cloud."""
    prior, model = problem.prior, problem.model
    health = problem.health._replace(settling=problem.health.settling - 1)
    garment = skin_removal.remove_skin(problem.frame, problem, prior.position, skin_removal.ON_CLOTH)
    if len(garment.points) == 0:
        return problem._replace(health=health)
    target = Target.of(garment.points, garment.sensor_origin)
    bent = nonrigid_registration.follow(prior.position, target, model, nonrigid_registration.SETTLED_REACH)
    rotation = rigidity.rotations(bent, model)
    return problem._replace(prior=_moved(prior, bent), motion_start=bent, rotation=rotation, health=health)


def _moved(prior: State, bent: np.ndarray) -> State:
    """The prior at (V, 3) ``bent``, metres, its velocity corrected by what it takes to get there.

    A garment is found at rest and the fit that follows sees little more than what bending left over: without this it would not
    learn from it that it moves, and be lost again when it is bent no further. The covariance stays, as the fit measures the same
    points.
    """
    noise = prior.P_pp + BENT_SD**2 * np.eye(3)
    correction = np.linalg.solve(noise, (bent - prior.position)[:, :, None])
    return prior._replace(position=bent, velocity=prior.velocity + np.einsum("vba,vb->va", prior.P_pu, correction[:, :, 0]))


def _stay(position: np.ndarray, mine: FrameInput, model: Model, first: bool) -> float:
    """Metres: the cost of leaving the garment where it is; of a cloud of more than the garment, garment to cloud alone.

    A start that the ``first`` cloud lies on is right, however little of it is seen.
    """
    if len(mine.points) == 0:
        return TRUNCATION
    target = Target.of(mine.points, mine.sensor_origin)
    there, back = _halves(Shape.of(position, model, target), target, ASKED)
    if skin_removal.apart(mine.points, position, TRUNCATION).mean() > FOREIGN:
        return back
    if first and there < PARTLY:
        return there
    return 0.5 * (there + back)


def _best(sought: list[np.ndarray], target: Target, turn_sd: float, model: Model) -> tuple[np.ndarray, float]:
    """The shape, laid and bent onto the cloud, that then fits it best; (V, 3) metres, and its cost.

    The wrong heading may fit as well as the right one until both are bent.
    """
    trials, squared = [], np.empty(len(sought[0]))
    for k, shape in enumerate(sought):
        for placement in places(shape, model, target, turn_sd)[:BENT]:
            rough = nonrigid_registration.follow(placement.apply(shape), target, model, steps=ROUGH_STEPS, thinner=ROUGHER)
            cost = cost_in_place(rough, model, target)
            strain = math.sqrt(strains(rough, model.start, model.neighbour, model.rest_length, squared))
            total = (cost + STRAIN_LENGTH * strain) * (1.0 + TEMPLATE_COST * k)
            trials.append((_negative_log_posterior(total, INDEPENDENT, placement.rotation, turn_sd), len(trials), cost, rough))
    _, _, cost, found = min(trials, key=lambda trial: trial[:2])
    return found, cost
