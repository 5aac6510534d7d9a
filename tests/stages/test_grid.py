"""Grid of the vertices: every vertex is in its cell, whatever the shape and the size of the cells."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from ddakf.stages.grid import CROWDED, distinct, nearest_vertices, spread_rows, vertex_grid
from ddakf.stages.skin_removal import apart

RNG = np.random.default_rng(0)
SHAPES = {
    "spread": RNG.uniform(-1, 1, (250, 3)),
    "on a line": np.outer(RNG.uniform(0, 2, 250), [0.0, 1.0, 0.0]),
    "one place": np.full((50, 3), 0.3),
    "far away": RNG.uniform(-0.5, 0.5, (200, 3)) + 900.0,
}


@pytest.mark.parametrize("most", [4, 32])
@pytest.mark.parametrize("cell", [0.01, 0.2, 5.0])
@pytest.mark.parametrize("shape", SHAPES)
def test_every_vertex_is_once_in_its_cell(shape, cell, most):
    position = SHAPES[shape]
    grid = vertex_grid(position, cell, most)
    cells = grid.grid
    np.testing.assert_array_equal(np.sort(grid.index), np.arange(len(position)))
    np.testing.assert_allclose(grid.vertices.T + cells.origin, position[grid.index], atol=1e-3)
    assert cells.cell >= cell
    assert (cells.dims <= most + 1).all()
    place = np.clip(((position[grid.index] - cells.origin) * (1.0 / cells.cell)).astype(int), 0, cells.dims - 1)
    number = (place[:, 0] * cells.dims[1] + place[:, 1]) * cells.dims[2] + place[:, 2]
    assert (np.diff(number) >= 0).all() or (np.diff(place @ [1, cells.dims[0], cells.dims[0] * cells.dims[1]]) >= 0).all()


def garment(astray: int) -> np.ndarray:
    """Vertices of a surface about 1 m large, the first ones kilometres away in all directions."""
    rng = np.random.default_rng(astray)
    position = rng.normal(size=(6000, 3))
    position *= 0.5 / np.linalg.norm(position, axis=1, keepdims=True)
    position[:astray] *= rng.uniform(1e2, 1e4, (astray, 1))
    return position


@pytest.mark.parametrize("astray", [1, 7, 60])
def test_vertices_astray_leave_no_cell_crowded(astray):
    position = garment(astray)
    grid = vertex_grid(position, 0.05, 32)
    assert np.diff(grid.grid.start[:-1]).max() < 150
    np.testing.assert_array_equal(np.sort(grid.index), np.arange(len(position)))
    assert (grid.grid.dims <= 33).all()


@pytest.mark.parametrize("others", [0, 300])
def test_of_a_folded_garment_an_even_sample_counts(others):
    """A cell costs each point that is near it no more than CROWDED vertices."""
    position = np.concatenate([np.tile([0.2, 0.1, 0.0], (5000, 1)), garment(0)[:others]])
    grid = vertex_grid(position, 0.05, 32)
    assert np.diff(grid.grid.start[:-1]).max() == CROWDED
    chosen = np.sort(grid.index[grid.index < 5000])
    assert CROWDED - others <= len(chosen) <= CROWDED
    assert np.diff(chosen).max() <= 5000 / CROWDED + 1
    assert set(range(5000, 5000 + others)) - set(grid.index) == set()


@pytest.mark.parametrize("astray", [0, 1, 60])
def test_searches_are_exact_beside_vertices_astray(astray):
    position = garment(astray)
    points = np.concatenate(
        [position + RNG.normal(scale=0.03, size=position.shape), RNG.uniform(-2, 2, (2000, 3)), RNG.uniform(-1e4, 1e4, (500, 3))]
    ).astype(np.float32)
    distance, index = cKDTree(position).query(points)
    clear = np.abs(distance - 0.05) > 1e-3  # the grid's coordinates are float32: a millimetre at kilometres
    np.testing.assert_array_equal(apart(points, position, 0.05)[clear], (distance > 0.05)[clear])
    nearest, away = nearest_vertices(points, position, 0.1)
    np.testing.assert_array_equal(nearest, np.where(distance < 0.1, index, -1))
    np.testing.assert_allclose(away[nearest >= 0], distance[nearest >= 0], rtol=1e-12)


@pytest.mark.parametrize("rows", [[0] * 20, [0] * 5 + [1] * 9, [0, 1] * 7, [2, 1, 1, 0, 2], [*range(64)] * 2, [*range(70)] * 2])
def test_distinct_rows_are_those_of_a_sort(rows):
    origins = np.random.default_rng(1).normal(size=(70, 3))[rows]
    origins[::2, 1] = 0.0
    origins[rows == np.min(rows), 1] = -0.0
    np.testing.assert_array_equal(distinct(origins), np.unique(origins, axis=0))


@pytest.mark.parametrize(("width", "height"), [(640, 480), (320, 240), (800, 800)])
def test_some_points_of_an_image_are_of_all_its_columns_and_rows(width, height):
    for count in (100, 800, 1200, width * height // 8):
        chosen = spread_rows(width * height, count)
        assert len(chosen) == len(set(chosen)) == count
        row, column = np.divmod(chosen, width)
        for at, size in ((row, height), (column, width)):
            assert len(set(at * 20 // size)) == 20  # in each twentieth of the image


def test_few_points_are_all_taken():
    np.testing.assert_array_equal(spread_rows(5, 5), np.arange(5))
    assert len(spread_rows(0, 5)) == len(spread_rows(5, 0)) == 0
