"""Stage F against dense algebra, with the energies written out anew and differentiated numerically."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from ddakf import Config, Fabric, Mesh, Tracker
from ddakf.body import contact as body_contact
from ddakf.config import MapUpdate, PlaneAssociation
from ddakf.garment import model
from ddakf.kernels.normals import vertex_normals
from ddakf.physics import energies, rigidity
from ddakf.stages import fuse
from ddakf.types import Health, InputReference, Sides, State, Track, UpdateTerms
from tests.physics.shapes import ball, sheet
from tests.stages import dense
from tests.stages.scenes import FPS, blocks, full, measured, posed, problem_of, random_state, rms, scan, tube

MESH = sheet()
V = MESH.n_vertices
THICKNESS = 0.003
CONFIG = dataclasses.replace(
    Config(),
    fuse=MapUpdate(solver_iterations=1000, solver_tolerance=1e-9),
    physics=dataclasses.replace(
        Config().physics,
        bend=0.5,
        stretch=3e5,
        shear=1e5,
        collision=1e9,
        thickness=THICKNESS,
        strain_scale=0.05,
    ),
)
FAR = 10.0  # m, a gate that bounds nothing


def scene(seed, config=CONFIG, body=False, seen=0.7, planes=True):
    """A problem whose terms all pull: a prior off the rest shape, planes off the prior, some vertices in the body."""
    rng = np.random.default_rng(seed)
    garment = model.build(MESH)
    position = MESH.vertices + rng.uniform(-0.002, 0.002, (V, 3))
    prior = random_state(position, rng)
    normal = np.array([0.0, 0.0, 1.0]) + rng.normal(scale=0.3, size=(V, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    target = position + rng.normal(scale=0.004, size=(V, 3))
    used = rng.random(V) < seen
    weight = np.where(used, rng.uniform(0.2, 1.0, V), 0.0)
    measurement = measured(target, normal if planes else None, used)
    contact = touching = None
    if body:
        below = ball(3, 0.2)
        low = position.mean(axis=0) - [0.0, 0.0, 0.2 - 0.002]
        contact = posed(type(below)(below.vertices + low, below.faces))
        nearest = body_contact.nearest(contact, position).closest
        touching = nearest.point, nearest.normal
    R = blocks(V, 3, rng) * 0.004**2
    problem = dense.Problem(MESH, garment, config, prior, measurement, weight, R, touching, physics_lambda=1.5)
    return problem, contact


def begun(problem):
    last = MESH.vertices + 0.001 * np.sin(100 * MESH.vertices)
    return fuse.begin(frame(problem)), last


def frame(problem, contact=None):
    """The frame of a dense problem."""
    last = MESH.vertices + 0.001 * np.sin(100 * MESH.vertices)
    rotation = rigidity.rotations(problem.prior.position, problem.model)
    health = Health(physics_lambda=problem.physics_lambda)
    before = Track(None, None, None, 0.0, Health(), 0.0, None, None)
    return problem_of(
        problem.model,
        problem.prior,
        problem.config,
        last=before,
        motion_start=last,
        rotation=rotation,
        health=health,
        body=contact,
    )


def one_pass(update, problem, contact, gate=FAR):
    now = frame(problem, contact)
    fresh = update._replace(terms=update.terms._replace(forces=None))  # bending is that of this pass
    forces = energies.linearize(now, fresh)
    return fuse.fuse(now, update, UpdateTerms(problem.measurement, problem.weight, problem.R, forces), gate)


def rigid_terms(update, last, problem):
    return (
        (MESH.vertices, update.rest.weight, dense.transforms(update.rest)),
        (last, update.motion.weight, dense.transforms(update.motion)),
    )


def test_only_hidden_cloth_without_a_body_is_stiffened():
    problem, contact = scene(0, body=True)
    hidden, finer = problem.weight == 0, CONFIG.physics.hidden_edge / problem.model.edge_length
    assert finer > 1
    assert 0 < hidden.mean() < 1
    for body, more in ((contact, 1.0), (None, finer)):
        update = one_pass(begun(problem)[0], problem, body)
        for term, power in ((update.rest, 4), (update.motion, 2)):
            seen = term.weight[~hidden][0]
            np.testing.assert_allclose(term.weight[~hidden], seen)
            np.testing.assert_allclose(term.weight[hidden], seen * more**power)


TRACKED = Health(state="tracking")
FRONT, BESIDE, BEHIND = [0.0, 0.0, 5.0], [5.0, 0.0, 0.5], [0.0, 0.0, -5.0]  # m
ALL_AROUND, ONE_SIDE, TWO_NEAR, RIG = (
    SimpleNamespace(sensor=sensors and np.array(sensors), cell=0.01, empty=False)
    for sensors in (None, [FRONT], [FRONT, BESIDE], [FRONT, BESIDE, BEHIND])
)


@pytest.mark.parametrize(
    ("cloud", "body", "health", "sides", "soft"),
    [
        (ALL_AROUND, False, TRACKED, 0.4, True),
        (ONE_SIDE, True, TRACKED, 0.4, True),
        (ONE_SIDE, False, TRACKED, 0.4, False),
        (TWO_NEAR, False, TRACKED, 0.4, False),
        (RIG, False, TRACKED, 0.4, True),
        (ALL_AROUND, False, TRACKED, 0.0, False),
        (ALL_AROUND, True, TRACKED, 0.0, True),
        (ALL_AROUND, False, Health(state="recovering"), 0.4, False),
        (ALL_AROUND, True, TRACKED._replace(settling=1), 0.4, False),
    ],
    ids=["all around", "body", "one side", "two beside", "rig", "sheet", "sheet on a body", "recovering", "settling"],
)
def test_a_coarse_mesh_is_as_soft_per_area_as_a_finer_one_where_the_garment_is_known(cloud, body, health, sides, soft):
    problem, contact = scene(0, body=True)
    edge, own = problem.model.edge_length, problem.config.physics
    weights = []
    for factor in (2.0, 0.9, 0.1):  # edges of a mesh that bends as easily, over those of this one
        physics = dataclasses.replace(own, coarse_edge=factor * edge, coarse_share=0.3)
        now = frame(problem, contact if body else None)._replace(
            config=dataclasses.replace(problem.config, physics=physics), cloud=cloud, health=health,
            reference=InputReference(Sides(sides, sheet=sides == 0.0), 1.0, 1.0),
        )  # fmt: skip
        start = fuse.begin(now)
        weights.append((start.rest.weight[0], start.motion.weight[0]))
    shares = np.array(weights) / weights[0]
    np.testing.assert_allclose(shares, np.transpose([[1.0, 0.81, 0.3] if soft else [1.0] * 3] * 2))


ROUND, BALL = tube(), ball(3, 0.2)
BOX = Mesh(0.2 * BALL.vertices / np.abs(BALL.vertices).max(axis=1, keepdims=True), BALL.faces)


@pytest.mark.parametrize(
    ("mesh", "cloud", "health", "share"),
    [
        (ROUND, ALL_AROUND, TRACKED, fuse.LEAST_MOTION),
        (BOX, ALL_AROUND, TRACKED, 1.0),
        (ROUND, ONE_SIDE, TRACKED, 1.0),
        (ROUND, ALL_AROUND, Health(state="recovering"), 1.0),
    ],
    ids=["tube", "box", "one side", "recovering"],
)
def test_seen_cloth_that_slips_along_itself_moves_less_rigidly(mesh, cloud, health, share):
    garment, at_rest = model.build(mesh), np.zeros_like(mesh.vertices)
    prior, before = State.at(mesh.vertices, at_rest, 0.01, 0.1, 0.005), Track(None, None, None, 0.0, Health(), 0.0, None, None)
    physics = dataclasses.replace(CONFIG.physics, coarse_share=1.0, hidden_edge=0.0)
    now = problem_of(garment, prior, dataclasses.replace(CONFIG, physics=physics), last=before, health=health)
    start, seen = fuse.begin(now._replace(cloud=cloud)), np.arange(mesh.n_vertices) % 2 == 0
    planes = measured(mesh.vertices, at_rest + [0.0, 1.0, 0.0], seen)
    R = np.tile(1e-5 * np.eye(3), (mesh.n_vertices, 1, 1))
    terms = UpdateTerms(planes, seen.astype(float), R, energies.linearize(now, start))
    weight = fuse.fuse(now, start, terms, FAR).motion.weight
    np.testing.assert_allclose(weight[seen], share * weight[~seen])
    assert fuse._yielding(now._replace(cloud=cloud, body=object())) == 1.0


@pytest.mark.parametrize("sheet", [True, False])
def test_hidden_cloth_of_a_sheet_is_not_stiffened(sheet):
    problem, _ = scene(0)
    now = frame(problem)._replace(reference=InputReference(Sides(0.0, sheet=sheet), 1.0, 1.0))
    start = fuse.begin(now)
    terms = UpdateTerms(problem.measurement, problem.weight, problem.R, energies.linearize(now, start))
    assert (np.ptp(fuse.fuse(now, start, terms, FAR).rest.weight) == 0) == sheet


# The fused update ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("body", [False, True], ids=["cloth alone", "body"])
@pytest.mark.parametrize("seed", range(3))
def test_one_pass_is_the_dense_gauss_newton_step(seed, body):
    problem, contact = scene(seed, body=body)
    start, last = begun(problem)
    update = one_pass(start, problem, contact)
    rigid = rigid_terms(update, last, problem)
    here, jacobian = dense.linearised(lambda x, held: dense.residuals(x, held, problem, rigid), problem.prior.position)
    assert all(np.linalg.norm(part) > 1e-3 for name, part in here.items() if name != "prior"), "a term that does nothing"
    step = np.linalg.solve(dense.gauss_newton(jacobian), -dense.gradient(here, jacobian)).reshape(V, 3)
    assert rms(step) > 5e-4
    assert rms(update.position - problem.prior.position - step) < 2e-3 * rms(step)


@pytest.mark.parametrize("without", ["stretch", "shear", "bend", "rest_rigidity", "motion_rigidity"])
def test_every_term_acts_by_its_own_number(without):
    """The dense step with one stiffness at zero: a term that leaks into another would show."""
    config = dataclasses.replace(CONFIG, physics=dataclasses.replace(CONFIG.physics, **{without: 0.0}))
    problem, contact = scene(4, config)
    start, last = begun(problem)
    update = one_pass(start, problem, contact)
    rigid = rigid_terms(update, last, problem)
    here, jacobian = dense.linearised(lambda x, held: dense.residuals(x, held, problem, rigid), problem.prior.position)
    step = np.linalg.solve(dense.gauss_newton(jacobian), -dense.gradient(here, jacobian)).reshape(V, 3)
    assert rms(update.position - problem.prior.position - step) < 2e-3 * rms(step)


@pytest.mark.parametrize("fabric", [Fabric.SILK, Fabric.DENIM])
def test_the_fabric_scales_its_terms(fabric):
    problem, contact = scene(5, CONFIG.with_fabric(fabric))
    start, last = begun(problem)
    update = one_pass(start, problem, contact)
    rigid = rigid_terms(update, last, problem)
    here, jacobian = dense.linearised(lambda x, held: dense.residuals(x, held, problem, rigid), problem.prior.position)
    step = np.linalg.solve(dense.gauss_newton(jacobian), -dense.gradient(here, jacobian)).reshape(V, 3)
    assert rms(update.position - problem.prior.position - step) < 2e-3 * rms(step)


@pytest.mark.parametrize("seed", range(3))
def test_passes_converge_to_where_the_total_energy_is_stationary(seed):
    """Finite differences of the total energy vanish, whatever matrix the steps were taken with."""
    problem, contact = scene(seed)
    update, last = begun(problem)
    for _ in range(300):  # slow where nothing is measured, as rotations are held during a step; down to their float32
        update = one_pass(update, problem, contact)
    rigid = rigid_terms(update, last, problem)
    function = lambda x, held: dense.residuals(x, held, problem, rigid)  # noqa: E731
    start = dense.gradient(*dense.linearised(function, problem.prior.position))
    end = dense.gradient(*dense.linearised(function, update.position))
    assert np.linalg.norm(end) < 1e-5 * np.linalg.norm(start)


@pytest.mark.parametrize("seed", range(3))
def test_each_pass_lowers_the_energy(seed):
    problem, contact = scene(seed)
    start, last = begun(problem)
    update = one_pass(start, problem, contact)
    rigid = rigid_terms(update, last, problem)
    assert dense.energy(update.position, problem, rigid) < dense.energy(problem.prior.position, problem, rigid)


def test_the_dense_gradient_is_the_derivative_of_the_energy():
    """The reference itself: finite differences of the total energy, softening and all."""
    problem, contact = scene(2, body=True)
    start, last = begun(problem)
    rigid = rigid_terms(one_pass(start, problem, contact), last, problem)
    x, direction, step = problem.prior.position, np.random.default_rng(0).normal(size=(V, 3)), 1e-7
    ahead, behind = (dense.energy(x + s * step * direction, problem, rigid) for s in (1, -1))
    here = dense.gradient(*dense.linearised(lambda x, held: dense.residuals(x, held, problem, rigid), x))
    assert here @ direction.ravel() == pytest.approx((ahead - behind) / (2 * step), rel=1e-4)


@pytest.mark.parametrize("gate", [1e-4, 1e-3])
def test_no_vertex_is_moved_farther_than_the_gate(gate):
    problem, contact = scene(6)
    update = one_pass(begun(problem)[0], problem, contact, gate)
    length = np.linalg.norm(update.position - problem.prior.position, axis=1)
    assert length.max() <= gate * (1 + 1e-6)
    assert length.max() > 0.9 * gate


def test_nothing_measured_at_the_rest_shape_moves_nothing():
    problem, _ = scene(7, seen=0.0)
    problem = problem._replace(prior=problem.prior._replace(position=MESH.vertices.copy()))
    still = frame(problem)._replace(motion_start=MESH.vertices, rotation=rigidity.identity(V), health=Health())
    start = fuse.begin(still)
    update = one_pass(start, problem, None)
    np.testing.assert_allclose(update.position, MESH.vertices, atol=1e-8)  # transforms are float32
    assert not update.rejected


def test_an_absent_measurement_is_ignored_whatever_its_numbers():
    problem, contact = scene(8)
    garbled = np.where(problem.weight[:, None] > 0, problem.measurement.target, 1e3)
    other = problem._replace(measurement=problem.measurement._replace(target=garbled))
    steps = [one_pass(begun(p)[0], p, contact).position for p in (problem, other)]
    np.testing.assert_array_equal(steps[0], steps[1])


def test_precise_planes_are_met_and_the_rest_follows_smoothly():
    problem, contact = scene(9, seen=1.0)
    flat = measured(MESH.vertices * [1, 1, 0] + [0, 0, 0.01], np.tile([0.0, 0.0, 1.0], (V, 1)), np.ones(V, bool))
    soft = dataclasses.replace(CONFIG.physics, bend=0.0, rest_rigidity=0.0, motion_rigidity=0.0, stretch=1.0, shear=1.0)
    problem = problem._replace(
        measurement=flat, weight=np.ones(V), R=np.tile(1e-12 * np.eye(3), (V, 1, 1)),
        config=dataclasses.replace(CONFIG, physics=soft),
    )  # fmt: skip
    update, _ = begun(problem)
    for _ in range(5):
        update = one_pass(update, problem, contact)
    assert np.abs(update.position[:, 2] - 0.01).max() < 1e-3


# Velocities ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_condition_is_the_kalman_update_of_the_whole_six_vector(seed):
    """Where the new position comes of a measurement z of it, the dense update of (p, u) is the reference."""
    rng = np.random.default_rng(seed)
    n = 8
    prior = random_state(rng.normal(size=(n, 3)), rng)
    N, z = blocks(n, 3, rng) * 0.006**2, prior.position + rng.normal(scale=0.01, size=(n, 3))
    H = np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
    means, covariances = [], []
    for i, P in enumerate(full(prior)):
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + N[i])
        x = np.concatenate([prior.position[i], prior.velocity[i]])
        means.append(x + K @ (z[i] - H @ x))
        covariances.append((np.eye(6) - K @ H) @ P @ (np.eye(6) - K @ H).T + K @ N[i] @ K.T)
    means, covariances = np.array(means), np.array(covariances)
    state = fuse.condition(prior, means[:, :3], covariances[:, :3, :3], prior.R)
    np.testing.assert_allclose(state.velocity, means[:, 3:], rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(full(state), covariances, rtol=1e-7, atol=1e-10)


@pytest.mark.parametrize("dt", [1e-4, 1e-3])
def test_a_change_over_a_short_step_is_no_speed(dt):
    """After a precise frame the prior's error of a later one is all that of the velocity, and the gain is 1 / dt."""
    rng = np.random.default_rng(0)
    n, unit = 6, np.tile(np.eye(3), (6, 1, 1))
    prior = random_state(rng.normal(size=(n, 3)), rng)._replace(velocity=np.zeros((n, 3)))
    prior = prior._replace(P_pp=dt**2 * unit, P_pu=dt * unit, P_uu=unit)
    state = fuse.condition(prior, prior.position + 0.01, 0.5 * prior.P_pp, prior.R)
    assert np.abs(state.velocity).max() == pytest.approx(60.0 * 0.01)
    assert (np.linalg.eigvalsh(full(state)) > -1e-12).all()


