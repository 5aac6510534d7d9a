"""Non-rigid ICP with as-rigid-as-possible regularisation, on the dense vertices.

Energy: sum_i w_i |x_i - c_i|^2 + stiffness sum_ij |(x_i - x_j) - (R_i + R_j) / 2 (r_i - r_j)|^2 over the edges, where c_i is
the mean of the nearest points of the cloud, w_i their weight, R_i the rotation of a vertex, r the start's shape; minimised
alternately over c, R and x (Sorkine and Alexa 2007, "As-rigid-as-possible surface modeling"; correspondences as in Amberg,
Romdhani and Vetter 2007, "Optimal step nonrigid ICP"). The source shape is always the start's, which has the folds that the
template lacks; replacing it by the last estimate drifts.

The weights change in every iteration and the matrix does not: the data term is majorised,
w |x - c|^2 <= |x - (x' + w (c - x'))|^2 + const for w <= 1 with x' the present estimate, so that one sparse factorisation
serves a whole recording.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from ddakf.evaluation.baselines.body_support import support_of
from ddakf.evaluation.baselines.linear_algebra import best_rotations, graph_laplacian
from ddakf.evaluation.baselines.matching import facing
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh, vertex_normals

LEAST_POINTS = 8  # a frame with fewer is predicted only
ROTATION_STEPS = 2  # per iteration; they start where the last one ended
TINY = 1e-20  # m^2


@dataclass(frozen=True)
class NicpSettings:
    """Numbers of the method; default stiffness, gate and hold are the best of ``benchmarks/results/tuning.json``.

    Attributes:
        stiffness: of an edge against a correspondence of full weight.
        iterations: per frame, always all.
        gate: metres; a correspondence at distance d weighs (1 - (d / gate)^2)^2, and nothing beyond.
        neighbours: nearest points that a correspondence is the mean of.
        momentum: share of the last frame's displacement with which the next one begins.
        hold: weight of a hidden vertex on the body, at most 1, see :mod:`.body_support`.
    """

    stiffness: float = 12.0
    iterations: int = 24
    gate: float = 0.07
    neighbours: int = 4
    momentum: float = 0.8
    hold: float = 0.009


TUNED = NicpSettings()
TWELVE_ITERATIONS = NicpSettings(stiffness=8.0, iterations=12)  # half the time of a frame, and softer


class NonRigidIcp:
    """See the module. Uses no time: the displacement of a frame is that of the last one, whatever their durations; relative to
    the body where one is given."""

    def __init__(self, settings: NicpSettings = TUNED):
        self.settings = settings

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        n, (first, second) = garment.n_vertices, garment.edges.T
        i, j = np.concatenate([first, second]), np.concatenate([second, first])
        self._factor = splu((self.settings.stiffness * graph_laplacian(garment) + sparse.eye_array(n)).tocsc())
        # row 3 i + k: component k of r_i - r_j in column j, and minus their sum in column i
        rest = np.asarray(vertices, np.float64)
        edge = rest[i] - rest[j]
        entries, row = np.concatenate([edge.ravel(), -edge.ravel()]), (3 * i[:, None] + np.arange(3)).ravel()
        column = np.concatenate([np.repeat(j, 3), np.repeat(i, 3)])
        self._lever = sparse.csr_array((entries, (np.tile(row, 2), column)), (3 * n, n))
        self._lever_transposed = self._lever.T.tocsr()
        self._faces = garment.faces
        self._rotation = best_rotations(self._edge_products(np.asarray(vertices, np.float64)))
        self._position = np.array(vertices, np.float64)
        self._displacement = np.zeros_like(self._position)  # of the last frame, beyond what the body carried
        self._support = support_of(body, self._position, self.settings.hold)

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        carried = self._support.begin(frame, self._position)
        x = carried + self.settings.momentum * self._displacement
        if len(frame.points) >= max(LEAST_POINTS, self.settings.neighbours):
            # an unbalanced tree with loose boxes is quicker to build, and rejects distant queries quickly
            tree = cKDTree(np.asarray(frame.points, np.float64), balanced_tree=False, compact_nodes=False)
            for _ in range(self.settings.iterations):
                x = self._support.outside(self._iterate(x, tree, frame.sensor_origin))
        self._position = self._support.outside(x)
        self._displacement = self._position - carried
        return self._position.copy()

    def _iterate(self, x: np.ndarray, tree: cKDTree, sensor_origin: np.ndarray | None) -> np.ndarray:
        settings = self.settings
        distance, nearest = tree.query(x, k=np.arange(1, settings.neighbours + 1), distance_upper_bound=settings.gate)
        found = nearest[:, 0] < tree.n
        nearest = np.where(nearest < tree.n, nearest, np.where(found, nearest[:, 0], 0)[:, None])
        weight = np.where(found, np.square(1 - np.square(np.where(found, distance[:, 0], 0) / settings.gate)), 0)
        if sensor_origin is not None:
            weight *= facing(x, vertex_normals(x, self._faces), sensor_origin, nearest[:, 0])
        pull = weight[:, None] * (tree.data[nearest].mean(axis=1) - x)
        pull += self._support.held(weight)[:, None] * (self._support.place - x)
        self._rotation = turned(self._rotation, self._edge_products(x), ROTATION_STEPS)
        # sum_j (R_i + R_j) / 2 (r_i - r_j), by both ends of every edge
        rigid = -0.5 * (self._lever_transposed @ self._rotation.transpose(0, 2, 1).reshape(-1, 3))
        return self._factor.solve(settings.stiffness * rigid + x + pull)

    def _edge_products(self, x: np.ndarray) -> np.ndarray:
        """(V, 3, 3) sum_j (x_i - x_j) (r_i - r_j)' over the one-rings, whose closest rotations are those of x (V, 3)."""
        return -(self._lever @ x).reshape(-1, 3, 3).transpose(0, 2, 1)


def turned(rotation: np.ndarray, matrices: np.ndarray, steps: int) -> np.ndarray:
    """Rotations R (n, 3, 3) after steps toward :func:`best_rotations` of M, at a third of its cost from nearby: omega =
    sum_k r_k x m_k / |sum_k r_k . m_k| over the columns (Mueller, Bender, Chentanez and Macklin 2016, "A robust method to extract
    the rotational part of deformations"), applied as Cayley's rotation."""
    for _ in range(steps):
        product = matrices @ rotation.transpose(0, 2, 1)
        h = 0.5 * np.stack([product[:, a, b] - product[:, b, a] for a, b in ((2, 1), (0, 2), (1, 0))], axis=1)
        h /= np.abs(np.trace(product, axis1=1, axis2=2))[:, None] + TINY
        square = (h**2).sum(axis=1)[:, None, None]
        cayley = h[:, :, None] * h[:, None, :] + 0.5 * (1 - square) * np.eye(3)
        for axis, (a, b) in enumerate(((2, 1), (0, 2), (1, 0))):
            cayley[:, a, b] += h[:, axis]
            cayley[:, b, a] -= h[:, axis]
        rotation = (2 / (1 + square)) * cayley @ rotation
    return rotation
