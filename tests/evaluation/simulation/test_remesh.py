"""Cutting keeps the area on one side; remeshing keeps the surface, its hems and its topology."""

import numpy as np
import pytest

from ddakf.errors import InvalidMesh
from ddakf.evaluation.simulation.cutting.remesh import cut, largest_part, remeshed, subdivided
from ddakf.mesh import Mesh


def sheet(n=9, width=1.0):
    """A flat square of n x n vertices in the plane z = 0."""
    side = np.linspace(0, width, n)
    x, y = np.meshgrid(side, side, indexing="ij")
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = i[:-1, :-1].ravel(), i[1:, :-1].ravel(), i[1:, 1:].ravel(), i[:-1, 1:].ravel()
    vertices = np.column_stack([x.ravel(), y.ravel(), np.zeros(n * n)])
    return Mesh(vertices, np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])]))


def area(mesh):
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return np.cross(b - a, c - a)[:, 2].sum() / 2


def test_a_cut_keeps_the_area_on_the_positive_side_and_the_winding():
    mesh = sheet()
    part = cut(mesh, 0.37 + 0.1 * mesh.vertices[:, 1] - mesh.vertices[:, 0])
    assert area(part) == pytest.approx(0.42)
    assert (part.vertices[:, 0] <= 0.37 + 0.1 * part.vertices[:, 1] + 1e-9).all()


def test_a_cut_that_leaves_nothing_is_refused():
    with pytest.raises(InvalidMesh, match="nothing left"):
        cut(sheet(), -np.ones(81))


@pytest.mark.parametrize("wanted", [40, 300])
def test_remeshing_keeps_a_flat_sheet_flat_and_its_border(wanted):
    result = remeshed(sheet(), wanted)
    assert abs(result.n_vertices / wanted - 1) < 0.15
    assert np.abs(result.vertices[:, 2]).max() < 1e-9
    assert area(result) == pytest.approx(1, abs=0.01 + 2.5 / wanted)  # corners are not kept
    border = result.vertices[result.boundary_vertices][:, :2]
    assert np.minimum(border, 1 - border).min(axis=1).max() < 1e-6
    assert result.n_vertices - len(result.edges) + result.n_faces == 1


def test_subdividing_makes_four_faces_of_one_and_keeps_the_area():
    mesh = sheet(4)
    fine = subdivided(mesh)
    assert fine.n_faces == 4 * mesh.n_faces
    assert area(fine) == pytest.approx(area(mesh))
    assert np.array_equal(fine.vertices[: mesh.n_vertices], mesh.vertices)


def test_the_largest_of_two_parts_is_kept():
    big, small = sheet(5), sheet(3)
    both = Mesh(np.concatenate([big.vertices, small.vertices + 3]), np.concatenate([big.faces, small.faces + big.n_vertices]))
    assert largest_part(both).n_vertices == big.n_vertices
