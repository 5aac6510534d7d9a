"""Kernels of the fusion update, held against NumPy."""

import numpy as np
import pytest

from ddakf.garment import model
from ddakf.kernels import fuse as kernels
from tests.physics.shapes import sheet

GARMENT = model.build(sheet())
V = GARMENT.mesh.n_vertices


def test_vertices_stand_out_of_the_mean_of_their_neighbours_but_at_boundaries():
    rng = np.random.default_rng(0)
    position, boundary, out = rng.normal(size=(V, 3)), GARMENT.boundary[:, 0], np.empty((V, 3))
    kernels.stand_out(position, GARMENT.start, GARMENT.neighbour, boundary, 0.3, out)
    rings = np.split(GARMENT.neighbour, GARMENT.start[1:-1])
    expected = np.array([0.3 * (position[i] - position[ring].mean(axis=0)) for i, ring in enumerate(rings)])
    expected[boundary] = 0.0
    np.testing.assert_allclose(out, expected, atol=1e-12)
    assert np.abs(out).max() > 0.1


def test_a_vertex_without_neighbours_stands_out_of_nothing():
    out = np.full((2, 3), np.nan)
    kernels.stand_out(np.ones((2, 3)), np.zeros(3, np.int64), np.empty(0, np.int32), np.empty(0, np.int32), 0.3, out)
    assert (out == 0.0).all()


def test_targets_move_along_their_normals_alone():
    rng = np.random.default_rng(1)
    target, offset, normal, shifted = (*rng.normal(size=(3, V, 3)), np.empty((V, 3)))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    kernels.shift_along(target, normal, offset, shifted)
    np.testing.assert_allclose(shifted - target, np.einsum("va,va->v", normal, offset)[:, None] * normal, atol=1e-12)


@pytest.mark.parametrize("seen", [np.arange(V) % 3 > 0, np.ones(V, bool), np.zeros(V, bool)], ids=["some", "all", "none"])
def test_upward_forces_are_none_together_and_on_seen_vertices_alone(seen):
    rng = np.random.default_rng(2)
    upward, up, force = rng.normal(size=V), np.array([0.0, 0.6, 0.8]), np.zeros((V, 4))
    share = GARMENT.vertex_share
    kernels.add_upward(upward, share, seen, up, force)
    assert (force[~seen] == 0.0).all()
    if seen.any():
        size = upward[seen] - upward[seen].sum() / share[seen].sum() * share[seen]
        np.testing.assert_allclose(force[seen, :3], size[:, None] * up, atol=1e-9)
        np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-9)
