"""Stage B, association (paper, section 2.3): the vertices that a sensor may see."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST

BLOCK = 256  # points whose directions are computed side by side
NEAREST = 0.05  # m: what is nearer to a sensor, or behind it, is not seen
DIRECTIONS = 160  # rows and columns of the grid of directions: 4 m of a garment with 17 mm edges


class VisibilityLimits(NamedTuple):
    """Limits of what a sensor may see."""

    cell: float  # m, of the grid of directions at the garment's distance: about an edge and a half of the meshes
    depth_margin: float  # m
    min_cosine: float  # least turn of a vertex toward the sensor


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def mark_visible(position, normal, body, surfels, origin, sensor, limits, visible):
    """Marks the vertices that a sensor may see: they face it, and nothing hides them.

    From each sensor a grid of directions, as wide as ``cell`` at the garment's distance, holds the least depth of the vertices of
    garment and body. A vertex is hidden when something in its cell is nearer by more than ``depth_margin`` plus the depth that
    the vertex's own slope explains across the cell. The garment's other layers are estimates as well: they hide only where the
    cloud shows something as near. Of the grid only the window that holds the garment is kept.

    Args:
        position, normal: (V, 3) metres, unit.
        body: (B, 3) metres, B may be 0.
        surfels: (6, S) float32 of the cloud, points (relative to origin) and normals; where S is 0 all layers hide.
        origin: (3,) metres.
        sensor: (K, 3) metres.
        limits: :class:`VisibilityLimits`.
        visible: (V,) bool out.
    """
    cell, depth_margin, min_cosine = limits
    n = position.shape[0]
    visible[:] = False
    place, depth = np.empty(n, np.int32), np.empty(n)
    block, some_place, some_depth = np.empty((3, BLOCK)), np.empty(BLOCK, np.int32), np.empty(BLOCK)
    center, axes = np.zeros(3), np.empty((3, 3))
    for v in range(n):
        for a in range(3):
            center[a] += position[v, a] / n
    for s in range(sensor.shape[0]):
        eye = sensor[s, 0], sensor[s, 1], sensor[s, 2]
        distance = 0.0
        for a in range(3):
            axes[2, a] = center[a] - sensor[s, a]
            distance += axes[2, a] ** 2
        distance = sqrt(distance) + 1e-12
        axes[2] /= distance
        perpendicular_axes(axes[2], axes)
        axes[:2] *= distance / cell  # cells per unit of slope
        whole = 0.0, 0.0, float(DIRECTIONS), float(DIRECTIONS)
        for first in range(0, n, BLOCK):
            size = seen_from(position, first, eye, block)
            directions(block, size, axes, whole, place[first : first + size], depth[first : first + size])
        window = window_of(place)
        columns, rows = int(window[2]), int(window[3])
        for v in range(n):
            inside = place[v] < DIRECTIONS * DIRECTIONS
            row, column = place[v] // DIRECTIONS - int(window[1]), place[v] % DIRECTIONS - int(window[0])
            place[v] = row * columns + column if inside else rows * columns
        nearest, cloud = np.full(rows * columns + 1, np.inf), np.full(rows * columns + 1, np.inf)
        for v in range(n):
            nearest[place[v]] = min(nearest[place[v]], depth[v])
        if surfels.shape[1] > 0:
            for first in range(0, surfels.shape[1], BLOCK):
                size = min(BLOCK, surfels.shape[1] - first)
                for a in range(3):
                    for i in range(size):
                        block[a, i] = surfels[a, first + i] + (origin[a] - eye[a])
                directions(block, size, axes, window, some_place, some_depth)
                for i in range(size):
                    cloud[some_place[i]] = min(cloud[some_place[i]], some_depth[i])
            for c in range(nearest.shape[0]):
                nearest[c] = max(nearest[c], cloud[c])
        for first in range(0, body.shape[0], BLOCK):
            size = seen_from(body, first, eye, block)
            directions(block, size, axes, window, some_place, some_depth)
            for i in range(size):
                nearest[some_place[i]] = min(nearest[some_place[i]], some_depth[i])
        nearest[rows * columns] = np.inf  # nothing hides what is outside the grid
        for v in range(n):
            dx, dy, dz = eye[0] - position[v, 0], eye[1] - position[v, 1], eye[2] - position[v, 2]
            length = sqrt(dx * dx + dy * dy + dz * dz)
            cosine = (normal[v, 0] * dx + normal[v, 1] * dy + normal[v, 2] * dz) / length
            slope = sqrt(max(1.0 - cosine * cosine, 0.0)) / max(cosine, 1e-3)
            free = nearest[place[v]] >= depth[v] - depth_margin - 1.5 * cell * slope
            visible[v] |= (cosine > min_cosine) & free


@njit(nogil=True, cache=True, error_model="numpy")
def perpendicular_axes(view, axes):
    """Completes the unit vector ``view`` (3,) to a right-handed frame: two unit vectors, rows 0 and 1 of ``axes`` out.

    The first is as near as possible to the coordinate axis along which ``view`` has its least component.
    """
    least = 0
    for a in range(1, 3):
        if abs(view[a]) < abs(view[least]):
            least = a
    for a in range(3):
        axes[0, a] = (1.0 if a == least else 0.0) - view[least] * view[a]
    axes[0] /= sqrt(axes[0, 0] ** 2 + axes[0, 1] ** 2 + axes[0, 2] ** 2)
    axes[1, 0] = view[1] * axes[0, 2] - view[2] * axes[0, 1]
    axes[1, 1] = view[2] * axes[0, 0] - view[0] * axes[0, 2]
    axes[1, 2] = view[0] * axes[0, 1] - view[1] * axes[0, 0]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def seen_from(points, first, eye, block):
    """Copies the points (N, 3) from ``first`` on, relative to ``eye``, into ``block`` (3, BLOCK), metres. Returns how many."""
    size = min(BLOCK, points.shape[0] - first)
    for i in range(size):
        block[0, i] = points[first + i, 0] - eye[0]
        block[1, i] = points[first + i, 1] - eye[1]
        block[2, i] = points[first + i, 2] - eye[2]
    return size


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def directions(block, n, axes, window, place, depth):
    """Places of points in a window of the grid of directions, row by row, the last one + 1 outside it or behind the eye.

    Args:
        block: (3, BLOCK) metres, relative to the eye.
        n: points.
        axes: (3, 3), whose rows are the grid's column, row and depth axes, the first two in cells per unit of slope.
        window: first column and row, columns and rows.
        place: (n,) int32 out.
        depth: (n,) metres out.
    """
    left, top, columns, rows = window
    ux, uy, uz = axes[0, 0], axes[0, 1], axes[0, 2]
    vx, vy, vz = axes[1, 0], axes[1, 1], axes[1, 2]
    wx, wy, wz = axes[2, 0], axes[2, 1], axes[2, 2]
    middle, outside = DIRECTIONS / 2, columns * rows
    for i in range(n):
        x, y, z = block[0, i], block[1, i], block[2, i]
        d = wx * x + wy * y + wz * z
        s = 1.0 / d
        u = (ux * x + uy * y + uz * z) * s + (middle - left)
        v = (vx * x + vy * y + vz * z) * s + (middle - top)
        inside = (d >= NEAREST) & (u >= 0.0) & (u < columns) & (v >= 0.0) & (v < rows)
        place[i] = np.int32(np.floor(v) * columns + np.floor(u) if inside else outside)
        depth[i] = d


@njit(nogil=True, cache=True, error_model="numpy")
def window_of(place):
    """First column and row, columns and rows of the least window that holds all the places in the grid of directions."""
    left = top = DIRECTIONS
    right = bottom = -1
    for v in range(place.shape[0]):
        row, column = place[v] // DIRECTIONS, place[v] % DIRECTIONS
        if row < DIRECTIONS:
            left, right = min(left, column), max(right, column)
            top, bottom = min(top, row), max(bottom, row)
    if right < 0:
        return 0.0, 0.0, 0.0, 0.0
    return float(left), float(top), float(right - left + 1), float(bottom - top + 1)
