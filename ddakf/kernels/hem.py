"""Stages B and F, hems: the end of the cloud beside each vertex of an open boundary, and its force."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.lanes import LANES, load_lanes, store_lanes
from ddakf.kernels.visibility import NEAREST, perpendicular_axes

NOWHERE = np.float32(-1e30)  # m
LEAST_POINTS = 4  # in the tube
BEYOND = 2.0  # mean distances between the tube's points: where cloth ends past the second last of them, on average
GOES_ON = 0.6  # share of the radius; a cloud that extends that far has no end in the tube
MOST_CELLS = 512  # across the view and up, in which points near the rim are sought
CROWD = 32  # points of such a cell that are looked at, about: of a garment around its camera a cell has thousands
MOST_SEEN = 16_384  # points around a vertex that are looked at; of more, an even sample is


class Tube(NamedTuple):
    """The space around a boundary vertex in which the end of the cloud is searched."""

    radius: float  # m, to either side of the boundary
    width: float  # m to either side along the boundary
    depth: float  # m above and below the surface, plus a third of the distance


class CloudEnds(NamedTuple):
    """Ends of the cloud beside the H boundary vertices."""

    direction: np.ndarray  # (H, 3) unit, in the surface, outward
    offset: np.ndarray  # (H,) m, from the vertex along it to the end of the cloud
    found: np.ndarray  # (H,) bool


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def across_in_tube(x, y, z, frame):
    """Distance of the point (x, y, z) across the boundary, metres, float32; NOWHERE outside the tube.

    ``frame`` holds, in float32, the vertex, the unit vectors across, along and above, and the tube's radius, width and depth.
    """
    px, py, pz, cx, cy, cz, tx, ty, tz, ax, ay, az, radius, width, depth = frame
    dx, dy, dz = x - px, y - py, z - pz
    a = cx * dx + cy * dy + cz * dz
    beside, above = abs(tx * dx + ty * dy + tz * dz), abs(ax * dx + ay * dy + az * dz)
    return a if (abs(a) <= radius) & (beside <= width) & (above <= depth + np.float32(0.33) * abs(a)) else NOWHERE


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def append_across(points, first, last, every, frame, across, n):
    """Writes :func:`across_in_tube` of every ``every``-th of the points first..last - 1 behind the first n. Returns how many.

    Args:
        points: (3, M) float32 metres.
        across: float32 out, metres; a few numbers behind the last may be overwritten.
    """
    X, Y, Z = points[0], points[1], points[2]
    k, end, size, eight, m = np.uint64(first), np.uint64(last), np.uint64(points.shape[1]), np.uint64(LANES), np.uint64(n)
    while every == 1 and k < end and k + eight <= size:
        x, y, z = load_lanes(X, k), load_lanes(Y, k), load_lanes(Z, k)
        a, b = across_in_tube(x[0], y[0], z[0], frame), across_in_tube(x[1], y[1], z[1], frame)
        c, d = across_in_tube(x[2], y[2], z[2], frame), across_in_tube(x[3], y[3], z[3], frame)
        e, f = across_in_tube(x[4], y[4], z[4], frame), across_in_tube(x[5], y[5], z[5], frame)
        g, h = across_in_tube(x[6], y[6], z[6], frame), across_in_tube(x[7], y[7], z[7], frame)
        store_lanes(across, m, (a, b, c, d, e, f, g, h))
        m += min(end - k, eight)
        k += eight
    while k < end:
        across[m] = across_in_tube(X[k], Y[k], Z[k], frame)
        m += np.uint64(1)
        k += np.uint64(every)
    return int(m)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def farthest_two(across, n):
    """How many of n numbers are not NOWHERE, and the second greatest of them; NOWHERE where there are fewer than two."""
    first = NOWHERE
    for m in range(n):
        first = max(first, across[m])
    inside, equal, second = 0, 0, NOWHERE
    for m in range(n):
        a = across[m]
        inside += int(a > NOWHERE)
        equal += int(a == first)
        second = max(second, a if a < first else NOWHERE)
    return inside, first if equal > 1 else second


@njit(nogil=True, cache=True, error_model="numpy")
def ends_of_cloud(position, normal, visible, boundary, points, grid, tube, ends):
    """Finds the end of the cloud across the boundary, beside each visible boundary vertex.

    The points in a tube along the outward direction in the surface belong to the same piece of cloth. The second farthest of
    them, against single outliers, marks the end. A cloud that extends toward the end of the tube, or has few points in it, does
    not end there.

    Args:
        position, normal: (V, 3) metres, unit.
        visible: (V,) bool.
        boundary: (H, 3) vertex, and the vertices before and after it along the boundary in the sense of its faces.
        points: (3, M) float32 sorted by cell, relative to the grid's origin, metres.
        grid: ``Grid`` of the points.
        tube: :class:`Tube`.
        ends: :class:`CloudEnds` out; direction and offset are unchanged where no end is found.
    """
    start, origin, cell, dims = grid
    radius, width, depth = tube
    direction, offset, found = ends
    inverse = 1.0 / cell
    nx, ny, nz = dims[0], dims[1], dims[2]
    across = np.empty(min(MOST_SEEN, points.shape[1]) + LANES, np.float32)
    for h in range(boundary.shape[0]):
        found[h] = False
        v, before, after = boundary[h, 0], boundary[h, 1], boundary[h, 2]
        if not visible[v]:
            continue
        tx = position[after, 0] - position[before, 0]
        ty = position[after, 1] - position[before, 1]
        tz = position[after, 2] - position[before, 2]
        ax, ay, az = normal[v, 0], normal[v, 1], normal[v, 2]
        length = sqrt(tx * tx + ty * ty + tz * tz)
        if length < 1e-9:
            continue
        tx, ty, tz = tx / length, ty / length, tz / length
        cx, cy, cz = ty * az - tz * ay, tz * ax - tx * az, tx * ay - ty * ax
        length = sqrt(cx * cx + cy * cy + cz * cz)
        if length < 1e-6:
            continue
        cx, cy, cz = cx / length, cy / length, cz / length
        px, py, pz = position[v, 0] - origin[0], position[v, 1] - origin[1], position[v, 2] - origin[2]
        x0, x1 = max(int((px - radius) * inverse), 0), min(int((px + radius) * inverse), nx - 1)
        y0, y1 = max(int((py - radius) * inverse), 0), min(int((py + radius) * inverse), ny - 1)
        z0, z1 = max(int((pz - radius) * inverse), 0), min(int((pz + radius) * inverse), nz - 1)
        if z0 > z1:
            continue
        every = 1
        if points.shape[1] > MOST_SEEN:
            total = 0
            for jx in range(x0, x1 + 1):
                for jy in range(y0, y1 + 1):
                    row = (jx * ny + jy) * nz
                    total += start[row + z1 + 1] - start[row + z0]
            every = max(1, (total + MOST_SEEN - 1) // MOST_SEEN)
        skipped = n = 0
        frame = (
            np.float32(px), np.float32(py), np.float32(pz), np.float32(cx), np.float32(cy), np.float32(cz),
            np.float32(tx), np.float32(ty), np.float32(tz), np.float32(ax), np.float32(ay), np.float32(az),
            np.float32(radius), np.float32(width), np.float32(depth),
        )  # fmt: skip
        for jx in range(x0, x1 + 1):
            for jy in range(y0, y1 + 1):
                row = (jx * ny + jy) * nz
                begin, end = start[row + z0] + skipped, start[row + z1 + 1]
                if every > 1:
                    skipped = (begin - end) % every
                n = append_across(points, begin, end, every, frame, across, n)
        inside, second = farthest_two(across, n)
        if inside < LEAST_POINTS or second > GOES_ON * radius:
            continue
        found[h] = True
        offset[h] = second + BEYOND * (second + radius) / (inside - 1)
        direction[h, 0], direction[h, 1], direction[h, 2] = cx, cy, cz


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def across_view(x, y, z, eye, axes, away, spot):
    """Writes where the ray to (x, y, z) is ``away`` metres from the eye, across the view. Returns False for what is behind it."""
    dx, dy, dz = x - eye[0], y - eye[1], z - eye[2]
    depth = axes[2, 0] * dx + axes[2, 1] * dy + axes[2, 2] * dz
    if depth < NEAREST:
        return False
    scale = away / depth
    spot[0] = (axes[0, 0] * dx + axes[0, 1] * dy + axes[0, 2] * dz) * scale
    spot[1] = (axes[1, 0] * dx + axes[1, 1] * dy + axes[1, 2] * dz) * scale
    return True


@njit(nogil=True, cache=True, error_model="numpy")
def gaps_across_view(position, normal, seen, points, eye, cosine, reach, gaps):
    """Median distance across the view from seen vertices to the nearest point: of the rim, and of the others.

    A mask that is too narrow moves all of the rim away from the cloud, a garment that is misplaced only a part of it, but far:
    hence the median. Vertices of the rim face the sensor by less than ``cosine``. Those that have no point within ``reach`` do
    not count: they are outside the image, or hidden. Points are moved along their rays to the distance of the garment's middle.

    Args:
        position, normal: (V, 3) metres, unit, relative to the origin of the points.
        seen: (V,) bool, vertices that the sensor may see.
        points: (3, M) float32 metres.
        eye: (3,) the sensor, metres.
        cosine: of the angle between normal and direction to the sensor.
        reach: metres.
        gaps: (2,) metres out, of the rim and of the others; 0 where there are none.

    Returns:
        How many of either there are, (2,).
    """
    center, axes = np.zeros(3), np.empty((3, 3))
    for v in range(position.shape[0]):
        for a in range(3):
            center[a] += position[v, a] / position.shape[0]
    away = 0.0
    for a in range(3):
        axes[2, a] = center[a] - eye[a]
        away += axes[2, a] ** 2
    away = sqrt(away) + 1e-12
    axes[2] /= away
    perpendicular_axes(axes[2], axes)
    here, count = np.full((position.shape[0], 2), np.inf), np.zeros(2, np.int64)
    left = bottom = np.inf
    right = top = -np.inf
    for v in range(position.shape[0]):
        if seen[v] and across_view(position[v, 0], position[v, 1], position[v, 2], eye, axes, away, here[v]):
            left, right = min(left, here[v, 0]), max(right, here[v, 0])
            bottom, top = min(bottom, here[v, 1]), max(top, here[v, 1])
    gaps[:] = 0.0
    if not left <= right:
        return count
    left, bottom, right, top = left - reach, bottom - reach, right + reach, top + reach
    cell = max(reach / 4, (right - left) / MOST_CELLS, (top - bottom) / MOST_CELLS)
    inverse = 1.0 / cell
    columns, rows = int((right - left) * inverse) + 1, int((top - bottom) * inverse) + 1
    start, place = np.zeros(columns * rows + 2, np.int32), np.empty(points.shape[1], np.int32)
    spot, there = np.empty((points.shape[1], 2)), np.empty((points.shape[1], 2))
    for k in range(points.shape[1]):
        place[k] = -1
        if across_view(points[0, k], points[1, k], points[2, k], eye, axes, away, spot[k]):
            column, row = int((spot[k, 0] - left) * inverse), int((spot[k, 1] - bottom) * inverse)
            if spot[k, 0] >= left and spot[k, 1] >= bottom and column < columns and row < rows:
                place[k] = row * columns + column
                start[place[k] + 2] += 1
    for c in range(2, start.shape[0]):
        start[c] += start[c - 1]
    for k in range(points.shape[1]):
        if place[k] >= 0:
            slot = start[place[k] + 1]
            start[place[k] + 1] += 1
            there[slot, 0], there[slot, 1] = spot[k, 0], spot[k, 1]
    rings, found = int(np.ceil(reach / cell)), np.empty((2, position.shape[0]))
    for v in range(position.shape[0]):
        if not here[v, 0] < np.inf:
            continue
        column, row, best = int((here[v, 0] - left) * inverse), int((here[v, 1] - bottom) * inverse), reach * reach
        for ring in range(rings + 1):
            for j in range(max(row - ring, 0), min(row + ring + 1, rows)):
                whole = abs(j - row) == ring
                for i in range(max(column - ring, 0), min(column + ring + 1, columns)):
                    if whole or abs(i - column) == ring:
                        c = j * columns + i
                        every = 1 + (start[c + 1] - start[c]) // CROWD
                        for slot in range(start[c], start[c + 1], every):
                            best = min(best, (there[slot, 0] - here[v, 0]) ** 2 + (there[slot, 1] - here[v, 1]) ** 2)
            if best <= (ring * cell) ** 2:
                break
        if best < reach * reach:
            along = squared = 0.0
            for a in range(3):
                to = eye[a] - position[v, a]
                along += normal[v, a] * to
                squared += to * to
            kind = int(along > cosine * sqrt(squared))
            found[kind, count[kind]] = sqrt(best)
            count[kind] += 1
    for kind in range(2):
        if count[kind] > 0:
            gaps[kind] = np.median(found[kind, : count[kind]])
    return count


@njit(nogil=True, cache=True, error_model="numpy")
def add_ends_of_cloud(vertex, direction, offset, weight, variance, D, force):
    """Adds the measured ends of the cloud: D += k c c' and force += k offset c, k = weight / variance (1/m^2).

    Args:
        vertex: (H,) boundary vertices.
        direction, offset: c (H, 3) unit and (H,) metres, of :class:`CloudEnds`.
        weight: (H,).
        variance: of each end, m^2.
        D: (V, 3, 3) diagonal blocks of A, 1/m^2, added to.
        force: (V, 3) or wider, 1/m, added to.
    """
    for h in range(vertex.shape[0]):
        k = weight[h] / variance
        if k == 0.0:
            continue
        i = vertex[h]
        for a in range(3):
            force[i, a] += k * offset[h] * direction[h, a]
            for b in range(3):
                D[i, a, b] += k * direction[h, a] * direction[h, b]
