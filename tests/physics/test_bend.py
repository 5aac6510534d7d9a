"""Dihedral angles: sign, wrapping, boundaries, and faces that are wound inconsistently."""

import numpy as np
import pytest

from ddakf.mesh import Mesh
from ddakf.physics import bend
from tests.physics.shapes import ball, sheet

FLAT = np.array([[0.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.4, 0.0], [1.0, 0.6, 0.0]])
HINGE = Mesh(FLAT, np.array([[0, 1, 2], [1, 0, 3]]))


def folded(angle):
    """The second flap turned about the edge, up to the side of the normals for positive angles."""
    x = FLAT.copy()
    x[3, 0], x[3, 2] = np.cos(angle), np.sin(angle)
    return x


@pytest.mark.parametrize("angle", [-3.0, -1.5, -0.1, 0.0, 1e-6, 0.1, 1.5, 3.0])
def test_angle_of_a_hinge(angle):
    constants = bend.build(HINGE)
    residual = bend.linearize(folded(angle), constants).residual
    assert len(residual) == 1
    assert abs(residual[0]) == pytest.approx(abs(angle), abs=1e-12)
    assert np.sign(residual[0]) == np.sign(bend.linearize(folded(0.1), constants).residual[0]) * np.sign(angle)


def test_the_way_round_is_the_shorter_one():
    constants = bend.build(Mesh(folded(3.0), HINGE.faces))
    assert abs(bend.linearize(folded(-3.0), constants).residual[0]) == pytest.approx(2 * np.pi - 6.0)


def test_weight_of_a_hinge():
    """3 |e|^2 / (A_1 + A_2) with an edge of length 1 and two areas of 1/2."""
    np.testing.assert_allclose(bend.build(HINGE).weight, 3.0)


def test_one_hinge_per_interior_edge():
    closed = ball()
    assert len(bend.build(closed).weight) == len(closed.edges)
    open_sheet = sheet()
    edges_of_faces = 3 * open_sheet.n_faces
    assert len(bend.build(open_sheet).weight) == edges_of_faces - len(open_sheet.edges)


def test_a_flipped_face_is_flat_at_rest_all_the_same():
    turned = Mesh(FLAT, HINGE.faces)
    object.__setattr__(turned, "faces", np.array([[0, 1, 2], [0, 1, 3]]))  # as a surface with one side has them somewhere
    constants = bend.build(turned)
    residual = bend.linearize(folded(0.2), constants).residual
    assert abs(residual[0]) == pytest.approx(0.2)
    assert constants.rest_angle[0] == pytest.approx(0.0)


def test_rest_angles_are_those_of_the_garment():
    constants = bend.build(Mesh(folded(0.8), HINGE.faces))
    np.testing.assert_allclose(bend.linearize(folded(0.8), constants).residual, 0.0, atol=1e-12)
    assert abs(bend.linearize(folded(0.0), constants).residual[0]) == pytest.approx(0.8)


def test_jacobian_is_bounded_where_a_face_collapses():
    constants = bend.build(HINGE)
    for height in 10.0 ** -np.arange(2, 14):
        x = folded(0.5)
        x[2, 0] = -height
        jacobian = bend.linearize(x, constants).jacobian
        assert np.abs(jacobian).max() < 20.0
