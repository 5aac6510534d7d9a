"""z-buffer of a pinhole camera: the nearest face and its depth at every pixel. Twins: tests/evaluation.

A ``lens`` is a named tuple of focal lengths and principal point (fx, fy, cx, cy) in pixels. The centre of the pixel in row v and
column u is at (u, v).
"""

from math import ceil, floor, inf

import numpy as np
from numba import njit

NEAR = 0.05  # m: faces with a corner nearer than this, or behind the camera, are left out whole


@njit(nogil=True, cache=True)
def on_screen(vertices, lens):
    """(V, 3) column, row and 1/z of vertices in camera axes; 1/z is -1 where they are nearer than NEAR."""
    fx, fy, cx, cy = lens
    screen = np.empty((vertices.shape[0], 3))
    for i in range(vertices.shape[0]):
        z = vertices[i, 2]
        screen[i, 2] = 1.0 / z if z >= NEAR else -1.0
        screen[i, 0] = vertices[i, 0] * screen[i, 2] * fx + cx
        screen[i, 1] = vertices[i, 1] * screen[i, 2] * fy + cy
    return screen


@njit(nogil=True, cache=True)
def whole_between(lower, upper, n):
    """First and last whole number of 0..n-1 between two bounds; there is none where the first is greater."""
    return ceil(min(max(lower, 0.0), float(n))), floor(max(min(upper, n - 1.0), -1.0))


@njit(nogil=True, cache=True)
def weights(triangle, area, u, v):
    """Barycentric coordinates of the pixel (u, v) in a triangle on the screen; none is negative where it is inside.

    ``triangle`` is (ua, va, ub, vb, uc, vc) in pixels, ``area`` its signed double area.
    """
    ua, va, ub, vb, uc, vc = triangle
    alpha = ((ub - u) * (vc - v) - (vb - v) * (uc - u)) / area
    beta = ((uc - u) * (va - v) - (vc - v) * (ua - u)) / area
    return alpha, beta, 1.0 - alpha - beta


@njit(nogil=True, cache=True)
def rasterize(vertices, faces, lens, label, depth, face):
    """Draws triangles, both sides, into a depth image.

    Args:
        vertices: (V, 3) float64 in camera axes, x right, y down, z forward, metres.
        faces: (F, 3) int64.
        lens: (fx, fy, cx, cy) pixels.
        label: added to the face's index before it is stored, so that several meshes share a buffer.
        depth: (H, W) float64 z of the nearest surface so far, infinity where there is none; updated.
        face: (H, W) int32 label + index of the face at that depth; updated.
    """
    height, width = depth.shape
    screen = on_screen(vertices, lens)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        wa, wb, wc = screen[a, 2], screen[b, 2], screen[c, 2]
        if wa < 0 or wb < 0 or wc < 0:
            continue
        ua, va, ub, vb, uc, vc = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1], screen[c, 0], screen[c, 1]
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if area == 0.0:
            continue
        first_row, last_row = whole_between(min(va, vb, vc), max(va, vb, vc), height)
        first_column, last_column = whole_between(min(ua, ub, uc), max(ua, ub, uc), width)
        for v in range(first_row, last_row + 1):
            for u in range(first_column, last_column + 1):
                alpha, beta, gamma = weights((ua, va, ub, vb, uc, vc), area, u, v)
                if alpha < 0.0 or beta < 0.0 or gamma < 0.0:
                    continue
                z = 1.0 / (alpha * wa + beta * wb + gamma * wc)  # 1/z is linear on the screen
                if z < depth[v, u]:
                    depth[v, u] = z
                    face[v, u] = label + f


