"""Preprocessing (paper, section 2.1): one uniform grid per frame, outlier removal and PCA planes on it."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.lanes import LANES, load_lanes, store_lanes
from ddakf.kernels.symmetric import smallest_eigenvector

STEP = 16  # points of a row of cells that are copied at once
BLOCK = 256  # planes that are fitted side by side
FAR = np.float32(1e9)  # m: outside any radius


class Grid(NamedTuple):
    """A uniform grid whose cells hold points, vertices or surfels in compressed rows."""

    start: np.ndarray  # (cells + 2,) int32: cell c holds the sorted entries [start[c], start[c + 1])
    origin: np.ndarray  # (3,) m, corner
    cell: float  # m
    dims: np.ndarray  # (3,) int64, cells per axis


@njit(nogil=True, cache=True, error_model="numpy")
def bounds(points, margin, lower, upper):
    """Bounding box of (N, 3) points, ``margin`` metres wider on all sides; corners (3,) out, metres."""
    x0 = y0 = z0 = np.inf
    x1 = y1 = z1 = -np.inf
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
        x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    lower[0], lower[1], lower[2] = x0 - margin, y0 - margin, z0 - margin
    upper[0], upper[1], upper[2] = x1 + margin, y1 + margin, z1 + margin


@njit(nogil=True, cache=True, error_model="numpy")
def crop(points, lower, upper, inside):
    """Selects the points inside a box, in order. Returns their number; the box shrinks to them.

    Args:
        points: (N, 3) metres.
        lower, upper: (3,) corners of the box, metres, in and out.
        inside: (N,) int32 out, their indices.
    """
    x0 = y0 = z0 = np.inf
    x1 = y1 = z1 = -np.inf
    n = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if (x >= lower[0]) & (x <= upper[0]) & (y >= lower[1]) & (y <= upper[1]) & (z >= lower[2]) & (z <= upper[2]):
            inside[n] = i
            n += 1
            x0, y0, z0 = min(x0, x), min(y0, y), min(z0, z)
            x1, y1, z1 = max(x1, x), max(y1, y), max(z1, z)
    lower[0], lower[1], lower[2] = x0, y0, z0
    upper[0], upper[1], upper[2] = x1, y1, z1
    return n


@njit(nogil=True, cache=True, error_model="numpy")
def fill_grid(points, chosen, grid, sorted_points, sorted_index):
    """Sorts the chosen points by grid cell (counting sort).

    Args:
        points: (N, 3) metres, world.
        chosen: (M,) indices of the points that take part.
        grid: :class:`Grid`; its ``start`` is written.
        sorted_points: (3, M) float32 out, relative to the grid's origin, metres.
        sorted_index: (M,) out, index into ``points``.
    """
    start, origin, cell, dims = grid
    inverse = 1.0 / cell
    n = chosen.shape[0]
    start[:] = 0
    own = np.empty(n, np.int32)
    for k in range(n):
        i = chosen[k]
        ix = min(max(int((points[i, 0] - origin[0]) * inverse), 0), dims[0] - 1)
        iy = min(max(int((points[i, 1] - origin[1]) * inverse), 0), dims[1] - 1)
        iz = min(max(int((points[i, 2] - origin[2]) * inverse), 0), dims[2] - 1)
        own[k] = (ix * dims[1] + iy) * dims[2] + iz + 1
        start[own[k] + 1] += 1
    total = 0
    for c in range(2, start.shape[0]):
        total += start[c]
        start[c] = total
    for k in range(n):
        i, c = chosen[k], own[k]
        slot = start[c]
        start[c] += 1
        for a in range(3):
            sorted_points[a, slot] = points[i, a] - origin[a]
        sorted_index[slot] = i


@njit(nogil=True, cache=True, error_model="numpy")
def neighbourhood_counts(start, dims, cell, count):
    """Lists the occupied cells, in order, and the points in the 27 cells around each. Returns the number of occupied cells.

    Args:
        start, dims: of :class:`Grid`.
        cell, count: (M,) int32 out, numbers of the cells, and points around them.
    """
    nx, ny, nz = dims[0], dims[1], dims[2]
    n = 0
    for ix in range(nx):
        for iy in range(ny):
            row = (ix * ny + iy) * nz
            if start[row] == start[row + nz]:
                continue
            for iz in range(nz):
                if start[row + iz] == start[row + iz + 1]:
                    continue
                z0 = max(iz - 1, 0)
                z1 = min(iz + 1, nz - 1)
                total = 0
                for jx in range(max(ix - 1, 0), min(ix + 2, nx)):
                    for jy in range(max(iy - 1, 0), min(iy + 2, ny)):
                        r = (jx * ny + jy) * nz
                        total += start[r + z1 + 1] - start[r + z0]
                cell[n], count[n] = row + iz, total
                n += 1
    return n


@njit(nogil=True, cache=True, error_model="numpy")
def split_suspects(start, cell, count, share, suspect, rest):
    """Splits the points into suspects, in cells whose ``count`` is below ``share`` of the median point's, and the others.

    Both stay in order. Returns the number of suspects. The median is exact: counts are small integers.

    Args:
        start: of :class:`Grid`.
        cell, count: of :func:`neighbourhood_counts`, one entry per occupied cell.
        share: of the median.
        suspect, rest: (M,) out, indices of sorted points.
    """
    points = np.zeros(count.max() + 1, np.int64)
    for k in range(cell.shape[0]):
        points[count[k]] += start[cell[k] + 1] - start[cell[k]]
    total = points.sum()
    low = high = -1
    passed = 0
    for value in range(points.shape[0]):
        passed += points[value]
        if low < 0 and passed > (total - 1) // 2:
            low = value
        if high < 0 and passed > total // 2:
            high = value
    limit = share * 0.5 * (low + high)
    n = m = 0
    for k in range(cell.shape[0]):
        for p in range(start[cell[k]], start[cell[k] + 1]):
            if count[k] < limit:
                suspect[n] = p
                n += 1
            else:
                rest[m] = p
                m += 1
    return n


@njit(nogil=True, cache=True, error_model="numpy")
def remove(start, removed, points, index, new_start, new_points, new_index):
    """Copies the sorted points without the removed ones.

    Args:
        start, points, index: of the grid, (3, M) float32 metres and (M,) of :func:`fill_grid`.
        removed: (M,) bool.
        new_start, new_points, new_index: the same of the remaining points, out.
    """
    n, gone = 0, 0
    before = np.empty(removed.shape[0] + 1, np.int32)  # removed points before each
    for k in range(removed.shape[0]):
        before[k] = gone
        gone += int(removed[k])
    before[removed.shape[0]] = gone
    for c in range(start.shape[0]):
        new_start[c] = start[c] - before[start[c]]
    for k in range(removed.shape[0]):
        if not removed[k]:
            new_points[0, n] = points[0, k]
            new_points[1, n] = points[1, k]
            new_points[2, n] = points[2, k]
            new_index[n] = index[k]
            n += 1


@njit(nogil=True, cache=True, error_model="numpy")
def mark_surplus(start, most, surplus):
    """Marks the points by which a cell is too full, evenly spread over the cell's points. Returns the number of the others.

    Args:
        start: of :class:`Grid`.
        most: points of a cell that stay.
        surplus: (M,) bool out, of the sorted points.
    """
    left = surplus.shape[0]
    surplus[:] = False
    for c in range(start.shape[0] - 2):
        first, n = start[c], start[c + 1] - start[c]
        if n > most:  # divisions are slow, and few cells are too full
            for k in range(n):
                surplus[first + k] = (k + 1) * most // n == k * most // n
            left -= n - most
    return left


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def gather_around(points, start, dims, middle, most, near):
    """Copies the points of the 27 cells around one. Returns how many.

    Args:
        points: (3, M) float32 sorted by cell, metres.
        start, dims: of :class:`Grid`.
        middle: the cell, along each axis.
        most: points; of more, an even sample is copied.
        near: (3, most + 2 STEP) float32 out, metres; what is behind the last point may be overwritten.
    """
    (ix, iy, iz), (nx, ny, nz) = middle, (dims[0], dims[1], dims[2])
    z0, z1 = max(iz - 1, 0), min(iz + 1, nz - 1)
    total = 0
    for jx in range(max(ix - 1, 0), min(ix + 2, nx)):
        for jy in range(max(iy - 1, 0), min(iy + 2, ny)):
            row = (jx * ny + jy) * nz
            total += start[row + z1 + 1] - start[row + z0]
    every, skipped, n = max(1, (total + most - 1) // most), 0, np.uint64(0)
    size, eight, step = np.uint64(points.shape[1]), np.uint64(LANES), np.uint64(STEP)
    for jx in range(max(ix - 1, 0), min(ix + 2, nx)):
        for jy in range(max(iy - 1, 0), min(iy + 2, ny)):
            row = (jx * ny + jy) * nz
            begin, end = start[row + z0] + skipped, start[row + z1 + 1]
            if every > 1:
                skipped = (begin - end) % every
            k, last = np.uint64(begin), np.uint64(end)
            if every == 1:
                # most rows hold fewer points than a step, so that the loop ends after one, as the processor predicts
                while k < last and k + step <= size:
                    for a in range(3):
                        store_lanes(near[a], n, load_lanes(points[a], k))
                        store_lanes(near[a], n + eight, load_lanes(points[a], k + eight))
                    n += min(last - k, step)
                    k += step
            while k < last:
                for a in range(3):
                    near[a, n] = points[a, k]
                n += np.uint64(1)
                k += np.uint64(every)
    return int(n)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def fit_planes(points, grid, radius, stride, most, surfels):
    """Fits a plane to the neighbours of every ``stride``-th point: the point moved onto it, and its unit normal.

    Neighbours weigh (1 - d^2 / radius^2)^2. Where they do not span a plane the normal is zero. All sums are in float32, of
    differences to the point, and without a branch: so the compiler vectorises them, which halves the time.

    Args:
        points: (3, M) float32 sorted by cell, relative to the grid's origin, metres.
        grid: :class:`Grid` of the points.
        radius: metres, at most one cell.
        stride: of the sorted points, so that each cell has its share of the planes.
        most: points of the 27 cells around that are neighbours; of more, an even sample is.
        surfels: (6, ceil(M / stride)) float32 out: projected point, normal.
    """
    start, _, cell, dims = grid
    inverse = 1.0 / cell
    r2 = radius * radius
    inverse_r2 = np.float32(1.0 / r2)
    zero, one = np.float32(0.0), np.float32(1.0)
    nx, ny, nz = dims[0], dims[1], dims[2]
    X, Y, Z = points[0], points[1], points[2]
    near, moments = np.empty((3, min(most, points.shape[1]) + 2 * STEP), np.float32), np.empty(10 * BLOCK, np.float32)
    AX, AY, AZ = near[0], near[1], near[2]
    here, padded = -1, 0
    for first in range(0, surfels.shape[1], BLOCK):
        n_block = min(BLOCK, surfels.shape[1] - first)
        for b in range(n_block):
            i = (first + b) * stride
            px, py, pz = X[i], Y[i], Z[i]
            ix = min(max(int(px * inverse), 0), nx - 1)
            iy = min(max(int(py * inverse), 0), ny - 1)
            iz = min(max(int(pz * inverse), 0), nz - 1)
            if (ix * ny + iy) * nz + iz != here:
                # the points of the 27 cells around are gathered once for all points of a cell
                here = (ix * ny + iy) * nz + iz
                n = gather_around(points, start, dims, (ix, iy, iz), most, near)
                padded = (n + LANES - 1) // LANES * LANES
                for k in range(n, padded):
                    AX[k], AY[k], AZ[k] = FAR, FAR, FAR
            sw = sx = sy = sz = zero
            xx = yy = zz = xy = xz = yz = zero
            for k in range(padded):
                dx, dy, dz = AX[k] - px, AY[k] - py, AZ[k] - pz
                w = max(one - (dx * dx + dy * dy + dz * dz) * inverse_r2, zero)
                w = w * w
                wx, wy, wz = w * dx, w * dy, w * dz
                sw += w
                sx += wx
                sy += wy
                sz += wz
                xx += wx * dx
                yy += wy * dy
                zz += wz * dz
                xy += wx * dy
                xz += wx * dz
                yz += wy * dz
            for a, moment in enumerate((sw, sx, sy, sz, xx, yy, zz, xy, xz, yz)):
                moments[a * BLOCK + b] = moment
        planes_of(moments, n_block, r2)
        for b in range(n_block):
            i, off = first + b, moments[b]
            for a in range(3):
                axis = moments[(a + 1) * BLOCK + b]
                surfels[a, i] = points[a, i * stride] + off * axis
                surfels[3 + a, i] = axis


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def planes_of(moments, n, r2):
    """Planes of n neighbourhoods, side by side.

    ``moments`` holds ten rows of BLOCK numbers, one per neighbourhood. In: weighted sums about each point of 1, x y z,
    xx yy zz xy xz yz. Out, in the first four rows: the plane's distance along its unit normal, metres, and the normal; 0 where
    there is no plane. It is one array because the compiler could not tell that sixteen arrays do not overlap.

    Args:
        moments: (10 BLOCK,) float32 in and out.
        n: neighbourhoods.
        r2: squared radius, m^2.
    """
    for i in range(n):
        s = 1.0 / np.float64(moments[i])
        x, y, z = moments[BLOCK + i] * s, moments[2 * BLOCK + i] * s, moments[3 * BLOCK + i] * s
        smallest, middle, ux, uy, uz = smallest_eigenvector(
            moments[4 * BLOCK + i] * s - x * x, moments[5 * BLOCK + i] * s - y * y, moments[6 * BLOCK + i] * s - z * z,
            moments[7 * BLOCK + i] * s - x * y, moments[8 * BLOCK + i] * s - x * z, moments[9 * BLOCK + i] * s - y * z,
        )  # fmt: skip
        # three points or a line have no plane; so has a ball, where no direction is thinner than the others
        scale = 1.0 if (middle > 0.004 * r2) & (smallest < 0.5 * middle) else 0.0
        moments[i] = scale * (ux * x + uy * y + uz * z)
        moments[BLOCK + i], moments[2 * BLOCK + i], moments[3 * BLOCK + i] = scale * ux, scale * uy, scale * uz


@njit(nogil=True, cache=True, error_model="numpy")
def orient_normals(surfels, sensor):
    """Turns each normal of (6, S) ``surfels`` toward its ``sensor`` (1, 3) or (S, 3), metres, relative to the grid's origin."""
    one = sensor.shape[0] == 1
    for i in range(surfels.shape[1]):
        s = 0 if one else i
        towards = 0.0
        for a in range(3):
            towards += surfels[3 + a, i] * (sensor[s, a] - surfels[a, i])
        if towards < 0.0:
            for a in range(3):
                surfels[3 + a, i] = -surfels[3 + a, i]


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def squared_distance(x, y, z, place):
    """Of (x, y, z) from a place, m^2."""
    dx, dy, dz = x - place[0], y - place[1], z - place[2]
    return dx * dx + dy * dy + dz * dz


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def append_distances(points, first, last, place, squared, n):
    """Writes the squared distances of the points first..last - 1 from a place behind the first n. Returns how many there are now.

    Args:
        points: (3, M) float32 metres.
        place: (x, y, z) float32 metres.
        squared: (M + LANES,) float32 m^2; a few numbers behind the last may be overwritten.
    """
    X, Y, Z = points[0], points[1], points[2]
    k, end, size, eight = np.uint64(first), np.uint64(last), np.uint64(points.shape[1]), np.uint64(LANES)
    m = np.uint64(n)
    while k < end and k + eight <= size:
        x, y, z = load_lanes(X, k), load_lanes(Y, k), load_lanes(Z, k)
        a, b = squared_distance(x[0], y[0], z[0], place), squared_distance(x[1], y[1], z[1], place)
        c, d = squared_distance(x[2], y[2], z[2], place), squared_distance(x[3], y[3], z[3], place)
        e, f = squared_distance(x[4], y[4], z[4], place), squared_distance(x[5], y[5], z[5], place)
        g, h = squared_distance(x[6], y[6], z[6], place), squared_distance(x[7], y[7], z[7], place)
        store_lanes(squared, m, (a, b, c, d, e, f, g, h))
        k += eight
        m += eight
    while k < end:
        squared[m] = squared_distance(X[k], Y[k], Z[k], place)
        k += np.uint64(1)
        m += np.uint64(1)
    return n + last - first


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def count_within(squared, n, limit):
    """How many of the first n numbers are at most ``limit``."""
    count = np.int32(0)
    for m in range(n):
        count += np.int32(squared[m] <= limit)
    return count


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def sum_of_least(squared, n, k, limit, within):
    """Sum of the roots of the k least of n numbers.

    Nothing is sorted: a limit is sought that k of them keep. By turns it is interpolated, since about as many points as are
    nearer lie in half the squared distance, and halved, so that the search ends.

    Args:
        squared: float32.
        limit: float32 that k or more of the numbers do not exceed.
        within: how many these are.
    """
    low, below, halve = np.float32(0.0), 0, False
    while within > k:
        share = 0.5 if halve else (k - below) / (within - below)
        middle = np.float32(low + (limit - low) * share)
        if middle <= low or middle >= limit:
            middle = np.float32(0.5) * (low + limit)
            if middle <= low or middle >= limit:
                break  # the numbers that are too many all equal the limit
        count = count_within(squared, n, middle)
        if count >= k:
            limit, within = middle, count
        else:
            low, below = middle, count
        halve = not halve
    total = 0.0
    for m in range(n):
        total += sqrt(squared[m]) if squared[m] <= limit else 0.0
    return total - (within - k) * sqrt(limit)


