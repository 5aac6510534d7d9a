"""Signed distance from a body at the closest points of its faces, by pseudo-normals (Baerentzen and Aanaes 2005)."""

from math import acos, inf, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels.triangles import FEATURE, closest_on_triangle, cross, dot, edges, face_normal, ring_step

SURFACE = 1e-7  # m: closer than this, the direction to the closest point is rounding noise


class BodyFaces(NamedTuple):
    """The faces of a body in the pose of one frame, and their adjacency."""

    vertices: np.ndarray  # (B, 3) m
    faces: np.ndarray  # (F, 3) int32, in leaf order
    neighbour: np.ndarray  # (F, 3) int32, the face across the edge from corner c to c + 1; -1 at a boundary
    ring_start: np.ndarray  # (B + 1,) int32
    ring_face: np.ndarray  # (3 F,) int32, the faces around vertex i are ring_face[ring_start[i]:ring_start[i + 1]]


class Contact(NamedTuple):
    """Closest points of N points on a body. With none within the radius: face -1, distance infinite, the rest 0."""

    face: np.ndarray  # (N,) int32, in leaf order
    barycentric: np.ndarray  # (N, 3)
    point: np.ndarray  # (N, 3) m, on the body
    normal: np.ndarray  # (N, 3) unit, outward: the gradient of the signed distance
    distance: np.ndarray  # (N,) m, negative inside


@njit(nogil=True, cache=True, error_model="numpy")
def corner_angle(vertices, i, j, k):
    """Angle at vertex i of the face i, j, k; 0 where an edge has no length."""
    b = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
    c = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1], vertices[k, 2] - vertices[i, 2]
    lengths = sqrt(dot(b, b) * dot(c, c))
    return acos(min(1.0, max(-1.0, dot(b, c) / lengths))) if lengths > 0.0 else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def pseudo_normal(vertices, faces, neighbour, ring_start, ring_face, f, barycentric):
    """Normal at a point of a face, of any length: the face's, both faces' at an edge, by angle around a corner.

    Args:
        vertices, faces, neighbour, ring_start, ring_face: of :class:`BodyFaces`.
        f: the face.
        barycentric: (u, v, w) of the point.
    """
    u, v, w = barycentric
    on_edges = (1 if u <= FEATURE else 0) + (1 if v <= FEATURE else 0) + (1 if w <= FEATURE else 0)
    x, y, z = face_normal(vertices, faces, f)
    if on_edges == 1:
        other = neighbour[f, 1 if u <= FEATURE else (2 if v <= FEATURE else 0)]
        if other >= 0:
            ox, oy, oz = face_normal(vertices, faces, other)
            x, y, z = x + ox, y + oy, z + oz
    elif on_edges == 2:
        corner = faces[f, 0 if u > FEATURE else (1 if v > FEATURE else 2)]
        x = y = z = 0.0
        for r in range(ring_start[corner], ring_start[corner + 1], ring_step(ring_start, corner)):
            g = ring_face[r]
            s = 0 if faces[g, 0] == corner else (1 if faces[g, 1] == corner else 2)
            angle = corner_angle(vertices, corner, faces[g, (s + 1) % 3], faces[g, (s + 2) % 3])
            gx, gy, gz = face_normal(vertices, faces, g)
            x, y, z = x + angle * gx, y + angle * gy, z + angle * gz
    return x, y, z


@njit(nogil=True, cache=True, error_model="numpy")
def side_of_face(vertices, faces, f, d):
    """1 where the vector d points to the outside of a face, 0 where it lies in the face's plane, -1 to the inside."""
    _, b, c = edges(vertices, faces, f)
    along = dot(cross(b, c), d)
    return (1 if along > 0.0 else 0) - (1 if along < 0.0 else 0)


