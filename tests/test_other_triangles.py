"""Templates of other triangles in benchmarks/other_triangles.py: the same vertices and surface, and the rows of a short run."""

import numpy as np
import other_triangles
import pytest
from conditions import RECORDINGS
from other_triangles import DIAGONALS, METHODS, OWN, TEMPLATES, VIEWS

from ddakf import Mesh
from ddakf.evaluation.datasets import collection
from ddakf.garment.remeshing import areas


def test_other_diagonals_are_another_mesh_of_the_same_vertices():
    sequence = collection.load(RECORDINGS[0])
    mesh, other = (Mesh(s.template, s.garment_faces) for s in (sequence, other_triangles.other_diagonals(sequence)))
    np.testing.assert_array_equal(other.vertices, mesh.vertices)
    assert (other.n_faces, len(other.edges)) == (mesh.n_faces, len(mesh.edges))
    assert (other.boundary_vertices == mesh.boundary_vertices).all()
    assert areas(other).sum() == pytest.approx(areas(mesh).sum(), rel=0.04)  # of folds
    same = set(map(tuple, np.sort(mesh.faces).tolist())) & set(map(tuple, np.sort(other.faces).tolist()))
    assert len(same) < 0.7 * mesh.n_faces


@pytest.mark.slow
def test_a_run_has_a_row_for_every_template_and_its_tables_a_line_for_every_garment_and_method():
    view, *rest = VIEWS
    rows = [row for method in METHODS for row in other_triangles.run((RECORDINGS[-1], (view, method), 1))]
    rows += [row for other in rest for row in other_triangles.run((RECORDINGS[-1], (other, "ddakf"), 1))]
    of_view = [("ddakf", title) for title in TEMPLATES] + [(m, title) for m in ("nicp", "opt-ed") for title in (OWN, DIAGONALS)]
    assert [(row["method"], row["template"]) for row in rows] == of_view + of_view[: len(TEMPLATES)] * len(rest)
    assert all(0 < row["rmse_mm"] < 40 for row in rows)
    assert len(other_triangles.of_garments([row for row in rows if row["method"] == "ddakf"])) == 4
    assert len(other_triangles.of_methods([{**row, "view": other} for row in rows for other in VIEWS])) == 2 + len(METHODS)
