"""The non-rigid ICP is a strong baseline: its energy, its solver and its errors."""

import numpy as np
import pytest

from ddakf.evaluation.baselines.linear_algebra import best_rotations
from ddakf.evaluation.baselines.nicp import NicpSettings, NonRigidIcp, turned
from ddakf.evaluation.metrics import rmse_mm
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.sensors.virtual_sensor import sample_surface
from ddakf.evaluation.trials.methods import make_baseline
from ddakf.mesh import Mesh
from ddakf.physics.bend import build as hinges
from tests.evaluation.baselines.shapes import moved


def box(n=8):
    """A closed box of 40 x 30 x 20 cm, (n + 1)^2 vertices to a side before they are joined."""
    grid = np.stack(np.meshgrid(*[np.linspace(-0.5, 0.5, n + 1)] * 2, indexing="ij"), axis=-1).reshape(-1, 2)
    quads = np.array([[i * (n + 1) + j, (i + 1) * (n + 1) + j, (i + 1) * (n + 1) + j + 1, i * (n + 1) + j + 1]
                      for i in range(n) for j in range(n)])  # fmt: skip
    corners, faces = [], []
    for axis in range(3):
        for side in (-0.5, 0.5):
            points = np.insert(grid, axis, side, axis=1)
            outward = quads if (side > 0) == (axis != 1) else quads[:, ::-1]
            faces.append(np.concatenate([outward[:, [0, 1, 2]], outward[:, [0, 2, 3]]]) + len(corners) * len(grid))
            corners.append(points)
    unique, index = np.unique(np.concatenate(corners).round(9), axis=0, return_inverse=True)
    return Mesh(unique * [0.4, 0.3, 0.2], index.ravel()[np.concatenate(faces)])


@pytest.fixture(scope="module")
def garment():
    return box()


def test_the_box_is_closed_and_its_faces_point_outward(garment):
    corners = garment.vertices[garment.faces]
    assert np.einsum("fa,fa->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6 == pytest.approx(0.024)
    assert len(hinges(garment).stencil) == len(garment.edges)


def test_it_follows_a_rigid_motion(garment):
    method, rng = make_baseline("nicp"), np.random.default_rng(0)
    method.start(garment, garment.vertices, None)
    for k in range(1, 8):
        truth = moved(garment.vertices, 0.03 * k, [0.01 * k, 0.005 * k, 0])
        points = sample_surface(truth, garment.faces, 3000, rng)
        estimate = method.step(CapturedFrame(0, k / 30, points))
    assert rmse_mm(garment.vertices, truth) > 60
    assert rmse_mm(estimate, truth) < 6


def test_without_points_it_stays_where_it_is(garment):
    method = make_baseline("nicp")
    method.start(garment, garment.vertices + 1.0, None)
    for k in range(3):
        assert np.array_equal(method.step(CapturedFrame(0, k / 30, np.zeros((0, 3)))), garment.vertices + 1.0)


def test_without_points_it_goes_on_and_comes_to_rest(garment):
    method = NonRigidIcp(NicpSettings(momentum=0.8))
    method.start(garment, garment.vertices, None)
    near = garment.vertices + [0.004, 0, 0]
    for _ in range(30):
        first = method.step(CapturedFrame(0, 0.0, near))
    last = method.step(CapturedFrame(0, 0.0, near + [0.004, 0, 0]))
    ahead = [method.step(CapturedFrame(0, 0.0, np.zeros((0, 3)))) for _ in range(60)]
    step = (last - first).mean(axis=0)[0]
    assert (ahead[0] - last).mean(axis=0)[0] == pytest.approx(0.8 * step)
    assert (ahead[-1] - last).mean(axis=0)[0] == pytest.approx(4 * step, rel=1e-4)  # 0.8 + 0.8^2 + ...


def test_points_beyond_the_gate_do_not_pull(garment):
    method = NonRigidIcp(NicpSettings(gate=0.05))
    method.start(garment, garment.vertices, None)
    estimate = method.step(CapturedFrame(0, 0.0, garment.vertices + [10.0, 0, 0]))
    assert np.allclose(estimate, garment.vertices, atol=1e-9)


def test_what_faces_away_from_the_sensor_takes_no_point(garment):
    """A wall of points behind the box: seen from the front, its back must not be drawn to them."""
    back = garment.vertices[:, 2] < -0.09
    wall = garment.vertices[back] - [0, 0, 0.03]
    pulled = {}
    for name, origin in (("blind", None), ("seeing", np.array([0, 0, 3.0])), ("each", np.tile([0, 0, 3.0], (len(wall), 1)))):
        method = make_baseline("nicp")
        method.start(garment, garment.vertices, None)
        pulled[name] = -(method.step(CapturedFrame(0, 0.0, wall, origin)) - garment.vertices)[back, 2].mean()
    assert pulled["blind"] > 0.015
    assert pulled["seeing"] < 0.002
    assert pulled["each"] == pytest.approx(pulled["seeing"])


def test_results_belong_to_the_caller(garment):
    method = make_baseline("nicp")
    method.start(garment, garment.vertices, None)
    first = method.step(CapturedFrame(0, 0.0, garment.vertices))
    kept = first.copy()
    first += 1.0
    assert rmse_mm(method.step(CapturedFrame(0, 0.1, garment.vertices)), kept) < 2


def test_best_rotations_are_rotations_also_of_reflections_and_flat_matrices():
    rng = np.random.default_rng(0)
    matrices = np.concatenate([rng.normal(size=(50, 3, 3)), rng.normal(size=(5, 3, 1)) * rng.normal(size=(5, 1, 3))])
    rotation = best_rotations(matrices)
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3))
    assert np.allclose(np.linalg.det(rotation), 1)
    assert np.allclose(best_rotations(rotation @ np.diag([3.0, 2.0, 1.0])), rotation)


def test_turning_step_by_step_ends_at_the_best_rotations():
    rng = np.random.default_rng(0)
    matrices = np.eye(3) + 0.3 * rng.normal(size=(200, 3, 3))
    best = best_rotations(matrices)
    rotation = turned(np.tile(np.eye(3), (200, 1, 1)), matrices, 60)
    assert np.allclose(rotation, best, atol=1e-6)
    assert np.allclose(turned(best, matrices, 1), best, atol=1e-12)
