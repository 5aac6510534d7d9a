"""Normals, nearest points and solvers of the baselines, against slow twins."""

import numpy as np
import pytest
from scipy import sparse

from ddakf.evaluation.baselines.linear_algebra import conjugate_gradients, factorised, graph_laplacian
from ddakf.evaluation.baselines.matching import MatchSettings, Scan, VertexNormals, rigid_motion
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import vertex_normals
from tests.evaluation.baselines.shapes import moved, tube

UP = np.array([0.0, 1.0, 0.0])
SETTINGS = MatchSettings(gate=0.1, normal_cosine=0.5, neighbours=8)


def plane(rng, count=400):
    """Points of the plane y = 0 around the origin, 20 cm wide."""
    return rng.uniform(-0.1, 0.1, (count, 3)) * [1, 0, 1]


def test_normals_of_a_mesh_are_the_library_s():
    garment, rng = tube(), np.random.default_rng(0)
    x = garment.vertices + 0.005 * rng.normal(size=garment.vertices.shape)
    assert np.allclose(VertexNormals(garment)(x), vertex_normals(x, garment.faces))


def test_a_vertex_above_a_plane_is_matched_with_its_normal_and_tukey_s_weight():
    scan = Scan(CapturedFrame(0, 0.0, plane(np.random.default_rng(0))), SETTINGS)
    found = scan.match(np.array([[0, 0.03, 0], [0, -0.03, 0], [0, 0.2, 0]]), np.array([UP, -UP, UP]))
    distance = np.linalg.norm(found.points[:2] - [[0, 0.03, 0], [0, -0.03, 0]], axis=1)
    assert found.normals[:2] == pytest.approx(np.array([UP, -UP]), abs=1e-6)
    assert found.weight == pytest.approx([*((1 - (distance / 0.1) ** 2) ** 2), 0])


def test_normals_that_disagree_are_no_match():
    points, x = plane(np.random.default_rng(0)), np.array([[0, 0.01, 0], [0, 0.01, 0]])
    slanted = np.array([[np.sin(1.2), np.cos(1.2), 0], [np.sin(0.5), np.cos(0.5), 0]])
    assert (Scan(CapturedFrame(0, 0.0, points), SETTINGS).match(x, slanted).weight > 0).tolist() == [False, True]


def test_seen_from_below_a_plane_is_not_matched_with_what_looks_up():
    points, x = plane(np.random.default_rng(0)), np.array([[0, 0.01, 0], [0, -0.01, 0]])
    for origin in (np.array([0, -2.0, 0]), np.tile([0, -2.0, 0], (len(points), 1))):
        found = Scan(CapturedFrame(0, 0.0, points, origin), SETTINGS).match(x, np.array([UP, -UP]))
        assert (found.weight > 0).tolist() == [False, True]


def test_conjugate_gradients_agree_with_a_dense_solve():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(30, 30))
    matrix, right = root @ root.T + np.eye(30), rng.normal(size=(30, 3))
    found = conjugate_gradients(lambda u: matrix @ u, right, lambda r: r / np.diag(matrix)[:, None], 500, 1e-12)
    assert found == pytest.approx(np.linalg.solve(matrix, right))
    assert not conjugate_gradients(lambda u: matrix @ u, 0 * right, lambda r: r, 5, 0.1).any()


def test_the_laplacian_is_the_sum_over_the_edges_and_its_factors_solve():
    garment, rng = tube(), np.random.default_rng(0)
    laplacian, x = graph_laplacian(garment), rng.normal(size=(garment.n_vertices, 3))
    i, j = garment.edges.T
    assert np.vdot(x, laplacian @ x) == pytest.approx(np.square(x[i] - x[j]).sum())
    matrix = laplacian + sparse.eye_array(len(x))
    assert matrix @ factorised(matrix).solve(x) == pytest.approx(x)


def test_a_rigid_motion_is_found_and_never_a_reflection():
    shape, rng = tube().vertices, np.random.default_rng(0)
    turn, shift = rigid_motion(shape, moved(shape, 2.5, [1, 2, 3]))
    assert shape @ turn.T + shift == pytest.approx(moved(shape, 2.5, [1, 2, 3]))
    assert np.linalg.det(rigid_motion(shape, rng.normal(size=shape.shape) - shape)[0]) == pytest.approx(1)
