"""Shape: strain, bending and crossed layers of a garment, against its rest shape or its truth."""

from __future__ import annotations

import numpy as np

from ddakf.mesh import Mesh
from ddakf.physics import bend, self_collision


class ShapeDifference:
    """Strain and bending of one pose of a mesh against another: the rest shape's, or the truth's.

    Args:
        mesh: gives the edges and hinges.
    """

    def __init__(self, mesh: Mesh):
        self._edges, self._hinges = mesh.edges, bend.build(mesh).stencil

    def stretch(self, vertices: np.ndarray, reference: np.ndarray) -> float:
        """mean_e | |e| / |e_reference| - 1 | over the edges, of poses (V, 3); per cent."""
        length, other = (self._lengths(np.asarray(pose, np.float64)) for pose in (vertices, reference))
        return float(100 * np.abs(length / np.maximum(other, 1e-9) - 1).mean())

    def bend(self, vertices: np.ndarray, reference: np.ndarray) -> float:
        """mean_h |theta - theta_reference| over the dihedral angles, the difference wrapped, of poses (V, 3); degrees."""
        angle, other = (self._angles(np.asarray(pose, np.float64)) for pose in (vertices, reference))
        difference = np.abs(angle - other)
        return float(np.degrees(np.minimum(difference, 2 * np.pi - difference).mean()))

    def _lengths(self, vertices: np.ndarray) -> np.ndarray:
        return np.linalg.norm(vertices[self._edges[:, 1]] - vertices[self._edges[:, 0]], axis=1)

    def _angles(self, vertices: np.ndarray) -> np.ndarray:
        """Signed angle between the normals of the two faces of every hinge, radians; 0 when flat."""
        start, end, one, other = (vertices[self._hinges[:, corner]] for corner in range(4))
        edge = end - start
        n1, n2 = np.cross(edge, one - start), np.cross(other - start, edge)
        sine = -np.linalg.norm(edge, axis=1) * (n1 * (other - start)).sum(axis=1)
        return np.arctan2(sine, (n1 * n2).sum(axis=1))


def crossings(estimate: np.ndarray, truth: np.ndarray, mesh: Mesh) -> int:
    """Number of vertices on another side of the adjacent layer than in the truth.

    The adjacent layer of a vertex is the nearest vertex that is not close to it at rest and at most an edge length away in the
    truth: see :mod:`ddakf.physics.self_collision`. The normal there tells the side, in each of the two poses.

    Args:
        estimate, truth: (V, 3) metres.
        mesh: the garment, at rest.
    """
    estimate, truth = (np.ascontiguousarray(pose, np.float64) for pose in (estimate, truth))
    layers = self_collision.find(truth, estimate, self_collision.build(mesh, np.zeros(len(truth)), 0.0))
    i, j = layers.stencil.T
    return int((np.einsum("ca,ca->c", layers.normal, estimate[i] - estimate[j]) < 0.0).sum())
