"""Metrics against values computed by hand."""

import numpy as np
import pytest

from ddakf.data import sample
from ddakf.errors import InvalidArgument
from ddakf.evaluation import metrics
from ddakf.mesh import Mesh
from ddakf.physics import bend

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


def test_nominal_probability_is_the_chi_square_distribution_function():
    assert metrics.nominal_probability(np.array([0, metrics.CHI2_3_90, np.inf])) == pytest.approx([0, 0.9, 1], abs=1e-5)


def test_gaussian_nll_by_hand():
    covariance = np.tile(np.diag([1.0, 4.0, 9.0]), (2, 1, 1))
    nll = metrics.gaussian_nll(np.array([0.0, 3.0]), covariance)
    at_the_mean = 0.5 * np.log((2 * np.pi) ** 3 * 36)  # the density there is 1 / sqrt((2 pi)^3 det P)
    assert nll == pytest.approx([at_the_mean, at_the_mean + 1.5])
    with pytest.raises(InvalidArgument, match="positive definite"):
        metrics.gaussian_nll(np.zeros(1), np.diag([1.0, 1.0, -1.0])[None])


def test_no_constant_covariance_beats_the_second_moment():
    rng = np.random.default_rng(0)
    error = rng.normal(size=(200, 3)) @ rng.normal(size=(3, 3))
    best = metrics.second_moment(error, 0 * error)

    def mean_nll(covariance):
        claimed = np.tile(covariance, (len(error), 1, 1))
        return metrics.gaussian_nll(metrics.squared_mahalanobis(error, 0 * error, claimed), claimed).mean()

    assert metrics.best_constant_nll(best) == pytest.approx(mean_nll(best))
    for other in (0.8 * best, 1.2 * best, best + 0.1 * np.diag(np.diag(best)) * [1, 0, -1]):
        assert mean_nll(other) > metrics.best_constant_nll(best)


def test_area_under_the_curve_by_hand():
    positive = np.array([True, False, True, False])
    assert metrics.roc_auc(np.array([3.0, 1, 4, 2]), positive) == 1
    assert metrics.roc_auc(-np.array([3.0, 1, 4, 2]), positive) == 0
    assert metrics.roc_auc(np.array([2.0, 1, 4, 3]), positive) == 0.75  # three of four pairs are in order
    assert metrics.roc_auc(np.ones(4), positive) == 0.5
    assert np.isnan(metrics.roc_auc(np.ones(2), np.array([True, True])))


def test_flicker_is_of_the_error_and_not_of_the_motion():
    time = np.arange(5.0)[:, None, None]
    truth = SQUARE + np.sin(time)
    assert metrics.flicker_mm(truth + 0.1 + 0.02 * time, truth) == pytest.approx(0, abs=1e-9), "a steady drift is no flicker"
    jump = truth.copy()
    jump[::2] += np.array([0, 0, 0.001])
    assert metrics.flicker_mm(jump, truth) == pytest.approx(2)  # 1 - 2 0 + 1 mm in every frame
    assert np.isnan(metrics.flicker_mm(truth[:2], truth[:2]))


def test_frames_until_within():
    reference = np.ones(6)
    assert metrics.frames_until_within(np.array([3, 2, 1.5, 1.4, 1, 1]), reference, 1.5) == 3
    assert metrics.frames_until_within(np.array([1, 2, 1, 1, 1, 2]), reference, 1.5) == 3, "once is not enough"
    assert metrics.frames_until_within(np.array([1, 2, 1, 1, 1, 2]), reference, 1.5, hold=1) == 1
    assert metrics.frames_until_within(np.array([2.0, 2, 2, 2, 2, 1]), reference, 1.5) == 6, "the run ends within"
    assert metrics.frames_until_within(2 * reference, reference, 1.5) is None


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


def test_penetration_of_a_cube_by_hand():
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
    faces = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                      [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])  # fmt: skip
    inside = metrics.Penetration(Mesh(corners, faces))
    points = np.array([[0.5, 0.5, 0.002], [0.5, 0.5, -0.01], [0.5, 0.006, 0.5], [2, 2, 2]])
    assert inside(points, corners) == pytest.approx((2.0, 0.5))  # (2 + 0 + 6 + 0) / 4 mm
    assert inside(points, corners + [0, 0, 0.496]) == pytest.approx((1.0, 0.25)), "the body has moved"
    assert inside(points[:1], corners) == pytest.approx((2.0, 1.0)), "another number of vertices"
