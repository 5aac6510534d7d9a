"""Initialisation, second half: a placed garment follows the cloud as an as-rigid-as-possible graph of its patches.

The patches are those of the solver's coarse level. Each has a position and a rotation. Vertices and points belong together softly
and about one to one, at first over a third of a metre, then ever more closely, while the graph becomes softer: nearest neighbours
would leave a sleeve that lies elsewhere without points of its own (Chui and Rangarajan 2003, "A new point matching algorithm for
non-rigid registration"). Local and global steps alternate (Sorkine and Alexa 2007, "As-rigid-as-possible surface modeling").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.kernels import nonrigid_registration as kernels
from ddakf.kernels.associate import VisibilityLimits, mark_visible, vertex_normals
from ddakf.kernels.cluster_alignment import centers
from ddakf.kernels.nonrigid_registration import ClusterGraph, Goals
from ddakf.kernels.relocalize import OrientedPoints, OrientedVertices, Pairing, correspond, normals, outward
from ddakf.stages.associate import OCCLUDER_CELL
from ddakf.stages.grid import distinct
from ddakf.types import Model

STEPS, ROUNDS = 24, 4  # of the annealing; local and global ones in each
FIRST_REACH, SETTLED_REACH, LAST_REACH = 0.20, 0.30, 0.04  # m: pairs farther apart are none
STIFF, SOFT, HALF_SEEN = 5.0, 0.2, 3.0  # weight of an edge against the data of a patch: first, last, last with one sensor
# rounds towards one to one, where all sides are seen: where they are not, what is seen of the two may differ at the rims
BALANCING, OUTLIER = 2, 0.1  # and the weight of a point's belonging to nothing
POINTS, VERTICES = 300, 700  # that are paired
DENSE = 3000  # points that distances are measured to, and normals from
SPACING, NORMAL_RADIUS = 0.012, 0.03  # m: a cloud is thinned to one point in a cell; its normals are of the points within
CELL_BITS = 21  # of a cell's number along an axis
MOST_POINTS, MOST_SENSORS = 30_000, 8  # of a cloud, that are looked at
HIDDEN_DEPTH, FACING = 0.03, 0.1  # m, cosine: what a sensor sees, as in stage B
NO_BODY, NO_SURFELS, NO_ORIGIN = np.empty((0, 3)), np.empty((6, 0), np.float32), np.zeros(3)
VIEW_CELL, VIEW_DEPTH = 0.03, 0.02  # m: of the grids in which a cloud's outside is looked for
VIEWS = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or z], float)  # not through the neck
VIEWS /= np.linalg.norm(VIEWS, axis=1, keepdims=True)


class Target(NamedTuple):
    """The cloud that a garment is laid on, even over its surface however near its sensors are; relative to ``origin``."""

    origin: np.ndarray  # (3,) m
    points: np.ndarray  # (3, N) float32 m, a sample
    normals: np.ndarray  # (3, N) float32 unit, to the outside where that is known; zero where there is none
    signed: np.ndarray  # (N,) bool: where it is
    dense: np.ndarray  # (3, D) float32 m, a denser sample
    sensors: np.ndarray | None  # (S, 3) m; None: seen from all around

    @classmethod
    def of(cls, points: np.ndarray, sensor_origin: np.ndarray | None) -> Target:
        """Of (N, 3) points, N > 0, and the (3,) or (N, 3) places they were seen from, metres."""
        stride = -(-len(points) // MOST_POINTS)
        points = points[::stride].astype(np.float64)
        origin = np.median(points, axis=0)
        points -= origin
        chosen = _thinned(points)
        dense = points[chosen[:: -(-len(chosen) // DENSE)]].T.astype(np.float32)
        chosen = chosen[:: max(1, len(chosen) // POINTS)]
        sample = points[chosen].T.astype(np.float32)
        normal = np.empty_like(sample)
        normals(sample, dense, NORMAL_RADIUS, normal)
        signed = np.ones(len(chosen), bool)
        if sensor_origin is None:
            outward(sample, dense, VIEWS, VIEW_CELL, VIEW_DEPTH, normal, signed)
            return cls(origin, sample, normal, signed, dense, None)
        if sensor_origin.ndim == 1:
            sensors = eye = sensor_origin[None] - origin
        else:
            sensors, eye = distinct(sensor_origin) - origin, sensor_origin[::stride][chosen] - origin
            sensors = sensors[:: -(-len(sensors) // MOST_SENSORS)]
        normal[:, np.einsum("an,na->n", normal, eye - sample.T) < 0] *= -1.0
        return cls(origin, sample, normal, signed, dense, sensors)

    def thinned(self, every: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Each such point, its normal, and whether that has a sign."""
        return *(np.ascontiguousarray(a[:, ::every]) for a in (self.points, self.normals)), self.signed[::every].copy()


