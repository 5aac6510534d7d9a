"""Garment vertices against a body: which touch, with which force."""

import numpy as np
import pytest

from ddakf import physics
from ddakf.body import proximity
from ddakf.errors import InvalidConfig
from ddakf.physics import collision
from tests.physics.shapes import ball, energy, sheet

MESH, BODY, RADIUS = sheet(), ball(3), 0.2
THICKNESS = 0.004


def contact_of(points, reach=0.1):
    body = proximity.build(BODY)
    return proximity.closest_points(body, proximity.refresh(body, BODY.vertices), points, reach)


def test_only_vertices_closer_than_the_thickness_are_pushed():
    heights = np.linspace(-0.02, 0.02, MESH.n_vertices)
    x = np.outer(RADIUS + heights, [0.0, 0.0, 1.0])
    lin = collision.linearize(x, collision.build(MESH, THICKNESS), contact_of(x))
    # inside, the facets of the ball are nearer than its corner above the points
    np.testing.assert_allclose(lin.residual, np.minimum(0.0, heights - THICKNESS), atol=3e-4)
    np.testing.assert_array_equal(lin.weight > 0, heights < THICKNESS)
    assert not lin.jacobian[heights > THICKNESS].any()


def test_gradient_is_the_derivative_of_the_energy_and_points_inward():
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(MESH.n_vertices, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    x = directions * (RADIUS + rng.uniform(-0.01, 0.01, (MESH.n_vertices, 1)))
    constants, contact, step = collision.build(MESH, THICKNESS), contact_of(x), 1e-8
    gradient = physics.gradient(collision.linearize(x, constants, contact), len(x))
    for moved in rng.normal(size=(5, *x.shape)):
        ahead = energy(collision.linearize(x + step * moved, constants, contact))
        behind = energy(collision.linearize(x - step * moved, constants, contact))
        assert np.sum(gradient * moved) == pytest.approx((ahead - behind) / (2 * step), rel=1e-4)
    assert np.einsum("va,va->v", gradient, directions).max() <= 0.0


def test_weights_share_out_the_area_of_the_garment():
    corners = MESH.vertices[MESH.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert collision.build(MESH).weight.sum() == pytest.approx(area.sum())


def test_no_body_within_reach_means_no_constraint():
    x = MESH.vertices + np.array([5.0, 0.0, 0.0])
    lin = collision.linearize(x, collision.build(MESH), contact_of(x))
    assert energy(lin) == 0.0
    assert all(np.isfinite(array).all() for array in lin)


def test_vertices_outside_have_no_weight_and_the_constants_keep_theirs():
    constants = collision.build(MESH, THICKNESS)
    outside = np.outer(np.full(MESH.n_vertices, 1.8 * RADIUS), [0.0, 1.0, 0.0])
    assert not collision.linearize(outside, constants, contact_of(outside)).weight.any()
    assert constants.weight.all()


@pytest.mark.parametrize("thickness", [-0.001, np.nan, np.inf])
def test_impossible_thickness_is_refused(thickness):
    with pytest.raises(InvalidConfig, match="thickness"):
        collision.build(MESH, thickness)
