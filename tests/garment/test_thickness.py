"""Garments with a thickness: the inner layer is found, left out of the working mesh, and carried along."""

import numpy as np
import pytest

from ddakf import Config, Mesh
from ddakf.garment import remeshing, thickness, working_mesh
from ddakf.mesh import vertex_normals
from tests.garment.shapes import centre_split, sheet, turned_about_y
from tests.garment.test_working_mesh import follow
from tests.lanes import every
from tests.tracker_runs import SAMPLE, SHIRT, TUBE

FINE = remeshing.subdivided(SHIRT, 0.012)[0]


def thick(mesh: Mesh, metres: float = 0.003, rims: bool = True) -> Mesh:
    """The mesh and a layer behind it, joined by rims along its boundaries or not at all."""
    vertices, faces = mesh.vertices.astype(np.float64), mesh.faces
    n = len(vertices)
    both = np.concatenate([vertices, vertices - metres * vertex_normals(vertices, faces)])
    parts = [faces, faces[:, ::-1] + n]
    if rims:
        edges = {tuple(edge) for edge in np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])}
        ends = [(a, b) for a, b in edges if (b, a) not in edges]
        parts.append(np.array([corners for a, b in ends for corners in ((b, a, a + n), (b, a + n, b + n))]))
    return Mesh(both, np.concatenate(parts))


@pytest.mark.parametrize("metres", every(2, [0.001, 0.003, 0.009]))
@pytest.mark.parametrize("rims", [True, False], ids=["joined", "apart"])
@pytest.mark.parametrize("mesh", [SHIRT, TUBE, FINE], ids=["shirt", "tube", "fine"])
def test_the_layer_behind_is_the_inner_one(mesh, metres, rims):
    inner = thickness.inner_layer(thick(mesh, metres, rims))
    assert inner[: mesh.n_vertices].mean() < 1e-3
    assert inner[mesh.n_vertices :].mean() > 1 - 1e-3


def test_layers_of_other_triangles_are_found_too():
    other = centre_split(SHIRT)
    behind = thick(other, 0.004, rims=False)
    inside = Mesh(behind.vertices[other.n_vertices :], behind.faces[other.n_faces :] - other.n_vertices)
    both = Mesh(
        np.concatenate([SHIRT.vertices, inside.vertices]),
        np.concatenate([SHIRT.faces, inside.faces + SHIRT.n_vertices]),
    )
    inner = thickness.inner_layer(both)
    assert inner[: SHIRT.n_vertices].mean() < 1e-3
    assert inner[SHIRT.n_vertices :].mean() > 1 - 1e-3


def flat_shirt(gap: float = 0.005) -> Mesh:
    """Front and back lie on each other, joined at both sides, open at the hem and at the neck."""
    front = sheet(20)
    back = front.vertices + [0.0, 0.0, -gap]
    sides = []
    for edge in (0, 19):
        rows = np.arange(19) * 20 + edge
        quads = np.stack([rows, rows + 20, rows + 420, rows + 400], axis=1)
        quads = quads if edge else quads[:, ::-1]
        sides += [quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]
    return Mesh.cleaned(
        np.concatenate([front.vertices, back]), np.concatenate([front.faces, front.faces[:, ::-1] + 400, *sides])
    )[0]


def two_panels() -> Mesh:
    front = sheet(20)
    return Mesh(
        np.concatenate([front.vertices, front.vertices + [0.0, 0.0, -0.005]]),
        np.concatenate([front.faces, front.faces[:, ::-1] + 400]),
    )


BALL = turned_about_y(np.stack([0.2 * np.sin(np.linspace(0, np.pi, 12)), -0.2 * np.cos(np.linspace(0, np.pi, 12))], axis=1))


SINGLE = {"shirt": SHIRT, "fine": FINE, "tube": TUBE, "flat": flat_shirt(), "panels": two_panels(), "ball": BALL}


@pytest.mark.parametrize("mesh", SINGLE.values(), ids=SINGLE)
def test_one_layer_has_no_inner_one(mesh):
    assert not thickness.inner_layer(mesh).any()


def test_a_missing_triangle_is_no_opening():
    mesh = thick(SHIRT)
    for face in (100, SHIRT.n_faces + 100):
        holed = Mesh(mesh.vertices, np.delete(mesh.faces, face, axis=0))
        np.testing.assert_array_equal(thickness.inner_layer(holed), thickness.inner_layer(mesh))


def test_a_thick_garment_is_tracked_as_its_outer_layer():
    garment = thick(SHIRT)
    working = working_mesh.build(garment, Config().discretisation)
    assert abs(working.mesh.n_vertices - SHIRT.n_vertices) < 10
    still = np.broadcast_to(np.eye(3), (working.mesh.n_vertices, 3, 3))
    np.testing.assert_allclose(working.carried(working.mesh.vertices, still), garment.vertices, atol=1e-12)
    plain, *_ = follow(SHIRT, lambda k: SAMPLE.garment_vertices[k])
    error, *_ = follow(garment, lambda k: thick(Mesh(SAMPLE.garment_vertices[k].astype(np.float64), SHIRT.faces)).vertices)
    assert error < 1.1 * plain + 3e-4
