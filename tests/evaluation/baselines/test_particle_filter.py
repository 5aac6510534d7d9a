"""The particle filter's parts: resampling, reduced space, looked-up distances."""

import numpy as np
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ddakf.evaluation.baselines.filters.particle_filter import (
    NearestPoints,
    ParticleFilter,
    ParticleSettings,
    harmonics,
    slopes,
    systematic,
    tempered,
)  # fmt: skip
from ddakf.evaluation.baselines.linear_algebra import graph_laplacian
from ddakf.evaluation.metrics import normal_rmse_mm
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.sensors.virtual_sensor import sample_surface
from ddakf.mesh import Mesh
from tests.evaluation.baselines.shapes import tube, widened


@pytest.fixture(scope="module")
def garment():
    return tube()


def test_systematic_resampling_takes_each_as_often_as_its_weight_says():
    rng = np.random.default_rng(0)
    weight = rng.random(200) ** 4
    weight /= weight.sum()
    for _ in range(20):
        taken = np.bincount(systematic(weight, rng), minlength=200)
        assert taken.sum() == 200
        assert (np.abs(taken - 200 * weight) < 1 + 1e-9).all()
    assert np.mean([np.bincount(systematic(weight, rng), minlength=200) for _ in range(2000)], axis=0) == pytest.approx(
        200 * weight, abs=0.1
    )


def test_harmonics_are_orthonormal_smooth_and_without_the_constant(garment):
    phi, value = harmonics(garment, 6)
    n = garment.n_vertices
    assert phi.T @ phi / n == pytest.approx(np.eye(6), abs=1e-8)
    assert phi.mean(axis=0) == pytest.approx(0, abs=1e-8)
    assert np.diag(phi.T @ (graph_laplacian(garment) @ phi)) / n == pytest.approx(value)
    rough = np.linalg.eigvalsh(graph_laplacian(garment).toarray())
    assert value == pytest.approx(rough[1:7])


def test_harmonics_of_two_parts_have_no_eigenvalue_zero():
    one = tube(8, 4)
    both = Mesh(np.concatenate([one.vertices, one.vertices + 2]), np.concatenate([one.faces, one.faces + one.n_vertices]))
    assert (harmonics(both, 4)[1] > 1e-6).all()


def test_looked_up_distances_are_near_the_true_ones():
    rng, voxel = np.random.default_rng(0), 0.02
    points, places = rng.random((300, 3)), rng.uniform(-0.2, 1.2, (500, 3))
    nearby = NearestPoints(points, np.zeros(3) - 0.1, np.ones(3) + 0.1, voxel)
    looked_up = np.sqrt(nearby.squared_distances(places.reshape(5, 100, 3))).ravel()
    assert np.abs(looked_up - cKDTree(points).query(places)[0])[(np.abs(places - 0.5) < 0.6).all(axis=1)].max() < 4 * voxel
    assert NearestPoints(points + 5, np.zeros(3), np.ones(3), voxel).empty


def test_the_mean_is_that_of_all_particles(garment):
    method = ParticleFilter(ParticleSettings(particles=30))
    method.start(garment, garment.vertices, None)
    method.step(CapturedFrame(0, 0.1, garment.vertices + 0.01))
    everything = method._vertices_of_all(np.arange(garment.n_vertices))
    assert method._mean_vertices() == pytest.approx(np.einsum("n,nva->va", method._weight, everything))


def test_the_effective_sample_size_is_that_of_the_last_frame_with_points(garment):
    method = ParticleFilter(ParticleSettings(particles=50, least_size=10.0))
    method.start(garment, garment.vertices, None)
    assert method.effective_sample_size == pytest.approx(50)
    method.step(CapturedFrame(0, 0.1, garment.vertices))
    size = method.effective_sample_size
    assert size == pytest.approx(1 / sum(weight**2 for weight in method._weight))
    assert 1 <= size < 49
    method.step(CapturedFrame(1, 0.2, np.zeros((0, 3))))
    assert method.effective_sample_size == size
    method.start(garment, garment.vertices, None)
    assert method.effective_sample_size == pytest.approx(50)


