"""Distances to a surface by hand and by dense sampling."""

import numpy as np
import pytest

from ddakf.data import sample
from ddakf.evaluation import metrics
from ddakf.mesh import Mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_distance_to_a_square_by_hand():
    distance = metrics.SurfaceDistance(Mesh(SQUARE, FACES))
    points = np.array([[0.3, 0.4, 0.2], [0.3, 0.4, -0.2], [-3, 0.5, 4], [2, 2, 0], [0.5, 0.5, 0]])
    assert np.allclose(distance(points, SQUARE), [0.2, 0.2, 5, np.sqrt(2), 0], atol=1e-12)
    assert np.allclose(distance(points, SQUARE + np.array([0, 0, 0.1])), [0.1, 0.3, np.hypot(3, 3.9), np.sqrt(2.01), 0.1])


def test_distance_agrees_with_dense_sampling():
    sequence = sample()
    mesh = Mesh(sequence.garment_rest, sequence.garment_faces)
    vertices = sequence.garment_vertices[70].astype(float)
    points = vertices[::40] + np.random.default_rng(0).normal(size=(len(vertices[::40]), 3)) * 0.05
    grid = [(i, j) for i in range(13) for j in range(13 - i)]
    a, b, c = (vertices[sequence.garment_faces[:, k]] for k in range(3))
    dense = np.concatenate([a + (b - a) * i / 12 + (c - a) * j / 12 for i, j in grid])
    nearest = np.array([np.linalg.norm(dense - point, axis=1).min() for point in points])
    exact = metrics.SurfaceDistance(mesh)(points, vertices)
    assert (exact <= nearest + 1e-12).all()
    assert np.abs(exact - nearest).max() < 0.002


def test_residual_of_points_above_a_square_by_hand():
    distance = metrics.SurfaceDistance(Mesh(SQUARE, FACES))
    points = np.array([[0.5, 0.5, 0.001], [0.2, 0.5, -0.003], [0.5, 0.3, 0.005], [0.9, 0.9, 0.007]])
    assert distance.residual(points, SQUARE) == pytest.approx((4, 6.7))  # 7 - 0.15 (7 - 5)
    assert np.isnan(distance.residual(points[:0], SQUARE)).all()
