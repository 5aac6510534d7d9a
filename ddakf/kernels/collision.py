"""Stage E, body collision (paper, section 2.4): r = min(0, n . (p - q) - gap), dr/dp = n where r is negative."""

from math import sqrt

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def linearize(position, contact, gap, area, yielding, residual, jacobian, weight):
    """Residual, Jacobian and weight of every vertex; zero where it does not touch the body.

    Args:
        position: (V, 3) metres.
        contact: the ``Contact`` of the vertices; its faces, points q and normals n are read.
        gap: (V,) metres.
        area: (V,) m^2, weight of a vertex that touches.
        yielding: (V,) 1/m^2, k times the variance of the body's surface along its normal.
        residual: (V,) out, metres, at most 0.
        jacobian: (V, 1, 3) out.
        weight: (V,) out, m^2.
    """
    face, point, normal = contact.face, contact.point, contact.normal
    for i in range(position.shape[0]):
        r = 0.0
        if face[i] >= 0:
            for a in range(3):
                r += normal[i, a] * (position[i, a] - point[i, a])
            r -= gap[i]
        touching = r < 0.0
        residual[i] = r if touching else 0.0
        weight[i] = area[i] / (1.0 + yielding[i] * area[i]) if touching else 0.0
        for a in range(3):
            jacobian[i, 0, a] = normal[i, a] if touching else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def intruded(position, observed, target, across, contact, gap):
    """Sum of the squared depths, m^2, at which cloth is seen inside its gap, and the number of these vertices.

    Args:
        position: (V, 3) metres.
        observed: (V,) bool.
        target, across: (V, 3) metres and unit normals of the planes in which the cloth was measured; its place is the nearest
            in the plane.
        contact: the ``Contact`` of the vertices; its faces, points and normals are read.
        gap: (V,) metres.
    """
    face, point, normal = contact.face, contact.point, contact.normal
    squares, count = 0.0, 0
    for i in range(position.shape[0]):
        if not observed[i] or face[i] < 0:
            continue
        off, slope, height = 0.0, 0.0, 0.0
        for a in range(3):
            off += across[i, a] * (target[i, a] - position[i, a])
            slope += across[i, a] * normal[i, a]
            height += normal[i, a] * (position[i, a] - point[i, a])
        depth = gap[i] - height - off * slope
        if depth > 0.0:
            squares += depth * depth
            count += 1
    return squares, count


@njit(nogil=True, cache=True, error_model="numpy")
def near_body(position, asked_at, contact, thickness, near, points, face):
    """Lists the vertices that may be closer to the body than ``thickness``, as far as they have moved since their search.

    Args:
        position: (V, 3) metres.
        asked_at: (V, 3) metres, where each vertex was when its closest point was searched.
        contact: the ``Contact`` of the vertices there.
        thickness: metres.
        near: (V,) uint32 out, the first N are the vertices.
        points: (V, 3) out, the first N are their positions, metres.
        face: (V,) int32 out, the first N are their closest faces.

    Returns:
        N.
    """
    n = np.uint32(0)
    for i in range(np.uint32(position.shape[0])):
        x, y, z = position[i, 0], position[i, 1], position[i, 2]
        dx, dy, dz = x - asked_at[i, 0], y - asked_at[i, 1], z - asked_at[i, 2]
        # every vertex is written, which is cheaper than an unpredictable branch
        near[n], face[n] = i, contact.face[i]
        points[n, 0], points[n, 1], points[n, 2] = x, y, z
        n += np.uint32(contact.distance[i] - sqrt(dx * dx + dy * dy + dz * dz) < thickness)
    return n


@njit(nogil=True, cache=True, error_model="numpy")
def replace_contacts(near, points, found, contact, asked_at):
    """Writes the contacts that N vertices have now among those of all.

    Args:
        near: (N,) uint32, the vertices.
        points: (N, 3) metres, where they were searched.
        found: their ``Contact``.
        contact: the ``Contact`` of all V vertices, in and out.
        asked_at: (V, 3) in and out, metres.
    """
    for k in range(near.shape[0]):
        i = near[k]
        contact.face[i], contact.distance[i] = found.face[k], found.distance[k]
        for a in range(3):
            contact.barycentric[i, a], contact.point[i, a] = found.barycentric[k, a], found.point[k, a]
            contact.normal[i, a], asked_at[i, a] = found.normal[k, a], points[k, a]
