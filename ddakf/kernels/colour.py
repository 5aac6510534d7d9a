"""Stage B, colour: registration of the colours around each vertex with those that it has learned (Park, Zhou and Koltun 2017)."""

from math import sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

SIDE = 5  # texels along either axis of a patch
CHANNELS = 2
MOST = 192  # points of a patch that are used
REGISTERED, LEARNED = 64, 512  # points around a patch that are looked at; of more, an even sample is
COMPARED = 4  # every so-many-th point of a patch tells the noise of its channels
LEAST_POINTS = 3  # with a learned colour, from which on a patch says something
DARKEST = 16.0  # added to values of 0 to 255, so that the logarithm of dark noise stays small
LOGARITHM = np.log(np.arange(256) + DARKEST).astype(np.float32)


class Patches(NamedTuple):
    """Learned colours: a grid of SIDE x SIDE texels in the tangent plane of each of V vertices."""

    mean: np.ndarray  # (V, SIDE, SIDE, CHANNELS) float32
    weight: np.ndarray  # (V, SIDE, SIDE) float32 1/m^2, sum of the inverse variances of the places that they were learned at
    texel: float  # m, edge of a texel


class ColouredPoints(NamedTuple):
    """Points of a cloud with their channels, sorted by grid cell."""

    points: np.ndarray  # (3, M) float32, relative to the grid's origin, m
    channels: np.ndarray  # (CHANNELS, M) float32
    start: np.ndarray  # of the grid
    origin: np.ndarray  # (3,) m
    cell: float  # m
    dims: np.ndarray  # (3,) int64


class TangentPlanes(NamedTuple):
    """Where the patches of V vertices are."""

    position: np.ndarray  # (V, 3) m
    axis: np.ndarray  # (V, 3) of the patches' first axes; its part in the plane counts
    target: np.ndarray  # (V, 3) m, a point of the cloud's plane
    normal: np.ndarray  # (V, 3) unit, of that plane
    used: np.ndarray  # (V,) bool


class SlideLimits(NamedTuple):
    """How residuals of the colours are judged."""

    noise2: np.ndarray  # (CHANNELS,) variance of a channel
    reach: float  # m, standard deviation of a slide before the colours are compared
    gate: float  # chi-square of a point's residual, from which on it does not count
    depth: float  # m from the plane, within which points belong to the same layer
    least_gradient: float  # information over that which the noise of the learned colours alone would give
    still: float  # m: a vertex that moved less since its last registration keeps it


class Slides(NamedTuple):
    """Where the colours of each of V vertices are, along two directions of its tangent plane."""

    direction: np.ndarray  # (2, V, 3) unit, the first with the larger information
    variance: np.ndarray  # (2, V) m^2 along either; infinite where colours say nothing
    target: np.ndarray  # (V, 3) m
    searched_at: np.ndarray  # (V, 3) m, where the vertex was when its colours were registered


@njit(nogil=True, cache=True, error_model="numpy")
def log_chromaticities(colors, index, table, channels):
    """Logarithms of red and of blue over green.

    Args:
        colors: (N, 3) uint8.
        index: (M,) rows of the points.
        table: (256,) float32, logarithm of each value.
        channels: (CHANNELS, M) float32 out.
    """
    for k in range(index.shape[0]):
        i = index[k]
        green = table[colors[i, 1]]
        channels[0, k] = table[colors[i, 0]] - green
        channels[1, k] = table[colors[i, 2]] - green


@njit(nogil=True, cache=True, error_model="numpy")
def tangent_axes(planes, v, axes):
    """Axes of a patch, rows of ``axes`` (2, 3) out. Returns whether there are any."""
    nx, ny, nz = planes.normal[v, 0], planes.normal[v, 1], planes.normal[v, 2]
    ax, ay, az = planes.axis[v, 0], planes.axis[v, 1], planes.axis[v, 2]
    d = ax * nx + ay * ny + az * nz
    ax, ay, az = ax - d * nx, ay - d * ny, az - d * nz
    length = sqrt(ax * ax + ay * ay + az * az)
    if length < 0.1:
        return False
    ax, ay, az = ax / length, ay / length, az / length
    axes[0, 0], axes[0, 1], axes[0, 2] = ax, ay, az
    axes[1, 0], axes[1, 1], axes[1, 2] = ny * az - nz * ay, nz * ax - nx * az, nx * ay - ny * ax
    return True