def _thinned(points: np.ndarray) -> np.ndarray:
    """Indices of the first of the (N, 3) points in each cell of :data:`SPACING`."""
    cell = np.floor(points / SPACING).astype(np.int64)
    cell -= cell.min(axis=0)
    number = (cell[:, 0] << 2 * CELL_BITS) + (cell[:, 1] << CELL_BITS) + cell[:, 2]
    return np.unique(number, return_index=True)[1]


def follow(
    position: np.ndarray, target: Target, model: Model, reach: float = FIRST_REACH, steps: int = STEPS, thinner: int = 1
) -> np.ndarray:
    """(V, 3) the garment, bent onto the cloud.

    Args:
        position: (V, 3) where the rigid search has laid it, metres.
        target: the cloud.
        model: the garment.
        reach: of the first pairs, metres.
        steps: of the annealing.
        thinner: so many times fewer vertices and points are paired.
    """
    source, clusters, K = position - target.origin, model.clusters, model.n_clusters
    every = max(1, thinner * len(source) // VERTICES)
    chosen = np.arange(0, len(source), every)
    normal = np.empty_like(source)
    vertex_normals(source, model.faces, normal)
    start, normal, patch = source[chosen], normal[chosen], model.cluster[chosen]
    nearest, share = clusters.nearest[chosen], clusters.share[chosen]
    limits = VisibilityLimits(OCCLUDER_CELL * model.edge_length * np.sqrt(every), HIDDEN_DEPTH, FACING)
    points = OrientedPoints(*target.thinned(thinner))
    middle, rotation = np.empty((K, 3)), np.tile(np.eye(3), (K, 1, 1))
    centers(source, model.cluster, middle)
    centre = middle.copy()
    rest, arm = centre[clusters.ends[:, 1]] - centre[clusters.ends[:, 0]], np.ascontiguousarray((start - centre[patch]).T)
    pair = np.empty((len(points.signed), len(chosen)), np.float32)
    mass, goal = np.empty(len(chosen), np.float32), np.empty((3, len(chosen)), np.float32)
    area = model.vertex_share[chosen]
    estimate, visible = start.copy(), np.ones(len(chosen), bool)
    soft, balancing = (SOFT, BALANCING) if target.sensors is None else (HALF_SEEN, 0)
    for step in range(steps):
        progress = step / max(steps - 1, 1)
        turned = np.einsum("vab,vb->va", rotation[patch], normal)
        if target.sensors is not None:
            mark_visible(estimate, turned, NO_BODY, NO_SURFELS, NO_ORIGIN, target.sensors, limits, visible)
        vertices = OrientedVertices(rows(estimate), rows(turned), visible * area)
        pairing = Pairing(reach * (LAST_REACH / reach) ** progress, balancing, OUTLIER)
        correspond(vertices, points, pairing, pair, mass, goal)
        if not mass.any():
            return position
        edge = STIFF * (soft / STIFF) ** progress / K
        kernels.settle(Goals(patch, arm, mass, goal), ClusterGraph(clusters.ends, rest, edge), ROUNDS, middle, rotation)
        kernels.blend(start, nearest, share, centre, middle, rotation, estimate)
    moved = np.empty_like(source)
    kernels.blend(source, clusters.nearest, clusters.share, centre, middle, rotation, moved)
    return moved + target.origin


def rows(position: np.ndarray) -> np.ndarray:
    """(3, V) float32 of (V, 3)."""
    return np.ascontiguousarray(position.T, np.float32)
