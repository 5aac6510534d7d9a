"""The end of the cloud beside a boundary against a slow twin."""

import numpy as np
import pytest

from ddakf.kernels import hem
from ddakf.kernels.hem import CloudEnds, Tube, ends_of_cloud
from ddakf.kernels.preprocess import Grid, fill_grid

TUBE = Tube(radius=0.04, width=0.012, depth=0.01)


def slow_end(vertex, along, above, points):
    """Outward direction and offset, metres; None where the cloud goes on, or has too few points in the tube."""
    along = along / np.linalg.norm(along)
    across = np.cross(along, above)
    across /= np.linalg.norm(across)
    step = points.astype(float) - vertex
    a = step @ across
    fits = (np.abs(a) <= TUBE.radius) & (np.abs(step @ along) <= TUBE.width)
    a = np.sort(a[fits & (np.abs(step @ above) <= TUBE.depth + 0.33 * np.abs(a))])
    if len(a) < hem.LEAST_POINTS or a[-2] > hem.GOES_ON * TUBE.radius:
        return None
    return across, a[-2] + hem.BEYOND * (a[-2] + TUBE.radius) / (len(a) - 1)


@pytest.mark.parametrize("pairs", [False, True])
@pytest.mark.parametrize("n", [0, 3, 30, 700, 6000])
def test_ends_are_those_of_the_twin(n, pairs):
    rng = np.random.default_rng(n)
    points = rng.uniform([0.0, 0.0, 0.1], [0.5, 0.3, 0.13], (n, 3)).astype(np.float32)
    if pairs:
        points[1::2] = points[: n // 2 * 2 : 2]
    dims = np.array([12, 8, 6])
    grid = Grid(np.empty(np.prod(dims) + 2, np.int32), np.zeros(3), 0.05, dims)
    ordered, index = np.empty((3, n), np.float32), np.empty(n, np.int32)
    fill_grid(points.astype(float), np.arange(n, dtype=np.int32), grid, ordered, index)
    position = rng.uniform([-0.1, -0.1, 0.05], [0.6, 0.4, 0.2], (90, 3))
    normal = rng.normal([0.0, 0.0, 3.0], 1.0, (90, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    boundary, visible = rng.permutation(90).reshape(30, 3), rng.random(90) > 0.1
    ends = CloudEnds(np.zeros((30, 3)), np.zeros(30), np.zeros(30, bool))
    ends_of_cloud(position, normal, visible, boundary, ordered, grid, TUBE, ends)
    for h, (v, before, after) in enumerate(boundary):
        known = slow_end(position[v], position[after] - position[before], normal[v], ordered.T) if visible[v] else None
        assert ends.found[h] == (known is not None)
        if known is not None:
            np.testing.assert_allclose(ends.direction[h], known[0], atol=1e-12)
            np.testing.assert_allclose(ends.offset[h], known[1], atol=1e-6)
    assert ends.found.any() == (n > 600)


def test_of_a_crowded_tube_an_even_sample_tells_the_end():
    """More points around a vertex than are looked at."""
    n = 4 * hem.MOST_SEEN
    points = np.random.default_rng(0).uniform([0.02, 0.02, 0.02], [0.05, 0.08, 0.021], (n, 3)).astype(np.float32)
    dims = np.array([2, 2, 2])
    grid = Grid(np.empty(np.prod(dims) + 2, np.int32), np.zeros(3), 0.05, dims)
    ordered, index = np.empty((3, n), np.float32), np.empty(n, np.int32)
    fill_grid(points.astype(float), np.arange(n, dtype=np.int32), grid, ordered, index)
    position = np.array([[0.048, 0.05, 0.02], [0.048, 0.04, 0.02], [0.048, 0.06, 0.02]])
    normal, boundary = np.tile([0.0, 0.0, 1.0], (3, 1)), np.array([[0, 1, 2]])
    ends = CloudEnds(np.zeros((1, 3)), np.zeros(1), np.zeros(1, bool))
    ends_of_cloud(position, normal, np.ones(3, bool), boundary, ordered, grid, TUBE, ends)
    across, offset = slow_end(position[0], position[2] - position[1], normal[0], ordered.T)
    assert ends.found[0]
    np.testing.assert_allclose(ends.direction[0], across, atol=1e-12)
    np.testing.assert_allclose(ends.offset[0], offset, atol=2e-4)


@pytest.mark.parametrize("n", [4, 6, 10, 40])
def test_cloth_ends_where_it_ends_in_the_mean_however_few_points_show_it(n):
    rng, dims, ends = np.random.default_rng(n), np.array([1, 1, 1]), CloudEnds(np.zeros((1, 3)), np.zeros(1), np.zeros(1, bool))
    position = np.array([[0.0, 0.0, 0.0], [-0.01, 0.0, 0.0], [0.01, 0.0, 0.0]])
    grid, offsets = Grid(np.empty(3, np.int32), np.full(3, -0.1), 0.2, dims), []
    normal, boundary = np.tile([0.0, 0.0, 1.0], (3, 1)), np.array([[0, 1, 2]], np.int32)
    ordered, index, visible = np.empty((3, n), np.float32), np.empty(n, np.int32), np.ones(3, bool)
    for _ in range(2000):
        points = rng.uniform([-TUBE.width, -TUBE.radius, 0.0], [TUBE.width, 0.0, 1e-9], (n, 3))
        fill_grid(points * [1, -1, 1], np.arange(n, dtype=np.int32), grid, ordered, index)
        ends_of_cloud(position, normal, visible, boundary, ordered, grid, TUBE, ends)
        if ends.found[0]:
            offsets.append(ends.offset[0])
    assert len(offsets) > 500
    assert abs(np.mean(offsets)) < 0.0006
