"""The Hausdorff distance of two surfaces, over all of their points and not only over their vertices.

The distance to a surface is greatest somewhere within a face just as well as at a vertex. Branch and bound finds it: the distance
to one face f of the other surface is convex, so over a triangle with corners c_i it is at most max_i d(c_i, f), and the
distance to the whole surface is at most that of any f; faces whose bound exceeds the greatest distance found so far are
quartered (Tang, Lee and Kim 2009, "Interactive Hausdorff distance computation for general polygonal models").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.body import proximity
from ddakf.evaluation.metrics.vertex_error import MM
from ddakf.mesh import Mesh

TOLERANCE = 1e-5  # m: largest shortfall of the result from the supremum


class Hausdorff:
    """d_H(A, B) = max(sup_{a in A} inf_{b in B} |a - b|, sup_{b in B} inf_{a in A} |a - b|) of two moving surfaces.

    Args:
        mesh: the faces of A, and the vertices of some pose.
        other: of B; default those of A.
    """

    def __init__(self, mesh: Mesh, other: Mesh | None = None):
        self._mesh, self._other = mesh, mesh if other is None else other
        self._tree = proximity.build(mesh)
        self._other_tree = self._tree if other is None else proximity.build(other)

    def __call__(self, vertices: np.ndarray, others: np.ndarray) -> float:
        """The distance of two poses, over all points of both surfaces; millimetres.

        Args:
            vertices, others: (V, 3) of A and (W, 3) of B, metres.

        Returns:
            A distance that some point has; the supremum is at most :data:`TOLERANCE` more. NaN where a vertex is not finite.
        """
        vertices, others = (np.ascontiguousarray(pose, np.float64) for pose in (vertices, others))
        if not (np.isfinite(vertices).all() and np.isfinite(others).all()):
            return float("nan")
        apart = None
        if self._other is self._mesh:  # a point and its counterpart are at most as far apart as the farthest corners
            apart = np.linalg.norm(vertices - others, axis=1)[self._mesh.faces].max(axis=1)

        def left(greatest: float) -> np.ndarray | slice:
            """The faces on which a point may be farther away."""
            return slice(None) if apart is None else apart > greatest + TOLERANCE

        there = _Triangles.from_faces(vertices, self._mesh.faces, _Target.at_pose(self._other_tree, others))
        greatest = there.distance.max()
        greatest = _farthest(there.where(left(greatest)), greatest)
        # only now, since of a torn estimate few are left, and a search in one is long
        back = _Triangles.from_faces(others, self._other.faces[left(greatest)], _Target.at_pose(self._tree, vertices))
        return float(MM * _farthest(back, greatest))


class _Target(NamedTuple):
    """The surface that distances are to."""

    tree: proximity.Body
    surface: proximity.BodySurface
    triangles: np.ndarray  # (F, 3, 3) m, in the order of the tree's faces

    @classmethod
    def at_pose(cls, tree: proximity.Body, vertices: np.ndarray) -> _Target:
        return cls(tree, proximity.refresh(tree, vertices), vertices[tree.faces])

    def nearest(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Distances (N,) of points (N, 3), metres, and the faces (N,) that they are to."""
        found = proximity.closest_points(self.tree, self.surface, np.ascontiguousarray(points), radius=np.inf)
        return np.abs(found.distance), found.face


class _Triangles(NamedTuple):
    """Triangles on one surface, with bounds of the distance to the other."""

    corners: np.ndarray  # (n, 3, 3) m
    distance: np.ndarray  # (n, 3) m, of the corners
    face: np.ndarray  # (n, 3) the target's face that it is to
    target: _Target

    @classmethod
    def from_faces(cls, vertices: np.ndarray, faces: np.ndarray, target: _Target) -> _Triangles:
        used, corner = np.unique(faces, return_inverse=True)
        distance, face = target.nearest(vertices[used])
        return cls(vertices[faces], distance[corner].reshape(-1, 3), face[corner].reshape(-1, 3), target)

    def where(self, chosen: np.ndarray) -> _Triangles:
        return _Triangles(self.corners[chosen], self.distance[chosen], self.face[chosen], self.target)

    def reach(self) -> np.ndarray:
        """(n,) bound on the distance of any point of a triangle: a corner's, and the way to the corner farthest from it."""
        edge = np.linalg.norm(self.corners - np.roll(self.corners, -1, axis=1), axis=2)  # from corner k to k + 1
        return (self.distance + np.maximum(edge, np.roll(edge, 1, axis=1))).min(axis=1)

    def bound(self, rank: int) -> np.ndarray:
        """(n,) another: max_i d(c_i, f), with f the face next to the corner that is the farthest but ``rank``."""
        rows, corner = np.arange(len(self.face)), np.argsort(self.distance, axis=1)[:, 2 - rank]
        face = self.target.triangles[self.face[rows, corner]]
        others = [_to_triangle(self.corners[rows, (corner + k) % 3], face) for k in (1, 2)]
        return np.maximum.reduce([self.distance[rows, corner], *others])

    def quarters(self) -> _Triangles:
        """The four triangles between the corners and the middles of the edges."""
        middle = 0.5 * (self.corners + np.roll(self.corners, -1, axis=1))  # of the edge from corner k to k + 1
        distance, face = (found.reshape(-1, 3) for found in self.target.nearest(middle.reshape(-1, 3)))
        parts = (
            np.concatenate([new, *(np.stack([old[:, k], new[:, k], new[:, k - 1]], axis=1) for k in range(3))])
            for old, new in ((self.corners, middle), (self.distance, distance), (self.face, face))
        )
        return _Triangles(*parts, self.target)


def _farthest(triangles: _Triangles, greatest: float) -> float:
    """The greatest distance of a point of the triangles, or ``greatest`` where that is more; metres."""
    greatest = max(greatest, triangles.distance.max(initial=0.0))
    while True:
        triangles = triangles.where(triangles.reach() > greatest + TOLERANCE)
        for rank in range(3):
            triangles = triangles.where(triangles.bound(rank) > greatest + TOLERANCE)
        if len(triangles.corners) == 0:
            return greatest
        triangles = triangles.quarters()
        greatest = max(greatest, triangles.distance.max())


def _to_triangle(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(n,) distances of points (n, 3) to one triangle each (n, 3, 3): to the plane above the inside, else to the nearest edge."""
    start, edge = triangles, np.roll(triangles, -1, axis=1) - triangles
    away = points[:, None] - start
    share = (away * edge).sum(axis=2) / np.maximum((edge**2).sum(axis=2), 1e-30)
    nearest = np.linalg.norm(away - np.clip(share, 0, 1)[:, :, None] * edge, axis=2).min(axis=1)
    normal = np.cross(edge[:, 0], edge[:, 1])
    area = np.linalg.norm(normal, axis=1)
    above = ((np.cross(normal[:, None], edge) * away).sum(axis=2) >= 0).all(axis=1) & (area > 0)
    height = np.abs((normal * away[:, 0]).sum(axis=1)) / np.maximum(area, 1e-30)
    return np.where(above, height, nearest)