@njit(nogil=True, cache=True, error_model="numpy")
def outside(vertices, faces, neighbour, ring_start, ring_face, f, barycentric, d):
    """Whether the offset d from a point of a face does not point against the pseudo-normal there, or the point is on a rim.

    Beyond the rim of a body mesh with a hole, such as a torso, there is neither inside nor outside: nothing is pushed out there.

    Where all faces around the point agree, so does any positive combination of their normals. Roots and angles are needed only
    within the fold of a crease.

    Args:
        vertices, faces, neighbour, ring_start, ring_face: of :class:`BodyFaces`.
        f: the face.
        barycentric: (u, v, w) of the point.
        d: (dx, dy, dz) metres.
    """
    u, v, w = barycentric
    on_edges = (1 if u <= FEATURE else 0) + (1 if v <= FEATURE else 0) + (1 if w <= FEATURE else 0)
    least = most = side_of_face(vertices, faces, f, d)
    if on_edges == 1:
        other = neighbour[f, 1 if u <= FEATURE else (2 if v <= FEATURE else 0)]
        if other < 0:
            return True
        side = side_of_face(vertices, faces, other, d)
        least, most = min(least, side), max(most, side)
    elif on_edges == 2:
        corner = faces[f, 0 if u > FEATURE else (1 if v > FEATURE else 2)]
        for r in range(ring_start[corner], ring_start[corner + 1]):
            g = ring_face[r]
            s = 0 if faces[g, 0] == corner else (1 if faces[g, 1] == corner else 2)
            if neighbour[g, s] < 0 or neighbour[g, (s + 2) % 3] < 0:
                return True
        for r in range(ring_start[corner], ring_start[corner + 1], ring_step(ring_start, corner)):
            side = side_of_face(vertices, faces, ring_face[r], d)
            least, most = min(least, side), max(most, side)
    if least < 0 < most:
        return dot(pseudo_normal(vertices, faces, neighbour, ring_start, ring_face, f, barycentric), d) >= 0.0
    return least >= 0


@njit(nogil=True, cache=True, error_model="numpy")
def contacts(body, points, contact):
    """Closest point of every point on its face, and its signed distance from the body.

    Args:
        body: :class:`BodyFaces`.
        points: (N, 3) metres.
        contact: :class:`Contact` of N points, its faces in, the rest out.
    """
    vertices, faces, neighbour, ring_start, ring_face = body
    face, barycentric, point, normal, distance = contact
    for i in range(points.shape[0]):
        f = face[i]
        if f < 0:
            for a in range(3):
                barycentric[i, a] = point[i, a] = normal[i, a] = 0.0
            distance[i] = inf
            continue
        p, b, c = edges(vertices, faces, f)
        ax, ay, az = points[i, 0] - p[0], points[i, 1] - p[1], points[i, 2] - p[2]
        v, w = closest_on_triangle((ax, ay, az), b, c)
        u = 1.0 - v - w
        barycentric[i, 0], barycentric[i, 1], barycentric[i, 2] = u, v, w
        dx, dy, dz = ax - v * b[0] - w * c[0], ay - v * b[1] - w * c[1], az - v * b[2] - w * c[2]
        length = sqrt(dx * dx + dy * dy + dz * dz)
        if u > FEATURE and v > FEATURE and w > FEATURE:  # nine of ten points; the rest of the work is called for the others
            inside = dot(cross(b, c), (dx, dy, dz)) < 0.0
        else:
            inside = not outside(vertices, faces, neighbour, ring_start, ring_face, f, (u, v, w), (dx, dy, dz))
        sign = -1.0 if inside else 1.0
        point[i, 0], point[i, 1], point[i, 2] = points[i, 0] - dx, points[i, 1] - dy, points[i, 2] - dz
        distance[i] = sign * length
        if length > SURFACE:
            x, y, z, scale = dx, dy, dz, sign / length
        else:
            x, y, z = pseudo_normal(vertices, faces, neighbour, ring_start, ring_face, f, (u, v, w))
            norm = sqrt(x * x + y * y + z * z)
            scale = 1.0 / norm if norm > 0.0 else 0.0
        normal[i, 0], normal[i, 1], normal[i, 2] = x * scale, y * scale, z * scale
