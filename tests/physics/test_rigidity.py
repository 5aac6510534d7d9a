"""The locally rigid terms: rotations of the one-rings, and the force of edges that do not follow them."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf import Config
from ddakf.config import MapUpdate
from ddakf.garment import model
from ddakf.physics import energies, rigidity
from ddakf.stages import fuse
from ddakf.types import Setup, State, UpdateTerms
from tests.physics.shapes import sheet
from tests.stages import dense
from tests.stages.scenes import about, measured, problem_of, rms, tube

GARMENTS = {"sheet": model.build(sheet()), "tube": model.build(tube(along=5))}
SHEET, TUBE = GARMENTS.values()
ONLY = dataclasses.replace(
    Config().physics, stretch=0.0, shear=0.0, bend=0.0, collision=0.0, rest_rigidity=6e3, motion_rigidity=3e4
)
RIGID = dataclasses.replace(Config(), physics=ONLY, fuse=MapUpdate(solver_iterations=1000, solver_tolerance=1e-9))
WHOLE_START = dataclasses.replace(RIGID, physics=dataclasses.replace(ONLY, start_strain=1e3))
AXES = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda axis: np.linalg.norm(axis) > 0.1)


def rigid_alone(garment, position, last, config=RIGID):
    """One fusion pass under the rigid terms and a weak prior alone: the estimate, and the force (V, 3) behind its step."""
    n = len(position)
    prior = State.at(position, np.zeros((n, 3)), 0.01, 0.1, 0.004)
    rotation = rigidity.rotations(position, garment)
    problem = problem_of(garment, prior, config, motion_start=last, rotation=rotation)
    update = fuse.begin(problem)
    nothing = measured(position, np.zeros((n, 3)), np.zeros(n, bool))
    terms = UpdateTerms(nothing, np.zeros(n), prior.R, energies.linearize(problem, update))
    update = fuse.fuse(problem, update, terms, 10.0)
    i, j = garment.mesh.edges.T
    ring = update.rest.weight + update.motion.weight
    weight = 0.5 * (ring[i] + ring[j])
    matrix = np.eye(n) / (0.01**2 + config.fuse.prior_sd**2)
    np.add.at(matrix, (i, i), weight)
    np.add.at(matrix, (j, j), weight)
    np.add.at(matrix, (i, j), -weight)
    np.add.at(matrix, (j, i), -weight)
    return update, matrix @ (update.position - position)


def rolled(mesh, radius=0.3):
    """The mesh about a cylinder along y: bent, and hardly strained."""
    x, y, z = mesh.vertices.T
    return np.column_stack([(radius + z) * np.sin(x / radius), y, (radius + z) * np.cos(x / radius)])


def rest_force(garment, position, shape) -> float:
    """Largest force of the term of rest at ``position``, of 6,000 per square metre and edge."""
    term = rigidity.to_rest(garment, 6e3, rigidity.rotations(position, garment), shape=shape)
    rigidity.fit(term, rigidity.padded(position), garment, 4)
    force = np.zeros((len(position), 4))
    rigidity.add_force((term,), rigidity.padded(position), garment, force)
    return np.abs(force).max()


def off_template(shape, garment) -> np.ndarray:
    """(2E, 3) m, edges of a shape at rest less those of the template, turned to it."""
    row = np.repeat(np.arange(len(shape.rotation)), np.diff(garment.start))
    turn = 0.5 * (shape.rotation[row] + shape.rotation[garment.neighbour])
    return shape.edge - np.einsum("eab,eb->ea", turn, garment.rest_edge)


@pytest.mark.parametrize("name", ["sheet", "tube"])
def test_the_start_is_at_rest(name):
    garment = GARMENTS[name]
    start = rolled(garment.mesh)
    resting = rigidity.resting(start, Setup(garment, None, WHOLE_START))
    assert rest_force(garment, start, resting) < 1e-4 * rest_force(garment, start, None)


@pytest.mark.parametrize("name", ["sheet", "tube"])
def test_a_start_that_no_cloth_can_have_leaves_the_template(name):
    garment = GARMENTS[name]
    noise = np.random.default_rng(1).normal(0, 0.5 * garment.rest_length.mean(), garment.mesh.vertices.shape)
    found, whole = (
        off_template(rigidity.resting(garment.mesh.vertices + noise, Setup(garment, None, config)), garment)
        for config in (RIGID, WHOLE_START)
    )
    assert np.linalg.norm(found) < 0.2 * np.linalg.norm(whole)


def energy(position, source, weight, rotation, garment):  # rotation: T_i
    """1/4 sum over the rings, and the edges of each, of w_i |x_j - x_i - R_i s_ij|^2."""
    i, j = np.concatenate([garment.mesh.edges, garment.mesh.edges[:, ::-1]]).T
    off = position[j] - position[i] - np.einsum("eab,eb->ea", rotation[i], source[j] - source[i])
    return 0.25 * np.sum(weight[i] * np.square(off).sum(axis=1))


@pytest.mark.parametrize("name", ["sheet", "tube"])
@given(axis=AXES, angle=st.floats(0, np.radians(175)))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_a_rotation_of_any_angle_is_recovered(name, axis, angle):
    garment, R = GARMENTS[name], about(axis, angle)
    found = rigidity.rotations(garment.mesh.vertices @ R.T + [0.3, -0.2, 1.0], garment)
    np.testing.assert_allclose(found, np.tile(R, (len(found), 1, 1)), atol=0.02)


@pytest.mark.parametrize("name", ["sheet", "tube"])
@pytest.mark.parametrize("axis", [(1, 0, 0), (0, 1, 0), (0, 0, 1)])
def test_a_half_turn_is_recovered(name, axis):
    garment, R = GARMENTS[name], about(axis, np.pi)
    found = rigidity.rotations(garment.mesh.vertices @ R.T, garment)
    np.testing.assert_allclose(found, np.tile(R, (len(found), 1, 1)), atol=0.02)


@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([1e-3, 1.0, 1e3]))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_rotations_are_proper_and_those_of_singular_values(seed, scale):
    """Wherever the vertices are: crumpled, mirrored and flattened rings as well."""
    x = scale * np.random.default_rng(seed).normal(size=(120, 3)) * [1.0, 1.0, seed % 2]
    found, row = rigidity.rotations(x, TUBE), np.repeat(np.arange(120), np.diff(TUBE.start))
    covariance = np.zeros((120, 3, 3))
    np.add.at(covariance, row, (x[TUBE.neighbour] - x[row])[:, :, None] * TUBE.rest_edge[:, None, :].astype(float))
    u, values, vt = np.linalg.svd(covariance)
    u[:, :, 2] *= (side := np.linalg.det(u @ vt))[:, None]
    clear = values[:, 1] + side * values[:, 2] > 1e-3 * values[:, 0]
    assert clear.mean() > 0.9
    np.testing.assert_allclose(found[clear], (u @ vt)[clear], atol=1e-9)
    np.testing.assert_allclose(np.einsum("vab,vcb->vac", found, found), np.tile(np.eye(3), (120, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-9)


def test_a_straight_ring_has_a_rotation_along_it():
    """Its turn about itself is open."""
    x, row = np.outer(np.arange(120.0), [0.0, 1.0, 0.0]), np.repeat(np.arange(120), np.diff(TUBE.start))
    found, along = rigidity.rotations(x, TUBE), np.zeros((120, 3))
    np.add.at(along, row, (TUBE.neighbour.astype(float) - row)[:, None] * TUBE.rest_edge)
    along /= np.linalg.norm(along, axis=1)[:, None]
    np.testing.assert_allclose(np.einsum("vab,vb->va", found, along), np.tile([0.0, 1.0, 0.0], (120, 1)), atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(found), 1.0, atol=1e-9)
    assert np.isfinite(rigidity.rotations(np.zeros((120, 3)), TUBE)).all()


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_fitted_rotations_are_the_best_ones(seed):
    """Of a deformed garment they agree with those of a singular value decomposition (Kabsch 1976)."""
    rng = np.random.default_rng(seed)
    x = TUBE.mesh.vertices @ about(rng.normal(size=3), rng.uniform(0, 2)).T + rng.normal(scale=0.003, size=(120, 3))
    found = rigidity.rotations(x, TUBE)
    for i in range(120):
        ring = slice(TUBE.start[i], TUBE.start[i + 1])
        covariance = (x[TUBE.neighbour[ring]] - x[i]).T @ TUBE.rest_edge[ring]
        u, values, vt = np.linalg.svd(covariance)
        if values[1] < 0.1 * values[0]:
            continue  # a nearly straight ring leaves the turn about itself open
        best = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
        assert np.sum(found[i] * covariance) >= np.sum(best * covariance) * (1 - 1e-5)


def test_rotations_are_rotations_after_many_turns():
    term = rigidity.to_rest(TUBE, 1.0, rigidity.identity(120))
    rng = np.random.default_rng(0)
    for k in range(300):
        x = TUBE.mesh.vertices @ about([1, 2, 3], 0.1 * k).T + rng.normal(scale=0.004, size=(120, 3))
        rigidity.turn(term, x, TUBE)
    product = term.rotation @ term.rotation.transpose(0, 2, 1)
    np.testing.assert_allclose(product, np.tile(np.eye(3), (120, 1, 1)), atol=1e-6)
    assert (np.linalg.det(term.rotation) > 0).all()


@pytest.mark.parametrize("name", ["sheet", "tube"])
@given(axis=AXES, angle=st.floats(0, 3))
@settings(max_examples=15, deadline=None, derandomize=True)
def test_rigid_motion_makes_no_force(name, axis, angle):
    """Neither against the rest shape nor, where nothing moved since, against the last frame."""
    garment = GARMENTS[name]
    moved = garment.mesh.vertices @ about(axis, angle).T + [1.0, 2.0, -0.5]
    update, force = rigid_alone(garment, moved, moved)
    stiffness = RIGID.physics.rest_rigidity + RIGID.physics.motion_rigidity
    assert np.abs(force).max() < 0.01 * stiffness * garment.edge_length
    assert rms(update.position - moved) < 0.02 * garment.edge_length


@given(seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10, deadline=None, derandomize=True)
def test_force_is_minus_the_gradient_with_the_rotations_held(seed):
    rng = np.random.default_rng(seed)
    x = SHEET.mesh.vertices + rng.normal(scale=0.005, size=(20, 3))
    last = SHEET.mesh.vertices + rng.normal(scale=0.002, size=(20, 3))
    update, force = rigid_alone(SHEET, x, last)
    direction, step = rng.normal(size=x.shape), 1e-5

    def total(at):
        rest = energy(at, SHEET.mesh.vertices, update.rest.weight, dense.transforms(update.rest), SHEET)
        return rest + energy(at, last, update.motion.weight, dense.transforms(update.motion), SHEET)

    numeric = (total(x + step * direction) - total(x - step * direction)) / (2 * step)
    scale = np.linalg.norm(force) * np.linalg.norm(direction)
    assert np.sum(-force * direction) == pytest.approx(numeric, abs=1e-3 * scale)


@given(seed=st.integers(0, 2**32 - 1), share=st.sampled_from([0.0, 0.9]))
@settings(max_examples=10, deadline=None, derandomize=True)
def test_rings_of_unlike_weights_pull_as_their_energy_says(seed, share):
    rng = np.random.default_rng(seed)
    x = SHEET.mesh.vertices + rng.normal(scale=0.005, size=(20, 3))
    term = rigidity.to_rest(SHEET, 1.0, rigidity.rotations(x, SHEET), share)
    rigidity.stiffen_hidden((term, term), (2e3, 2e3), (2e3, 2e3), rng.random(20) < 0.5, 1.5)
    assert len(np.unique(term.weight)) == 2
    rigidity.fit(term, rigidity.padded(x), SHEET, 4)
    force, rotation = np.zeros((20, 4)), dense.transforms(term)
    rigidity.add_force((term,), rigidity.padded(x), SHEET, force)
    direction, step = rng.normal(size=x.shape), 1e-5
    ahead, behind = (
        energy(x + sign * step * direction, SHEET.mesh.vertices, term.weight, rotation, SHEET) for sign in (1, -1)
    )
    scale = np.linalg.norm(force) * np.linalg.norm(direction)
    assert np.sum(-force[:, :3] * direction) == pytest.approx((ahead - behind) / (2 * step), abs=1e-3 * scale)


def test_the_start_of_the_rotations_is_left_as_it_was():
    start = rigidity.identity(120)
    term = rigidity.to_rest(TUBE, 1.0, start)
    rigidity.turn(term, TUBE.mesh.vertices @ about([0, 1, 0], 0.5).T, TUBE)
    np.testing.assert_array_equal(start, rigidity.identity(120))


def fitted(garment, position, share):
    """(V, 3, 3) T_i of the rest term at a position, its rotations exact."""
    term = rigidity.to_rest(garment, 1.0, rigidity.rotations(position, garment), share)
    rigidity.turn(term, position, garment)
    return term, dense.transforms(term)


def resistance(garment, position, share) -> float:
    """Largest force (1/m^2 times m) of the rest term alone."""
    term, _ = fitted(garment, position, share)
    force = np.zeros((len(position), 4))
    rigidity.add_force((term,), rigidity.padded(position), garment, force)
    return float(np.abs(force).max())


@given(axis=AXES, angle=st.floats(0, 3), share=st.floats(0.05, 0.99))
@settings(max_examples=20, deadline=None, derandomize=True)
def test_rings_that_follow_their_strain_follow_no_turn(axis, angle, share):
    """A rigid motion is none of their strain: T is the rotation, and there is no force."""
    R = about(axis, angle)
    moved = TUBE.mesh.vertices @ R.T + [1.0, 2.0, -0.5]
    np.testing.assert_allclose(fitted(TUBE, moved, share)[1], np.tile(R, (120, 1, 1)), atol=1e-4)
    assert resistance(TUBE, moved, share) < 1e-4 * TUBE.edge_length


@given(seed=st.integers(0, 2**32 - 1), share=st.floats(0.05, 0.99))
@settings(max_examples=15, deadline=None, derandomize=True)
def test_a_followed_transform_is_the_best_between_ring_and_rotation(seed, share):
    """No other T makes sum |x_j - x_i - T s_ij|^2 + m |T - R|^2 smaller, m = (1 / share - 1) tr S / 2."""
    rng = np.random.default_rng(seed)
    x = TUBE.mesh.vertices * [1.1, 0.9, 1.05] + rng.normal(scale=0.002, size=(120, 3))
    term, T = fitted(TUBE, x, share)
    for i in rng.integers(0, 120, 10):
        ring = slice(TUBE.start[i], TUBE.start[i + 1])
        edge, s = x[TUBE.neighbour[ring]] - x[i], TUBE.rest_edge[ring].astype(float)
        m = (1 / share - 1) * np.sum(s**2) / 2

        def cost(M, edge=edge, s=s, m=m, i=i):
            return np.sum((edge - s @ M.T) ** 2) + m * np.sum((M - term.rotation[i]) ** 2)

        assert all(cost(T[i]) <= cost(T[i] + rng.normal(scale=0.02, size=(3, 3))) for _ in range(20))


def test_the_more_is_followed_the_less_an_even_strain_costs_and_an_uneven_one_still_does():
    """Twelve per cent along the sheet, everywhere alike or in half of it: the step between the halves is resisted."""
    garment = model.build(sheet(9))
    vertices = garment.mesh.vertices
    even = vertices * [1.12, 1.0, 1.0]
    middle = np.median(vertices[:, 0])
    uneven = vertices + np.maximum(vertices - middle, 0.0) * [0.12, 0.0, 0.0]
    forces = {share: [resistance(garment, x, share) for x in (even, uneven)] for share in (0.0, 0.5, 0.99)}
    assert forces[0.99][0] < 0.1 * forces[0.5][0] < 0.07 * forces[0.0][0]
    assert forces[0.99][1] > 3 * forces[0.99][0]
