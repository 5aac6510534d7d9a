"""Initialisation: where the garment is when the tracker does not know, first as a rigid motion about the vertical."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ddakf import deform, rigidity, segment
from ddakf.config import Start
from ddakf.deform import TRUNCATION, Target
from ddakf.frame import Frame
from ddakf.kernels.associate import vertex_normals
from ddakf.kernels.reliability import strain
from ddakf.model import Model
from ddakf.physics.contact import BodyContact
from ddakf.reliability import Health
from ddakf.types import State

HEADINGS = 12
FEW_POINTS, FEW_VERTICES = 100, 600  # of the cloud and the garment, while all headings are tried
POINTS, VERTICES = 300, 2500  # for the finalists
FINALISTS = 5
FIRST_STEPS, LAST_STEPS = 6, 14
TRIMMED = 0.8  # share of the points that an alignment follows
NEAR = 0.015  # m: a cost in place below it is that of a garment in its place
PARTLY = 0.010  # m: a cost of the cloud alone below it is that of a start in its place, of which a part is seen
ALIKE = 0.04  # m: a cost above it is that of something else, wherever the garment is laid
FOREIGN = 0.15  # share of the points beyond TRUNCATION of the garment, above which the cloud is of more than the garment
GAIN = 0.8  # share of the cost in place that a found placement must stay below
DISTINCT = np.radians(30.0)  # between headings that are bent apart
BENT, ROUGH_STEPS = 3, 6  # headings of each shape that are bent, and how long
BENT_TURN_COST = 1.0  # by so much more a half turn costs of bent shapes, in its square: within a quarter turn little
STRAIN_LENGTH = 0.03  # m: what a strain of 1 costs, as the wrong heading fits only a garment that is pulled about
TEMPLATE_COST = 0.05  # by so much more the template costs than the last shape
TURN_COST = 0.6  # by so much more a half turn costs than none


class Placement(NamedTuple):
    """x -> rotation x + translation, and how well garment and cloud then lie on each other."""

    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,) m
    cost: float  # m, mean truncated distance: half of it cloud to garment, half of it garment to cloud

    def apply(self, positions: np.ndarray) -> np.ndarray:
        return positions @ self.rotation.T + self.translation


class Shape(NamedTuple):
    """Vertices that may be laid on a cloud."""

    position: np.ndarray  # (V, 3) m
    normal: np.ndarray  # (V, 3) unit
    tree: cKDTree

    @classmethod
    def of(cls, position: np.ndarray, normal: np.ndarray, count: int) -> Shape:
        every = max(1, len(position) // count)
        return cls(position[::every], normal[::every], cKDTree(position[::every]))


def places(
    position: np.ndarray, faces: np.ndarray, points: np.ndarray, sensor_origin: np.ndarray | None = None
) -> list[Placement]:
    """Rigid motions that lay a garment on a cloud, the best first; their headings are :data:`DISTINCT` apart.

    Headings all around are tried on a few points, the best of them on more, each by trimmed point-to-point alignment. Among
    equals the one nearest to the present heading wins, since most garments look alike from several sides.

    Args:
        position: (V, 3) metres.
        faces: (F, 3) int32.
        points: (N, 3) metres.
        sensor_origin: (3,) metres: what is turned away from it has no points; None or (N, 3): every side has.
    """
    normal = _normals(position, faces)
    rough, few = Shape.of(position, normal, FEW_VERTICES), Target.of(points, sensor_origin, FEW_POINTS)
    fine, many = Shape.of(position, normal, VERTICES), Target.of(points, sensor_origin, POINTS)
    rotation, translation = _started(rough, few, 2 * np.pi * np.arange(HEADINGS) / HEADINGS)
    rotation, translation = _aligned(rough, few, rotation, translation, FIRST_STEPS)
    best = np.argsort(_costs(rough, few, rotation, translation) * (1.0 + TURN_COST * turn(rotation)))[:FINALISTS]
    # and where it is now
    rotation = np.concatenate([rotation[best], np.eye(3)[None]])
    translation = np.concatenate([translation[best], np.zeros((1, 3))])
    rotation, translation = _aligned(fine, many, rotation, translation, LAST_STEPS)
    cost = _costs(fine, many, rotation, translation)
    found: list[Placement] = []
    for k in np.argsort(cost * (1.0 + TURN_COST * turn(rotation))):
        if all(np.trace(rotation[k].T @ other.rotation) < 1 + 2 * np.cos(DISTINCT) for other in found):
            found.append(Placement(rotation[k], translation[k], float(cost[k])))
    return found


def cost_in_place(position: np.ndarray, faces: np.ndarray, points: np.ndarray, sensor_origin: np.ndarray | None) -> float:
    """Metres: the cost of leaving a garment where it is; arguments as for :func:`place`."""
    shape, target = Shape.of(position, _normals(position, faces), VERTICES), Target.of(points, sensor_origin, POINTS)
    return float(_costs(shape, target, np.eye(3)[None], np.zeros((1, 3)))[0])


def _normals(position: np.ndarray, faces: np.ndarray) -> np.ndarray:
    normal = np.empty_like(position)
    vertex_normals(position, faces, normal)
    return normal


def turn(rotation: np.ndarray) -> np.ndarray:
    """(...,) half turns by which (..., 3, 3) is turned away from the present heading, in [0, 1]."""
    return np.abs(np.arctan2(rotation[..., 0, 2], rotation[..., 0, 0])) / np.pi


def _started(shape: Shape, target: Target, heading: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotations (K, 3, 3) and the translations (K, 3) that make the middles coincide, of the side that is seen."""
    rotation = _turns(heading)
    middle = np.median(target.points, axis=0)
    turned = np.einsum("kab,vb->kva", rotation, shape.position)
    seen = np.ones(turned.shape[:2])
    if target.eye is not None:
        view = target.eye - middle
        seen = (np.einsum("kab,vb,a->kv", rotation, shape.normal, view) > 0).astype(np.float64)
    mean = np.einsum("kv,kva->ka", seen, turned) / np.maximum(seen.sum(axis=1), 1.0)[:, None]
    return rotation, middle - mean


