"""Matching of vertices with points, shared by the baselines: normals, nearest points, vertices that face a sensor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

LEAST_POINTS = 20  # a smaller cloud counts as a frame without measurements
TINY = 1e-30  # m^2


class VertexNormals:
    """Area-weighted unit normals of a mesh in any pose; those of :func:`ddakf.mesh.vertex_normals`, at a fraction of the time.

    Args:
        mesh: gives the faces.
    """

    def __init__(self, mesh: Mesh):
        corner, face = mesh.faces.ravel(), np.repeat(np.arange(mesh.n_faces), 3)
        self._faces = mesh.faces
        self._sum = sparse.csr_array((np.ones(len(face)), (corner, face)), (mesh.n_vertices, mesh.n_faces))

    def __call__(self, x: np.ndarray) -> np.ndarray:
        """(V, 3) of the vertices x (V, 3)."""
        a, b, c = (x[self._faces[:, corner]] for corner in range(3))
        normals = self._sum @ np.cross(b - a, c - a)
        return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), TINY)


class Matches(NamedTuple):
    """A point of the cloud for every vertex; its weight is 0 without one."""

    points: np.ndarray  # (V, 3) m
    normals: np.ndarray  # (V, 3) of the points, on the side of the vertices' own
    weight: np.ndarray  # (V,) in [0, 1]


@dataclass(frozen=True)
class MatchSettings:
    """Settings of the matching.

    Attributes:
        gate: metres; points farther away are no match, see :meth:`Scan.match`.
        normal_cosine: least between the normals of a vertex and its point; of either sign where there is no sensor.
        neighbours: number of points around a point whose direction of least variance is its normal.
    """

    gate: float = 0.1
    normal_cosine: float = 0.5
    neighbours: int = 8


class Scan:
    """A frame's cloud with a search tree and normals.

    Args:
        frame: its points and their sensor's place.
        settings: see :class:`MatchSettings`.
    """

    def __init__(self, frame: CapturedFrame, settings: MatchSettings):
        # an unbalanced tree with loose boxes is quicker to build, and rejects distant queries quickly
        self._tree = cKDTree(np.asarray(frame.points, np.float64), balanced_tree=False, compact_nodes=False)
        self._origin, self._settings = frame.sensor_origin, settings
        self._normals, self._known = np.zeros_like(self._tree.data), np.zeros(self._tree.n, bool)

    def match(self, x: np.ndarray, normals: np.ndarray) -> Matches:
        """The nearest point of every vertex, if it lies within the gate and its normal agrees.

        A point at distance d weighs (1 - (d / gate)^2)^2 (Tukey's biweight). Where there is a sensor, vertices that face away
        from it have no point.

        Args:
            x, normals: (V, 3) of the vertices.
        """
        gate = self._settings.gate
        distance, nearest = self._tree.query(x, distance_upper_bound=gate)
        weight = np.square(1 - np.square(np.minimum(distance / gate, 1)))
        nearest = np.where(nearest < self._tree.n, nearest, 0)
        its = self._normals_of(nearest)
        cosine = (normals * its).sum(axis=1)
        if self._origin is None:
            its = np.where(cosine[:, None] < 0, -its, its)
            cosine = np.abs(cosine)
        seen = (cosine > self._settings.normal_cosine) & facing(x, normals, self._origin, nearest)
        return Matches(self._tree.data[nearest], its, weight * seen)

    def _normals_of(self, index: np.ndarray) -> np.ndarray:
        """Normals of the points of these indices, computed on the first request."""
        new = np.unique(index[~self._known[index]])
        if len(new):
            points = self._tree.data
            around = points[self._tree.query(points[new], k=min(self._settings.neighbours, len(points)))[1]]
            around = around - around.mean(axis=1, keepdims=True)
            normals = np.linalg.eigh(around.transpose(0, 2, 1) @ around)[1][:, :, 0]
            if self._origin is not None:
                origin = self._origin[new] if np.ndim(self._origin) == 2 else self._origin
                normals *= np.where((normals * (origin - points[new])).sum(axis=1) < 0, -1, 1)[:, None]
            self._normals[new], self._known[new] = normals, True
        return self._normals[index]


def facing(x: np.ndarray, normals: np.ndarray, sensor_origin: np.ndarray | None, nearest: np.ndarray) -> np.ndarray:
    """(V,) bool: vertices x (V, 3) whose normal (V, 3) is turned to the sensor; all of them where none is known.

    Args:
        sensor_origin: (3,), or (N, 3) of the points.
        nearest: (V,) point whose sensor counts for a vertex.
    """
    if sensor_origin is None:
        return np.ones(len(x), bool)
    origin = sensor_origin[nearest] if np.ndim(sensor_origin) == 2 else sensor_origin
    return (normals * (origin - x)).sum(axis=1) > 0


def rigid_motion(shape: np.ndarray, target: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and shift (3,) that lay a shape (V, 3) nearest to another (V, 3) (Kabsch 1976)."""
    middle, centre = shape.mean(axis=0), target.mean(axis=0)
    u, _, vt = np.linalg.svd((target - centre).T @ (shape - middle))
    u[:, 2] *= np.linalg.det(u @ vt)
    return u @ vt, centre - u @ vt @ middle
