"""Stage A, motion of the body's surface between two frames, and of the points that it carries (paper, section 2.2)."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels.triangles import cross, dot

LANES = 8  # faces whose rotations are computed side by side
FACE_AREA = 1e-12  # m^2 of double area, weight of the identity: a degenerate face's rotation counts for nothing against it


class BodyMotion(NamedTuple):
    """A body in two frames."""

    last: np.ndarray  # (B, 3) m, vertices before the motion
    now: np.ndarray  # (B, 3) m, vertices after it
    rotation: np.ndarray  # (B, 4) unit quaternions (w, x, y, z) of the surface around each vertex


# inlined: the loop over the faces side by side is vectorised only without calls
@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def triangle_frame(b, c):
    """Tangent along edge b, normal, in-plane edges (l, 0) and (x, h), double area; without area any finite ones and 0.

    Args:
        b, c: edges from corner 0 to corners 1 and 2, metres.
    """
    n = cross(b, c)
    length, area = sqrt(dot(b, b)), sqrt(dot(n, n))
    # no branches: the compiler vectorises a selection of values
    l_inverse, a_inverse = 1.0 / (length if length > 0.0 else 1.0), 1.0 / (area if area > 0.0 else 1.0)
    tangent = b[0] * l_inverse, b[1] * l_inverse, b[2] * l_inverse
    return tangent, (n[0] * a_inverse, n[1] * a_inverse, n[2] * a_inverse), length, dot(c, tangent), area * l_inverse, area


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def quaternion(t, u, n, t2, u2, n2):
    """Unit quaternion (w, x, y, z) of the rotation that takes the orthonormal frame (t, u, n) to (t2, u2, n2)."""
    xx, yy, zz = (
        t2[0] * t[0] + u2[0] * u[0] + n2[0] * n[0],
        t2[1] * t[1] + u2[1] * u[1] + n2[1] * n[1],
        t2[2] * t[2] + u2[2] * u[2] + n2[2] * n[2],
    )
    xy, yx = t2[0] * t[1] + u2[0] * u[1] + n2[0] * n[1], t2[1] * t[0] + u2[1] * u[0] + n2[1] * n[0]
    xz, zx = t2[0] * t[2] + u2[0] * u[2] + n2[0] * n[2], t2[2] * t[0] + u2[2] * u[0] + n2[2] * n[0]
    yz, zy = t2[1] * t[2] + u2[1] * u[2] + n2[1] * n[2], t2[2] * t[1] + u2[2] * u[1] + n2[2] * n[1]
    # four times the product of the quaternion with its greatest component, or with w where that is great enough
    dx, dy, dz, sx, sy, sz = zy - yz, xz - zx, yx - xy, yz + zy, xz + zx, xy + yx
    qw, qx, qy, qz = 1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz
    by_w, by_x, by_y = xx + yy + zz > 0.0, (xx >= yy) & (xx >= zz), yy >= zz
    w = qw if by_w else (dx if by_x else (dy if by_y else dz))
    x = dx if by_w else (qx if by_x else (sz if by_y else sy))
    y = dy if by_w else (sz if by_x else (qy if by_y else sx))
    z = dz if by_w else (sy if by_x else (sx if by_y else qz))
    scale = 1.0 / sqrt(w * w + x * x + y * y + z * z)
    return w * scale, x * scale, y * scale, z * scale


@njit(nogil=True, cache=True, error_model="numpy")
def face_rotations(lanes):
    """Rotations of the faces in LANES lanes, and their weights.

    Args:
        lanes: (17 * LANES,) in and out, flat, so that the distance of its rows is known when this is compiled: both edges before
            the motion, both after it, metres; unit quaternion (w, x, y, z); the smaller double area, m^2, 0 for no rotation.
    """
    for k in range(LANES):
        b1 = lanes[k], lanes[LANES + k], lanes[2 * LANES + k]
        c1 = lanes[3 * LANES + k], lanes[4 * LANES + k], lanes[5 * LANES + k]
        b2 = lanes[6 * LANES + k], lanes[7 * LANES + k], lanes[8 * LANES + k]
        c2 = lanes[9 * LANES + k], lanes[10 * LANES + k], lanes[11 * LANES + k]
        t1, n1, l1, x1, h1, area1 = triangle_frame(b1, c1)
        t2, n2, l2, x2, h2, area2 = triangle_frame(b2, c2)
        # polar factor of the in-plane deformation [[l2/l1, (x2 - x1 l2/l1) / h1], [0, h2/h1]], multiplied by l1 h1
        c, s = l2 * h1 + h2 * l1, l2 * x1 - x2 * l1
        norm = sqrt(c * c + s * s)
        inverse = 1.0 / (norm if norm > 0.0 else 1.0)
        c, s = c * inverse, s * inverse
        u1, u2 = cross(n1, t1), cross(n2, t2)
        turned = (c * t2[0] + s * u2[0], c * t2[1] + s * u2[1], c * t2[2] + s * u2[2])
        w, x, y, z = quaternion(t1, u1, n1, turned, cross(n2, turned), n2)
        lanes[12 * LANES + k], lanes[13 * LANES + k], lanes[14 * LANES + k], lanes[15 * LANES + k] = w, x, y, z
        lanes[16 * LANES + k] = min(area1, area2) if norm > 0.0 else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def vertex_rotations(last, now, faces, face, needed, rotation):
    """Unit quaternion of every vertex that a contact uses: its faces' rotations, by area, on one hemisphere.

    Most of the faces of a body are near no garment.

    Args:
        last, now: (B, 3) vertices before and after the motion, metres.
        faces: (F, 3) int32.
        face: (N,) int32 faces that contacts use, or -1.
        needed: (B,) uint8 workspace.
        rotation: (B, 4) out, (w, x, y, z); the identity at vertices that no contact uses.
    """
    lanes, chosen = np.zeros(17 * LANES), np.empty(faces.shape[0] + 1, np.uint32)
    needed[:] = 0
    for i in range(face.shape[0]):
        if face[i] >= 0:
            for s in range(3):
                needed[faces[face[i], s]] = 1
    n = 0
    for f in range(faces.shape[0]):  # every face is written, which is cheaper than an unpredictable branch
        chosen[n] = f
        n += needed[np.uint32(faces[f, 0])] | needed[np.uint32(faces[f, 1])] | needed[np.uint32(faces[f, 2])]
    rotation[:] = 0.0
    rotation[:, 0] = FACE_AREA
    for first in range(0, n, LANES):
        size = min(LANES, n - first)
        for k in range(size):
            f = chosen[first + k]
            o, p, q = np.uint32(faces[f, 0]), np.uint32(faces[f, 1]), np.uint32(faces[f, 2])
            for a in range(3):
                lanes[a * LANES + k], lanes[(3 + a) * LANES + k] = last[p, a] - last[o, a], last[q, a] - last[o, a]
                lanes[(6 + a) * LANES + k], lanes[(9 + a) * LANES + k] = now[p, a] - now[o, a], now[q, a] - now[o, a]
        face_rotations(lanes)
        for k in range(size):
            w, x, y, z = lanes[12 * LANES + k], lanes[13 * LANES + k], lanes[14 * LANES + k], lanes[15 * LANES + k]
            weight = lanes[16 * LANES + k]
            for corner in range(3):
                v = np.uint32(faces[chosen[first + k], corner])
                sign = rotation[v, 0] * w + rotation[v, 1] * x + rotation[v, 2] * y + rotation[v, 3] * z
                share = weight if sign >= 0.0 else -weight
                rotation[v, 0] += share * w
                rotation[v, 1] += share * x
                rotation[v, 2] += share * y
                rotation[v, 3] += share * z
    for v in range(rotation.shape[0]):
        if not needed[v]:
            rotation[v, 0], rotation[v, 1], rotation[v, 2], rotation[v, 3] = 1.0, 0.0, 0.0, 0.0
            continue
        w, x, y, z = rotation[v, 0], rotation[v, 1], rotation[v, 2], rotation[v, 3]
        scale = 1.0 / max(sqrt(w * w + x * x + y * y + z * z), 1e-300)
        rotation[v, 0], rotation[v, 1], rotation[v, 2], rotation[v, 3] = w * scale, x * scale, y * scale, z * scale


@njit(nogil=True, cache=True, error_model="numpy")
def carry(motion, faces, contact, points, near, radius, position, weight):
    """Moves points with the surface under them: all of the motion within ``near``, none of it from ``radius`` on.

    Args:
        motion: :class:`BodyMotion`.
        faces: (F, 3) int32 of the body.
        contact: the ``Contact`` of the points; its faces and barycentric coordinates are read.
        points: (N, 3) metres.
        near, radius: metres.
        position: (N, 3) out, metres.
        weight: (N,) out, share of the motion that was applied.
    """
    last, now, rotation = motion
    face, barycentric = contact.face, contact.barycentric
    for i in range(points.shape[0]):
        for a in range(3):
            position[i, a] = points[i, a]
        weight[i] = 0.0
        f = face[i]
        if f < 0:
            continue
        w = x = y = z = 0.0
        ox = oy = oz = tx = ty = tz = 0.0
        for s in range(3):
            v, b = faces[f, s], barycentric[i, s]
            qw, qx, qy, qz = rotation[v, 0], rotation[v, 1], rotation[v, 2], rotation[v, 3]
            if w * qw + x * qx + y * qy + z * qz < 0.0:
                qw, qx, qy, qz = -qw, -qx, -qy, -qz
            w, x, y, z = w + b * qw, x + b * qx, y + b * qy, z + b * qz
            ox, oy, oz = ox + b * last[v, 0], oy + b * last[v, 1], oz + b * last[v, 2]
            tx, ty, tz = tx + b * now[v, 0], ty + b * now[v, 1], tz + b * now[v, 2]
        ox, oy, oz = points[i, 0] - ox, points[i, 1] - oy, points[i, 2] - oz
        share = (radius - sqrt(ox * ox + oy * oy + oz * oz)) / (radius - near)
        share = min(1.0, max(0.0, share))
        share = share * share * (3.0 - 2.0 * share)
        weight[i] = share
        # rotation of the offset o by the quaternion: o + 2 w (q x o) + 2 q x (q x o), over the squared norm
        scale = 2.0 / max(w * w + x * x + y * y + z * z, 1e-300)
        cx, cy, cz = y * oz - z * oy, z * ox - x * oz, x * oy - y * ox
        ox += scale * (w * cx + y * cz - z * cy)
        oy += scale * (w * cy + z * cx - x * cz)
        oz += scale * (w * cz + x * cy - y * cx)
        position[i, 0] += share * (tx + ox - points[i, 0])
        position[i, 1] += share * (ty + oy - points[i, 1])
        position[i, 2] += share * (tz + oz - points[i, 2])
