"""Grid of the vertices: every vertex is in its cell, whatever the shape and the size of the cells."""

import numpy as np
import pytest

from ddakf.stages.grid import distinct, vertex_grid

RNG = np.random.default_rng(0)
SHAPES = {
    "spread": RNG.uniform(-1, 1, (500, 3)),
    "on a line": np.outer(RNG.uniform(0, 2, 300), [0.0, 1.0, 0.0]),
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
    place = np.clip(((position[grid.index] - cells.origin) / cells.cell).astype(int), 0, cells.dims - 1)
    number = (place[:, 0] * cells.dims[1] + place[:, 1]) * cells.dims[2] + place[:, 2]
    assert (np.diff(number) >= 0).all() or (np.diff(place @ [1, cells.dims[0], cells.dims[0] * cells.dims[1]]) >= 0).all()


@pytest.mark.parametrize("rows", [[0] * 20, [0] * 5 + [1] * 9, [0, 1, 2] * 7, [2, 2, 1, 1, 0, 2]])
def test_distinct_rows_are_those_of_a_sort(rows):
    origins = RNG.normal(size=(3, 3))[rows]
    np.testing.assert_array_equal(distinct(origins), np.unique(origins, axis=0))
