"""Layers and bulge of a cloud against NumPy, cell by cell."""

from collections import defaultdict

import numpy as np
import pytest

from ddakf.kernels.sidedness import CELLS, bulge, hidden_shares
from ddakf.plausibility.sidedness import all_axes

CELL, GAP = 0.05, 0.08


def columns(points, axes):
    """Heights toward the viewer by cell."""
    cells = defaultdict(list)
    for x, y, height in points.astype(float) @ axes.T:
        u, v = x / CELL + CELLS / 2, y / CELL + CELLS / 2
        if 0 <= u < CELLS and 0 <= v < CELLS:
            cells[int(u), int(v)].append(height)
    return cells


def slow_share(points, axes):
    cells = columns(points, axes)
    count = sum(map(len, cells.values()))
    if count == 0:
        return 1.0
    ends = []
    for sign in (1, -1):
        hidden = 0
        for heights in cells.values():
            ordered = np.sort(sign * np.array(heights))[::-1]
            hidden += (ordered < ordered[1] - GAP).sum() if len(ordered) > 1 else 0
        ends.append(hidden / count)
    return min(ends)


def slow_bulge(points, axes):
    mean = {cell: np.mean(heights) for cell, heights in columns(points, axes).items()}
    above = []
    for (u, v), height in mean.items():
        if 0 < u < CELLS - 1 and 0 < v < CELLS - 1:
            for before, after in (((u - 1, v), (u + 1, v)), ((u, v - 1), (u, v + 1))):
                if before in mean and after in mean:
                    above.append(np.clip(height - 0.5 * (mean[before] + mean[after]), -CELL / 2, CELL / 2))
    return np.mean(above) if above else 0.0


CLOUDS = {
    "ball": lambda rng: rng.normal(size=(800, 3)) * 0.15,
    "shell": lambda rng: (p := rng.normal(size=(900, 3))) / np.linalg.norm(p, axis=1)[:, None] * 0.2,
    "wider than the grid": lambda rng: rng.uniform(-4, 4, (700, 3)),
    "one point": lambda rng: np.zeros((1, 3)),
    "one place": lambda rng: np.zeros((50, 3)),
    "outside": lambda rng: np.full((5, 3), 9.0),
}


@pytest.mark.parametrize("kind", CLOUDS)
def test_it_counts_what_the_definition_says(kind):
    points = CLOUDS[kind](np.random.default_rng(3)).astype(np.float32)
    axes = all_axes(6)
    share = np.empty(len(axes))
    hidden_shares(points, axes, CELL, GAP, share)
    np.testing.assert_allclose(share, [slow_share(points, one) for one in axes], atol=2 / len(points))  # points on an edge
    for one in axes:
        assert bulge(points, one, CELL) == pytest.approx(slow_bulge(points, one), abs=2e-4)