def _aligned(
    shape: Shape, target: Target, rotation: np.ndarray, translation: np.ndarray, steps: int
) -> tuple[np.ndarray, np.ndarray]:
    """Trimmed point-to-point alignment of K placements at once; the cloud is moved to the garment, so that the tree stays."""
    cloud = target.points
    for _ in range(steps):
        distance, index, facing = _nearest(shape, target, rotation, translation)
        kept = ((distance <= np.quantile(distance, TRIMMED, axis=1)[:, None]) & facing).astype(np.float64)
        total = np.maximum(kept.sum(axis=1), 1.0)[:, None]
        garment = shape.position[index]
        a, b = (kept @ cloud) / total, np.einsum("kn,kna->ka", kept, garment) / total
        da, db = cloud[None] - a[:, None], garment - b[:, None]
        # the heading alone: a garment lying flat on its cloud would be no solution
        cosine = (kept * (da[..., 0] * db[..., 0] + da[..., 2] * db[..., 2])).sum(axis=1)
        sine = (kept * (da[..., 0] * db[..., 2] - da[..., 2] * db[..., 0])).sum(axis=1)
        rotation = _turns(np.arctan2(sine, cosine))
        translation = a - np.einsum("kab,kb->ka", rotation, b)
    return rotation, translation


def _nearest(shape: Shape, target: Target, rotation: np.ndarray, translation: np.ndarray):
    """Distance and index (K, N) of the vertex nearest to each point, and whether that vertex faces the sensor."""
    local = np.einsum("kba,knb->kna", rotation, target.points[None] - translation[:, None])
    distance, index = shape.tree.query(local.reshape(-1, 3))
    distance, index = distance.reshape(local.shape[:2]), index.reshape(local.shape[:2])
    if target.eye is None:
        return distance, index, np.ones(distance.shape, bool)
    eye = np.einsum("kba,kb->ka", rotation, target.eye - translation)
    facing = np.einsum("kna,kna->kn", shape.normal[index], eye[:, None] - shape.position[index]) > 0
    return distance, index, facing


