"""Preprocessing (paper, section 2.1): one uniform grid per frame, outlier removal and PCA planes on it."""

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
    """Sorts the chosen points by grid cell (counting sort). Returns the most points that a cell holds.

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
    total = most = 0
    for c in range(2, start.shape[0]):
        most = max(most, start[c])
        total += start[c]
        start[c] = total
    for k in range(n):
        i, c = chosen[k], own[k]
        slot = start[c]
        start[c] += 1
        for a in range(3):
            sorted_points[a, slot] = points[i, a] - origin[a]
        sorted_index[slot] = i
    return most


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
        s = 1.0 / max(np.float64(moments[i]), 1e-30)  # a point of a crowd may have no neighbour among those looked at
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
