"""Stage B, association (paper, section 2.3): the cloud's planes or points beside the vertices."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.lanes import II, III, IV, LANES, VI, VII, I, V, load_lanes, store_lanes

BLEND = 4  # surfels that a measurement is averaged over
CANDIDATES = 256  # surfels whose distances are compared at once, a power of two
AT_ONCE = 2 * LANES  # of a row of cells: most rows hold fewer, so that the loop over them ends after one step, as is predicted
SCANNED = 32  # candidates that are compared side by side
NONE, BELOW_ALL = np.int32(2**31 - 1), np.int32(-1)
TOO_FAR = np.float32(1e30)  # m^2
FAR_AWAY = 1e30  # m: place of the last search of a vertex that was never searched for
NO_SURFEL, PAST_THE_END = -1.0, -2.0  # distance of a vertex without a measurement, by reason
# Surfels after which no farther cells are searched. A vertex of an ordinary cloud finds its plane among a few hundred; of a clump
# whose normals agree with none it would search all.
MOST_SEEN = 4096


class PlaneSearch(NamedTuple):
    """Limits of the search for planes."""

    gate: float  # m, search radius
    min_cosine: float  # least agreement of the normals
    normal_distance: float  # m, distance that a unit difference of the normals counts as
    oriented: bool  # the surfels' normals point to the sensor
    least_motion: float  # m: a vertex that moved less since its last search keeps its plane
    lateral_gate: float  # m along the plane, beyond which a vertex lies past the end of the cloud and has no measurement


class FoundPlanes(NamedTuple):
    """Planes of the cloud beside V vertices, updated from pass to pass."""

    target: np.ndarray  # (V, 3) m, blended surface point
    normal: np.ndarray  # (V, 3) unit, on the side of the vertex normal
    distance: np.ndarray  # (V,) m to the nearest surfel, the difference of the normals included; NO_SURFEL, PAST_THE_END
    searched_at: np.ndarray  # (V, 3) m, position at the last search; FAR_AWAY before the first


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def surfel_distance(surfel, vertex, metric):
    """Squared distance of a surfel from a vertex, m^2, of point and normal; TOO_FAR where the normals disagree.

    Args:
        surfel, vertex: (x, y, z, nx, ny, nz) float32, relative to the grid's origin, metres, unit.
        metric: float32 (signed, least, penalty): -1 where the sign of the surfel's normal is unknown, else 1; least cosine of
            the normals; m^2 per unit of 1 - cosine.
    """
    x, y, z, nx, ny, nz = surfel
    signed, least, penalty = metric
    px, py, pz, ax, ay, az = vertex
    dx, dy, dz = x - px, y - py, z - pz
    agreement = nx * ax + ny * ay + nz * az
    agreement = max(agreement, signed * agreement)
    squared = dx * dx + dy * dy + dz * dz + penalty * max(np.float32(1.0) - agreement, np.float32(0.0))
    return squared if agreement >= least else TOO_FAR


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def append_candidates(surfels, k, vertex, metric, squared, index, n):
    """Writes the distances and numbers of the LANES surfels from k on behind the first n candidates.

    All are read before any is written, so that the compiler makes one vector of each. The arguments are those of
    :func:`surfel_distance` and :func:`select_nearest`.
    """
    x, y, z = load_lanes(surfels[0], k), load_lanes(surfels[1], k), load_lanes(surfels[2], k)
    u, v, w = load_lanes(surfels[3], k), load_lanes(surfels[4], k), load_lanes(surfels[5], k)
    a = surfel_distance((x[0], y[0], z[0], u[0], v[0], w[0]), vertex, metric)
    b = surfel_distance((x[1], y[1], z[1], u[1], v[1], w[1]), vertex, metric)
    c = surfel_distance((x[2], y[2], z[2], u[2], v[2], w[2]), vertex, metric)
    d = surfel_distance((x[3], y[3], z[3], u[3], v[3], w[3]), vertex, metric)
    e = surfel_distance((x[4], y[4], z[4], u[4], v[4], w[4]), vertex, metric)
    f = surfel_distance((x[5], y[5], z[5], u[5], v[5], w[5]), vertex, metric)
    g = surfel_distance((x[6], y[6], z[6], u[6], v[6], w[6]), vertex, metric)
    h = surfel_distance((x[7], y[7], z[7], u[7], v[7], w[7]), vertex, metric)
    store_lanes(squared, n, (a, b, c, d, e, f, g, h))
    store_lanes(index, n, (k, k + I, k + II, k + III, k + IV, k + V, k + VI, k + VII))


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def append_last_candidates(surfels, k, end, vertex, metric, squared, index, n):
    """As :func:`append_candidates`, for the surfels from k up to ``end``, where fewer than AT_ONCE are left in memory."""
    X, Y, Z, NX, NY, NZ = surfels[0], surfels[1], surfels[2], surfels[3], surfels[4], surfels[5]
    for m in range(end - k):
        j = k + m
        squared[n + m] = surfel_distance((X[j], Y[j], Z[j], NX[j], NY[j], NZ[j]), vertex, metric)
        index[n + m] = j


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def select_nearest(squared, bits, index, n, gate2):
    """Moves the BLEND nearest of n candidates to the front, in order. Returns the number of them within the gate.

    Positive floats have the order of their bits. With the candidate's number in the lowest bits, the least integer holds the
    least distance and its owner. Distances that agree to 2^-15 count as equal.

    Args:
        squared: (CANDIDATES + SCANNED,) float32 square metres, in and out; the ordered ones are rounded down to 2^-15.
        bits: the same memory as int32.
        index: (CANDIDATES,) in and out, numbers of the surfels.
        n: candidates.
        gate2: square metres.
    """
    number, distance = np.int32(CANDIDATES - 1), np.int32(~(CANDIDATES - 1))  # masks of the bits
    padded = (n + np.uint64(SCANNED - 1)) & ~np.uint64(SCANNED - 1)
    for m in range(SCANNED):
        squared[n + np.uint64(m)] = TOO_FAR
    for m in range(padded):
        bits[m] = (bits[m] & distance) | np.int32(m)
    a = least_above(bits, padded, BELOW_ALL)
    b = least_above(bits, padded, a)
    c = least_above(bits, padded, b)
    d = least_above(bits, padded, c)
    e, f, g, h = index[a & number], index[b & number], index[c & number], index[d & number]
    index[0], index[1], index[2], index[3] = e, f, g, h
    bits[0], bits[1], bits[2], bits[3] = a & distance, b & distance, c & distance, d & distance
    return int(squared[0] < gate2) + int(squared[1] < gate2) + int(squared[2] < gate2) + int(squared[3] < gate2)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST, inline="always")
def least_above(bits, n, bound):
    """The least of n integers that is greater than ``bound``.

    Nothing is removed: a vector that is read after one of its numbers was written has to wait.
    """
    least = NONE
    for m in range(n):
        least = min(least, bits[m] if bits[m] > bound else NONE)
    return least


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def nearest_planes(position, normal, eligible, surfels, grid, search, planes):
    """Finds the cloud's plane next to each eligible vertex.

    The nearest surfels whose normal agrees with the vertex's are blended by inverse squared distance, |z - p|^2 +
    normal_distance^2 |m - n|^2 of point and normal, so that a fold's flank finds its own flank. A cloud without a known sensor
    has unsigned normals, which agree up to sign. A vertex that has moved by less than ``least_motion`` since its last search
    keeps its plane: the surface is flat within that distance.

    Args:
        position, normal: (V, 3) estimate, metres, and its unit normals.
        eligible: (V,) bool, vertices that are measured.
        surfels: (6, S) float32, point (relative to the grid's origin, metres) and unit normal, sorted by cell.
        grid: ``Grid`` of the surfels.
        search: :class:`PlaneSearch`.
        planes: :class:`FoundPlanes` in and out.
    """
    start, origin, cell, dims = grid
    gate, min_cosine, normal_distance, oriented, least_motion, lateral_gate = search
    target, plane_normal, distance, searched_at = planes
    nx, ny, nz = dims[0], dims[1], dims[2]
    inverse = 1.0 / cell
    reach = int(np.ceil(gate * inverse))
    least, penalty = np.float32(min_cosine), np.float32(2.0 * normal_distance * normal_distance)
    gate2, signed = np.float32(gate * gate), np.float32(1.0 if oriented else -1.0)
    metric = signed, least, penalty
    X, Y, Z = surfels[0], surfels[1], surfels[2]
    NX, NY, NZ = surfels[3], surfels[4], surfels[5]
    size = np.uint64(surfels.shape[1])
    squared, index = np.zeros(CANDIDATES + SCANNED, np.float32), np.zeros(CANDIDATES, np.int32)
    bits = squared.view(np.int32)
    for v in range(position.shape[0]):
        if not eligible[v]:
            distance[v] = NO_SURFEL
            searched_at[v, 0] = FAR_AWAY
            continue
        moved = 0.0
        for a in range(3):
            moved += (position[v, a] - searched_at[v, a]) ** 2
        if moved < least_motion * least_motion and distance[v] <= gate:
            continue
        for a in range(3):
            searched_at[v, a] = position[v, a]
        distance[v] = NO_SURFEL
        px = np.float32(position[v, 0] - origin[0])
        py = np.float32(position[v, 1] - origin[1])
        pz = np.float32(position[v, 2] - origin[2])
        ax, ay, az = np.float32(normal[v, 0]), np.float32(normal[v, 1]), np.float32(normal[v, 2])
        ix, iy, iz = int(np.floor(px * inverse)), int(np.floor(py * inverse)), int(np.floor(pz * inverse))
        margin = min(
            px - ix * cell, (ix + 1) * cell - px, py - iy * cell, (iy + 1) * cell - py, pz - iz * cell, (iz + 1) * cell - pz
        )
        vertex = px, py, pz, ax, ay, az
        found, n, seen = 0, np.uint64(0), np.uint64(0)
        for ring in range(1, reach + 1):
            for jx in range(max(ix - ring, 0), min(ix + ring + 1, nx)):
                for jy in range(max(iy - ring, 0), min(iy + ring + 1, ny)):
                    row = (jx * ny + jy) * nz
                    whole = ring == 1 or abs(jx - ix) == ring or abs(jy - iy) == ring
                    for part in range(1 if whole else 2):
                        if whole:
                            z0, z1 = max(iz - ring, 0), min(iz + ring, nz - 1)
                        else:
                            z0 = z1 = iz - ring if part == 0 else iz + ring
                        if z0 > z1 or z0 < 0 or z1 >= nz:
                            continue
                        k, end = np.uint64(start[row + z0]), np.uint64(start[row + z1 + 1])
                        seen += end - k
                        while k < end:  # surfels read past the end are overwritten by the next ones
                            count = min(end - k, np.uint64(AT_ONCE))
                            if k + np.uint64(AT_ONCE) <= size:
                                append_candidates(surfels, k, vertex, metric, squared, index, n)
                                half = np.uint64(LANES)
                                append_candidates(surfels, k + half, vertex, metric, squared, index, n + half)
                            else:
                                append_last_candidates(surfels, k, k + count, vertex, metric, squared, index, n)
                            n += count
                            k += np.uint64(AT_ONCE)
                            if n > np.uint64(CANDIDATES - AT_ONCE):
                                n = np.uint64(select_nearest(squared, bits, index, n, gate2))
            found = select_nearest(squared, bits, index, n, gate2)
            n = np.uint64(found)
            searched = ring * cell + margin
            if found == BLEND and squared[BLEND - 1] <= searched * searched:
                break
            # one surfel well inside the searched ball is enough: the others only smooth
            if found > 0 and squared[0] <= 0.25 * searched * searched:
                break
            if seen > np.uint64(MOST_SEEN):
                break
        if found == 0:
            continue
        soft = squared[0] + (0.25 * cell) ** 2
        sw = tx = ty = tz = mx = my = mz = 0.0
        for m in range(found):
            k = index[m]
            w = 1.0 / (squared[m] + soft)
            side = -w if NX[k] * ax + NY[k] * ay + NZ[k] * az < 0.0 else w
            sw += w
            tx += w * X[k]
            ty += w * Y[k]
            tz += w * Z[k]
            mx += side * NX[k]
            my += side * NY[k]
            mz += side * NZ[k]
        length = sqrt(mx * mx + my * my + mz * mz)
        if length < 1e-12:
            continue
        dx, dy, dz = tx / sw - px, ty / sw - py, tz / sw - pz
        along = (mx * dx + my * dy + mz * dz) / length
        if dx * dx + dy * dy + dz * dz - along * along > lateral_gate * lateral_gate:
            distance[v] = PAST_THE_END
            continue
        distance[v] = sqrt(squared[0])
        target[v, 0] = tx / sw + origin[0]
        target[v, 1] = ty / sw + origin[1]
        target[v, 2] = tz / sw + origin[2]
        plane_normal[v, 0] = mx / length
        plane_normal[v, 1] = my / length
        plane_normal[v, 2] = mz / length


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_points(position, points, grid, gate, target, distance):
    """Finds the exact nearest point of the cloud within the gate for every vertex: the paper's association.

    Args:
        position: (V, 3) metres.
        points: (3, M) float32 sorted by cell, relative to the grid's origin, metres.
        grid: ``Grid`` of the points.
        gate: search radius, metres.
        target: (V, 3) out, metres; unchanged where there is no point.
        distance: (V,) out, metres; negative where there is no point.
    """
    start, origin, cell, dims = grid
    nx, ny, nz = dims[0], dims[1], dims[2]
    inverse = 1.0 / cell
    for v in range(position.shape[0]):
        distance[v] = -1.0
        px, py, pz = position[v, 0] - origin[0], position[v, 1] - origin[1], position[v, 2] - origin[2]
        ix, iy, iz = int(np.floor(px * inverse)), int(np.floor(py * inverse)), int(np.floor(pz * inverse))
        margin = min(
            px - ix * cell, (ix + 1) * cell - px, py - iy * cell, (iy + 1) * cell - py, pz - iz * cell, (iz + 1) * cell - pz
        )
        best = gate * gate
        winner = -1
        for ring in range(int(np.ceil(gate * inverse)) + 1):
            for jx in range(max(ix - ring, 0), min(ix + ring + 1, nx)):
                for jy in range(max(iy - ring, 0), min(iy + ring + 1, ny)):
                    shell = abs(jx - ix) == ring or abs(jy - iy) == ring
                    jz = iz - ring
                    while jz <= iz + ring:
                        if 0 <= jz < nz:
                            c = (jx * ny + jy) * nz + jz
                            for k in range(start[c], start[c + 1]):
                                d2 = (points[0, k] - px) ** 2 + (points[1, k] - py) ** 2 + (points[2, k] - pz) ** 2
                                if d2 < best:
                                    best = d2
                                    winner = k
                        jz += 1 if shell else max(2 * ring, 1)
            if winner >= 0 and best <= (ring * cell + margin) ** 2:
                break
        if winner >= 0:
            distance[v] = sqrt(best)
            for a in range(3):
                target[v, a] = points[a, winner] + origin[a]
