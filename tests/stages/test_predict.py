"""Stage A against dense 6x6 algebra."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf.config import Config, ConstantAcceleration, ConstantVelocity
from ddakf.data.rotation import rotation_matrices
from ddakf.kernels import predict as kernels
from ddakf.stages.fuse import condition
from ddakf.stages.predict import learn_acceleration, predict
from tests.stages.scenes import assert_positive_definite, full, problem_of, random_state

PLAIN = ConstantVelocity(damping=0.0)
WHOLE = ConstantVelocity(damping=0.0, acceleration_time=10.0)  # one acceleration in a step, however long
DAMPED = ConstantVelocity(damping=3.0, acceleration_time=10.0)
ACCELERATED = ConstantAcceleration(damping=0.0, share=1.0)
STEPS = st.floats(1e-3, 0.4)
SEEDS = st.integers(0, 2**32 - 1)



def learn(posterior, prior, measured, dt, config):
    """The acceleration after a frame with this prediction."""
    return learn_acceleration(problem_of(None, prior, dataclasses.replace(Config(), predict=config), dt=dt), posterior, measured)


def start(seed=0, n=7):
    rng = np.random.default_rng(seed)
    return random_state(rng.normal(size=(n, 3)), rng)


def dense(state, dt, config):
    """x = F x and P = F P F' + Q, one vertex at a time, Q of white acceleration."""
    g = np.exp(-config.damping * dt)
    travel = dt if config.damping == 0 else (1 - g) / config.damping
    F = np.block([[np.eye(3), travel * np.eye(3)], [np.zeros((3, 3)), g * np.eye(3)]])
    q = config.acceleration**2
    Q = q * np.kron([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]], np.eye(3))
    x = np.concatenate([state.position, state.velocity], axis=1) @ F.T
    return x, np.array([F @ P @ F.T + Q for P in full(state)])


