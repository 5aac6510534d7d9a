"""Symmetric 3x3 matrices."""

from math import sqrt

from numba import njit


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def invert3(a, b, c, d, e, f):
    """Inverse of [[a, d, e], [d, b, f], [e, f, c]] as the same six numbers."""
    A = b * c - f * f
    B = e * f - d * c
    C = d * f - b * e
    r = 1.0 / (a * A + d * B + e * C)
    return A * r, (a * c - e * e) * r, (a * b - d * d) * r, B * r, C * r, (e * d - a * f) * r


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def smallest_eigenvector(a, b, c, d, e, f):
    """Smallest and middle eigenvalue of [[a, d, e], [d, b, f], [e, f, c]], and the unit eigenvector of the smallest.

    The vector is the longest cross product of two rows, or the last axis where all eigenvalues are equal. With q the mean of the
    eigenvalues and p their spread they are q + p t, t^3 - 3 t = 2 r. The least root is -(1 + x) with x^3 + 3 x^2 = 2 (1 - r);
    a cubic in sqrt((1 - r) / 2) has four digits of it, and each of Newton's two steps doubles them. There is no branch and no
    function but the square root, so that the compiler computes many matrices side by side.
    """
    q = (a + b + c) / 3.0
    p2 = (a - q) ** 2 + (b - q) ** 2 + (c - q) ** 2 + 2.0 * (d * d + e * e + f * f)
    p = sqrt(p2 / 6.0)
    i = 1.0 / max(p, 1e-30)
    A, B, C, D, E, F = (a - q) * i, (b - q) * i, (c - q) * i, d * i, e * i, f * i
    r = 0.5 * (A * (B * C - F * F) - D * (D * C - F * E) + E * (D * F - B * E))
    goal = 2.0 * (1.0 - min(max(r, -1.0), 1.0))
    half = sqrt(0.25 * goal) + 1e-30
    x = half * (1.154606 - half * (0.218855 - half * (0.087144 - half * 0.022978)))
    x -= (x * x * (x + 3.0) - goal) / (3.0 * x * (x + 2.0))
    x -= (x * x * (x + 3.0) - goal) / (3.0 * x * (x + 2.0))
    smallest = q - p * (1.0 + x)
    middle = q + 0.5 * p * (1.0 + x - sqrt(max(9.0 - 3.0 * x * (x + 2.0), 0.0)))
    g, h, k = a - smallest, b - smallest, c - smallest
    ux, uy, uz = d * f - e * h, e * d - g * f, g * h - d * d
    vx, vy, vz = d * k - e * f, e * e - g * k, g * f - d * e
    wx, wy, wz = h * k - f * f, f * e - d * k, d * f - h * e
    nu, nv, nw = ux * ux + uy * uy + uz * uz, vx * vx + vy * vy + vz * vz, wx * wx + wy * wy + wz * wz
    ux, uy, uz, nu = (vx if nv > nu else ux), (vy if nv > nu else uy), (vz if nv > nu else uz), max(nu, nv)
    ux, uy, uz, nu = (wx if nw > nu else ux), (wy if nw > nu else uy), (wz if nw > nu else uz), max(nu, nw)
    flat = nu >= 1e-60
    s = 1.0 / sqrt(max(nu, 1e-60))
    return smallest, middle, (ux * s if flat else 0.0), (uy * s if flat else 0.0), (uz * s if flat else 1.0)


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def along(P, x, y, z):
    """n' P n of a vector n = (x, y, z)."""
    return (
        P[0, 0] * x * x + P[1, 1] * y * y + P[2, 2] * z * z
        + 2.0 * (P[0, 1] * x * y + P[0, 2] * x * z + P[1, 2] * y * z)
    )  # fmt: skip
