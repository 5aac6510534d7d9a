"""Pyramid: the vertices of a decimated level of a garment, and the place of the finer vertices on its faces."""

import numpy as np
from numba import njit

from ddakf.kernels.proximity import closest_on_triangle


@njit(nogil=True, cache=True, error_model="numpy")
def choose_independent(order, start, neighbour, chosen):
    """Chooses a maximal independent set: in turn each vertex without a chosen neighbour.

    Args:
        order: (V,) vertices in the order of choice.
        start, neighbour: one-rings in compressed rows.
        chosen: (V,) bool out.
    """
    chosen[:] = False
    for k in range(order.shape[0]):
        i = order[k]
        free = True
        for e in range(start[i], start[i + 1]):
            free &= not chosen[neighbour[e]]
        chosen[i] = free


@njit(nogil=True, cache=True, error_model="numpy")
def find_corners(points, vertices, faces, face_start, face_of, owner, corner, share):
    """Finds the closest point of each finer vertex on the faces around its owner.

    Args:
        points: (V, 3) metres.
        vertices, faces: (W, 3) metres, (F, 3) of the decimated level.
        face_start, face_of: faces around each of its vertices, in compressed rows.
        owner: (V,) vertex of the decimated level.
        corner: (V, 3) int32 out, corners of that face.
        share: (V, 3) out, barycentric coordinates.
    """
    for i in range(points.shape[0]):
        nearest = np.inf
        for e in range(face_start[owner[i]], face_start[owner[i] + 1]):
            f = face_of[e]
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            p = points[i, 0] - vertices[a, 0], points[i, 1] - vertices[a, 1], points[i, 2] - vertices[a, 2]
            u = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
            v = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
            s, t = closest_on_triangle(p, u, v)
            squared = 0.0
            for k in range(3):
                squared += (p[k] - s * u[k] - t * v[k]) ** 2
            if squared < nearest:
                nearest = squared
                corner[i, 0], corner[i, 1], corner[i, 2] = a, b, c
                share[i, 0], share[i, 1], share[i, 2] = 1.0 - s - t, s, t


@njit(nogil=True, cache=True, error_model="numpy")
def interpolate(base, displacement, corner, share, moved):
    """Moves the finer vertices by the displacement of the decimated level, linear over its faces.

    Args:
        base: (V, 3) metres.
        displacement: (W, 3) of the level's vertices, metres.
        corner, share: (V, 3) of :func:`find_corners`.
        moved: (V, 3) out, metres.
    """
    for i in range(base.shape[0]):
        a, b, c = corner[i, 0], corner[i, 1], corner[i, 2]
        s, t, u = share[i, 0], share[i, 1], share[i, 2]
        for k in range(3):
            moved[i, k] = base[i, k] + s * displacement[a, k] + t * displacement[b, k] + u * displacement[c, k]
