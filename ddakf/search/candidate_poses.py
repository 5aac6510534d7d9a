"""Candidate poses: rigid motions about the vertical that lay a garment on a cloud, and what they cost."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ddakf.config import Config, Relocalization
from ddakf.kernels.normals import vertex_normals
from ddakf.kernels.relocalize import OrientedVertices, Pairing, correspond, mean_distance
from ddakf.search.nonrigid_registration import Target, rows
from ddakf.types import Model

FARTHEST = 0.3  # m from the body: a point beyond is not of the garment, and a vertex beyond counts as this far


class Search(NamedTuple):
    """Constants of a search."""

    model: Model
    target: Target  # the cloud
    config: Config
    size: np.ndarray = np.zeros((3, 3))  # logarithm of the stretch of the template
    body: np.ndarray | None = None  # (3, B) float32 m, a sample of its vertices in this frame
    farthest: float = math.inf  # m, mean distance from the body of a garment that is worn

    def off_body(self, position: np.ndarray) -> float:
        """Mean distance of a garment, at (V, 3) metres, from the body; 0 without one."""
        if self.body is None:
            return 0.0
        some = rows(position[self.model.curve[:: max(1, len(position) // self.config.relocalization.cost_samples)]])
        asking, answers = (np.ones(sample.shape[1], np.float32) for sample in (some, self.body))
        return mean_distance(some, self.body, asking, answers, FARTHEST)


class CandidatePose(NamedTuple):
    """x -> rotation x + translation, and the distance between garment and cloud in that pose."""

    rotation: np.ndarray  # (3, 3)
    translation: np.ndarray  # (3,) m
    cost: float = math.inf  # m, mean truncated distance: half of it cloud to garment, half of it garment to cloud

    @property
    def heading(self) -> float:
        """Radians about the vertical."""
        return math.atan2(self.rotation[0, 2], self.rotation[0, 0])

    def apply(self, positions: np.ndarray) -> np.ndarray:
        """(N, 3) positions in this pose, metres."""
        return positions @ self.rotation.T + self.translation


class HeadingPrior(NamedTuple):
    """Density of the garment's turn about the vertical: normal, or with some doubt any."""

    sd: float  # rad, about the present heading
    doubt: float = 0.0  # probability that the present heading says nothing, as that of a file may

    def cost(self, heading: float) -> float:
        """Negative logarithm of the density, up to a constant."""
        known = 0.5 * (heading / self.sd) ** 2
        if self.doubt == 0.0:  # its logarithm stays exact where the density is none
            return known
        anywhere = min(1.0, self.sd / math.sqrt(2.0 * math.pi))
        return -math.log((1.0 - self.doubt) * math.exp(-known) + self.doubt * anywhere)


