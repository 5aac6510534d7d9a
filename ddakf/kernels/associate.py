"""Stage B, association (paper, section 2.3)."""

from math import sqrt

import numpy as np
from numba import njit

BLEND = 4  # surfels that a measurement is averaged over
FAR_AWAY = 1e30  # m: no search has been made there


@njit(nogil=True, cache=True, error_model="numpy")
def vertex_normals(position, faces, normal):
    """Area-weighted unit normals, (V, 3) out; zero where the adjacent faces have no area."""
    normal[:] = 0.0
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = position[j, 0] - position[i, 0], position[j, 1] - position[i, 1], position[j, 2] - position[i, 2]
        bx, by, bz = position[k, 0] - position[i, 0], position[k, 1] - position[i, 1], position[k, 2] - position[i, 2]
        cx, cy, cz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        for v in (i, j, k):
            normal[v, 0] += cx
            normal[v, 1] += cy
            normal[v, 2] += cz
    for v in range(normal.shape[0]):
        length = sqrt(normal[v, 0] ** 2 + normal[v, 1] ** 2 + normal[v, 2] ** 2)
        scale = 1.0 / length if length > 1e-30 else 0.0
        for a in range(3):
            normal[v, a] *= scale


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def nearest_planes(
    position, normal, eligible, surfels, start, origin, cell, dims, gate, min_cosine, oriented, still,
    searched_at, target, plane_normal, distance,
):  # fmt: skip
    """For each eligible vertex the surface of the cloud next to it.

    The nearest surfels whose normal agrees with the vertex's are blended by inverse squared distance; a cloud without a
    known sensor has unsigned normals, and agreement is then up to sign. A vertex that has moved by less than ``still`` since
    it was last searched for keeps its plane, which is as flat as that.

    Args:
        position, normal: (V, 3) estimate, metres, and its unit normals.
        eligible: (V,) bool: vertices that the sensor may see.
        surfels: (6, S) float32, point (relative to origin) and normal, sorted by cell.
        start, origin, cell, dims: the grid.
        gate: search radius, metres.
        min_cosine: least agreement of the normals.
        oriented: the surfels' normals point to the sensor.
        still: metres.
        searched_at: (V, 3) in and out, position at the last search, metres; FAR_AWAY before the first.
        target: (V, 3) in and out, blended surface point, metres.
        plane_normal: (V, 3) in and out, unit, on the vertex normal's side.
        distance: (V,) in and out, metres to the nearest surfel; negative where there is none.
    """
    nx, ny, nz = dims[0], dims[1], dims[2]
    inverse = 1.0 / cell
    reach = int(np.ceil(gate * inverse))
    least = np.float32(min_cosine)
    X, Y, Z = surfels[0], surfels[1], surfels[2]
    NX, NY, NZ = surfels[3], surfels[4], surfels[5]
    best = np.empty(BLEND, np.float32)
    slot_of = np.empty(BLEND, np.int64)
    for v in range(position.shape[0]):
        if not eligible[v]:
            distance[v] = -1.0
            searched_at[v, 0] = FAR_AWAY
            continue
        moved = 0.0
        for a in range(3):
            moved += (position[v, a] - searched_at[v, a]) ** 2
        if moved < still * still and distance[v] <= gate:
            continue
        for a in range(3):
            searched_at[v, a] = position[v, a]
        distance[v] = -1.0
        px = np.float32(position[v, 0] - origin[0])
        py = np.float32(position[v, 1] - origin[1])
        pz = np.float32(position[v, 2] - origin[2])
        ax, ay, az = np.float32(normal[v, 0]), np.float32(normal[v, 1]), np.float32(normal[v, 2])
        ix, iy, iz = int(np.floor(px * inverse)), int(np.floor(py * inverse)), int(np.floor(pz * inverse))
        margin = min(
            px - ix * cell, (ix + 1) * cell - px, py - iy * cell, (iy + 1) * cell - py, pz - iz * cell, (iz + 1) * cell - pz
        )
        limit = np.float32(gate * gate)
        found = 0
        for ring in range(reach + 1):
            for jx in range(max(ix - ring, 0), min(ix + ring + 1, nx)):
                for jy in range(max(iy - ring, 0), min(iy + ring + 1, ny)):
                    row = (jx * ny + jy) * nz
                    whole = ring == 0 or abs(jx - ix) == ring or abs(jy - iy) == ring
                    for part in range(1 if whole else 2):
                        if whole:
                            z0, z1 = max(iz - ring, 0), min(iz + ring, nz - 1)
                        else:
                            z0 = z1 = iz - ring if part == 0 else iz + ring
                        if z0 > z1 or z0 < 0 or z1 >= nz:
                            continue
                        for k in range(start[row + z0], start[row + z1 + 1]):
                            dx, dy, dz = X[k] - px, Y[k] - py, Z[k] - pz
                            d2 = dx * dx + dy * dy + dz * dz
                            if d2 >= limit:
                                continue
                            agreement = NX[k] * ax + NY[k] * ay + NZ[k] * az
                            if not oriented:
                                agreement = abs(agreement)
                            if agreement < least:
                                continue
                            slot = min(found, BLEND - 1)
                            while slot > 0 and best[slot - 1] > d2:
                                best[slot] = best[slot - 1]
                                slot_of[slot] = slot_of[slot - 1]
                                slot -= 1
                            best[slot] = d2
                            slot_of[slot] = k
                            if found < BLEND:
                                found += 1
                            if found == BLEND:
                                limit = best[BLEND - 1]
            searched = ring * cell + margin
            if found == BLEND and limit <= searched * searched:
                break
            # one compatible surfel well inside the searched ball is enough: the others only smooth
            if found > 0 and best[0] <= 0.25 * searched * searched:
                break
        if found == 0:
            continue
        soft = best[0] + (0.25 * cell) ** 2
        sw = tx = ty = tz = mx = my = mz = 0.0
        for m in range(found):
            k = slot_of[m]
            w = 1.0 / (best[m] + soft)
            signed = -w if NX[k] * ax + NY[k] * ay + NZ[k] * az < 0.0 else w
            sw += w
            tx += w * X[k]
            ty += w * Y[k]
            tz += w * Z[k]
            mx += signed * NX[k]
            my += signed * NY[k]
            mz += signed * NZ[k]
        length = sqrt(mx * mx + my * my + mz * mz)
        if length < 1e-12:
            continue
        distance[v] = sqrt(best[0])
        target[v, 0] = tx / sw + origin[0]
        target[v, 1] = ty / sw + origin[1]
        target[v, 2] = tz / sw + origin[2]
        plane_normal[v, 0] = mx / length
        plane_normal[v, 1] = my / length
        plane_normal[v, 2] = mz / length


@njit(nogil=True, cache=True, error_model="numpy")
def facing(position, normal, sensor, min_cosine, eligible):
    """Marks the vertices whose normal is turned to the sensor (or to any of several, (S, 3)) by at least min_cosine."""
    for v in range(position.shape[0]):
        eligible[v] = False
        for s in range(sensor.shape[0]):
            dx, dy, dz = sensor[s, 0] - position[v, 0], sensor[s, 1] - position[v, 1], sensor[s, 2] - position[v, 2]
            length = sqrt(dx * dx + dy * dy + dz * dz)
            if normal[v, 0] * dx + normal[v, 1] * dy + normal[v, 2] * dz > min_cosine * length:
                eligible[v] = True
                break


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_points(position, points, start, origin, cell, dims, gate, target, distance):
    """The exact nearest point of the cloud within the gate, for every vertex: the paper's association.

    ``points`` (3, M) float32 sorted by cell, relative to origin; ``target`` (V, 3) and ``distance`` (V,) out, the latter
    negative where there is no point.
    """
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
