"""Covariances: positive definite, bounded for any pattern of missing data (section 2.7), near the exact marginals."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf import Config, Mesh, Tracker, fuse, model, rigidity, snapshot
from ddakf.types import State
from ddakf.uncertainty import bound, marginals, posterior
from tests.physics.shapes import sheet
from tests.stages import dense
from tests.stages.scenes import assert_positive_definite, full, inner_body, linearized, measured, random_state, scan, tube

PRESETS = pytest.mark.parametrize("preset", ["default", "paper"])
CONFIGS = {"default": Config(), "paper": Config.paper()}
ONE_EACH = dataclasses.replace(
    Config(), uncertainty=dataclasses.replace(Config().uncertainty, correlated_measurements=1.0, correlated_coupling=1.0)
)


def traces(covariance):
    return np.trace(covariance, axis1=1, axis2=2)


def stored(tracker) -> np.ndarray:
    """(V, 6, 6) what the recursion keeps."""
    _, arrays = snapshot.unpack(tracker.snapshot())
    return full(State(**{name: arrays[f"state_{name}"] for name in State._fields}))


# Any pattern of missing data ----------------------------------------------------------------------------------------

GARMENT = tube(radius=0.08, around=20, along=12, spacing=0.022)
CLOUDS = [scan(GARMENT.vertices, GARMENT, 1500, 0.002, seed) for seed in range(6)]
KINDS = {
    "whole": lambda k: CLOUDS[k % 6],
    "left half": lambda k: CLOUDS[k % 6][CLOUDS[k % 6][:, 0] < 0],
    "lower part": lambda k: CLOUDS[k % 6][CLOUDS[k % 6][:, 1] < 0.08],
    "few": lambda k: CLOUDS[k % 6][:15],
    "empty": lambda k: CLOUDS[0][:0],
    "elsewhere": lambda k: CLOUDS[k % 6] + np.float32(0.07),
    "noise": lambda k: np.random.default_rng(k).uniform(-0.3, 0.5, (90, 3)).astype(np.float32),
}
PATTERNS = st.lists(
    st.tuples(st.sampled_from(list(KINDS)), st.integers(1, 40), st.sampled_from([1 / 30, 1 / 120, 0.2, 3.0])),
    min_size=1,
    max_size=12,
)


@PRESETS
@given(pattern=PATTERNS)
@settings(max_examples=2, deadline=None, derandomize=True)
def test_trace_is_bounded_for_a_thousand_steps_of_any_missing_data(preset, pattern):
    config = CONFIGS[preset]
    limits = config.uncertainty
    calm = dataclasses.replace(config, start=dataclasses.replace(config.start, search=False))  # a search takes long
    tracker, now, k = Tracker(GARMENT, config=calm), 0.0, 0
    while k < 1000:
        for kind, length, dt in pattern:
            for _ in range(length):
                now, k = now + dt, k + 1
                result = tracker.step(KINDS[kind](k), timestamp=now)
                assert traces(result.covariance).max() <= 3 * limits.ceiling_sd**2 * (1 + 1e-9)
                if k % 100 == 0:
                    P = stored(tracker)
                    assert_positive_definite(P)
                    assert_positive_definite(result.covariance)
                    assert traces(P[:, :3, :3]).max() <= 3 * limits.ceiling_sd**2 * (1 + 1e-9)
                    assert traces(P[:, 3:, 3:]).max() <= 3 * limits.ceiling_speed_sd**2 * (1 + 1e-9)
                    assert np.isfinite(result.vertices).all()


@PRESETS
@pytest.mark.parametrize("worn", [False, True], ids=["cloth alone", "body"])
def test_grows_while_nothing_is_measured_and_shrinks_after(preset, worn):
    body = inner_body(GARMENT) if worn else None
    tracker = Tracker(GARMENT, body=body, config=CONFIGS[preset])
    more = {"body_vertices": body.vertices} if worn else {}
    for k in range(1, 11):
        result = tracker.step(CLOUDS[k % 6], timestamp=k / 30, **more)
    sizes = [traces(result.covariance)]
    for k in range(11, 50):
        result = tracker.step(CLOUDS[0][:0], timestamp=k / 30, **more)
        sizes.append(traces(result.covariance))
        assert not result.observed.any()
    stride = 10 if worn else 1  # for a while a new touch of the body may tell more than time takes away
    before, after = np.array(sizes)[:-stride], np.array(sizes)[stride:]
    growing = before < 0.9 * 3 * CONFIGS[preset].uncertainty.ceiling_sd ** 2
    assert (after > before)[growing].all()
    again = tracker.step(CLOUDS[0], timestamp=50 / 30, **more)
    assert (traces(again.covariance)[again.observed] < sizes[-1][again.observed]).all()


def test_hidden_vertices_are_less_certain_than_seen_ones():
    tracker = Tracker(GARMENT)
    for k in range(1, 16):
        result = tracker.step(KINDS["lower part"](k), timestamp=k / 30)
    far = GARMENT.vertices[:, 1] > 0.18
    assert result.sigma[far].min() > 1.3 * np.median(result.sigma[result.observed])


# Bounds -------------------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1), size=st.sampled_from([1e-6, 1e-2, 1.0, 1e3, 1e8]))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_bounding_keeps_blocks_positive_definite_and_small_ones_as_they_are(seed, size):
    limits = Config().uncertainty
    rng = np.random.default_rng(seed)
    state = random_state(rng.normal(size=(10, 3)), rng, sd=size, speed_sd=10 * size)
    bounded = bound(state, limits)
    assert_positive_definite(full(bounded))
    assert traces(bounded.P_pp).max() <= 3 * limits.ceiling_sd**2 * (1 + 1e-9)
    assert traces(bounded.P_uu).max() <= 3 * limits.ceiling_speed_sd**2 * (1 + 1e-9)
    small = (traces(state.P_pp) < 3 * limits.ceiling_sd**2) & (traces(state.P_uu) < 3 * limits.ceiling_speed_sd**2)
    np.testing.assert_array_equal(full(bounded)[small], full(state)[small])


# Against the exact marginals ----------------------------------------------------------------------------------------

MESHES = {"sheet": sheet(), "larger sheet": sheet(8, 8), "tube": tube(around=10, along=6)}
SEEN = {
    "all": lambda x: np.ones(len(x), bool),
    "half": lambda x: x[:, 0] > np.median(x[:, 0]),
    "every other": lambda x: np.arange(len(x)) % 2 == 0,
    "two": lambda x: np.arange(len(x)) < 2,
}


def solved(mesh: Mesh, seen, config, seed=0):
    """One update of a noisy garment: the state, its reported covariance, and the dense matrix of its MAP problem."""
    rng = np.random.default_rng(seed)
    garment, n = model.build(mesh, 0.003), mesh.n_vertices
    prior = random_state(mesh.vertices + rng.uniform(-0.002, 0.002, (n, 3)), rng)
    normal = np.array([0.0, 0.0, 1.0]) + rng.normal(scale=0.3, size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    used = SEEN[seen](mesh.vertices)
    measurement = measured(prior.position + rng.normal(scale=0.003, size=(n, 3)), normal, used)
    problem = dense.Problem(
        mesh, garment, config, prior, measurement, used.astype(float), np.tile(0.004**2 * np.eye(3), (n, 1, 1))
    )
    update = fuse.begin(prior, mesh.vertices, rigidity.rotations(prior.position, garment), 1.0, garment, config)
    parts = linearized(prior.position, garment, None, 1.0, config.physics)
    update = fuse.fuse(update, prior, measurement, problem.weight, problem.R, parts, 1.0, garment, config)
    rigid = (
        (mesh.vertices, config.physics.rest_rigidity, update.rest.rotation),
        (mesh.vertices, config.physics.motion_rigidity, update.motion.rotation),
    )
    _, jacobian = dense.linearised(lambda x, held: dense.residuals(x, held, problem, rigid), prior.position)
    state = posterior(update, prior, config)
    return state, marginals(update, state, garment, config), dense.gauss_newton(jacobian, majorised=False), used


def diagonal_blocks(matrix):
    n = len(matrix) // 3
    return matrix.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]


@pytest.mark.parametrize("seen", list(SEEN))
@pytest.mark.parametrize("name", list(MESHES))
def test_reported_covariance_is_near_the_exact_marginals(name, seen):
    """With evidence counted as independent, as the dense inverse counts it: within a factor 3 in the trace, every vertex."""
    _, covariance, A, _ = solved(MESHES[name], seen, ONE_EACH)
    ratio = traces(covariance) / traces(diagonal_blocks(np.linalg.inv(A)))
    assert ratio.min() > 0.3
    assert ratio.max() < 2.5
    assert 0.35 < np.median(ratio) < 1.8


@pytest.mark.parametrize("seen", list(SEEN))
@pytest.mark.parametrize("name", list(MESHES))
def test_default_never_reports_less_than_the_exact_marginals(name, seen):
    """The default divides evidence that is counted more than once, so it is never the more confident one."""
    _, covariance, A, _ = solved(MESHES[name], seen, Config())
    assert (traces(covariance) / traces(diagonal_blocks(np.linalg.inv(A)))).min() > 1.0


@pytest.mark.parametrize("seen", list(SEEN))
def test_stored_blocks_are_the_covariance_given_the_neighbours(seen):
    """Never more than the marginals; equal to the inverse of the diagonal blocks but for the bound on bending."""
    state, _, A, _ = solved(MESHES["tube"], seen, Config())
    conditional = traces(np.linalg.inv(diagonal_blocks(A)))
    assert (traces(state.P_pp) <= conditional * (1 + 1e-4)).all()
    assert (traces(state.P_pp) > 0.2 * conditional).all()
    assert_positive_definite(full(state))


@pytest.mark.parametrize("name", list(MESHES))
def test_reported_covariances_are_positive_definite(name):
    for config in (Config(), ONE_EACH):
        assert_positive_definite(solved(MESHES[name], "half", config)[1])


def test_a_measurement_makes_its_vertex_more_certain():
    seen, unseen = (solved(MESHES["larger sheet"], which, Config())[1] for which in ("all", "two"))
    assert (traces(seen)[2:] < traces(unseen)[2:]).all()