def test_condition_on_what_was_known_changes_nothing():
    rng = np.random.default_rng(0)
    prior = random_state(rng.normal(size=(9, 3)), rng)
    state = fuse.condition(prior, prior.position, prior.P_pp, prior.R)
    np.testing.assert_allclose(full(state), full(prior), rtol=1e-9, atol=1e-15)
    np.testing.assert_allclose(state.velocity, prior.velocity)


# The paper's decoupled update ---------------------------------------------------------------------------------------

PAPER = dataclasses.replace(Config.paper(), physics=dataclasses.replace(CONFIG.physics, rest_rigidity=0.0, motion_rigidity=0.0))


@pytest.mark.parametrize("body", [False, True], ids=["cloth alone", "body"])
@pytest.mark.parametrize("seed", range(3))
def test_decoupled_update_is_a_kalman_filter_per_vertex_and_the_gradient_pseudo_measurement(seed, body):
    problem, contact = scene(seed, PAPER, body=body, planes=False)
    prior, weight, R = problem.prior, problem.weight, problem.R
    update = one_pass(begun(problem)[0], problem, contact)

    here, jacobian = dense.linearised(lambda x, held: dense.cloth(x, held, problem), prior.position)
    h = dense.gradient(here, jacobian).reshape(V, 3)
    # every energy's blocks times the vertices of its stencil: the neighbours move as well
    size = {"stretch": 3, "shear": 3, "bend": 4, "collision": 1}
    blocks = sum(size[name] * (J.T @ J).reshape(V, 3, V, 3)[np.arange(V), :, np.arange(V)] for name, J in jacobian.items())
    H = np.concatenate([np.eye(3), np.zeros((3, 3))], axis=1)
    for i, P in enumerate(full(prior)):
        x = np.concatenate([prior.position[i], prior.velocity[i]])
        if weight[i] > 0:
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R[i] / weight[i])
            x, P = x + K @ (problem.measurement.target[i] - H @ x), (np.eye(6) - K @ H) @ P
        # z = 0, h = dE/dp, H_phys = R_phys = blocks[i]
        Pp, B = P[:3, :3], blocks[i]
        correction = Pp @ B.T @ np.linalg.inv(B @ Pp @ B.T + B) @ h[i]
        x[:3] -= correction * min(1.0, PAPER.fuse.longest_correction / np.linalg.norm(correction))
        np.testing.assert_allclose(update.position[i], x[:3], rtol=0, atol=2e-6)
        np.testing.assert_allclose(update.state.velocity[i], x[3:], rtol=1e-9)
        np.testing.assert_allclose(full(update.state)[i], P, rtol=1e-7, atol=1e-12)
    assert update.finished


