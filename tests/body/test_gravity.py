"""Gravity: the weight of cloth that the start does not balance, and what strain of the start balances."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.body import body_anchor, contact, gravity
from ddakf.config import Physics
from ddakf.garment import model
from ddakf.kernels import strain as strain_kernels
from ddakf.physics import rigidity
from ddakf.types import Health, Resting, Setup, Track
from tests.stages.scenes import FPS, about, inner_body, posed, problem_of, rms, scan, tube

MESH = tube()
BODY = inner_body(MESH)
GARMENT = model.build(MESH)
V = MESH.n_vertices
UPRIGHT = np.tile(np.eye(3), (V, 1, 1))
DOWN = np.array([0.0, -1.0, 0.0])


def frame(physics=None, velocity=None, carried=None, contacts=None, dt=1 / FPS):
    """A frame in which the body holds the tube."""
    config = Config() if physics is None else dataclasses.replace(Config(), physics=physics)
    constants = contact.build(BODY, 0.1)
    under = contact.start(constants, MESH.vertices, config.physics)._replace(velocity=velocity, contacts=contacts)
    anchor = body_anchor.start(Setup(GARMENT, constants, config), BODY.vertices, MESH.vertices)
    last = Track(None, None, None, 0.0, Health(), None, under, anchor)
    return body_anchor.measure(problem_of(GARMENT, None, config, last=last, body=posed(BODY), dt=dt, carried=carried))


def force_of(problem, rotation=UPRIGHT):
    """(V, 3) force over that of the weight of each vertex."""
    areas = GARMENT.area / V * GARMENT.vertex_share.astype(float)
    return gravity.force(problem, rotation) / (problem.config.physics.weight * areas)[:, None]


def resting_on(normal) -> contact.Contacts:
    """Contacts of a garment that lies on surface that faces so everywhere."""
    found = contact.nearest(posed(BODY), MESH.vertices)
    closest = found.closest._replace(
        distance=np.zeros(V), normal=np.tile(np.asarray(normal, float), (V, 1)), face=np.zeros(V, found.closest.face.dtype)
    )
    return found._replace(closest=closest)


def test_where_the_track_starts_the_weight_is_balanced():
    np.testing.assert_allclose(force_of(frame()), 0.0, atol=1e-12)


def test_cloth_that_has_turned_hangs_another_way():
    turned = np.tile(about([1.0, 0.0, 0.0], np.pi / 2), (V, 1, 1))  # what was down is now -z
    np.testing.assert_allclose(force_of(frame(), turned), np.tile(DOWN - [0.0, 0.0, -1.0], (V, 1)), atol=1e-6)
    about_vertical = np.tile(about([0.0, 1.0, 0.0], 1.0), (V, 1, 1))
    np.testing.assert_allclose(force_of(frame(), about_vertical), 0.0, atol=1e-6)


def test_the_weight_is_that_of_the_cloth_and_not_of_its_vertices():
    turned = np.tile(about([1.0, 0.0, 0.0], np.pi), (V, 1, 1))
    total = gravity.force(frame(), turned).sum(axis=0)
    np.testing.assert_allclose(total, 2.0 * Physics.weight * GARMENT.area * DOWN, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("dt", [1 / FPS, 1 / 10])
def test_a_body_that_accelerates_leaves_its_cloth_behind(dt):
    before, acceleration = np.array([0.3, 0.0, 0.1]), np.array([4.0, 2.0, 0.0])
    moving = np.tile(before, (V, 1))
    steady = frame(velocity=moving, carried=dt * moving, dt=dt)
    np.testing.assert_allclose(force_of(steady), 0.0, atol=1e-9)
    faster = frame(velocity=moving, carried=dt * (moving + dt * acceleration), dt=dt)
    np.testing.assert_allclose(
        force_of(faster), np.tile(-Physics.inertia * acceleration / gravity.GRAVITY, (V, 1)), rtol=1e-5, atol=1e-9
    )


def test_a_jump_of_the_body_model_throws_nothing_off():
    jump = frame(velocity=np.zeros((V, 3)), carried=np.tile([0.5, 0.0, 0.0], (V, 1)))
    size = np.linalg.norm(force_of(jump), axis=1)
    np.testing.assert_allclose(size, Physics.inertia * Physics.strongest_inertia, rtol=1e-6)


def test_cloth_is_pressed_onto_surface_that_carries_it_and_onto_no_wall():
    np.testing.assert_allclose(force_of(frame(contacts=resting_on([0.0, 1.0, 0.0]))), np.tile(DOWN, (V, 1)), atol=1e-6)
    for normal in ([1.0, 0.0, 0.0], [0.0, -1.0, 0.0]):
        np.testing.assert_allclose(force_of(frame(contacts=resting_on(normal))), 0.0, atol=1e-9)


def test_without_a_hold_there_is_no_weight():
    held = frame()
    assert gravity.force(held._replace(anchored=None), UPRIGHT) is None
    assert gravity.force(frame(Physics(weight=0.0)), UPRIGHT) is None


# Of strain that is not at rest ----------------------------------------------------------------------------------------


def resting_at(vertices) -> Resting:
    return rigidity.resting(np.ascontiguousarray(vertices), Setup(GARMENT, None, Config()))


HIGH, LENGTH = MESH.vertices[:, 1].max(), np.ptp(MESH.vertices[:, 1])
DEPTH = HIGH - MESH.vertices[:, 1]
SAG = 0.02 * (LENGTH * DEPTH - DEPTH**2 / 2)  # the strain grows toward the top, which bears all below
HANGING = MESH.vertices - np.outer(SAG, [0.0, 1.0, 0.0])


def test_a_start_in_the_shape_of_the_template_draws_nothing():
    assert np.abs(resting_at(MESH.vertices + [1.0, 2.0, 3.0]).upward).max() < 1e-4


def test_a_start_that_hangs_is_drawn_down_and_carried_at_its_top():
    upward, height = resting_at(HANGING).upward, HANGING[:, 1]
    low, high = height < np.quantile(height, 0.4), height > np.quantile(height, 0.9)
    assert upward.sum() == pytest.approx(0.0, abs=1e-6 * np.abs(upward).sum())
    assert (upward[low] < 0).all()
    assert (upward[high] > 0).all()


def test_what_draws_does_the_work_of_the_strain():
    position, config = np.ascontiguousarray(HANGING), Config()
    resting, size = resting_at(position), 1e-4
    below = position[:, 1].max() - position[:, 1]
    stretched = position - size * np.outer(below, [0.0, 1.0, 0.0])
    energies = []
    for place in (position, stretched):
        rows, blocks, force = np.zeros((V, 4)), np.zeros((len(MESH.edges), 12), np.float32), np.zeros((V, 4))
        rows[:, :3] = place
        strain_kernels.add_strain(rows, resting.strain, config.physics.stretch, config.physics.shear, 0.01, blocks, force)
        energies.append(force[:, 1])
    elastic = -np.mean(energies, axis=0) @ (stretched - position)[:, 1]
    weights = config.physics.weight * GARMENT.area * GARMENT.vertex_share / GARMENT.vertex_share.sum()
    share = elastic / (size * weights @ below)
    assert 0.0 < share < gravity.MOST
    carries = resting.upward + share * weights  # what is left is of the cloth that carries
    assert carries.min() > 0.0
    assert carries.sum() == pytest.approx(share * weights.sum(), rel=1e-3)


def test_noise_and_a_squeezed_start_draw_no_more_than_the_weight_could():
    rng, areas = np.random.default_rng(0), GARMENT.area * GARMENT.vertex_share / GARMENT.vertex_share.sum()
    noisy = resting_at(MESH.vertices + 0.01 * rng.normal(size=(V, 3))).upward
    assert (noisy >= -gravity.MOST * Physics.weight * areas * 1.001).all()
    assert np.abs(resting_at(MESH.vertices * [1.0, 0.97, 1.0]).upward).max() == 0.0


def test_only_what_is_seen_is_drawn():
    problem = frame()._replace(body=None, anchored=None, resting=resting_at(HANGING))
    observed = MESH.vertices[:, 0] > 0
    force = np.zeros((V, 4))
    gravity.add_to_seen(problem, observed, force)
    assert np.abs(force[observed]).max() > 0.0
    assert (force[~observed] == 0).all()
    np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-9 * np.abs(force).sum())
    nothing = np.zeros((V, 4))
    gravity.add_to_seen(problem, np.zeros(V, bool), nothing)
    gravity.add_to_seen(problem._replace(resting=None), observed, nothing)
    assert (nothing == 0).all()


def test_a_garment_that_hangs_keeps_its_length():
    lengths = []
    for share in (0.0, Physics.weight):
        tracker = Tracker(MESH, config=dataclasses.replace(Config(), physics=Physics(weight=share, size_memory=0.0)))
        tracker.reset(vertices=HANGING)
        for k in range(20):
            result = tracker.step(scan(HANGING, MESH, seed=k), timestamp=k / FPS)
        off, (low, high) = (result.vertices - HANGING)[:, 1], np.quantile(DEPTH, [0.3, 0.7])
        lengths.append(float(off[high < DEPTH].mean() - off[low > DEPTH].mean()))
    assert abs(lengths[1]) < 0.95 * abs(lengths[0])


def drape(**physics) -> float:
    """Metres by which the end of a sleeve sinks that nobody sees, when the arm in it turns from upright to level.

    The sleeve is a tube of cloth; the arm is thinner, so the sleeve hangs from it.
    """
    arm = Mesh(MESH.vertices * [0.3, 1.0, 0.3], MESH.faces)
    config = dataclasses.replace(Config(), physics=Physics(**physics))
    tracker, middle = Tracker(MESH, body=arm, config=config), MESH.vertices.mean(axis=0)
    visible = MESH.vertices[:, 1] > np.median(MESH.vertices[:, 1])
    for k in range(1, 31):
        turned = about([0.0, 0.0, 1.0], np.pi / 2 * min(1.0, k / 15)).T
        shape = (MESH.vertices - middle) @ turned + middle
        points = scan(shape, MESH, seed=k)
        near = np.linalg.norm(points[:, None, :] - shape[visible][None, ::4, :], axis=2).min(axis=1) < 0.03
        result = tracker.step(points[near], timestamp=k / FPS, body_vertices=(arm.vertices - middle) @ turned + middle)
    assert rms((result.vertices - shape)[visible]) < 0.02
    return float((shape - result.vertices)[~visible][:, 1].mean())


def test_a_hidden_sleeve_sinks_when_the_arm_is_raised():
    assert drape() > drape(weight=0.0) + 0.001
