"""Strain and bending by hand, and angles against those of the energy."""

import numpy as np
import pytest

from ddakf.data import sample
from ddakf.evaluation import metrics
from ddakf.mesh import Mesh
from ddakf.physics import bend

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_stretch_and_bend_by_hand():
    shape = metrics.ShapeDifference(Mesh(SQUARE, FACES))
    wide = SQUARE * [1.1, 1, 1]  # two edges of five by 10 %, the diagonal from sqrt(2) to sqrt(2.21)
    assert shape.stretch(wide, SQUARE) == pytest.approx(100 * (0.2 + np.sqrt(2.21 / 2) - 1) / 5)
    assert shape.stretch(SQUARE, SQUARE) == shape.bend(SQUARE, SQUARE) == 0
    folded = SQUARE.copy()
    folded[3] = [0.5, 0.5, np.sqrt(0.5)]  # the second triangle stands upright on the diagonal
    assert shape.bend(folded, SQUARE) == pytest.approx(90)
    assert shape.stretch(folded, SQUARE) == pytest.approx(0)
    assert shape.bend(folded * [1, 1, -1], folded) == pytest.approx(180), "to the other side"


def test_angles_are_those_of_the_bending_energy():
    sequence = sample()
    mesh = Mesh(sequence.garment_rest, sequence.garment_faces)
    vertices = sequence.garment_vertices[70].astype(float)
    residual = bend.linearize(vertices, bend.build(mesh)).residual
    expected = np.degrees(np.abs(residual).mean())
    assert metrics.ShapeDifference(mesh).bend(vertices, mesh.vertices) == pytest.approx(expected, rel=1e-6)
