"""Initialisation: where the garment is when the tracker does not know, as a rigid motion about the vertical."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from ddakf import rigidity
from ddakf.config import Start
from ddakf.model import Model
from ddakf.reliability import Health
from ddakf.types import State

HEADINGS = 24
SAMPLES = 400
SEARCH_EVERY = 8  # frames: a search takes as long as several of them, and a stream of nonsense must not stall
TRUNCATION = 0.10  # m: points farther from the garment count as this far
FAR = 0.05  # m: a mean truncated distance above it asks for a search
GAIN = 0.8  # share of the cost in place that a found placement must stay below


class Placement(NamedTuple):
    """x -> rotation x + translation, and how well the cloud then lies on the garment."""

    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,) m
    cost: float  # m, mean truncated distance of the cloud's points to the garment

    def apply(self, positions: np.ndarray) -> np.ndarray:
        return positions @ self.rotation.T + self.translation


def place(position: np.ndarray, points: np.ndarray) -> tuple[Placement, float]:
    """The rigid motion that lays (V, 3) ``position`` on (N, 3) ``points``, and the cost of leaving it where it is.

    Headings all around are tried from coinciding centres, each refined by trimmed point-to-point ICP; among equals the one
    nearest to the present heading wins, since most garments look alike from several sides.
    """
    cloud = points[:: max(1, len(points) // SAMPLES)].astype(np.float64)
    garment = cKDTree(position)
    stay = _cost(garment, cloud)
    center, target = position.mean(axis=0), cloud.mean(axis=0)
    candidates = []
    for k in range(HEADINGS):
        rotation = _turn(2 * np.pi * k / HEADINGS)
        start = Placement(rotation, target - rotation @ center, 0.0)
        candidates.append((_refined(garment, position, cloud, start, 6), k))
    candidates.sort(key=_preference)
    finalists = [(_refined(garment, position, cloud, placement, 25), k) for placement, k in candidates[:4]]
    in_place = _refined(garment, position, cloud, Placement(np.eye(3), np.zeros(3), stay), 25)
    return min([*finalists, (in_place, 0)], key=_preference)[0], stay


def _preference(candidate: tuple[Placement, int]) -> float:
    """Cost, up to a quarter higher for turning away from the present heading."""
    placement, k = candidate
    return placement.cost * (1.0 + 0.5 * min(k, HEADINGS - k) / HEADINGS)


def _refined(garment: cKDTree, position: np.ndarray, cloud: np.ndarray, start: Placement, iterations: int) -> Placement:
    """Trimmed ICP from a start. The cloud is moved to the garment, so that the tree is built once."""
    rotation, translation = start.rotation.T, -start.rotation.T @ start.translation
    for _ in range(iterations):
        moved = cloud @ rotation.T + translation
        distance, index = garment.query(moved)
        kept = distance <= np.quantile(distance, 0.8)
        a, b = cloud[kept], position[index[kept]]
        ca, cb = a.mean(axis=0), b.mean(axis=0)
        # the heading alone: a garment lying flat on its cloud would be no solution
        rotation = _best_heading(a - ca, b - cb)
        translation = cb - rotation @ ca
    cost = _cost(garment, cloud @ rotation.T + translation)
    return Placement(rotation.T, -rotation.T @ translation, cost)


def _best_heading(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Rotation about the vertical that maximises sum b . R a."""
    cosine = (a[:, 0] * b[:, 0] + a[:, 2] * b[:, 2]).sum()
    sine = (a[:, 2] * b[:, 0] - a[:, 0] * b[:, 2]).sum()
    return _turn(np.arctan2(sine, cosine))


def _turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def _cost(garment: cKDTree, cloud: np.ndarray) -> float:
    return float(np.minimum(garment.query(cloud, distance_upper_bound=TRUNCATION)[0], TRUNCATION).mean())


def locate(
    prior: State, last: np.ndarray, rotation: np.ndarray, points: np.ndarray, health: Health, model: Model, config: Start
) -> tuple[State, np.ndarray, np.ndarray]:
    """The prior, laid on the cloud where the tracker has no track; otherwise as it came.

    Before the first fit and after a loss a cloud that lies elsewhere is searched. After a loss the shape may be as wrong as the
    place, and what is sought is the template.

    Args:
        prior: the prediction.
        last: (V, 3) position from which the motion is locally rigid, metres.
        rotation: (V, 3, 3) of the one-rings against the rest shape.
        points: (N, 3) metres.
        health: state of the tracker.
        model, config: the garment, and when to search.

    Returns:
        Prior, last and rotation, of the place that was found or as they came.
    """
    unplaced = health.state in ("initializing", "lost") and health.frames_unplaced % SEARCH_EVERY == 0
    if not config.search or not unplaced or len(points) < config.least_points:
        return prior, last, rotation
    stay = _cost(cKDTree(prior.position), points[:: max(1, len(points) // SAMPLES)].astype(np.float64))
    if stay < FAR:
        return prior, last, rotation
    sought = model.mesh.vertices if health.state == "lost" else prior.position
    placement, _ = place(sought, points)
    if placement.cost > GAIN * stay:
        return prior, last, rotation
    found = placement.apply(sought)
    start = State.at(found, np.zeros_like(found), config.sd, config.speed_sd, 1.0)
    return start._replace(R=prior.R), found, rigidity.rotations(found, model)
