"""Metrics against values computed by hand."""

import numpy as np
import pytest

from ddakf.data import sample
from ddakf.errors import InvalidArgument
from ddakf.evaluation import metrics
from ddakf.mesh import Mesh

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
FACES = np.array([[0, 1, 2], [0, 2, 3]])


def test_rmse_is_three_four_five():
    estimate = SQUARE + np.array([0.003, 0, 0.004])
    assert metrics.rmse_mm(estimate, SQUARE) == pytest.approx(5)
    assert metrics.normal_rmse_mm(estimate, SQUARE, FACES) == pytest.approx(4)


def test_rmse_weighs_vertices_not_frames():
    estimate = SQUARE.copy()
    estimate[0, 2] = 0.01
    assert metrics.rmse_mm(estimate, SQUARE) == pytest.approx(5)  # sqrt(10^2 / 4)


def test_shapes_must_agree():
    with pytest.raises(InvalidArgument, match="shape"):
        metrics.rmse_mm(SQUARE[:2], SQUARE)
    with pytest.raises(InvalidArgument, match="covariance"):
        metrics.squared_mahalanobis(SQUARE, SQUARE, np.eye(3))


def test_mahalanobis_of_a_diagonal_covariance():
    covariance = np.tile(np.diag([1e-4, 4e-4, 9e-4]), (4, 1, 1))
    m = metrics.squared_mahalanobis(SQUARE + np.array([0.01, 0.02, 0.03]), SQUARE, covariance)
    assert np.allclose(m, 3)
    assert metrics.nees3(m) == pytest.approx(1)
    assert metrics.coverage90(m) == 1
    assert metrics.coverage90(m * [1, 2, 2.1, 3]) == 0.5
    assert np.isnan(metrics.coverage90(m[:0]))
    assert np.isnan(metrics.nees3(m[:0]))


def test_a_gaussian_with_the_claimed_covariance_is_calibrated():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(3, 3))
    error = rng.normal(size=(40_000, 3)) @ root.T
    m = metrics.squared_mahalanobis(error, 0 * error, np.tile(root @ root.T, (len(error), 1, 1)))
    assert metrics.coverage90(m) == pytest.approx(0.9, abs=0.01)
    assert metrics.nees3(m) == pytest.approx(1, abs=0.02)


def test_spearman_sees_order_only():
    a = np.array([1.0, 2, 3, 4])
    assert metrics.spearman(a, np.exp(a)) == pytest.approx(1)
    assert metrics.spearman(a, -(a**3)) == pytest.approx(-1)
    assert metrics.spearman(a, np.array([2.0, 1, 4, 3])) == pytest.approx(0.6)  # 1 - 6 * 4 / (4 * 15)
    assert metrics.spearman(a, np.array([1.0, 1, 2, 2])) == pytest.approx(np.sqrt(0.8))
    assert np.isnan(metrics.spearman(a, np.ones(4)))


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
