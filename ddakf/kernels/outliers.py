"""Preprocessing (paper, section 2.1): mean distances of points to their neighbours, by which outliers are removed."""

from math import sqrt

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.lanes import LANES, load_lanes, store_lanes


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
