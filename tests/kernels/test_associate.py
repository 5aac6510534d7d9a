"""Planes beside vertices against a slow twin, in clouds with more candidates than are compared at once."""

import numpy as np
import pytest

from ddakf.kernels.associate import BLEND, CANDIDATES, FAR_AWAY, MOST_SEEN, NO_SURFEL, FoundPlanes, PlaneSearch, nearest_planes
from ddakf.kernels.preprocess import Grid, fill_grid

CELL = 0.02  # m
N = 60


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def scattered(n, side, rng):
    """Surfels in a cube of this side, in metres, and vertices among them; those of a cell come together."""
    points, dims = rng.uniform(0, side, (n, 3)), np.full(3, max(int(np.ceil(side / CELL)), 1))
    grid = Grid(np.empty(dims.prod() + 2, np.int32), np.array([0.3, -0.2, 0.1]), CELL, dims)
    ordered, index = np.empty((3, n), np.float32), np.empty(n, np.int32)
    fill_grid(points + grid.origin, np.arange(n, dtype=np.int32), grid, ordered, index)
    surfels = np.concatenate([ordered, unit(rng.normal(size=(n, 3))).T.astype(np.float32)])
    return surfels, grid, rng.uniform(0, side, (N, 3)) + grid.origin, unit(rng.normal(size=(N, 3)))


def found_by_sorting(position, normal, surfels, grid, search):
    """Distances of one vertex to all surfels that agree with it, and the blend of the nearest."""
    points, normals = surfels[:3].T.astype(float) + grid.origin, surfels[3:].T.astype(float)
    agreement = normals @ normal if search.oriented else np.abs(normals @ normal)
    squared = np.square(points - position).sum(axis=1) + search.normal_distance**2 * 2.0 * (1.0 - agreement)
    squared[(agreement < search.min_cosine) | (squared >= search.gate**2)] = np.inf
    nearest = np.argsort(squared)[:BLEND]
    nearest = nearest[np.isfinite(squared[nearest])]
    if len(nearest) == 0:
        return squared, None, None
    weight = 1.0 / (squared[nearest] + squared[nearest[0]] + (0.25 * grid.cell) ** 2)
    side = np.where(normals[nearest] @ normal < 0.0, -1.0, 1.0)
    mean = (weight * side) @ normals[nearest]
    return squared, weight @ points[nearest] / weight.sum(), mean / np.linalg.norm(mean)


@pytest.mark.parametrize("oriented", [True, False])
@pytest.mark.parametrize(
    ("n", "side"),
    [
        (3000, 0.06),  # all in the first ring: many times what is compared at once
        (400, 0.025),
        (CANDIDATES, 0.03),
        (250, 0.05),
        (40, 0.12),  # few: more rings are searched
        (1, 0.02),
    ],
)
def test_planes_are_blends_of_the_nearest_surfels(n, side, oriented):
    assert n < MOST_SEEN
    surfels, grid, position, normal = scattered(n, side, np.random.default_rng(n))
    search = PlaneSearch(0.06, 0.5, 0.01, oriented, 0.0, 1.0)
    planes = FoundPlanes(np.zeros((N, 3)), np.zeros((N, 3)), np.full(N, -5.0), np.full((N, 3), FAR_AWAY))
    eligible = np.arange(N) % 10 != 0
    nearest_planes(position, normal, eligible, surfels, grid, search, planes)
    blended = 0
    for v in range(N):
        squared, target, mean = found_by_sorting(position[v], normal[v], surfels, grid, search)
        if not eligible[v] or target is None:
            assert planes.distance[v] == NO_SURFEL
            continue
        least = np.sort(squared)[:BLEND]
        assert planes.distance[v] == pytest.approx(np.sqrt(least[0]), rel=1e-4)  # the nearest is exact
        if len(least) == BLEND and least[-1] <= CELL**2:  # so are those that the first ring holds for certain
            blended += 1
            np.testing.assert_allclose(planes.target[v], target, atol=2e-6)
            np.testing.assert_allclose(planes.normal[v], mean, atol=2e-3)
    assert blended > N // 2 or n <= 250


def test_a_vertex_that_hardly_moved_keeps_its_plane():
    surfels, grid, position, normal = scattered(400, 0.05, np.random.default_rng(1))
    search = PlaneSearch(0.06, 0.5, 0.01, True, 0.002, 1.0)
    planes = FoundPlanes(np.zeros((N, 3)), np.zeros((N, 3)), np.full(N, -5.0), np.full((N, 3), FAR_AWAY))
    eligible = np.ones(N, bool)
    nearest_planes(position, normal, eligible, surfels, grid, search, planes)
    kept = [each.copy() for each in planes]
    half = np.arange(N) < N // 2
    nearest_planes(position + np.where(half[:, None], 1e-3, 3e-3), normal, eligible, surfels, grid, search, planes)
    found = planes.distance >= 0
    for before, after in zip(kept, planes, strict=True):
        np.testing.assert_array_equal(after[half], before[half])
    assert (planes.searched_at[~half] != kept[3][~half]).all()
    assert (planes.target[~half & found] != kept[0][~half & found]).any()
