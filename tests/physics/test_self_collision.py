"""Two layers of one garment pressed together."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker, physics
from ddakf.evaluation import metrics
from ddakf.physics import collision, self_collision
from tests.physics import shapes
from tests.physics.shapes import grid_faces

ROWS, SPACING, THICKNESS = 9, 0.02, 0.004
PLANE = np.stack(np.meshgrid(np.arange(ROWS), np.arange(ROWS), indexing="ij"), axis=-1).reshape(-1, 2) * SPACING
N = len(PLANE)
FACES = np.concatenate([grid_faces(ROWS, ROWS), grid_faces(ROWS, ROWS) + N])


def layers_at(gap, rest_gap=0.2):
    """A garment of two sheets, and its vertices with the upper one ``gap`` metres above the lower, half a cell aside."""
    lower = np.column_stack([PLANE, np.zeros(N)])
    rest = Mesh(np.concatenate([lower, lower + [0.0, 0.0, rest_gap]]), FACES)
    return rest, np.concatenate([lower, lower + [0.3 * SPACING, 0.3 * SPACING, gap]])


def pressed(gap, start=0.01):
    mesh, before = layers_at(start)
    _, now = layers_at(gap)
    layers = self_collision.find(before, now, self_collision.build(mesh, collision.build(mesh).weight, THICKNESS))
    return layers, self_collision.linearize(now, layers), now


def test_layers_closer_than_the_thickness_push_each_other_apart():
    _, lin, now = pressed(0.001)
    np.testing.assert_allclose(lin.residual, 0.001 - THICKNESS, atol=1e-12)
    pull = physics.gradient(lin, len(now))
    assert (pull[:N, 2] >= 0).all()
    assert (pull[N:, 2] <= 0).all()
    assert pull[:N, 2].sum() > 0
    np.testing.assert_allclose(pull.sum(axis=0), 0.0, atol=1e-12)


def test_a_layer_that_went_through_is_pushed_back():
    _, lin, now = pressed(-0.003)
    np.testing.assert_allclose(lin.residual, -0.003 - THICKNESS, atol=1e-12)
    assert (physics.gradient(lin, len(now))[N:, 2] <= 0).all()


def test_layers_that_are_far_apart_or_were_always_close_do_not_act():
    assert not pressed(0.005)[1].weight.any()
    layers, lin, _ = pressed(0.002, start=0.002)
    assert len(layers.gap) > 0
    np.testing.assert_allclose(layers.gap, 0.002)
    assert not lin.weight.any() or np.abs(lin.residual).max() < 1e-12


def test_what_is_close_at_rest_is_one_layer():
    mesh, x = layers_at(0.001, rest_gap=0.01)
    assert len(self_collision.find(x, x, self_collision.build(mesh, np.ones(2 * N), THICKNESS)).gap) == 0


def test_gradient_and_blocks_are_the_derivatives_of_the_energy():
    layers, lin, now = pressed(0.001)
    rng, step = np.random.default_rng(0), 1e-6

    def energy(x):
        return shapes.energy(self_collision.linearize(x, layers))

    gradient, blocks = physics.gradient(lin, len(now)), physics.diagonal_blocks(lin, len(now))
    for moved in rng.normal(size=(5, *now.shape)):
        numeric = (energy(now + step * moved) - energy(now - step * moved)) / (2 * step)
        assert np.sum(gradient * moved) == pytest.approx(numeric, rel=1e-6)
    for i in rng.integers(0, len(now), 10):
        moved = np.zeros_like(now)
        moved[i] = rng.normal(size=3)
        curvature = (energy(now + step * moved) - 2 * energy(now) + energy(now - step * moved)) / step**2
        assert moved[i] @ blocks[i] @ moved[i] == pytest.approx(curvature, rel=1e-3, abs=1e-9)


@pytest.mark.parametrize("stiffness", [0.0, 1e10])
def test_a_tracked_layer_is_kept_on_its_side(stiffness):
    """The upper sheet is seen where it presses through the lower one, which is not seen: only self-collision gives way."""
    mesh, start = layers_at(0.008)
    config = Config()
    config = dataclasses.replace(
        config,
        physics=dataclasses.replace(config.physics, thickness=THICKNESS, self_collision=stiffness),
        start=dataclasses.replace(config.start, search=False),
    )
    tracker = Tracker(mesh, config=config)
    tracker.reset(start)
    rng = np.random.default_rng(0)
    for k in range(1, 6):
        cloud = start[N + rng.integers(0, N, 1500)] + rng.uniform(-0.5, 0.5, (1500, 3)) * [SPACING, SPACING, 0.0]
        cloud[:, 2] = 0.008 - 0.003 * k
        result = tracker.step(cloud, timestamp=k / 30, sensor_origin=[0.1, 0.1, 2.0])
    through = result.vertices[:N, 2].mean() - result.vertices[N:, 2].mean()
    assert through < -0.002 if stiffness else through > -0.002


def test_crossings_are_counted_where_layers_changed_sides():
    mesh, truth = layers_at(0.01)
    paired = len(self_collision.find(truth, truth, self_collision.build(mesh, np.ones(2 * N), THICKNESS)).stencil)
    assert paired > N
    assert metrics.crossings(truth, truth, mesh) == 0
    assert metrics.crossings(layers_at(0.001)[1], truth, mesh) == 0, "closer is not across"
    assert metrics.crossings(layers_at(-0.001)[1], truth, mesh) == paired
    pushed = truth.copy()
    pushed[N + 40, 2] = -0.02  # one vertex of the upper sheet, far from the edges
    assert 1 <= metrics.crossings(pushed, truth, mesh) <= 8, "it, and what it is next to"
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert metrics.crossings(pushed @ turn.T + 1.0, truth, mesh) == metrics.crossings(pushed, truth, mesh)
