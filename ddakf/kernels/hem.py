"""Hems: where the cloud ends beside an open boundary of the garment."""

from math import sqrt

from numba import njit

NOWHERE = -1e30  # m
LEAST_POINTS = 4  # in the tube
BEYOND = 1.0  # mean distances between the tube's points, by which cloth goes on behind the second last
GOES_ON = 0.6  # share of the reach; a cloud that goes on to there has no end within it


@njit(nogil=True, cache=True, error_model="numpy")
def ends_of_cloud(
    position, normal, visible, boundary, points, start, origin, cell, dims, radius, width, depth, direction, offset, found
):  # fmt: skip
    """How far from each boundary vertex the cloud ends, across the boundary.

    Points in a tube along the outward direction in the surface, ``width`` to either side and ``depth`` (plus a third of the
    distance) above and below, are those of the same piece of cloth. The second farthest of them, against single outliers, is
    where the cloud ends. A cloud that goes on toward the end of the tube, or is hardly in it, does not end there.

    Args:
        position, normal: (V, 3) metres, unit.
        visible: (V,) bool.
        boundary: (H, 3) vertex, and its neighbours before and after it along the boundary as the faces run.
        points: (3, M) float32 sorted by cell, relative to origin.
        start, origin, cell, dims: the grid.
        radius, width, depth: metres.
        direction: (H, 3) out, unit, in the surface, outward.
        offset: (H,) out, metres from the vertex along it to the end of the cloud.
        found: (H,) bool out.
    """
    inverse = 1.0 / cell
    nx, ny, nz = dims[0], dims[1], dims[2]
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
        first = second = NOWHERE
        inside = 0
        x0, x1 = max(int((px - radius) * inverse), 0), min(int((px + radius) * inverse), nx - 1)
        y0, y1 = max(int((py - radius) * inverse), 0), min(int((py + radius) * inverse), ny - 1)
        z0, z1 = max(int((pz - radius) * inverse), 0), min(int((pz + radius) * inverse), nz - 1)
        if z0 > z1:
            continue
        for jx in range(x0, x1 + 1):
            for jy in range(y0, y1 + 1):
                row = (jx * ny + jy) * nz
                for k in range(start[row + z0], start[row + z1 + 1]):
                    dx, dy, dz = points[0, k] - px, points[1, k] - py, points[2, k] - pz
                    a = cx * dx + cy * dy + cz * dz
                    beside, above = abs(tx * dx + ty * dy + tz * dz), abs(ax * dx + ay * dy + az * dz)
                    # no branch to mispredict
                    fits = (abs(a) <= radius) & (beside <= width) & (above <= depth + 0.33 * abs(a))
                    inside += int(fits)
                    a = a if fits else NOWHERE
                    second = max(second, min(first, a))
                    first = max(first, a)
        if inside < LEAST_POINTS or second > GOES_ON * radius:
            continue
        found[h] = True
        offset[h] = second + BEYOND * (second + radius) / inside
        direction[h, 0], direction[h, 1], direction[h, 2] = cx, cy, cz


@njit(nogil=True, cache=True, error_model="numpy")
def add_ends_of_cloud(vertex, direction, offset, weight, variance, D, force):
    """Adds the measured ends of the cloud: D += k c c' and force += k offset c, k = weight / variance (1/m^2)."""
    for h in range(vertex.shape[0]):
        k = weight[h] / variance
        if k == 0.0:
            continue
        i = vertex[h]
        for a in range(3):
            force[i, a] += k * offset[h] * direction[h, a]
            for b in range(3):
                D[i, a, b] += k * direction[h, a] * direction[h, b]
