"""Planes of neighbourhoods, and points of a grid that are gathered and removed, against slow twins."""

import numpy as np
import pytest

from ddakf.kernels.preprocess import BLOCK, STEP, Grid, fill_grid, gather_around, mark_surplus, planes_of, remove

RADIUS = 0.03  # m
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
KINDS = ("surface", "line", "ball", "point", "two points", "three points")


def neighbourhood(kind, rng):
    """Weighted points about the origin, where the point itself is; metres."""
    n = int(rng.integers(6, 60))
    frame = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    if kind == "ball":
        points = rng.normal(size=(2000, 3))
        points *= RADIUS * rng.random((2000, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    elif kind == "surface":
        points = rng.uniform(-0.6, 0.6, (n, 3)) * RADIUS * [1.0, 1.0, 0.1] @ frame
    elif kind == "line":
        points = rng.uniform(-0.9, 0.9, (n, 1)) * RADIUS * frame[:1]
    else:
        others = {"point": 0, "two points": 1, "three points": 2}[kind]
        points = rng.uniform(-0.5, 0.5, (others, 3)) * RADIUS
    points = np.concatenate([np.zeros((1, 3)), points])
    return points, np.maximum(1.0 - np.square(points).sum(axis=1) / RADIUS**2, 0.0) ** 2


def moments_of(points, weight):
    """The ten sums, rounded as the kernel gets them."""
    second = np.einsum("n,na,nb->ab", weight, points, points)
    return np.array([weight.sum(), *(weight @ points), *(second[a, b] for a, b in PAIRS)], np.float32)


def slow_plane(moments):
    """Distance and normal of the plane; zero where the weighted covariance has no one thin direction, or only one thick one."""
    w, mean, C = float(moments[0]), moments[1:4].astype(float), np.empty((3, 3))
    for (a, b), value in zip(PAIRS, moments[4:].astype(float), strict=True):
        C[a, b] = C[b, a] = value / w - mean[a] * mean[b] / w**2
    values, vectors = np.linalg.eigh(C)
    if values[1] <= 0.004 * RADIUS**2 or values[0] >= 0.5 * values[1]:
        return 0.0, np.zeros(3)
    return vectors[:, 0] @ mean / w, vectors[:, 0]


@pytest.mark.parametrize("n", [1, 7, BLOCK])
def test_planes_are_those_of_the_least_eigenvector(n):
    rng = np.random.default_rng(n)
    kinds = [KINDS[0] if i == 0 else KINDS[i % len(KINDS)] for i in range(n)]
    rows = np.array([moments_of(*neighbourhood(kind, rng)) for kind in kinds])
    block = np.ones((10, BLOCK), np.float32)
    block[:, :n] = rows.T
    moments = block.ravel().copy()
    planes_of(moments, n, RADIUS**2)
    got = moments.reshape(10, BLOCK)[:4].T
    np.testing.assert_array_equal(got[n:], 1.0)  # others' are left alone
    spanned = 0
    for kind, row, (offset, *normal) in zip(kinds, rows, got[:n], strict=True):
        expected, direction = slow_plane(row)
        spanned += bool(direction.any())
        sign = 1.0 if direction @ normal >= 0.0 else -1.0
        np.testing.assert_allclose(sign * np.array(normal), direction, atol=2e-5, err_msg=kind)
        assert sign * offset == pytest.approx(expected, abs=1e-6 * RADIUS)
        assert kind == "surface" or kind == "three points" or not any(normal), kind
    assert spanned >= n // len(KINDS)


def gridded(n, dims, rng):
    """A grid of unit cells with n points, a part of them in one clump: the grid, (3, M) points and their numbers."""
    points = rng.random((n, 3)) * dims
    points[: n // 3] = np.array(dims) / 2 + 0.3 * rng.random((n // 3, 3))
    grid = Grid(np.empty(np.prod(dims) + 2, np.int32), np.zeros(3), 1.0, np.array(dims))
    ordered, index = np.empty((3, n), np.float32), np.empty(n, np.int32)
    fill_grid(points, np.arange(n, dtype=np.int32), grid, ordered, index)
    return grid, ordered, index


@pytest.mark.parametrize("most", [1, 7, 100, 10**6])
@pytest.mark.parametrize(("n", "dims"), [(900, (4, 3, 5)), (300, (1, 1, 1)), (60, (2, 7, 3)), (3, (3, 3, 3))])
def test_points_around_a_cell_are_gathered_or_an_even_sample_of_them(n, dims, most):
    rng = np.random.default_rng(n)
    grid, points, _ = gridded(n, dims, rng)
    place = np.stack(np.unravel_index(np.repeat(np.arange(np.prod(dims)), np.diff(grid.start[:-1])), dims), axis=1)
    for middle in np.ndindex(*dims):
        near = np.full((3, min(most, n) + 2 * STEP), np.nan, np.float32)
        count = gather_around(points, grid.start, grid.dims, middle, most, near)
        around = points[:, (np.abs(place - middle) <= 1).all(axis=1)]  # in the order of the cells' rows
        every = max(1, -(-around.shape[1] // most))
        assert count == -(-around.shape[1] // every) <= most
        np.testing.assert_array_equal(near[:, :count], around[:, ::every])


@pytest.mark.parametrize("share", [0.0, 0.3, 1.0])
def test_the_grid_without_the_removed_points_is_that_of_the_others(share):
    rng = np.random.default_rng(5)
    grid, points, index = gridded(500, (4, 3, 5), rng)
    removed = rng.random(500) < share
    left = np.count_nonzero(~removed)
    start, kept, numbers = np.empty_like(grid.start), np.empty((3, left), np.float32), np.empty(left, np.int32)
    remove(grid.start, removed, points, index, start, kept, numbers)
    np.testing.assert_array_equal(kept, points[:, ~removed])
    np.testing.assert_array_equal(numbers, index[~removed])
    cell = np.repeat(np.arange(60), np.diff(grid.start[:-1]))
    np.testing.assert_array_equal(np.diff(start[:-1]), np.bincount(cell[~removed], minlength=60))
    assert start[0] == 0


@pytest.mark.parametrize("most", [1, 3, 40, 1000])
def test_of_a_cell_that_is_too_full_evenly_spread_points_are_surplus(most):
    grid, _, _ = gridded(500, (4, 3, 5), np.random.default_rng(6))
    surplus = np.ones(500, bool)
    left = mark_surplus(grid.start, most, surplus)
    assert left == np.count_nonzero(~surplus)
    for first, end in zip(grid.start[:-2], grid.start[1:-1], strict=True):
        n = end - first
        stays = np.flatnonzero(~surplus[first:end])
        assert len(stays) == min(n, most)
        if n > most:  # no gap is longer than the mean one, rounded up
            assert np.diff(np.concatenate([[-1], stays])).max() <= -(-n // most)