def test_decoupled_update_without_measurements_keeps_the_covariance():
    problem, contact = scene(3, PAPER, seen=0.0, planes=False)
    update = one_pass(begun(problem)[0], problem, contact)
    np.testing.assert_allclose(full(update.state), full(problem.prior), rtol=1e-12)


@pytest.mark.parametrize("size", [1, 7, 8, 24, 93])
def test_a_symmetric_matrix_is_inverted_whatever_its_size(size):
    root = np.random.default_rng(size).normal(size=(size, size + 5))
    matrix = root @ root.T
    inverse = fuse.invert(matrix)
    np.testing.assert_array_equal(inverse, inverse.T)
    np.testing.assert_allclose(inverse @ matrix, np.eye(size), atol=1e-3)


def test_a_matrix_that_rounding_made_indefinite_is_inverted_with_a_little_added():
    matrix = np.diag(np.arange(-1e-4, 9.0))
    inverse = fuse.invert(matrix)
    assert np.isfinite(inverse).all()
    np.testing.assert_allclose(inverse[3, 3], 1.0 / matrix[3, 3], rtol=1e-2)


def test_a_matrix_that_is_not_finite_has_no_inverse():
    assert np.isnan(fuse.invert(np.full((9, 9), np.inf))).all()


def test_vertices_stand_out_of_the_patches_that_their_planes_are_fitted_to():
    garment = tube()
    normal, inner = np.empty_like(garment.vertices), np.ones(garment.n_vertices, bool)
    vertex_normals(garment.vertices, garment.faces.astype(np.int32), normal)
    inner[model.build(garment).boundary[:, 0]] = False
    across = []
    for bulge in (0.0, PlaneAssociation.bulge):
        tracker = Tracker(garment, config=Config(associate=PlaneAssociation(bulge=bulge, points=0)))
        for k in range(12):
            result = tracker.step(scan(garment.vertices, garment, seed=k), timestamp=k / FPS)
        across.append(np.einsum("va,va->v", result.vertices - garment.vertices, normal)[inner])
    sunk, corrected = (each.mean() for each in across)
    assert sunk < corrected < 0.0
    assert corrected > 0.75 * sunk
    assert np.square(across[1]).mean() < 0.8 * np.square(across[0]).mean()


def test_a_garment_from_one_side_without_a_body_has_no_bulge(monkeypatch):
    cloud, tracker, seen, bulge = scan(tube().vertices, tube()), Tracker(tube()), [], fuse._bulge
    monkeypatch.setattr(fuse, "_bulge", lambda problem: seen.append(bulge(problem)) or seen[-1])
    tracker.step(cloud, timestamp=0.0, sensor_origin=[0.0, 0.2, 2.0])
    assert seen[-1] is None
    tracker.step(cloud, timestamp=0.1)
    assert np.abs(seen[-1]).max() > 1e-4