class Surface(NamedTuple):
    """Vertices that are aligned with a cloud, relative to its origin."""

    position: np.ndarray  # (M, 3) m
    normal: np.ndarray  # (M, 3) unit
    share: np.ndarray  # (M,) float32 area over the mean

    @classmethod
    def from_garment(cls, position: np.ndarray, model: Model, target: Target) -> Surface:
        """All vertices of a garment at (V, 3) ``position``, metres, along its curve."""
        normal, curve = np.empty_like(position), model.curve
        vertex_normals(position, model.faces, normal)
        return cls(position[curve] - target.origin, normal[curve], model.vertex_share[curve])

    def sampled(self, count: int) -> Surface:
        """About so many of the vertices, evenly spread."""
        every = max(1, len(self.position) // count)
        return Surface(self.position[::every], self.normal[::every], self.share[::every])

    def moved(self, pose: CandidatePose) -> Surface:
        """The vertices in a pose."""
        return Surface(pose.apply(self.position), self.normal @ pose.rotation.T, self.share)

    def facing(self, target: Target) -> np.ndarray:
        """(M,) float32: 1 where a vertex faces a sensor."""
        if target.sensors is None:
            return np.ones(len(self.position), np.float32)
        towards = target.sensors[:, None] - self.position[None]
        return (np.einsum("va,sva->sv", self.normal, towards) > 0).any(axis=0).astype(np.float32)


class Alignment(NamedTuple):
    """Schedule of a rigid alignment."""

    points: int  # of the cloud
    reaches: np.ndarray  # m, of the soft correspondences of each step
    along_normals: bool  # goals count along the normals, or in all directions alike
    config: Relocalization

    @classmethod
    def rough(cls, config: Relocalization) -> Alignment:
        """The schedule of all headings."""
        reaches = np.geomspace(config.rough_reach, config.fine_reach, config.rough_steps)
        return cls(config.rough_points, reaches, False, config)

    @classmethod
    def fine(cls, config: Relocalization) -> Alignment:
        """The schedule of the finalists."""
        return cls(config.fine_points, np.geomspace(config.fine_reach, config.last_reach, config.fine_steps), True, config)


class Correspondence(NamedTuple):
    """Soft correspondences of M vertices with a cloud."""

    mass: np.ndarray  # (M,) points that correspond to each vertex
    goal: np.ndarray  # (M, 3) float32 their mean, m; arbitrary where the mass is 0


def candidate_poses(position: np.ndarray, search: Search, prior: HeadingPrior) -> list[CandidatePose]:
    """Rigid motions that lay a garment on a cloud, the best first; their headings are ``heading_separation`` apart.

    Headings all around are aligned with a few points, the best of them with more, by soft correspondences that grow closer. Most
    garments look alike from several sides, so a heading costs more the farther it is from the present one.

    Args:
        position: (V, 3) metres.
        search: the garment, the cloud and the configuration.
        prior: of the garment's turn about the vertical.
    """
    model, target, config = search.model, search.target, search.config.relocalization
    surface = Surface.from_garment(position, model, target)
    rough, fine = surface.sampled(config.rough_vertices), surface.sampled(config.fine_vertices)
    tried = []
    for angle in 2 * np.pi * np.arange(config.headings) / config.headings:
        pose = _align(rough, target, _initial(rough, target, angle), Alignment.rough(config))
        pose = pose._replace(cost=_cost(rough.moved(pose), target, config.rough_points, config))
        tried.append((negative_log_posterior(pose, config.rigid_samples, prior), len(tried), pose))
    tried.sort()
    found: list[CandidatePose] = []
    for _, _, initial in tried[: config.finalists]:
        pose = _align(fine, target, initial, Alignment.fine(config))
        cost = _cost(fine.moved(pose), target, config.fine_points, config)
        # in the world's frame: x -> R (x - o) + t + o
        found.append(CandidatePose(pose.rotation, pose.translation + target.origin - pose.rotation @ target.origin, cost))
    found.sort(key=lambda pose: negative_log_posterior(pose, config.rigid_samples, prior))
    apart: list[CandidatePose] = []
    least = np.radians(config.heading_separation)
    for pose in found:
        if all(np.trace(pose.rotation.T @ other.rotation) < 1 + 2 * np.cos(least) for other in apart):
            apart.append(pose)
    return apart


def cost_in_place(position: np.ndarray, search: Search) -> float:
    """Metres: the cost of a garment that stays at (V, 3) ``position``, metres."""
    config = search.config.relocalization
    return _cost(Surface.from_garment(position, search.model, search.target), search.target, config.cost_samples, config)


def negative_log_posterior(pose: CandidatePose, samples: float, prior: HeadingPrior) -> float:
    """Cost of a pose as probability: ``samples`` Laplace distances of unknown scale, and the heading."""
    return samples * np.log(pose.cost) + prior.cost(pose.heading)


def turn_between(first: np.ndarray, second: np.ndarray) -> float:
    """Radians about the vertical by which (V, 3) ``second`` has turned from (V, 3) ``first``, in the least-squares sense."""
    (x, _, z), (u, _, w) = ((vertices - vertices.mean(axis=0)).T for vertices in (first, second))
    return math.atan2(float(z @ u - x @ w), float(x @ u + z @ w))


def turned(vertices: np.ndarray, angle: float) -> np.ndarray:
    """(V, 3) vertices, metres, turned about the vertical by so many radians."""
    return vertices @ _about_vertical(angle).T


def _initial(surface: Surface, target: Target, heading: float) -> CandidatePose:
    """The pose of a heading in which the middles of the cloud and of the garment's visible side coincide."""
    rotation, middle = _about_vertical(heading), np.median(target.points, axis=1)
    turned = surface.moved(CandidatePose(rotation, np.zeros(3)))
    if target.sensors is None:
        return CandidatePose(rotation, middle - turned.position.mean(axis=0))
    # visible from the place where the garment will be
    towards = target.sensors - middle
    seen = (turned.normal @ towards.T > 0).any(axis=1)
    own = turned.position[seen].mean(axis=0) if seen.any() else turned.position.mean(axis=0)
    return CandidatePose(rotation, middle - own)


def _align(surface: Surface, target: Target, pose: CandidatePose, alignment: Alignment) -> CandidatePose:
    """The pose after one step with each reach of a schedule."""
    every, config = max(1, target.points.shape[1] // alignment.points), alignment.config
    points = target.subsampled(every)
    N, M = len(points.signed), len(surface.position)
    pair, mass, goal = np.empty((N, M), np.float32), np.empty(M, np.float32), np.empty((3, M), np.float32)
    for reach in alignment.reaches:
        moved = surface.moved(pose)
        vertices = OrientedVertices(rows(moved.position), rows(moved.normal), moved.share * moved.facing(target))
        correspond(vertices, points, Pairing(reach, config.balancing, config.outlier_weight), pair, mass, goal)
        if not mass.any():
            break
        found = Correspondence(mass.astype(np.float64), goal.T)
        pose = _plane_step(moved, found, pose, config) if alignment.along_normals else _point_fit(surface, found)
    return pose


def _point_fit(surface: Surface, found: Correspondence) -> CandidatePose:
    """The pose that brings vertices nearest to their goals."""
    weight = found.mass / found.mass.sum()
    a, b = weight @ surface.position, weight @ found.goal
    arm, wanted = (surface.position - a) * weight[:, None], found.goal - b
    # the heading alone: a garment lying flat on its cloud would be no solution
    cosine = np.vdot(arm[:, 0], wanted[:, 0]) + np.vdot(arm[:, 2], wanted[:, 2])
    sine = np.vdot(arm[:, 2], wanted[:, 0]) - np.vdot(arm[:, 0], wanted[:, 2])
    rotation = _about_vertical(np.arctan2(sine, cosine))
    return CandidatePose(rotation, b - rotation @ a)


def _plane_step(moved: Surface, found: Correspondence, pose: CandidatePose, config: Relocalization) -> CandidatePose:
    """The pose after one Gauss-Newton step to goals along the normals.

    The heading of nearly round cloth converges sooner than with goals in all directions.
    """
    weight, beside = found.mass / found.mass.sum(), config.tangential_weight
    middle = weight @ moved.position
    arm = moved.position - middle
    jacobian = np.zeros((len(weight), 3, 4))
    jacobian[:, 0, 0], jacobian[:, 2, 0] = arm[:, 2], -arm[:, 0]
    jacobian[:, :, 1:] = np.eye(3)
    off = found.goal - moved.position
    along, height = np.einsum("ma,mab->mb", moved.normal, jacobian), np.einsum("ma,ma->m", moved.normal, off)
    A = np.einsum("m,mb,mc->bc", (1.0 - beside) * weight, along, along)
    A += np.einsum("m,mab,mac->bc", beside * weight, jacobian, jacobian)
    b = (1.0 - beside) * (weight * height) @ along + beside * np.einsum("m,mab,ma->b", weight, jacobian, off)
    step = np.linalg.solve(A + 1e-9 * np.trace(A) * np.eye(4), b)  # regular with a single vertex
    turn = _about_vertical(np.clip(step[0], -config.longest_turn, config.longest_turn))
    # x -> turn (R x + t - middle) + middle + step
    return CandidatePose(turn @ pose.rotation, turn @ (pose.translation - middle) + middle + step[1:])


def _cost(surface: Surface, target: Target, count: int, config: Relocalization) -> float:
    """Metres: half the sum of :func:`_distances`."""
    return 0.5 * sum(distances(surface, target, count, config))


def distances(surface: Surface, target: Target, count: int, config: Relocalization) -> tuple[float, float]:
    """Metres each: mean truncated distance cloud to garment and, of the vertices that face a sensor, garment to cloud."""
    many, few = surface.sampled(config.cost_vertices), surface.sampled(count)
    points = np.ascontiguousarray(target.points[:, :: max(1, target.points.shape[1] // count)])
    dense = np.ascontiguousarray(target.dense[:, :: max(1, target.dense.shape[1] // (config.cost_density * count))])
    asked, answers = np.ones(points.shape[1], np.float32), np.ones(dense.shape[1], np.float32)
    there = mean_distance(points, rows(many.position), asked, many.facing(target), config.truncation)
    back = mean_distance(rows(few.position), dense, few.facing(target), answers, config.truncation)
    return there, back


def _about_vertical(angle: float) -> np.ndarray:
    """(3, 3) rotation about the vertical."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])
