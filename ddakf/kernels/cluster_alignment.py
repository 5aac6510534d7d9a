"""The coarse level of stages B to F: clusters that move rigidly, and what holds them together."""

from math import sqrt

import numpy as np
from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def centers(position, cluster, center):
    """center (K, 3) out: centroid of each cluster's vertices, metres."""
    count = np.zeros(center.shape[0])
    center[:] = 0.0
    for i in range(position.shape[0]):
        count[cluster[i]] += 1.0
        for a in range(3):
            center[cluster[i], a] += position[i, a]
    for k in range(center.shape[0]):
        for a in range(3):
            center[k, a] /= max(count[k], 1.0)


@njit(nogil=True, cache=True, error_model="numpy")
def add_planes(position, prior, sample, cluster, center, target, normal, weight, variance, tangential, information, share, A, b):
    """Adds the measurements and the prior of the sampled vertices to the normal equations of the clusters.

    A cluster moves by x + omega x (x - c) + t; its unknowns are (omega, t).

    Args:
        position, prior: (V, 3) estimate and prediction, metres.
        sample: (S,) indices of the sampled vertices; each stands for ``share`` of them.
        cluster: (V,) of each vertex.
        center: (K, 3) metres.
        target, normal, weight: (V, 3), (V, 3), (V,) of the measurements; weight 0 where there is none.
        variance, tangential: m^2, along the normal and in the plane; infinite: nothing is said about that.
        information: 1/m^2, of the prior of each vertex.
        share: vertices per sampled one.
        A: (6K, 6K) in and out, lower triangle of each 6x6 block row.
        b: (6K,) in and out.
    """
    row = np.empty(6)
    for s in range(sample.shape[0]):
        i = sample[s]
        k = 6 * cluster[i]
        rx, ry, rz = (position[i, 0] - center[cluster[i], 0], position[i, 1] - center[cluster[i], 1],
                      position[i, 2] - center[cluster[i], 2])  # fmt: skip
        w = share * weight[i]
        across = share * information
        dx = share * information * (prior[i, 0] - position[i, 0])
        dy = share * information * (prior[i, 1] - position[i, 1])
        dz = share * information * (prior[i, 2] - position[i, 2])
        if w > 0.0:
            t = w / tangential
            zx, zy, zz = target[i, 0] - position[i, 0], target[i, 1] - position[i, 1], target[i, 2] - position[i, 2]
            across += t
            dx += t * zx
            dy += t * zy
            dz += t * zz
            nx, ny, nz = normal[i, 0], normal[i, 1], normal[i, 2]
            along = w / variance - t
            row[0], row[1], row[2] = ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx
            row[3], row[4], row[5] = nx, ny, nz
            d = along * (nx * zx + ny * zy + nz * zz)
            for a in range(6):
                b[k + a] += d * row[a]
                for c in range(a + 1):
                    A[k + a, k + c] += along * row[a] * row[c]
        # isotropic part: J = [-[r]x, I]
        b[k] += ry * dz - rz * dy
        b[k + 1] += rz * dx - rx * dz
        b[k + 2] += rx * dy - ry * dx
        b[k + 3] += dx
        b[k + 4] += dy
        b[k + 5] += dz
        A[k, k] += across * (ry * ry + rz * rz)
        A[k + 1, k + 1] += across * (rx * rx + rz * rz)
        A[k + 2, k + 2] += across * (rx * rx + ry * ry)
        A[k + 1, k] -= across * rx * ry
        A[k + 2, k] -= across * rx * rz
        A[k + 2, k + 1] -= across * ry * rz
        A[k + 3, k + 3] += across
        A[k + 4, k + 4] += across
        A[k + 5, k + 5] += across
        A[k + 3, k + 1] += across * rz
        A[k + 3, k + 2] -= across * ry
        A[k + 4, k] -= across * rz
        A[k + 4, k + 2] += across * rx
        A[k + 5, k] += across * ry
        A[k + 5, k + 1] -= across * rx


