"""Stretch and shear: what they measure, and along which threads."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Tracker
from ddakf.config import Physics
from ddakf.errors import InvalidConfig
from ddakf.kernels import strain as kernels
from ddakf.mesh import Mesh
from ddakf.physics import shear, strain, stretch
from ddakf.physics.rest import rest_frames
from tests.physics import shapes
from tests.physics.shapes import grid_faces, sheet
from tests.stages.scenes import rms, scan, tube

ROWS, COLUMNS = 4, 3
FLAT = Mesh(
    np.array([[0.02 * r, 0.03 * c, 0.0] for r in range(ROWS) for c in range(COLUMNS)]), grid_faces(ROWS, COLUMNS)
)
AREA = 0.06 * 0.06
START_STRAIN = Physics().start_strain


def started(constants, position, kept, strain_sd):
    return strain.with_metric(constants, strain.metric_at_start(constants, position, kept, strain_sd))


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


# At the start ----------------------------------------------------------------------------------------------------------


def squared_at(position, constants):
    """(F,) squared norm of the strain of all faces."""
    squared = np.empty(FLAT.n_faces)
    assert kernels.squared_strains(position, np.ones(len(position), bool), constants, squared) == FLAT.n_faces
    return squared


def test_all_of_the_strain_of_the_start_can_be_at_rest():
    start = FLAT.vertices @ (np.eye(3) + 0.02 * np.random.default_rng(0).normal(size=(3, 3))).T
    constants = strain.build(FLAT)
    assert squared_at(start, constants).min() > 1e-4
    np.testing.assert_allclose(squared_at(start, started(constants, start, 1.0, 1e3)), 0.0, atol=1e-12)


def test_none_of_it_is_or_the_template_is_at_rest():
    constants = strain.build(FLAT)
    stretched = FLAT.vertices * [1.05, 1.0, 1.0]
    none = started(constants, stretched, 0.0, START_STRAIN)
    np.testing.assert_allclose(squared_at(stretched, none), squared_at(stretched, constants), rtol=1e-9)
    turned = (FLAT.vertices + [0.1, 0.2, 0.3])[:, [1, 2, 0]]
    np.testing.assert_allclose(squared_at(turned, started(constants, turned, 0.4, START_STRAIN)), 0.0, atol=1e-12)


def test_a_share_of_small_strain_is_at_rest_and_little_of_what_no_cloth_has():
    constants, left = strain.build(FLAT), []
    for size in (0.02, 0.5):
        stretched = FLAT.vertices * [1.0 + size, 1.0, 1.0]
        after = np.sqrt(squared_at(stretched, started(constants, stretched, 0.4, START_STRAIN)))
        left.append((after / np.sqrt(squared_at(stretched, constants))).mean())
    assert left[0] == pytest.approx(0.6, abs=0.05)
    assert left[1] > 0.9


def test_a_face_that_has_collapsed_at_the_start_keeps_finite_lengths():
    constants = started(strain.build(FLAT), FLAT.vertices * [0.0, 1.0, 1.0], 1.0, 1e3)
    assert np.isfinite(constants.warp).all()
    assert np.isfinite(constants.weft).all()


def test_the_metric_at_rest_is_the_inverse_root_of_the_metric_at_the_start():
    """With all of the strain at rest, for faces that are strained, sheared, turned and collapsed."""
    constants, rng = strain.build(FLAT), np.random.default_rng(3)
    for change in (rng.normal(size=(3, 3)), np.eye(3), np.diag([1.0, 0.0, 1.0]), np.zeros((3, 3))):
        position = FLAT.vertices @ change
        corner, coefficient = position[constants.corner], np.stack([constants.warp, constants.weft], axis=2)
        deformation = corner.transpose(0, 2, 1) @ coefficient
        values, vectors = np.linalg.eigh(deformation.transpose(0, 2, 1) @ deformation)
        root = vectors / np.sqrt(np.maximum(values, strain.SMALLEST))[:, None] @ vectors.transpose(0, 2, 1)
        np.testing.assert_allclose(strain.metric_at_start(constants, position, 1.0, 1e9), root, rtol=1e-9, atol=1e-9)


def test_cloth_that_is_strained_where_it_starts_stays_there():
    """The first frame moved vertices by several millimetres along a surface that they lay on."""
    mesh = tube()
    start = mesh.vertices * [1.03, 0.98, 1.03]
    moved = {}
    for kept in (0.0, Physics().start_strain_kept):
        physics = dataclasses.replace(Physics(), start_strain_kept=kept, size_memory=0.0)  # which takes up most of it
        tracker = Tracker(mesh, config=dataclasses.replace(Config(), physics=physics))
        tracker.reset(vertices=start)
        result = tracker.step(scan(start, mesh, 8000, 0.001, seed=1), timestamp=0.0)
        moved[kept] = rms(result.vertices - start)
    assert moved[Physics().start_strain_kept] < 0.8 * moved[0.0]