def test_a_tempered_likelihood_keeps_the_sample_size_and_the_order():
    energy = np.random.default_rng(3).exponential(1e-4, 500)
    sharp = tempered(np.full(500, 1 / 500), energy, 1e-5, 1.0)
    assert 1 / np.square(sharp).sum() < 5, "the likelihood alone leaves a few"
    kept = tempered(np.full(500, 1 / 500), energy, 1e-5, 50.0)
    assert kept.sum() == pytest.approx(1)
    assert 1 / np.square(kept).sum() == pytest.approx(50, rel=0.05)
    assert (np.argsort(kept) == np.argsort(-energy)).all()
    soft = tempered(np.full(500, 1 / 500), energy, 1.0, 50.0)
    assert soft == pytest.approx(1 / 500, rel=1e-3), "a soft one is as it is"


def test_slopes_are_the_derivatives_of_the_places(garment):
    rng = np.random.default_rng(0)
    phi, turn, shift = rng.normal(size=(5, 2)), Rotation.from_rotvec([0.3, -0.2, 0.5]), np.array([1.0, 2.0, 3.0])
    shape, amplitude = rng.normal(size=(5, 3)), rng.normal(size=(2, 3))

    def places(u):
        return (Rotation.from_rotvec(u[:3]) * turn).apply(shape + phi @ (amplitude + u[6:].reshape(2, 3))) + shift + u[3:6]

    h = 1e-6
    numeric = np.stack([(places(h * e) - places(-h * e)) / (2 * h) for e in np.eye(12)], axis=2)
    assert slopes(places(np.zeros(12)) - shift, turn.as_matrix(), phi) == pytest.approx(numeric, abs=1e-6)


def test_soft_enough_it_follows_a_smooth_deformation(garment):
    rng, method = np.random.default_rng(0), ParticleFilter(ParticleSettings(harmonics=5, elasticity=1.0, amplitude_sd=0.004))
    method.start(garment, garment.vertices, None)
    for k in range(1, 9):
        truth = widened(garment.vertices, 0.02 * k)
        estimate = method.step(CapturedFrame(0, k / 30, sample_surface(truth, garment.faces, 4000, rng)))
    assert normal_rmse_mm(estimate, truth, garment.faces) < 0.6 * normal_rmse_mm(garment.vertices, truth, garment.faces)


def test_its_motion_ends_where_it_finds_no_points(garment):
    method, step = ParticleFilter(ParticleSettings(particles=50)), np.array([0.03, 0.0, 0.0])
    method.start(garment, garment.vertices, None)
    for k in range(1, 6):
        seen = method.step(CapturedFrame(k, k / 30, garment.vertices + k * step)).mean(axis=0)
    elsewhere = garment.vertices + 50.0
    for k in range(6, 20):
        estimate = method.step(CapturedFrame(k, k / 30, elsewhere)).mean(axis=0)
    assert np.linalg.norm(estimate - seen) < 1.5 * 0.03, "one frame's motion, and noise"


def test_a_step_of_the_proposal_stays_within_the_gate(garment):
    """A small flat patch leaves most of the motion open."""
    settings = ParticleSettings(particles=20, proposal_steps=1, proposal_gate=0.1, momentum=0.0, shift_sd=1e-6, turn_sd=1e-6)
    method, rng = ParticleFilter(settings), np.random.default_rng(1)
    method.start(garment, garment.vertices, None)
    centre = garment.vertices[garment.vertices[:, 0].argmax()]
    patch = centre + 0.05 + 0.03 * rng.normal(size=(40, 3)) * [0.02, 1.0, 1.0]
    estimate = method.step(CapturedFrame(0, 0.1, patch))
    assert np.linalg.norm(estimate - garment.vertices, axis=1).max() < 0.11