@njit(nogil=True, cache=True, error_model="numpy")
def points_of_patch(cloud, planes, v, axes, limits, place, number):
    """Finds the points on a patch: ``place`` (MOST, 2) out, in texels from its first corner, and their numbers. Returns how many.

    Args:
        cloud: :class:`ColouredPoints`.
        planes: :class:`TangentPlanes`.
        v: the vertex.
        axes: (2, 3) of its patch.
        limits: edge of a texel and depth, metres, and points that are looked at.
        place, number: (MOST, 2) and (MOST,) out.
    """
    texel, depth, most = limits
    points, start, cell, dims = cloud.points, cloud.start, cloud.cell, cloud.dims
    inverse, per_texel, half = 1.0 / cell, 1.0 / texel, 0.5 * (SIDE - 1)
    px = planes.position[v, 0] - cloud.origin[0]
    py = planes.position[v, 1] - cloud.origin[1]
    pz = planes.position[v, 2] - cloud.origin[2]
    nx, ny, nz = planes.normal[v, 0], planes.normal[v, 1], planes.normal[v, 2]
    away = (
        nx * (planes.target[v, 0] - planes.position[v, 0])
        + ny * (planes.target[v, 1] - planes.position[v, 1])
        + nz * (planes.target[v, 2] - planes.position[v, 2])
    )
    px, py, pz = px + away * nx, py + away * ny, pz + away * nz
    reach = half * texel
    ux, uy, uz = axes[0, 0], axes[0, 1], axes[0, 2]
    vx, vy, vz = axes[1, 0], axes[1, 1], axes[1, 2]
    rx = reach * (abs(ux) + abs(vx)) + depth * abs(nx)
    ry = reach * (abs(uy) + abs(vy)) + depth * abs(ny)
    rz = reach * (abs(uz) + abs(vz)) + depth * abs(nz)
    x0, x1 = max(int(np.floor((px - rx) * inverse)), 0), min(int(np.floor((px + rx) * inverse)), dims[0] - 1)
    y0, y1 = max(int(np.floor((py - ry) * inverse)), 0), min(int(np.floor((py + ry) * inverse)), dims[1] - 1)
    z0, z1 = max(int(np.floor((pz - rz) * inverse)), 0), min(int(np.floor((pz + rz) * inverse)), dims[2] - 1)
    n = total = 0
    if z0 > z1:
        return n
    for jx in range(x0, x1 + 1):
        for jy in range(y0, y1 + 1):
            row = (jx * dims[1] + jy) * dims[2]
            total += start[row + z1 + 1] - start[row + z0]
    every, skipped = max(1, (total + most - 1) // most), 0
    for jx in range(x0, x1 + 1):
        for jy in range(y0, y1 + 1):
            row = (jx * dims[1] + jy) * dims[2]
            begin, end = start[row + z0] + skipped, start[row + z1 + 1]
            skipped = (begin - end) % every
            for k in range(begin, end, every):
                dx, dy, dz = points[0, k] - px, points[1, k] - py, points[2, k] - pz
                a, b = ux * dx + uy * dy + uz * dz, vx * dx + vy * dy + vz * dz
                place[n, 0], place[n, 1] = a * per_texel + half, b * per_texel + half
                number[n] = k  # a point that is not on the patch is overwritten by the next one
                n += int((abs(a) < reach) & (abs(b) < reach) & (abs(nx * dx + ny * dy + nz * dz) < depth))
                if n == MOST:
                    return n
    return n


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def look_up(mean, inverse, x, y, texel, found):
    """Learned colour of a patch at a place, in texels, and its gradient.

    Args:
        mean: (SIDE, SIDE, CHANNELS) float32.
        inverse: (SIDE, SIDE) variance of each texel, in those of a channel; infinite where nothing is learned.
        x, y: in texels.
        texel: m.
        found: (3, CHANNELS) out.

    Returns the variances of the colour, infinite where it is not known, and of the gradient, in those of a channel.
    """
    i, j = min(int(x), SIDE - 2), min(int(y), SIDE - 2)
    f, g = x - i, y - j
    e, h = 1.0 - f, 1.0 - g
    p, q, r, s = inverse[i, j], inverse[i, j + 1], inverse[i + 1, j], inverse[i + 1, j + 1]
    ee, ff, gg, hh = e * e, f * f, g * g, h * h
    of_colour = ee * (hh * p + gg * q) + ff * (hh * r + gg * s)
    of_gradient = 0.5 * (ee * (p + q) + ff * (r + s) + hh * (p + r) + gg * (q + s)) / (texel * texel)
    for c in range(CHANNELS):
        k, m, n, o = mean[i, j, c], mean[i, j + 1, c], mean[i + 1, j, c], mean[i + 1, j + 1, c]
        found[0, c] = e * (h * k + g * m) + f * (h * n + g * o)
        found[1, c] = (h * (n - k) + g * (o - m)) / texel
        found[2, c] = (e * (m - k) + f * (o - n)) / texel
    return of_colour, of_gradient


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def variances_of_texels(weight, counted, inverse):
    """Variance of each texel of a patch, in those of a channel: ``counted``, the weight of one point, over its own."""
    for i in range(SIDE):
        for j in range(SIDE):
            inverse[i, j] = counted / weight[i, j] if weight[i, j] > 0.0 else np.inf


@njit(nogil=True, cache=True, error_model="numpy")
def register(cloud, planes, patches, counted, limits, slides):
    """Registers the colours around each vertex with its patch: one step of Lucas and Kanade (1981).

    A point at u in the tangent plane shows the colour T(u - d) where the cloth has slid by d, so that its residual against the
    learned T(u) is -g'd.

    Args:
        cloud: :class:`ColouredPoints`.
        planes: :class:`TangentPlanes`.
        patches: :class:`Patches`.
        counted: (V,) 1/m^2, weight of a texel that one point gave.
        limits: :class:`SlideLimits`.
        slides: :class:`Slides` in and out; target and direction are finite where nothing is known.
    """
    noise2, reach, gate, depth, least_gradient, still = limits
    direction, variance, target, searched_at = slides
    mean_of, texel, inverse = patches.mean, patches.texel, np.empty((SIDE, SIDE))
    axes, place, number = np.empty((2, 3)), np.empty((MOST, 2)), np.empty(MOST, np.int64)
    found, residual, gradient = np.empty((3, CHANNELS)), np.empty((MOST, CHANNELS)), np.empty((MOST, 2, CHANNELS))
    inexact, noisy = np.empty(MOST), np.empty(MOST)
    reach2 = reach * reach
    for v in range(planes.position.shape[0]):
        if not planes.used[v]:
            variance[0, v] = variance[1, v] = np.inf
            continue
        moved = 0.0
        for a in range(3):
            moved += (planes.position[v, a] - searched_at[v, a]) ** 2
        if moved < still * still:
            continue
        variance[0, v] = variance[1, v] = np.inf
        for a in range(3):
            searched_at[v, a] = target[v, a] = planes.position[v, a]
            direction[0, v, a] = direction[1, v, a] = 0.0
        if not tangent_axes(planes, v, axes):
            continue
        n = points_of_patch(cloud, planes, v, axes, (texel, depth, REGISTERED), place, number)
        variances_of_texels(patches.weight[v], counted[v], inverse)
        known = 0
        for k in range(n):
            of_colour, of_gradient = look_up(mean_of[v], inverse, place[k, 0], place[k, 1], texel, found)
            if not of_colour < np.inf:
                continue
            for c in range(CHANNELS):
                residual[known, c] = cloud.channels[c, number[k]] - found[0, c]
                gradient[known, 0, c], gradient[known, 1, c] = found[1, c], found[2, c]
            inexact[known], noisy[known] = 1.0 + of_colour, of_gradient
            known += 1
        if known < LEAST_POINTS:
            continue
        xx = xy = yy = x = y = spurious = 0.0
        for k in range(known):
            d2 = 0.0
            for c in range(CHANNELS):
                steep = gradient[k, 0, c] ** 2 + gradient[k, 1, c] ** 2
                d2 += residual[k, c] ** 2 / (inexact[k] * noise2[c] + steep * reach2)
            if d2 >= gate:
                continue
            w = (1.0 - d2 / gate) ** 2 / inexact[k]
            for c in range(CHANNELS):
                q = w / noise2[c]
                a, b = gradient[k, 0, c], gradient[k, 1, c]
                xx += q * a * a
                xy += q * a * b
                yy += q * b * b
                x -= q * a * residual[k, c]
                y -= q * b * residual[k, c]
            spurious += w * CHANNELS * noisy[k]
        half, apart = 0.5 * (xx + yy), sqrt(0.25 * (xx - yy) ** 2 + xy * xy)
        large, small = half + apart, max(half - apart, 0.0)
        # the longer of the two columns of A - small I is the eigenvector of the larger value
        if xx >= yy:
            c, s = xx - small, xy
        else:
            c, s = xy, yy - small
        length = sqrt(c * c + s * s)
        if length <= 0.0:
            c, s, length = 1.0, 0.0, 1.0
        c, s = c / length, s / length
        for m in range(2):
            information, along = (large, c * x + s * y) if m == 0 else (small, c * y - s * x)
            if information <= least_gradient * spurious or information <= 0.0:
                continue
            # noise of the learned colours adds to the gradients and not to their product with the residuals
            true = information - spurious
            variance[m, v] = information / (true * true)
            offset = min(max(along / true, -texel), texel)
            for a in range(3):
                direction[m, v, a] = c * axes[0, a] + s * axes[1, a] if m == 0 else c * axes[1, a] - s * axes[0, a]
                target[v, a] += offset * direction[m, v, a]


@njit(nogil=True, cache=True, error_model="numpy")
def learn(cloud, planes, patches, certainty, most, depth, squares):
    """Adds the colours of a frame to the patches, in place.

    Args:
        cloud: :class:`ColouredPoints`.
        planes: :class:`TangentPlanes`, at the end of the frame.
        patches: :class:`Patches` in and out.
        certainty: (V,) 1/m^2, inverse variance of the vertex in its tangent plane.
        most: (V,) 1/m^2, bound of the weights.
        depth: m from the plane, within which points belong to the same layer.
        squares: (CHANNELS + 1,) out: sums over the points of the squared residuals, and their number.
    """
    axes, place, number = np.empty((2, 3)), np.empty((MOST, 2)), np.empty(MOST, np.int64)
    found, texel, inverse = np.empty((3, CHANNELS)), patches.texel, np.empty((SIDE, SIDE))
    sums = np.empty((SIDE, SIDE, CHANNELS + 1))  # of the points' shares in a texel, times their channels and alone
    squares[:] = 0.0
    for v in range(planes.position.shape[0]):
        if not planes.used[v] or not tangent_axes(planes, v, axes):
            continue
        n = points_of_patch(cloud, planes, v, axes, (texel, depth, LEARNED), place, number)
        variances_of_texels(patches.weight[v], 1.0, inverse)
        for k in range(0, n, COMPARED):
            if look_up(patches.mean[v], inverse, place[k, 0], place[k, 1], texel, found)[0] < np.inf:
                for c in range(CHANNELS):
                    squares[c] += (cloud.channels[c, number[k]] - found[0, c]) ** 2
                squares[CHANNELS] += 1.0
        sums[:] = 0.0
        for k in range(n):
            i, j = min(int(place[k, 0]), SIDE - 2), min(int(place[k, 1]), SIDE - 2)
            f, g = place[k, 0] - i, place[k, 1] - j
            for a in range(2):
                for b in range(2):
                    share = (f if a == 1 else 1.0 - f) * (g if b == 1 else 1.0 - g)
                    for c in range(CHANNELS):
                        sums[i + a, j + b, c] += share * cloud.channels[c, number[k]]
                    sums[i + a, j + b, CHANNELS] += share
        for i in range(SIDE):
            for j in range(SIDE):
                added = certainty[v] * sums[i, j, CHANNELS]
                total = patches.weight[v, i, j] + added
                if added > 0.0:
                    for c in range(CHANNELS):
                        old = patches.mean[v, i, j, c]
                        patches.mean[v, i, j, c] = old + (certainty[v] * sums[i, j, c] - added * old) / total
                    patches.weight[v, i, j] = min(total, most[v])


@njit(nogil=True, cache=True, error_model="numpy")
def add_slides(position, target, direction, information, D, force):
    """Adds what colours say of a place in the plane: D += k d d' and force += k d' (target - x) d along each direction.

    Args:
        position: x, (V, 3) or wider, metres.
        target: (V, 3) metres.
        direction: (2, V, 3) unit.
        information: k, (2, V) 1/m^2.
        D: (V, 3, 3) diagonal blocks of A, 1/m^2, added to.
        force: (V, 3) or wider, 1/m, added to.
    """
    for m in range(direction.shape[0]):
        for i in range(direction.shape[1]):
            k = information[m, i]
            if k == 0.0:
                continue
            offset = 0.0
            for a in range(3):
                offset += direction[m, i, a] * (target[i, a] - position[i, a])
            for a in range(3):
                force[i, a] += k * offset * direction[m, i, a]
                for b in range(3):
                    D[i, a, b] += k * direction[m, i, a] * direction[m, i, b]


@njit(nogil=True, cache=True, error_model="numpy")
def condition(direction, information, covariance):
    """Covariance of each vertex after independent measurements along two directions: P -= P d d' P / (d' P d + 1/k), in place.

    Args:
        direction: (2, V, 3) unit.
        information: k, (2, V) 1/m^2.
        covariance: (V, 3, 3) m^2 in and out.
    """
    u = np.empty(3)
    for m in range(direction.shape[0]):
        for i in range(direction.shape[1]):
            k = information[m, i]
            if k == 0.0:
                continue
            across = 1.0 / k
            for a in range(3):
                u[a] = 0.0
                for b in range(3):
                    u[a] += covariance[i, a, b] * direction[m, i, b]
                across += direction[m, i, a] * u[a]
            for a in range(3):
                for b in range(3):
                    covariance[i, a, b] -= u[a] * u[b] / across
