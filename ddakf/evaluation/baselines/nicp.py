"""Non-rigid ICP with as-rigid-as-possible regularisation, on the dense vertices.

Energy: sum_i w_i |x_i - c_i|^2 + stiffness sum_ij |(x_i - x_j) - (R_i + R_j) / 2 (r_i - r_j)|^2 over the edges, where c_i is
the mean of the nearest points of the cloud, w_i their weight, R_i the rotation of a vertex, r the rest shape; minimised by
turns over c, R and x (Sorkine and Alexa 2007, "As-rigid-as-possible surface modeling"; correspondences as in Amberg,
Romdhani and Vetter 2007, "Optimal step nonrigid ICP"). The source shape is always the rest template: replacing it by the last
estimate drifts.

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

from ddakf.mesh import Mesh, vertex_normals

LEAST_POINTS = 8  # a frame with fewer moves on as predicted


@dataclass(frozen=True)
class NicpSettings:
    """Numbers of the method.

    Attributes:
        stiffness: of an edge against a correspondence of full weight.
        iterations: per frame, all of them.
        gate: metres; a correspondence at distance d weighs (1 - (d / gate)^2)^2, and nothing beyond.
        neighbours: nearest points that a correspondence is the mean of.
        momentum: share of the last frame's displacement with which the next one begins.
    """

    stiffness: float = 8.0
    iterations: int = 12
    gate: float = 0.10
    neighbours: int = 4
    momentum: float = 0.8


class NonRigidIcp:
    """See the module. Knows no body and no time: the displacement of a frame is that of the last one, however long it was."""

    def __init__(self, settings: NicpSettings | None = None):
        self.settings = NicpSettings() if settings is None else settings

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.Baseline`."""
        n = garment.n_vertices
        first, second = garment.edges.T
        self._from, self._to = np.concatenate([first, second]), np.concatenate([second, first])
        self._faces, self._rest = garment.faces, garment.vertices[self._from] - garment.vertices[self._to]
        entries = np.arange(len(self._from))
        self._sum = sparse.csr_array((np.ones(len(entries)), (self._from, entries)), (n, len(entries)))
        adjacency = sparse.csr_array((np.ones(len(entries)), (self._from, self._to)), (n, n))
        laplacian = sparse.diags_array(adjacency.sum(axis=1)) - adjacency
        self._factor = splu((self.settings.stiffness * laplacian + sparse.eye_array(n)).tocsc())
        self._position = np.array(vertices, np.float64)
        self._last = self._position.copy()

    def step(
        self,
        points: np.ndarray,
        timestamp: float,
        sensor_origin: np.ndarray | None,
        body_vertices: np.ndarray | None,
    ) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.Baseline`."""
        x = self._position + self.settings.momentum * (self._position - self._last)
        self._last = self._position
        if len(points) >= max(LEAST_POINTS, self.settings.neighbours):
            tree = cKDTree(np.asarray(points, np.float64))
            for _ in range(self.settings.iterations):
                x = self._iterate(x, tree, sensor_origin)
        self._position = x
        return x.copy()

    def _iterate(self, x: np.ndarray, tree: cKDTree, sensor_origin: np.ndarray | None) -> np.ndarray:
        distance, nearest = tree.query(x, k=self.settings.neighbours)
        weight = np.square(np.maximum(1 - np.square(distance[:, 0] / self.settings.gate), 0))
        if sensor_origin is not None:
            origin = sensor_origin[nearest[:, 0]] if np.ndim(sensor_origin) == 2 else sensor_origin
            weight *= (vertex_normals(x, self._faces) * (origin - x)).sum(axis=1) > 0
        pull = weight[:, None] * (tree.data[nearest].mean(axis=1) - x)
        return self._factor.solve(self.settings.stiffness * self._rigid_laplacian(x) + x + pull)

    def _rigid_laplacian(self, x: np.ndarray) -> np.ndarray:
        """(V, 3) sum_j (R_i + R_j) / 2 (r_i - r_j) with the best rotations of the one-rings of x."""
        edge = x[self._from] - x[self._to]
        outer = (edge[:, :, None] * self._rest[:, None, :]).reshape(-1, 9)
        rotation = closest_rotations((self._sum @ outer).reshape(-1, 3, 3))
        turned = 0.5 * ((rotation[self._from] + rotation[self._to]) @ self._rest[:, :, None])[:, :, 0]
        return self._sum @ turned


def closest_rotations(matrices: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rotations R that maximise trace(R' M) for matrices M (n, 3, 3) (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt
