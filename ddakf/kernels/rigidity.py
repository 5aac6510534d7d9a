"""Local rigidity: best-fitting rotations of one-rings, and the force of edges that do not follow them."""

from math import sqrt

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy")
def fit_rotations(position, start, neighbour, source, weight, iterations, rotation):
    """Rotation of each one-ring from its source edges to the present ones, in place, warm-started.

    Maximises sum_j w_ij (x_j - x_i) . R_i s_ij by the iteration of Mueller, Bender, Chentanez and Macklin, "A robust method
    to extract the rotational part of deformations" (2016), which stays defined on flat rings.

    Args:
        position: (V, 3) metres.
        start, neighbour: one-rings in compressed rows.
        source: (2E, 3) source edge vectors s_ij = s_j - s_i per row entry, metres.
        weight: (2E,) edge weights.
        iterations: fixed number of steps.
        rotation: (V, 3, 3) in: the start; out: the fit.
    """
    for i in range(position.shape[0]):
        c00 = c01 = c02 = c10 = c11 = c12 = c20 = c21 = c22 = 0.0
        px, py, pz = position[i, 0], position[i, 1], position[i, 2]
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            w = weight[e]
            ex, ey, ez = (position[j, 0] - px) * w, (position[j, 1] - py) * w, (position[j, 2] - pz) * w
            sx, sy, sz = source[e, 0], source[e, 1], source[e, 2]
            c00 += ex * sx
            c01 += ex * sy
            c02 += ex * sz
            c10 += ey * sx
            c11 += ey * sy
            c12 += ey * sz
            c20 += ez * sx
            c21 += ez * sy
            c22 += ez * sz
        r00, r01, r02 = rotation[i, 0, 0], rotation[i, 0, 1], rotation[i, 0, 2]
        r10, r11, r12 = rotation[i, 1, 0], rotation[i, 1, 1], rotation[i, 1, 2]
        r20, r21, r22 = rotation[i, 2, 0], rotation[i, 2, 1], rotation[i, 2, 2]
        for _ in range(iterations):
            # omega = sum of columns r_k x c_k over |sum of r_k . c_k|
            wx = r10 * c20 - r20 * c10 + r11 * c21 - r21 * c11 + r12 * c22 - r22 * c12
            wy = r20 * c00 - r00 * c20 + r21 * c01 - r01 * c21 + r22 * c02 - r02 * c22
            wz = r00 * c10 - r10 * c00 + r01 * c11 - r11 * c01 + r02 * c12 - r12 * c02
            trace = r00 * c00 + r10 * c10 + r20 * c20 + r01 * c01 + r11 * c11 + r21 * c21 + r02 * c02 + r12 * c12 + r22 * c22
            scale = 1.0 / (abs(trace) + 1e-20)
            wx, wy, wz = wx * scale, wy * scale, wz * scale
            # Cayley's rotation of about that angle: (1 + h^2) Q = (1 - h^2) I + 2 h h' + 2 [h]x, h = omega / 2
            hx, hy, hz = 0.5 * wx, 0.5 * wy, 0.5 * wz
            h2 = hx * hx + hy * hy + hz * hz
            t = 1.0 / (1.0 + h2)
            d = (1.0 - h2) * t
            hx2, hy2, hz2 = 2.0 * t * hx, 2.0 * t * hy, 2.0 * t * hz
            q00, q01, q02 = d + hx2 * hx, hx2 * hy - hz2, hx2 * hz + hy2
            q10, q11, q12 = hx2 * hy + hz2, d + hy2 * hy, hy2 * hz - hx2
            q20, q21, q22 = hx2 * hz - hy2, hy2 * hz + hx2, d + hz2 * hz
            r00, r10, r20 = (
                q00 * r00 + q01 * r10 + q02 * r20,
                q10 * r00 + q11 * r10 + q12 * r20,
                q20 * r00 + q21 * r10 + q22 * r20,
            )
            r01, r11, r21 = (
                q00 * r01 + q01 * r11 + q02 * r21,
                q10 * r01 + q11 * r11 + q12 * r21,
                q20 * r01 + q21 * r11 + q22 * r21,
            )
            r02, r12, r22 = r10 * r21 - r20 * r11, r20 * r01 - r00 * r21, r00 * r11 - r10 * r01
            if h2 < 1e-7:
                break
        # what rounding adds up over thousands of frames is taken out here
        n = 1.0 / sqrt(r00 * r00 + r10 * r10 + r20 * r20)
        r00, r10, r20 = r00 * n, r10 * n, r20 * n
        d = r00 * r01 + r10 * r11 + r20 * r21
        r01, r11, r21 = r01 - d * r00, r11 - d * r10, r21 - d * r20
        n = 1.0 / sqrt(r01 * r01 + r11 * r11 + r21 * r21)
        r01, r11, r21 = r01 * n, r11 * n, r21 * n
        r02, r12, r22 = r10 * r21 - r20 * r11, r20 * r01 - r00 * r21, r00 * r11 - r10 * r01
        rotation[i, 0, 0], rotation[i, 0, 1], rotation[i, 0, 2] = r00, r01, r02
        rotation[i, 1, 0], rotation[i, 1, 1], rotation[i, 1, 2] = r10, r11, r12
        rotation[i, 2, 0], rotation[i, 2, 1], rotation[i, 2, 2] = r20, r21, r22


@njit(nogil=True, cache=True, error_model="numpy")
def edge_vectors(position, start, neighbour, edge):
    """(2E, 3) out: x_j - x_i for every row entry."""
    for i in range(position.shape[0]):
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            for a in range(3):
                edge[e, a] = position[j, a] - position[i, a]


@njit(nogil=True, cache=True, error_model="numpy")
def add_force(position, start, neighbour, source, weight, rotation, force):
    """Adds -gradient of 1/2 sum_edges w_ij |x_j - x_i - (R_i + R_j) s_ij / 2|^2 to (V, 3) force."""
    for i in range(position.shape[0]):
        fx = fy = fz = 0.0
        for e in range(start[i], start[i + 1]):
            j = neighbour[e]
            w = weight[e]
            sx, sy, sz = 0.5 * source[e, 0], 0.5 * source[e, 1], 0.5 * source[e, 2]
            m00, m01, m02 = (
                rotation[i, 0, 0] + rotation[j, 0, 0],
                rotation[i, 0, 1] + rotation[j, 0, 1],
                rotation[i, 0, 2] + rotation[j, 0, 2],
            )
            m10, m11, m12 = (
                rotation[i, 1, 0] + rotation[j, 1, 0],
                rotation[i, 1, 1] + rotation[j, 1, 1],
                rotation[i, 1, 2] + rotation[j, 1, 2],
            )
            m20, m21, m22 = (
                rotation[i, 2, 0] + rotation[j, 2, 0],
                rotation[i, 2, 1] + rotation[j, 2, 1],
                rotation[i, 2, 2] + rotation[j, 2, 2],
            )
            fx += w * (position[j, 0] - position[i, 0] - (m00 * sx + m01 * sy + m02 * sz))
            fy += w * (position[j, 1] - position[i, 1] - (m10 * sx + m11 * sy + m12 * sz))
            fz += w * (position[j, 2] - position[i, 2] - (m20 * sx + m21 * sy + m22 * sz))
        force[i, 0] += fx
        force[i, 1] += fy
        force[i, 2] += fz