@njit(nogil=True, cache=True, error_model="numpy")
def add_seams(position, cluster, center, seam, rest_source, rest_rotation, rest_weight, motion_source, motion_rotation,
              motion_weight, stretch, strain_scale, A, b):  # fmt: skip
    """Adds what holds the clusters together: rigidity to the rest shape and since the last frame, and length, of the seam edges.

    An edge's rigid source turns with both of its clusters, so that a common rotation costs nothing.

    Args:
        position: (V, 3) metres.
        cluster, center: of each vertex, and (K, 3) metres.
        seam: (C, 3) edges between two clusters: vertices i and j, and the entry of the edge i to j among the one-rings.
        rest_source, motion_source: (2E, 3) edge vectors, metres.
        rest_rotation, motion_rotation: (V, 3, 3).
        rest_weight, motion_weight, stretch: 1/m^2.
        strain_scale: of the length, beyond which a strain counts as an error of the model.
        A, b: in and out, as above.
    """
    J = np.empty((3, 12))
    total = rest_weight + motion_weight
    for s in range(seam.shape[0]):
        i, j, e = seam[s, 0], seam[s, 1], seam[s, 2]
        p, q = cluster[i], cluster[j]
        ex, ey, ez = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1], position[j, 2] - position[i, 2]
        fx = fy = fz = 0.0  # weighted residual of both terms
        mx = my = mz = 0.0  # weighted mean of the turned sources
        for a in range(2):
            w = rest_weight if a == 0 else motion_weight
            S = rest_source if a == 0 else motion_source
            R = rest_rotation if a == 0 else motion_rotation
            sx, sy, sz = 0.5 * S[e, 0], 0.5 * S[e, 1], 0.5 * S[e, 2]
            tx = (R[i, 0, 0] + R[j, 0, 0]) * sx + (R[i, 0, 1] + R[j, 0, 1]) * sy + (R[i, 0, 2] + R[j, 0, 2]) * sz
            ty = (R[i, 1, 0] + R[j, 1, 0]) * sx + (R[i, 1, 1] + R[j, 1, 1]) * sy + (R[i, 1, 2] + R[j, 1, 2]) * sz
            tz = (R[i, 2, 0] + R[j, 2, 0]) * sx + (R[i, 2, 1] + R[j, 2, 1]) * sy + (R[i, 2, 2] + R[j, 2, 2]) * sz
            fx += w * (ex - tx)
            fy += w * (ey - ty)
            fz += w * (ez - tz)
            mx += w * tx
            my += w * ty
            mz += w * tz
        half = 0.5 / total if total > 0.0 else 0.0
        mx, my, mz = half * mx, half * my, half * mz
        ix, iy, iz = position[i, 0] - center[p, 0], position[i, 1] - center[p, 1], position[i, 2] - center[p, 2]
        jx, jy, jz = position[j, 0] - center[q, 0], position[j, 1] - center[q, 1], position[j, 2] - center[q, 2]
        # change of the residual: d = dx_j - dx_i - (omega_p + omega_q)/2 x m; J = [[r_i + m]x, -I, [m - r_j]x, I]
        ux, uy, uz = ix + mx, iy + my, iz + mz
        vx, vy, vz = mx - jx, my - jy, mz - jz
        J[:] = 0.0
        J[0, 1], J[0, 2], J[1, 0], J[1, 2], J[2, 0], J[2, 1] = -uz, uy, uz, -ux, -uy, ux
        J[0, 7], J[0, 8], J[1, 6], J[1, 8], J[2, 6], J[2, 7] = -vz, vy, vz, -vx, -vy, vx
        for a in range(3):
            J[a, 3 + a] = -1.0
            J[a, 9 + a] = 1.0
        if total > 0.0:
            add_block(J, total, fx, fy, fz, 6 * p, 6 * q, A, b)
        # length: derivative along the edge of dx_j - dx_i alone
        length = sqrt(ex * ex + ey * ey + ez * ez)
        rest = sqrt(rest_source[e, 0] ** 2 + rest_source[e, 1] ** 2 + rest_source[e, 2] ** 2)
        if length < 1e-9 or rest < 1e-9 or stretch == 0.0:
            continue
        strain = length / rest - 1.0
        k = stretch / (1.0 + (strain / strain_scale) ** 2)
        nx, ny, nz = ex / length, ey / length, ez / length
        row = J[0]
        row[0], row[1], row[2] = -(iy * nz - iz * ny), -(iz * nx - ix * nz), -(ix * ny - iy * nx)
        row[3], row[4], row[5] = -nx, -ny, -nz
        row[6], row[7], row[8] = jy * nz - jz * ny, jz * nx - jx * nz, jx * ny - jy * nx
        row[9], row[10], row[11] = nx, ny, nz
        f = k * (length - rest)
        for a in range(12):
            ra = (6 * p + a) if a < 6 else (6 * q + a - 6)
            b[ra] -= f * row[a]
            for c in range(a + 1):
                rc = (6 * p + c) if c < 6 else (6 * q + c - 6)
                x = k * row[a] * row[c]
                if ra >= rc:
                    A[ra, rc] += x
                else:
                    A[rc, ra] += x


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def add_block(J, weight, fx, fy, fz, p, q, A, b):
    for a in range(12):
        ra = (p + a) if a < 6 else (q + a - 6)
        b[ra] -= J[0, a] * fx + J[1, a] * fy + J[2, a] * fz
        for c in range(a + 1):
            x = weight * (J[0, a] * J[0, c] + J[1, a] * J[1, c] + J[2, a] * J[2, c])
            rc = (p + c) if c < 6 else (q + c - 6)
            if ra >= rc:
                A[ra, rc] += x
            else:
                A[rc, ra] += x


