"""Closest points on a body by a walk from face to face, from those that were closest a moment ago."""

import numpy as np
from numba import njit

from ddakf.kernels.triangles import FEATURE, closest_on_triangle, edges, ring_step

MOST_STEPS = 32  # faces that a walk crosses; from frame to frame it crosses one or two


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def distance_to_face(vertices, faces, f, x, y, z):
    """Squared distance of (x, y, z) to a face, m^2, and the coordinates (v, w) of its closest point there."""
    p, b, c = edges(vertices, faces, f)
    ax, ay, az = x - p[0], y - p[1], z - p[2]
    v, w = closest_on_triangle((ax, ay, az), b, c)
    dx, dy, dz = ax - v * b[0] - w * c[0], ay - v * b[1] - w * c[1], az - v * b[2] - w * c[2]
    return dx * dx + dy * dy + dz * dz, v, w


@njit(nogil=True, cache=True, error_model="numpy")
def walk(body, points, radius, face):
    """Moves each point's face to a neighbouring one while that is nearer: to the nearest of the surface around it.

    The nearest face of the whole body may be a farther one, which a walk cannot reach without going away first: an arm that
    comes beside the chest.

    Args:
        body: ``BodyFaces`` in the present pose.
        points: (N, 3) metres.
        radius: metres; a point whose face is farther has none.
        face: (N,) int32 in and out; -1: none, which stays so.
    """
    vertices, faces, neighbour, ring_start, ring_face = body
    for i in range(points.shape[0]):
        f = face[i]
        if f < 0:
            continue
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        best, v, w = distance_to_face(vertices, faces, f, x, y, z)
        for _ in range(MOST_STEPS):
            u, from_face = 1.0 - v - w, f
            no_u, no_v, no_w = u <= FEATURE, v <= FEATURE, w <= FEATURE
            on_edges = int(no_u) + int(no_v) + int(no_w)
            if on_edges == 1:
                other = neighbour[f, 1 if no_u else (2 if no_v else 0)]
                if other >= 0:
                    squared, s, t = distance_to_face(vertices, faces, other, x, y, z)
                    if squared < best:
                        best, f, v, w = squared, other, s, t
            elif on_edges == 2:
                corner = faces[f, 0 if not no_u else (1 if not no_v else 2)]
                for r in range(ring_start[corner], ring_start[corner + 1], ring_step(ring_start, corner)):
                    squared, s, t = distance_to_face(vertices, faces, ring_face[r], x, y, z)
                    if squared < best:
                        best, f, v, w = squared, ring_face[r], s, t
            if f == from_face:
                break
        face[i] = np.int32(f) if best <= radius * radius else np.int32(-1)