@njit(nogil=True, cache=True, error_model="numpy")
def knn_mean_distances(points, chosen, grid, k, reach, mean_distance):
    """Mean distance of the chosen points to their k nearest others: the paper's statistical filter.

    Rings of cells are searched outward until the k-th distance lies inside the searched box, exactly, or until ``reach`` rings.
    A point with fewer than k neighbours by then counts at least the searched distance.

    Args:
        points: (3, M) float32 sorted by cell.
        chosen: (C,) indices of sorted points.
        grid: :class:`Grid` of the points.
        k: neighbours.
        reach: limit of the rings, one at least.
        mean_distance: (C,) out, metres.
    """
    start, _, cell, dims = grid
    inverse = 1.0 / cell
    squared = np.empty(points.shape[1] + LANES, np.float32)
    nx, ny, nz = dims[0], dims[1], dims[2]
    reach = min(reach, max(nx, ny, nz))
    for c in range(chosen.shape[0]):
        i = chosen[c]
        place = px, py, pz = points[0, i], points[1, i], points[2, i]
        ix = min(max(int(px * inverse), 0), nx - 1)
        iy = min(max(int(py * inverse), 0), ny - 1)
        iz = min(max(int(pz * inverse), 0), nz - 1)
        margin = min(
            px - ix * cell, (ix + 1) * cell - px, py - iy * cell, (iy + 1) * cell - py, pz - iz * cell, (iz + 1) * cell - pz
        )
        n = within = 0
        limit = np.float32(0.0)
        for ring in range(1, reach + 1):
            for jx in range(max(ix - ring, 0), min(ix + ring + 1, nx)):
                for jy in range(max(iy - ring, 0), min(iy + ring + 1, ny)):
                    row = (jx * ny + jy) * nz
                    z0, z1 = iz - ring, iz + ring
                    if ring == 1 or abs(jx - ix) == ring or abs(jy - iy) == ring:
                        n = append_distances(points, start[row + max(z0, 0)], start[row + min(z1, nz - 1) + 1], place, squared, n)
                        continue
                    if z0 >= 0:
                        n = append_distances(points, start[row + z0], start[row + z0 + 1], place, squared, n)
                    if z1 < nz:
                        n = append_distances(points, start[row + z1], start[row + z1 + 1], place, squared, n)
            limit = np.float32(max(ring * cell + margin, 0.0) ** 2)
            within = count_within(squared, n, limit)
            if within > k:  # the point itself is one of them
                break
        if within <= k:
            within = n
            for m in range(n):
                limit = max(limit, squared[m])
        found = min(n - 1, k)
        mean = sum_of_least(squared, n, found + 1, limit, within) / found if found else 0.0
        mean_distance[c] = mean if found == k else max(mean, reach * cell + margin)