@njit(nogil=True, cache=True, error_model="numpy")
def move(position, clusters, share, center, motion, limit, moved):
    """moved (V, 3) out: the vertices moved by the blend of their nearest clusters' rigid motions. Returns the RMS step, metres.

    Args:
        position: (V, 3) metres.
        clusters, share: (V, N) clusters that a vertex follows, and by how much; rows sum to one.
        center: (K, 3) metres.
        motion: (K, 6) rotation vector and translation of each.
        limit: metres, no cluster moves farther.
    """
    k = center.shape[0]
    R = np.empty((k, 3, 3))
    T = np.empty((k, 3))
    for p in range(k):
        x, y, z = motion[p, 0], motion[p, 1], motion[p, 2]
        # Cayley's rotation of about that angle
        x, y, z = 0.5 * x, 0.5 * y, 0.5 * z
        h2 = x * x + y * y + z * z
        if h2 > 0.25:
            scale = 0.5 / sqrt(h2)
            x, y, z, h2 = x * scale, y * scale, z * scale, 0.25
        t = 2.0 / (1.0 + h2)
        R[p, 0, 0], R[p, 0, 1], R[p, 0, 2] = 1.0 - t * (y * y + z * z), t * (x * y - z), t * (x * z + y)
        R[p, 1, 0], R[p, 1, 1], R[p, 1, 2] = t * (x * y + z), 1.0 - t * (x * x + z * z), t * (y * z - x)
        R[p, 2, 0], R[p, 2, 1], R[p, 2, 2] = t * (x * z - y), t * (y * z + x), 1.0 - t * (x * x + y * y)
        length = sqrt(motion[p, 3] ** 2 + motion[p, 4] ** 2 + motion[p, 5] ** 2)
        scale = min(1.0, limit / max(length, 1e-12))
        for a in range(3):
            T[p, a] = motion[p, 3 + a] * scale + center[p, a]
    total = 0.0
    for i in range(position.shape[0]):
        x = y = z = 0.0
        for m in range(clusters.shape[1]):
            p = clusters[i, m]
            w = share[i, m]
            rx, ry, rz = position[i, 0] - center[p, 0], position[i, 1] - center[p, 1], position[i, 2] - center[p, 2]
            x += w * (R[p, 0, 0] * rx + R[p, 0, 1] * ry + R[p, 0, 2] * rz + T[p, 0])
            y += w * (R[p, 1, 0] * rx + R[p, 1, 1] * ry + R[p, 1, 2] * rz + T[p, 1])
            z += w * (R[p, 2, 0] * rx + R[p, 2, 1] * ry + R[p, 2, 2] * rz + T[p, 2])
        total += (x - position[i, 0]) ** 2 + (y - position[i, 1]) ** 2 + (z - position[i, 2]) ** 2
        moved[i, 0], moved[i, 1], moved[i, 2] = x, y, z
    return sqrt(total / max(position.shape[0], 1))
