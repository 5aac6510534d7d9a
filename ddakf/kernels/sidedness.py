"""Sidedness: layers and bulge of a cloud that is seen from afar along a direction."""

import numpy as np
from numba import njit

CELLS = 64  # rows and columns of the grid; points beyond it do not count


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def cell_of(p, axes, scale):
    """Cell of a point in the grid, -1 outside, and its height toward the viewer, metres.

    Args:
        p: (3,) metres, relative to the grid's middle.
        axes: (3, 3), whose rows are the grid's column and row axes and the direction toward the viewer.
        scale: cells per metre.
    """
    u = (axes[0, 0] * p[0] + axes[0, 1] * p[1] + axes[0, 2] * p[2]) * scale + CELLS / 2
    v = (axes[1, 0] * p[0] + axes[1, 1] * p[1] + axes[1, 2] * p[2]) * scale + CELLS / 2
    height = axes[2, 0] * p[0] + axes[2, 1] * p[1] + axes[2, 2] * p[2]
    return (int(u) * CELLS + int(v) if 0.0 <= u < CELLS and 0.0 <= v < CELLS else -1), height


@njit(nogil=True, cache=True, error_model="numpy")
def hidden_shares(points, axes, cell, gap, share):
    """Share of the points that a nearer layer hides, seen along each of K directions, from the end where it is less.

    A point is hidden when it lies more than ``gap`` behind the second point of its cell: the foremost may be an outlier.

    Args:
        points: (N, 3) metres, relative to the middle of the cloud.
        axes: (K, 3, 3), see :func:`cell_of`.
        cell, gap: metres.
        share: (K,) out, in [0, 1]; 1 where no point is inside the grid.
    """
    n, scale = points.shape[0], 1.0 / cell
    place, height = np.empty(n, np.int32), np.empty(n)
    top, bottom, first, last = np.empty((4, CELLS * CELLS))  # second and foremost heights from either end
    for k in range(axes.shape[0]):
        top[:], first[:] = -np.inf, -np.inf
        bottom[:], last[:] = np.inf, np.inf
        inside = 0
        for i in range(n):
            c, h = cell_of(points[i], axes[k], scale)
            place[i], height[i] = c, h
            if c >= 0:
                inside += 1
                top[c], first[c] = max(top[c], min(first[c], h)), max(first[c], h)
                bottom[c], last[c] = min(bottom[c], max(last[c], h)), min(last[c], h)
        from_above = from_below = 0
        for i in range(n):
            c = place[i]
            if c >= 0:
                from_above += int(height[i] < top[c] - gap)
                from_below += int(height[i] > bottom[c] + gap)
        share[k] = min(from_above, from_below) / inside if inside > 0 else 1.0


@njit(nogil=True, cache=True, error_model="numpy")
def bulge(points, axes, cell):
    """Mean height of cells above their two neighbours in a row or column, metres; positive where a cloud curves as a body does.

    A difference of more than half a cell counts as so much: it is a step, or an outlier.

    Args:
        points: (N, 3) metres, relative to the middle of the cloud.
        axes: (3, 3), see :func:`cell_of`.
        cell: metres.

    Returns:
        0 where no three cells in line hold points.
    """
    total, count = np.zeros((CELLS, CELLS)), np.zeros((CELLS, CELLS))
    flat_total, flat_count = total.ravel(), count.ravel()
    for i in range(points.shape[0]):
        c, h = cell_of(points[i], axes, 1.0 / cell)
        if c >= 0:
            flat_total[c] += h
            flat_count[c] += 1.0
    total /= count  # mean heights; no number where a cell is empty
    above, triples, most = 0.0, 0, 0.5 * cell
    for u in range(1, CELLS - 1):
        for v in range(1, CELLS - 1):
            for before, after in ((total[u - 1, v], total[u + 1, v]), (total[u, v - 1], total[u, v + 1])):
                difference = total[u, v] - 0.5 * (before + after)
                if difference == difference:
                    above += min(max(difference, -most), most)
                    triples += 1
    return above / triples if triples > 0 else 0.0
