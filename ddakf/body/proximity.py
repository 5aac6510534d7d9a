"""The body's closest-point structure, shared by collision (stage E) and contact-aware prediction (stage A).

Topology and a balanced tree over the faces are built once per body; per frame the tree's boxes are refitted to the
new vertices (no rebuilding, no grid whose size would depend on where the body is). Queries are exact: the tree
prunes by box distances only. The sign comes from angle-weighted pseudo-normals (Baerentzen and Aanaes 2005), right
at edges and corners too.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.kernels import face_walk as walk_kernels
from ddakf.kernels import proximity as kernels
from ddakf.kernels import signed_distance as distance_kernels
from ddakf.kernels import surface_motion as motion_kernels
from ddakf.kernels.proximity import BodyTree
from ddakf.kernels.signed_distance import BodyFaces, Contact
from ddakf.kernels.surface_motion import BodyMotion
from ddakf.mesh import Mesh


class Body(NamedTuple):
    """Constant for the life of a session. The F faces are renumbered: those of a leaf are consecutive; L leaves."""

    faces: np.ndarray  # (F, 3) int32, in leaf order
    original_face: np.ndarray  # (F,) int32, index in the mesh of a face in leaf order
    leaf_start: np.ndarray  # (L + 1,) int32, first face of each leaf
    leaf_of: np.ndarray  # (F,) int32, leaf of each face
    n_inner: int  # inner nodes of the tree
    shift: int  # the children of node n are 8 n + shift + 0..7
    neighbour: np.ndarray  # (F, 3) int32, the face across the edge from corner c to c + 1; -1 at a boundary
    ring_start: np.ndarray  # (B + 1,) int32
    ring_face: np.ndarray  # (3 F,) int32, the faces around vertex i are ring_face[ring_start[i]:ring_start[i + 1]]


class BodySurface(NamedTuple):
    """A body in the pose of one frame."""

    vertices: np.ndarray  # (B, 3) m
    triangles: np.ndarray  # (L, 15, 8), the faces as the search reads them, eight to a leaf
    boxes: np.ndarray  # (G, 6, 8) m, lower and upper corners of the eight children of every inner node


class SurfaceMotion(NamedTuple):
    """What the body's motion does to points near it."""

    position: np.ndarray  # (N, 3) m, after the motion
    weight: np.ndarray  # (N,) share of the body's motion that was applied, in [0, 1]


def build(mesh: Mesh) -> Body:
    """Adjacency and tree of a body; the tree is shaped by the pose of ``mesh``, and right in any other."""
    order, leaf_start, leaf_of = _tree_order(mesh.vertices[mesh.faces].mean(axis=1))
    faces = np.ascontiguousarray(mesh.faces[order], np.int32)
    ring_start = np.zeros(mesh.n_vertices + 1, np.int32)
    ring_start[1:] = np.cumsum(np.bincount(faces.ravel(), minlength=mesh.n_vertices))
    ring_face = (np.argsort(faces.ravel(), kind="stable") // 3).astype(np.int32)
    n_inner, shift = _tree_shape(len(leaf_start) - 1)
    return Body(
        faces, order.astype(np.int32), leaf_start, leaf_of, n_inner, shift, _neighbours(faces), ring_start, ring_face
    )


def refresh(body: Body, vertices: np.ndarray) -> BodySurface:
    """The body with its vertices (B, 3) at a new place, metres."""
    triangles = np.empty((len(body.leaf_start) - 1, 15, kernels.LANES))
    surface = BodySurface(np.array(vertices, np.float64), triangles, np.empty((body.n_inner, 6, kernels.LANES)))
    kernels.refit(surface.vertices, body.faces, body.leaf_start, body.shift, surface.triangles, surface.boxes)
    return surface


def closest_points(
    body: Body,
    surface: BodySurface,
    points: np.ndarray,
    radius: float,
    hint: np.ndarray | None = None,
) -> Contact:
    """Exact closest points on the body's surface.

    Args:
        body, surface: from :func:`build` and :func:`refresh`.
        points: (N, 3) metres.
        radius: how far to look, metres.
        hint: (N,) int32 faces that are probably close, such as ``Contact.face`` of the iteration before; makes the
            search a fifth faster and never changes the result.
    """
    return _contacts(body, surface, points, _nearest_faces(body, surface, points, radius, hint))


def followed_points(
    body: Body, surface: BodySurface, points: np.ndarray, radius: float, face: np.ndarray, due: slice
) -> Contact:
    """Closest points on the surface around former closest faces, and exact ones of a part of the points.

    Args:
        body, surface, points, radius: as for :func:`closest_points`.
        face: (N,) int32 faces that were closest a moment ago, or -1: such a point is searched, as a walk cannot begin.
        due: points that are searched in the whole body.
    """
    found, searched = face.copy(), face < 0
    walk_kernels.walk(_faces(body, surface), points, radius, found)
    searched[due] = True
    found[searched] = _nearest_faces(body, surface, points[searched], radius, found[searched])
    return _contacts(body, surface, points, found)


def _faces(body: Body, surface: BodySurface) -> BodyFaces:
    return BodyFaces(surface.vertices, body.faces, body.neighbour, body.ring_start, body.ring_face)


def _nearest_faces(
    body: Body, surface: BodySurface, points: np.ndarray, radius: float, hint: np.ndarray | None
) -> np.ndarray:
    face = np.empty(len(points), np.int32)
    tree = BodyTree(surface.triangles, surface.boxes, body.leaf_start, body.leaf_of, body.shift)
    kernels.nearest_faces(tree, points, radius, np.full(len(points), -1, np.int32) if hint is None else hint, face)
    return face


def _contacts(body: Body, surface: BodySurface, points: np.ndarray, face: np.ndarray) -> Contact:
    n = len(points)
    out = Contact(face, np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3)), np.empty(n))
    distance_kernels.contacts(_faces(body, surface), points, out)
    return out