def _costs(shape: Shape, target: Target, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """(K,) metres: half the sum of :func:`_halves`."""
    there, back = _halves(shape, target, rotation, translation)
    return 0.5 * (there + back)


def _halves(
    shape: Shape, target: Target, rotation: np.ndarray, translation: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(K,) metres each: mean truncated distance cloud to garment and, of the vertices that face the sensor, garment to cloud."""
    distance, _, facing = _nearest(shape, target, rotation, translation)
    there = np.where(facing, np.minimum(distance, TRUNCATION), TRUNCATION).mean(axis=1)
    back = np.empty(len(rotation))
    every = max(1, len(shape.position) // len(target.points))
    for k, (R, t) in enumerate(zip(rotation, translation, strict=True)):
        vertices = shape.position[::every] @ R.T + t
        if target.eye is not None:
            vertices = vertices[np.einsum("va,va->v", shape.normal[::every] @ R.T, target.eye - vertices) > 0]
        away = target.tree.query(vertices, distance_upper_bound=TRUNCATION)[0]
        back[k] = np.minimum(away, TRUNCATION).mean() if len(vertices) else TRUNCATION
    return there, back


def _turns(angle: np.ndarray) -> np.ndarray:
    """(K, 3, 3) rotations about the vertical."""
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.stack([c, zero, s, zero, one, zero, -s, zero, c], axis=1).reshape(-1, 3, 3)


def locate(
    prior: State, last: np.ndarray, rotation: np.ndarray, now: Frame, contact: BodyContact | None, dt: float,
    health: Health, model: Model, config: Start,
) -> tuple[State, np.ndarray, np.ndarray]:  # fmt: skip
    """The prior, laid on the cloud where the tracker has no track; otherwise as it came.

    A cloud that lies elsewhere is searched before the first fit, after a loss, and when the garment was out of sight or without
    a fit lately. What is laid on it is the last shape, and beside it the template where that shape may be as wrong as the place.

    Args:
        prior: the prediction.
        last: (V, 3) position from which the motion is locally rigid, metres.
        rotation: (V, 3, 3) of the one-rings against the rest shape.
        now: the frame.
        contact: the body, whose skin may be among the points, or None.
        dt: seconds since the last frame.
        health: state of the tracker.
        model, config: the garment, and when to search.

    Returns:
        Prior, last and rotation, of the place that was found or as they came.
    """
    points, sensor_origin = now.points, now.sensor_origin
    if not config.search or len(points) < config.least_points or not (health.search_due or health.interrupted(dt)):
        return prior, last, rotation
    # the last shape and not the predicted one: over a gap velocities tear it
    sought = [last]
    if (health.unplaced and health.state != "initializing") or health.interrupted(dt):
        sought.append(model.mesh.vertices)
    mine = segment.cloth(now, prior.position, contact, model, segment.ON_CLOTH)
    stay = _stay(prior.position, mine, model, health.state == "initializing")
    if stay < NEAR:
        return prior, last, rotation
    found, cost = _best(sought, points, sensor_origin, model)
    if cost > min(GAIN * stay, ALIKE):
        return prior, last, rotation
    start = State.at(found, np.zeros_like(found), config.sd, config.speed_sd, 1.0)
    return start._replace(R=prior.R), found, rigidity.rotations(found, model)


def _stay(position: np.ndarray, mine: Frame, model: Model, first: bool) -> float:
    """Metres: the cost of leaving the garment where it is; of a cloud of more than the garment, garment to cloud alone.

    A start that the ``first`` cloud lies on is right, however little of it is seen.
    """
    if len(mine.points) == 0:
        return TRUNCATION
    shape = Shape.of(position, _normals(position, model.faces), VERTICES)
    there, back = _halves(shape, Target.of(mine.points, mine.sensor_origin, POINTS), np.eye(3)[None], np.zeros((1, 3)))
    if segment.apart(mine.points, position, TRUNCATION).mean() > FOREIGN:
        return float(back[0])
    if first and there[0] < PARTLY:
        return float(there[0])
    return 0.5 * float(there[0] + back[0])


def _best(
    sought: list[np.ndarray], points: np.ndarray, sensor_origin: np.ndarray | None, model: Model
) -> tuple[np.ndarray, float]:
    """The shape, laid and bent onto the cloud, that then fits it best; (V, 3) metres, and its cost.

    The wrong heading may fit as well as the right one until both are bent.
    """
    trials = []
    for k, shape in enumerate(sought):
        for placement in places(shape, model.faces, points, sensor_origin)[:BENT]:
            rough = deform.follow(placement.apply(shape), points, sensor_origin, model, ROUGH_STEPS)
            cost = cost_in_place(rough, model.faces, points, sensor_origin)
            cost += STRAIN_LENGTH * strain(rough, model.start, model.neighbour, model.rest_edge)
            cost *= 1.0 + BENT_TURN_COST * np.square(turn(placement.rotation))
            trials.append((cost * (1.0 + TEMPLATE_COST * k), len(trials), placement, shape))
    _, _, placement, shape = min(trials)
    found = deform.follow(placement.apply(shape), points, sensor_origin, model)
    return found, cost_in_place(found, model.faces, points, sensor_origin)
