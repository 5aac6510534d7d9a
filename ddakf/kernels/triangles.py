"""Triangles in space: edges, normals, closest points, and those around a corner. Vectors are (x, y, z); metres."""

from math import sqrt

from numba import njit

MOST_AROUND = 256  # faces around a corner; of more, as in a folded body, an even sample decides about the side
FEATURE = 1e-9  # barycentric coordinate below which the closest point lies on an edge or a corner


@njit(nogil=True, cache=True, error_model="numpy")
def dot(a, b):
    """Scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(nogil=True, cache=True, error_model="numpy")
def cross(a, b):
    """Vector product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(nogil=True, cache=True, error_model="numpy")
def edges(vertices, faces, f):
    """Corner 0 of a face and the edges from it to corners 1 and 2."""
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a = vertices[i, 0], vertices[i, 1], vertices[i, 2]
    b = vertices[j, 0] - a[0], vertices[j, 1] - a[1], vertices[j, 2] - a[2]
    c = vertices[k, 0] - a[0], vertices[k, 1] - a[1], vertices[k, 2] - a[2]
    return a, b, c


@njit(nogil=True, cache=True, error_model="numpy")
def face_normal(vertices, faces, f):
    """Unit normal of a face, zero where it has no area."""
    _, b, c = edges(vertices, faces, f)
    n = cross(b, c)
    length = sqrt(dot(n, n))
    scale = 1.0 / length if length > 0.0 else 0.0
    return n[0] * scale, n[1] * scale, n[2] * scale


@njit(nogil=True, cache=True, error_model="numpy")
def closest_on_triangle(p, b, c):
    """Coordinates (v, w) on edges b and c of the point closest to p, relative to corner 0 (Ericson 2005, 5.1.5)."""
    bb, bc, cc = dot(b, b), dot(b, c), dot(c, c)
    d1, d2 = dot(b, p), dot(c, p)
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and bb > 0.0:
        return d1 / bb, 0.0
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / cc
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w
    total = max(va + vb + vc, 1e-300)  # zero only by rounding, on a face without area; any point of it will do then
    return min(vb / total, 1.0), min(vc / total, 1.0)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def ring_step(ring_start, corner):
    """Step through the faces around a corner of which at most MOST_AROUND count; ``ring_start`` as in ``BodyFaces``."""
    return (ring_start[corner + 1] - ring_start[corner]) // MOST_AROUND + 1