def surface_motion(
    body: Body,
    last: np.ndarray,
    now: np.ndarray,
    points: np.ndarray,
    contact: Contact,
    radius: float,
    near: float | None = None,
) -> SurfaceMotion:
    """Carries points with the body's surface under them, from one frame to the next.

    Every face has a rotation (the polar factor of its in-plane deformation, with its normal), every vertex the mean
    of its one-ring's, and a point the barycentric mean of its face's vertices: the offset from the body turns
    continuously from face to face. Degenerate faces count for nothing; where there are only such, the motion is a
    translation. Within ``near`` the point moves with the body, from there the share falls smoothly to none at
    ``radius``.

    Args:
        body: from :func:`build`.
        last: (B, 3) body vertices when ``points`` were estimated, metres.
        now: (B, 3) body vertices to move to, metres.
        points: (N, 3) metres.
        contact: the points' faces and barycentric coordinates, found in any pose of this body.
        radius: distance from the body at which its motion has no influence, metres.
        near: distance up to which a point moves with the body, metres, less than ``radius``; half of it by default.
    """
    near = 0.5 * radius if near is None else near
    position, weight = np.empty_like(points), np.empty(len(points))
    rotation, needed = np.empty((len(last), 4)), np.empty(len(last), np.uint8)
    motion_kernels.vertex_rotations(last, now, body.faces, contact.face, needed, rotation)
    motion_kernels.carry(BodyMotion(last, now, rotation), body.faces, contact, points, near, radius, position, weight)
    return SurfaceMotion(position, weight)


def _tree_order(centroids: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Faces in leaf order, each leaf's start, each face's leaf.

    Every level halves its ranges at the median of their longest axis, down to at most eight faces. The number of
    leaves is a power of two, and at least two.
    """
    n = len(centroids)
    depth = max(1, int(np.ceil(np.log2(n / kernels.LANES))))
    leaf_start = np.arange(2**depth + 1) * n // 2**depth
    leaf_of = np.searchsorted(leaf_start, np.arange(n), side="right") - 1
    order = np.arange(n)
    for level in range(depth):
        segment = leaf_of >> (depth - level)
        first = np.flatnonzero(np.diff(segment, prepend=-1))
        segment = np.repeat(np.arange(len(first)), np.diff(first, append=n))
        extent = np.maximum.reduceat(centroids[order], first) - np.minimum.reduceat(centroids[order], first)
        order = order[np.lexsort((centroids[order, extent.argmax(axis=1)[segment]], segment))]
    return order, leaf_start.astype(np.int32), leaf_of.astype(np.int32)


def _tree_shape(n_leaves: int) -> tuple[int, int]:
    """Number of inner nodes and shift of a tree with eight children per node, at the root as few as are needed."""
    n_inner, at_root = 1, n_leaves
    while at_root > kernels.LANES:
        at_root //= kernels.LANES
    level = at_root
    while level < n_leaves:
        n_inner, level = n_inner + level, level * kernels.LANES
    return n_inner, at_root - 7


def _neighbours(faces: np.ndarray) -> np.ndarray:
    """(F, 3) int32: the other face at each edge."""
    n = len(faces)
    start, end = faces.T.ravel(), np.roll(faces, -1, axis=1).T.ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((high, low))
    first, second = order[:-1], order[1:]
    paired = (low[first] == low[second]) & (high[first] == high[second])
    first, second = first[paired], second[paired]
    neighbour = np.full(3 * n, -1, np.int32)
    neighbour[first], neighbour[second] = second % n, first % n
    return np.ascontiguousarray(neighbour.reshape(3, n).T)