@pytest.mark.parametrize("config", [WHOLE, DAMPED], ids=["constant velocity", "damped"])
@given(dt=STEPS, seed=SEEDS)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_prediction_is_F_x_and_F_P_Ft_plus_Q(config, dt, seed):
    state = start(seed)
    prior = predict(state, dt, None, config, seen=False)
    x, P = dense(state, dt, config)
    np.testing.assert_allclose(np.concatenate([prior.position, prior.velocity], axis=1), x, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(full(prior), P, rtol=1e-10, atol=1e-15)
    np.testing.assert_array_equal(prior.R, state.R)


@given(n=st.integers(1, 6), seed=SEEDS)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_accelerations_that_follow_each_other_are_independent(n, seed):
    """A step over several of them leaves what as many short steps leave."""
    state, part = start(seed), PLAIN.acceleration_time
    stepwise = state
    for _ in range(n):
        stepwise = predict(stepwise, part, None, PLAIN)
    np.testing.assert_allclose(full(predict(state, n * part, None, PLAIN)), full(stepwise), rtol=1e-9, atol=1e-14)


def test_velocity_of_a_slow_stream_settles():
    """Positions alone are measured, exactly; what is missed shrinks from frame to frame instead of ringing."""
    dt, config = 0.1, ConstantVelocity(damping=0.0)
    state = start()._replace(velocity=np.ones((7, 3)), P_pu=np.zeros((7, 3, 3)))
    missed = []
    for _ in range(6):
        prior = predict(state, dt, None, config)
        missed.append(np.abs(prior.position - state.position).max())  # the truth stands still
        state = condition(prior, state.position, 1e-8 * np.tile(np.eye(3), (7, 1, 1)), prior.R)
    assert missed[-1] < 0.05 * missed[0]


def turning(state, rng):
    """The state with the velocities of a rigid motion, and where it will be after ``seconds``, as a function."""
    center, mean, by = state.position.mean(axis=0), rng.normal(size=3), rng.normal(size=3)
    velocity = mean + np.cross(by, state.position - center)

    def later(seconds):
        return center + seconds * mean + (state.position - center) @ rotation_matrices(seconds * by).T

    return state._replace(velocity=velocity), later


@given(dt=STEPS, seed=SEEDS)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_a_garment_without_a_body_goes_on_turning(dt, seed):
    state, later = turning(start(seed), np.random.default_rng(seed))
    prior = predict(state, dt, None, DAMPED)
    np.testing.assert_allclose(prior.position, later(dt), atol=1e-6)
    np.testing.assert_allclose(predict(prior, dt, None, DAMPED).position, later(2 * dt), atol=1e-5)
    for slower in (predict(state, dt, None, DAMPED, seen=False), predict(state, dt, np.zeros((7, 3)), DAMPED)):
        np.testing.assert_allclose(slower.velocity, np.exp(-DAMPED.damping * dt) * state.velocity)


@given(seed=SEEDS)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_motion_that_is_not_rigid_is_damped(seed):
    """Velocities away from a centre turn nothing."""
    state = start(seed)
    state = state._replace(velocity=state.position - state.position.mean(axis=0))
    prior, damped = predict(state, 0.1, None, DAMPED), predict(state, 0.1, None, DAMPED, seen=False)
    np.testing.assert_allclose(prior.position, damped.position, atol=1e-9)
    np.testing.assert_allclose(prior.velocity, damped.velocity, atol=1e-9)


def test_undamped_velocity_is_constant():
    state = start()
    np.testing.assert_array_equal(predict(state, 0.1, None, PLAIN).velocity, state.velocity)


def test_damped_velocity_decays_and_its_steps_compose():
    state = start()
    once = predict(state, 0.2, None, DAMPED, seen=False)
    twice = predict(predict(state, 0.08, None, DAMPED, seen=False), 0.12, None, DAMPED, seen=False)
    np.testing.assert_allclose(once.velocity, np.exp(-3.0 * 0.2) * state.velocity)
    np.testing.assert_allclose(twice.velocity, once.velocity)
    np.testing.assert_allclose(twice.position, once.position)


def test_body_motion_is_added_to_the_position_alone():
    state, carried = start(), np.random.default_rng(1).normal(size=(7, 3))
    still, ridden = predict(state, 0.03, None, DAMPED, seen=False), predict(state, 0.03, carried, DAMPED)
    np.testing.assert_allclose(ridden.position, still.position + carried)
    np.testing.assert_array_equal(ridden.velocity, still.velocity)
    np.testing.assert_array_equal(full(ridden), full(still))


@pytest.mark.parametrize("config", [PLAIN, DAMPED], ids=["constant velocity", "damped"])
@pytest.mark.parametrize("gap", [2.0, 60.0, 86_400.0])
def test_long_gap_moves_the_mean_no_further_than_the_longest_step(config, gap):
    state = start()
    limit = predict(state, config.longest_step, None, config).position
    prior = predict(state, gap, None, config)
    np.testing.assert_allclose(prior.position, limit)
    assert np.isfinite(full(prior)).all()
    assert_positive_definite(full(prior))


@given(gap=st.floats(1e-6, 1e6), more=st.floats(1.01, 100), seed=SEEDS)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_longer_gap_is_less_certain(gap, more, seed):
    state = start(seed)._replace(P_pu=np.zeros((7, 3, 3)))  # with a negative correlation uncertainty may first shrink
    shorter, longer = (predict(state, dt, None, PLAIN) for dt in (gap, more * gap))
    assert (np.linalg.eigvalsh(longer.P_pp - shorter.P_pp).min(axis=1) > -1e-12 * np.trace(longer.P_pp, axis1=1, axis2=2)).all()
    assert (np.trace(longer.P_pp, axis1=1, axis2=2) > np.trace(shorter.P_pp, axis1=1, axis2=2)).all()


@pytest.mark.parametrize("config", [PLAIN, DAMPED], ids=["constant velocity", "damped"])
def test_uncertainty_grows_with_every_missing_frame(config):
    rng = np.random.default_rng(2)
    state = random_state(rng.normal(size=(7, 3)), rng)._replace(P_pu=np.zeros((7, 3, 3)))
    sizes = []
    for _ in range(60):
        sizes.append(np.trace(state.P_pp, axis1=1, axis2=2))
        state = predict(state, 1 / 30, None, config)
        assert_positive_definite(full(state))
    assert (np.diff(sizes, axis=0) > 0).all()


def test_input_is_left_as_it_was():
    state = start()
    copies = [array.copy() for array in state]
    predict(state, 0.1, np.ones((7, 3)), DAMPED)
    learn(predict(state, 0.1, None, ACCELERATED), state, np.ones(7, bool), 0.1, ACCELERATED)
    for array, copy in zip(state, copies, strict=True):
        np.testing.assert_array_equal(array, copy)


def test_process_noise_grows_with_the_acceleration():
    state = start()
    calm, wild = (predict(state, 0.1, None, dataclasses.replace(PLAIN, acceleration=a)) for a in (1.0, 30.0))
    assert (np.linalg.eigvalsh(full(wild) - full(calm)) > -1e-12).all()


# Constant acceleration ----------------------------------------------------------------------------------------------

ALL = np.ones(7, bool)
NONE = np.zeros(7, bool)


def accelerated(seed=0):
    """A state with accelerations."""
    return start(seed)._replace(acceleration=np.random.default_rng(seed + 1).normal(scale=9.0, size=(7, 3)))


@given(dt=st.floats(1e-3, 0.1), seed=SEEDS)
@settings(max_examples=25, deadline=None, derandomize=True)
def test_acceleration_enters_the_mean_alone(dt, seed):
    state = accelerated(seed)
    prior, plain = predict(state, dt, None, ACCELERATED), predict(state, dt, None, PLAIN)
    a = state.acceleration
    np.testing.assert_allclose(prior.position, state.position + dt * state.velocity + dt**2 / 2 * a, atol=1e-12)
    np.testing.assert_allclose(prior.velocity, state.velocity + dt * a, atol=1e-12)
    np.testing.assert_allclose(prior.acceleration, a, atol=1e-9)
    np.testing.assert_array_equal(full(prior), full(plain))


@pytest.mark.parametrize("memory", [0.05, 0.5])
@given(steps=st.lists(st.floats(0.01, 0.05), min_size=150, max_size=150), seed=SEEDS)
@settings(max_examples=10, deadline=None, derandomize=True)
def test_constant_acceleration_is_learnt_exactly(memory, steps, seed):
    """Frames at any distance from each other, positions and velocities known exactly."""
    config = dataclasses.replace(ACCELERATED, memory=memory)
    truth = accelerated(seed)
    state, t = truth._replace(acceleration=np.zeros((7, 3))), 0.0
    for dt in steps:
        prior = predict(state, dt, None, config)
        t += dt
        p = truth.position + t * truth.velocity + t**2 / 2 * truth.acceleration
        seen = prior._replace(position=p, velocity=truth.velocity + t * truth.acceleration)
        state = learn(seen, prior, ALL, dt, config)
    left = np.exp(-t / memory)
    np.testing.assert_allclose(state.acceleration, (1 - left) * truth.acceleration, rtol=1e-6, atol=1e-6)
    exact = predict(state, 0.03, None, config).position
    t += 0.03
    away = exact - (truth.position + t * truth.velocity + t**2 / 2 * truth.acceleration)
    assert np.abs(away).max() < 1e-8 + left * 0.03**2 / 2 * np.abs(truth.acceleration).max() * 1.001


def test_positions_alone_teach_the_acceleration():
    """As in the tracker, where velocities follow from positions through the prior's cross covariance."""
    a, dt = np.array([0.0, -9.81, 2.0]), 1 / 30
    state = start(n=7)._replace(velocity=np.zeros((7, 3)))
    origin, known, errors = state.position, np.broadcast_to(1e-8 * np.eye(3), (7, 3, 3)), []
    for k in range(1, 31):
        prior = predict(state, dt, None, ACCELERATED)
        position = origin + (k * dt) ** 2 / 2 * a
        errors.append(np.abs(prior.position - position).max())
        state = learn(condition(prior, position, known, state.R), prior, ALL, dt, ACCELERATED)
    assert errors[0] > 5e-3  # the first prediction knows of no acceleration
    assert max(errors[-5:]) < 2e-4
    np.testing.assert_allclose(state.acceleration, np.tile(a, (7, 1)), atol=0.3)


def test_nothing_is_learnt_with_constant_velocity():
    state = start()
    prior = predict(state, 0.03, None, DAMPED)
    seen = prior._replace(velocity=prior.velocity + 1.0)
    assert learn(seen, prior, ALL, 0.03, DAMPED) is seen
    np.testing.assert_array_equal(prior.acceleration, 0.0)


def test_share_of_nothing_is_constant_velocity():
    state = accelerated()
    none = predict(state, 0.03, None, dataclasses.replace(ACCELERATED, share=0.0))
    plain = predict(state, 0.03, None, PLAIN)
    np.testing.assert_array_equal(none.position, plain.position)
    np.testing.assert_array_equal(none.velocity, plain.velocity)


@pytest.mark.parametrize("config", [ConstantAcceleration(), ACCELERATED], ids=["default", "undamped, all of it"])
@pytest.mark.parametrize("gap", [0.3, 2.0, 60.0, 86_400.0])
def test_in_a_long_gap_the_acceleration_ends(config, gap):
    state = accelerated()
    still = predict(state._replace(acceleration=np.zeros((7, 3))), gap, None, config)
    prior = predict(state, gap, None, config)
    a = np.abs(state.acceleration)
    assert (np.abs(prior.velocity - still.velocity) <= config.memory * a * (1 + 1e-9)).all()
    assert (np.abs(prior.position - still.position) <= config.memory * config.longest_step * a).all()


@pytest.mark.parametrize("config", [ConstantAcceleration(), ACCELERATED], ids=["default", "undamped, all of it"])
def test_without_measurements_the_acceleration_fades(config):
    state, dt = accelerated()._replace(velocity=np.zeros((7, 3))), 1 / 30
    a = np.abs(state.acceleration).max()
    for _ in range(60):
        prior = predict(state, dt, None, config)
        state = learn(prior, prior, NONE, dt, config)
    assert np.abs(state.acceleration).max() < 1e-2 * a
    assert np.abs(state.velocity).max() < 1.2 * config.memory * a


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.1e-3, 0.5, 3.0, 40.0])
def test_the_rotation_of_a_vector_is_that_of_numpy(angle):
    vector, got = np.random.default_rng(2).normal(size=3), np.empty((3, 3))
    vector *= angle / np.linalg.norm(vector)
    kernels.rotation_matrix(vector / 0.3, 0.3, got)
    np.testing.assert_allclose(got, rotation_matrices(vector), rtol=0, atol=1e-14)


@pytest.mark.parametrize("extent", [(1, 1, 1), (1, 1, 0), (1, 0, 0), (0, 0, 0)], ids=["body", "plane", "line", "point"])
def test_the_angular_velocity_is_that_of_numpy(extent):
    rng = np.random.default_rng(3)
    position, velocity = 0.3 * rng.normal(size=(50, 3)) * extent, rng.normal(size=(50, 3))
    inertia = np.square(position).sum() * np.eye(3) - position.T @ position
    momentum, got = np.cross(position, velocity).sum(axis=0), np.empty(3)
    energy = kernels.angular_velocity(inertia, momentum, got)
    expected = np.linalg.solve(inertia + (1e-9 * np.trace(inertia) + 1e-30) * np.eye(3), momentum)
    np.testing.assert_allclose(got, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())
    assert energy == pytest.approx(expected @ inertia @ expected, rel=1e-6, abs=1e-12)
