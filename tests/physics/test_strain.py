"""Stretch and shear: what they measure, and along which threads."""

import numpy as np
import pytest

from ddakf.errors import InvalidConfig
from ddakf.mesh import Mesh
from ddakf.physics import shear, stretch
from ddakf.physics.rest import rest_frames
from tests.physics import shapes
from tests.physics.shapes import grid_faces, sheet

ROWS, COLUMNS = 4, 3
FLAT = Mesh(
    np.array([[0.02 * r, 0.03 * c, 0.0] for r in range(ROWS) for c in range(COLUMNS)]), grid_faces(ROWS, COLUMNS)
)
AREA = 0.06 * 0.06


def test_pulling_along_the_warp_lengthens_the_warp_only():
    residual = stretch.linearize(FLAT.vertices * [1.1, 1.0, 1.0], stretch.build(FLAT, warp=[1.0, 0.0, 0.0])).residual
    np.testing.assert_allclose(residual[: FLAT.n_faces], 0.1, atol=1e-12)
    np.testing.assert_allclose(residual[FLAT.n_faces :], 0.0, atol=1e-12)


def test_shear_measures_the_angle_between_the_threads():
    sheared = FLAT.vertices + 0.05 * FLAT.vertices[:, [1, 0, 2]] * [1.0, 0.0, 0.0]
    residual = shear.linearize(sheared, shear.build(FLAT, warp=[1.0, 0.0, 0.0])).residual
    np.testing.assert_allclose(residual, 0.05, atol=1e-12)


def test_energy_of_a_pulled_sheet_is_half_the_area_times_the_squared_strain():
    lin = stretch.linearize(FLAT.vertices * [1.1, 1.0, 1.0], stretch.build(FLAT, warp=[1.0, 0.0, 0.0]))
    assert shapes.energy(lin) == pytest.approx(0.5 * AREA * 0.1**2)


def test_stretch_and_shear_together_know_no_direction_at_small_strain():
    rng = np.random.default_rng(0)
    strained = FLAT.vertices @ (np.eye(3) + 1e-5 * rng.normal(size=(3, 3))).T

    def energy(angle):
        warp = [np.cos(angle), np.sin(angle), 0.0]
        parts = [module.linearize(strained, module.build(FLAT, warp)) for module in (stretch, shear)]
        return sum(shapes.energy(part) for part in parts)

    assert energy(0.7) == pytest.approx(energy(0.0), rel=1e-3)
    assert energy(2.0) == pytest.approx(energy(0.0), rel=1e-3)


def test_rest_frames_are_orthonormal_tangents_and_blind_to_translation():
    mesh = sheet()
    frames = rest_frames(mesh, warp=[0.3, 1.0, 0.2])
    corners = mesh.vertices[mesh.faces]
    u, v = (np.einsum("fc,fca->fa", weights, corners) for weights in (frames.warp, frames.weft))
    np.testing.assert_allclose(np.einsum("fa,fa->f", u, u), 1.0)
    np.testing.assert_allclose(np.einsum("fa,fa->f", v, v), 1.0)
    np.testing.assert_allclose(np.einsum("fa,fa->f", u, v), 0.0, atol=1e-12)
    np.testing.assert_allclose(frames.warp.sum(axis=1), 0.0, atol=1e-9)


def test_a_warp_across_the_sheet_falls_back_to_the_first_edge():
    np.testing.assert_allclose(rest_frames(FLAT, warp=[0.0, 0.0, 1.0]).warp, rest_frames(FLAT).warp)


@pytest.mark.parametrize("warp", [[1.0, 0.0], [np.nan, 0.0, 1.0], np.ones((2, 3))])
def test_unusable_warp_is_refused(warp):
    with pytest.raises(InvalidConfig, match="warp"):
        stretch.build(FLAT, warp)
