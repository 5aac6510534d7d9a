"""Non-rigid registration: a garment in a candidate pose follows the cloud as an as-rigid-as-possible graph of its clusters.

Each cluster has a position and a rotation. Vertices and points correspond softly and about one to one: at first over 0.2 m, or
0.3 m while a found garment settles, then ever more closely, while the graph becomes softer. With nearest neighbours instead, a
sleeve that lies elsewhere would get no points of its own (Chui and Rangarajan 2003, "A new point matching algorithm for
non-rigid registration"). Local and global steps alternate (Sorkine and Alexa 2007, "As-rigid-as-possible surface modeling").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.config import Registration
from ddakf.kernels import nonrigid_registration as kernels
from ddakf.kernels.cluster_alignment import centers
from ddakf.kernels.nonrigid_registration import ClusterGraph, Goals
from ddakf.kernels.normals import vertex_normals
from ddakf.kernels.relocalize import OrientedPoints, OrientedVertices, Pairing, correspond, normals, outward
from ddakf.kernels.visibility import VisibilityLimits, mark_visible
from ddakf.stages.grid import distinct, spread_rows
from ddakf.types import Model

CELL_BITS = 21  # of a cell's number along an axis: three of them fit into an int64
NO_TURN = np.eye(3)
NO_BODY, NO_SURFELS, NO_ORIGIN = np.empty((0, 3)), np.empty((6, 0), np.float32), np.zeros(3)  # occluders that are absent here
# Directions in which the outside of a cloud is sought: 24 around, none from above or below, through the neck.
VIEWS = np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or z], float)
VIEWS /= np.linalg.norm(VIEWS, axis=1, keepdims=True)


class Target(NamedTuple):
    """A cloud that a garment is registered to, sampled evenly over its surface; relative to ``origin``."""

    origin: np.ndarray  # (3,) m
    points: np.ndarray  # (3, N) float32 m, a sample
    normals: np.ndarray  # (3, N) float32 unit, outward where the side is known; zero where no normal is known
    signed: np.ndarray  # (N,) bool: the side is known
    dense: np.ndarray  # (3, D) float32 m, a denser sample
    sensors: np.ndarray | None  # (S, 3) m; None: seen from all around

    @classmethod
    def from_points(
        cls, points: np.ndarray, sensor_origin: np.ndarray | None, config: Registration, turn: np.ndarray = NO_TURN
    ) -> Target:
        """A target of (N, 3) points, N > 0, and the (3,) or (N, 3) positions of their sensors, metres; all turned by (3, 3)."""
        some = spread_rows(len(points), config.input_points)
        points = points[some].astype(np.float64) @ turn.T
        origin = np.median(points, axis=0)
        points -= origin
        chosen = _subsampled(points, config.spacing)
        dense = rows(points[chosen[:: -(-len(chosen) // config.dense_points)]])
        chosen = chosen[:: max(1, len(chosen) // config.points)]
        sample = rows(points[chosen])
        normal = np.empty_like(sample)
        normals(sample, dense, config.normal_radius, normal)
        signed = np.ones(len(chosen), bool)
        if sensor_origin is None:
            outward(sample, dense, VIEWS, config.view_cell, config.view_depth, normal, signed)
            return cls(origin, sample, normal, signed, dense, None)
        if sensor_origin.ndim == 1:
            sensors = eye = sensor_origin[None] @ turn.T - origin
        else:
            sensors, eye = (o @ turn.T - origin for o in (distinct(sensor_origin), sensor_origin[some][chosen]))
            sensors = np.ascontiguousarray(sensors[:: -(-len(sensors) // config.sensors)])  # the layout that kernels know
        normal[:, np.einsum("an,na->n", normal, eye - sample.T) < 0] *= -1.0
        return cls(origin, sample, normal, signed, dense, sensors)

    def subsampled(self, every: int) -> OrientedPoints:
        """Every so-many-th point."""
        points, normal = (np.ascontiguousarray(a[:, ::every]) for a in (self.points, self.normals))
        return OrientedPoints(points, normal, self.signed[::every].copy())


def _subsampled(points: np.ndarray, spacing: float) -> np.ndarray:
    """Indices of the first of the (N, 3) points in each cell of ``spacing`` metres."""
    cell = np.floor(points / spacing).astype(np.int64)
    cell -= cell.min(axis=0)
    number = (cell[:, 0] << 2 * CELL_BITS) + (cell[:, 1] << CELL_BITS) + cell[:, 2]
    return np.unique(number, return_index=True)[1]


def register(position: np.ndarray, target: Target, model: Model, config: Registration) -> np.ndarray:
    """(V, 3) the garment after its registration to the cloud, metres.

    Args:
        position: (V, 3) the garment in a candidate pose, metres.
        target: the cloud.
        model: the garment.
        config: schedule of the annealing.
    """
    source, clusters, K = position - target.origin, model.clusters, model.n_clusters
    every = max(1, config.decimation * len(source) // config.vertices)
    chosen = np.sort(model.curve[::every])
    normal = np.empty_like(source)
    vertex_normals(source, model.faces, normal)
    start, normal, cluster = source[chosen], normal[chosen], model.cluster[chosen]
    nearest, share = clusters.nearest[chosen], clusters.share[chosen]
    cell = config.occluder_cell * model.edge_length * np.sqrt(every)
    limits = VisibilityLimits(cell, config.hidden_depth, config.facing_cosine)
    points = target.subsampled(config.decimation)
    middle, rotation = np.empty((K, 3)), np.tile(np.eye(3), (K, 1, 1))
    centers(source, model.cluster, middle)
    centre = middle.copy()
    rest, arm = centre[clusters.ends[:, 1]] - centre[clusters.ends[:, 0]], np.ascontiguousarray((start - centre[cluster]).T)
    pair = np.empty((len(points.signed), len(chosen)), np.float32)
    mass, goal = np.empty(len(chosen), np.float32), np.empty((3, len(chosen)), np.float32)
    area = model.vertex_share[chosen]
    estimate, visible = start.copy(), np.ones(len(chosen), bool)
    first, last, reach = config.first_stiffness, config.last_stiffness, config.first_reach
    balancing = config.balancing
    if target.sensors is not None:  # at the rims of a partial view cloud and visible garment may differ
        last, balancing = config.one_sided_stiffness, 0
    for step in range(config.steps):
        progress = step / max(config.steps - 1, 1)
        turned = np.einsum("vab,vb->va", rotation[cluster], normal)
        if target.sensors is not None:
            mark_visible(estimate, turned, NO_BODY, NO_SURFELS, NO_ORIGIN, target.sensors, limits, visible)
        vertices = OrientedVertices(rows(estimate), rows(turned), visible * area)
        pairing = Pairing(reach * (config.last_reach / reach) ** progress, balancing, config.outlier_weight)
        correspond(vertices, points, pairing, pair, mass, goal)
        if not mass.any():
            return position
        graph = ClusterGraph(clusters.ends, rest, first * (last / first) ** progress / K)
        kernels.settle(Goals(cluster, arm, mass, goal), graph, config.iterations, middle, rotation)
        kernels.blend(start, nearest, share, centre, middle, rotation, estimate)
    moved = np.empty_like(source)
    kernels.blend(source, clusters.nearest, clusters.share, centre, middle, rotation, moved)
    return moved + target.origin


def rows(position: np.ndarray) -> np.ndarray:
    """(3, V) float32 of (V, 3), row after row: the transpose of a single row would be another type to a kernel."""
    return np.ascontiguousarray(position.T, np.float32)
