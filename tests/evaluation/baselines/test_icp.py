"""The non-rigid step minimises its stated energy."""

import numpy as np
import pytest

from ddakf.evaluation.baselines import icp
from ddakf.evaluation.baselines.icp import DAMPING, IcpSettings, NonRigidPointToPlane
from ddakf.evaluation.baselines.matching import Matches, rigid_motion
from tests.evaluation.baselines.shapes import moved, tube


def test_a_step_is_the_dense_least_squares_solution(monkeypatch):
    monkeypatch.setattr(icp, "SOLVER_STEPS", 1000)
    monkeypatch.setattr(icp, "SOLVER_TOLERANCE", 1e-12)
    garment, rng, stiffness = tube(8, 5), np.random.default_rng(0), 3.0
    n = garment.n_vertices
    x = moved(garment.vertices, 0.7, [0.1, 0, 0]) + 0.01 * rng.normal(size=(n, 3))
    points, normals, weight = x + 0.02 * rng.normal(size=(n, 3)), rng.normal(size=(n, 3)), rng.random(n) * (rng.random(n) < 0.7)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    method = NonRigidPointToPlane(IcpSettings(stiffness=stiffness))
    method.start(garment, garment.vertices, None)
    move = method._move(x, Matches(points, normals, weight))

    i, j = garment.edges.T
    turn, shift = rigid_motion(garment.vertices, x)
    apart = np.zeros((len(i), n))
    apart[np.arange(len(i)), i], apart[np.arange(len(i)), j] = 1, -1
    rows = [np.sqrt(weight)[:, None] * (np.eye(n)[:, :, None] * normals[:, None]).reshape(n, -1)]
    right = [np.sqrt(weight) * ((points - x) * normals).sum(axis=1)]
    rows += [np.sqrt(stiffness) * np.kron(apart, np.eye(3)), np.sqrt(DAMPING) * np.eye(3 * n)]
    displacement = x - garment.vertices @ turn.T - shift
    right += [-np.sqrt(stiffness) * (apart @ displacement).ravel(), np.zeros(3 * n)]
    best = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    assert move.ravel() == pytest.approx(best, abs=1e-9)