@njit(nogil=True, cache=True)
def cover(vertices, faces, lens, free):
    """Draws a silhouette: the pixels that :func:`rasterize` draws, each once however many faces cover it.

    A face costs time for its rows and for the pixels that it covers first, so that a mesh torn across the picture costs little
    more.

    Args:
        vertices, faces, lens: as given to :func:`rasterize`.
        free: (H, W + 1) int32, updated: at first every pixel's own column, which an uncovered pixel keeps. A covered one has a
            column on the way to the next free one, or to W, the end of the row.
    """
    height, width = free.shape[0], free.shape[1] - 1
    screen = on_screen(vertices, lens)
    for f in range(faces.shape[0]):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if screen[a, 2] < 0 or screen[b, 2] < 0 or screen[c, 2] < 0:
            continue
        ua, va, ub, vb, uc, vc = screen[a, 0], screen[a, 1], screen[b, 0], screen[b, 1], screen[c, 0], screen[c, 1]
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if area == 0.0:
            continue
        first_row, last_row = whole_between(min(va, vb, vc), max(va, vb, vc), height)
        first_column, last_column = whole_between(min(ua, ub, uc), max(ua, ub, uc), width)
        for v in range(first_row, last_row + 1):
            if next_free(free, v, first_column) > last_column:
                continue
            lower, upper = -inf, inf  # where the edges cross the row, rounded
            for p, q, r, s in ((ub, vb, uc, vc), (uc, vc, ua, va), (ua, va, ub, vb)):
                if q != s:
                    crossing = p + (v - q) * (r - p) / (s - q)
                    if (s > q) == (area > 0.0):  # the inside is on the smaller side
                        upper = min(upper, crossing)
                    else:
                        lower = max(lower, crossing)
            first, last = whole_between(lower, upper, width)
            u, last = max(first_column, first - 1), min(last_column, last + 1)
            while u <= last and min(weights((ua, va, ub, vb, uc, vc), area, u, v)) < 0.0:
                u += 1
            while u <= last and min(weights((ua, va, ub, vb, uc, vc), area, last, v)) < 0.0:
                last -= 1
            u = next_free(free, v, u)
            while u <= last:
                free[v, u] = u + 1
                u = next_free(free, v, u + 1)


@njit(nogil=True, cache=True)
def next_free(free, v, u):
    """The first free column from u on in a row v; halves the paths that it follows."""
    while free[v, u] != u:
        free[v, u] = free[v, free[v, u]]
        u = free[v, u]
    return u


@njit(nogil=True, cache=True)
def splat(points, lens, radius, depth, index):
    """Draws points as discs that face the camera, where nothing is nearer.

    Args:
        points: (N, 3) float64 in camera axes, metres.
        lens: (fx, fy, cx, cy) pixels.
        radius: of a disc, pixels.
        depth: (H, W) float64 metres, updated.
        index: (H, W) int32, the point's index; updated.
    """
    fx, fy, cx, cy = lens
    height, width = depth.shape
    reach = ceil(radius)
    for i in range(points.shape[0]):
        z = points[i, 2]
        if z < NEAR:
            continue
        u, v = points[i, 0] / z * fx + cx, points[i, 1] / z * fy + cy
        if not (-reach <= u < width + reach and -reach <= v < height + reach):
            continue
        column, row = floor(u + 0.5), floor(v + 0.5)
        for y in range(max(0, row - reach), min(height, row + reach + 1)):
            for x in range(max(0, column - reach), min(width, column + reach + 1)):
                if (x - u) ** 2 + (y - v) ** 2 <= radius * radius and z < depth[y, x]:
                    depth[y, x] = z
                    index[y, x] = i


@njit(nogil=True, cache=True)
def interpolate(vertices, faces, values, lens, label, face, image):
    """Perspective-correct values of the vertices at the pixels where a mesh is visible.

    Args:
        vertices, faces, lens, label: as given to :func:`rasterize`.
        values: (V, C) float64.
        face: (H, W) int32, from :func:`rasterize`.
        image: (H, W, C) float64; written where ``face`` is one of this mesh.
    """
    fx, fy, cx, cy = lens
    height, width = face.shape
    for v in range(height):
        for u in range(width):
            f = face[v, u] - label
            if face[v, u] < 0 or f < 0 or f >= faces.shape[0]:
                continue
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            x, y = (u - cx) / fx, (v - cy) / fy
            # The ray's triple products with the corners are the weights of the point that it hits
            wa = _triple(vertices, b, c, x, y)
            wb = _triple(vertices, c, a, x, y)
            wc = _triple(vertices, a, b, x, y)
            total = wa + wb + wc
            for k in range(values.shape[1]):
                image[v, u, k] = (wa * values[a, k] + wb * values[b, k] + wc * values[c, k]) / total


@njit(nogil=True, cache=True)
def _triple(vertices, i, j, x, y):
    """(x, y, 1) . (vertex i x vertex j)"""
    ax, ay, az = vertices[i, 0], vertices[i, 1], vertices[i, 2]
    bx, by, bz = vertices[j, 0], vertices[j, 1], vertices[j, 2]
    return x * (ay * bz - az * by) + y * (az * bx - ax * bz) + ax * by - ay * bx
