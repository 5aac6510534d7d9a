"""Covariances: positive definite, bounded for any pattern of missing data (section 2.7), and the drift against dense algebra."""

import dataclasses
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf import Config, Mesh, Tracker, snapshot
from ddakf.body import body_anchor
from ddakf.body.proximity import Contact
from ddakf.config import Uncertainty
from ddakf.garment import model
from ddakf.kernels.uncertainty import PatchMeans
from ddakf.mesh import vertex_normals
from ddakf.physics import energies, rigidity
from ddakf.stages import error_size, fuse, uncertainty
from ddakf.stages.uncertainty import PatchStatistics, bound, marginals
from ddakf.types import Contacts, Drift, Estimate, Health, Problem, State, Track, UpdateTerms
from tests.lanes import every
from tests.physics.shapes import sheet
from tests.stages import dense
from tests.stages.scenes import assert_positive_definite, full, inner_body, measured, problem_of, random_state, scan, tube
from tests.tracker_runs import assert_same

PRESETS = pytest.mark.parametrize("preset", ["default", "paper"])
CONFIGS = {"default": Config(), "paper": Config.paper()}


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


@pytest.mark.slow
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


def without_clearance(config: Config) -> Config:
    """A configuration whose laws do not know how far cloth is from a body: cloth that falls on it is held again."""
    laws = config.normal_error, config.tangential_error
    along, across = (dataclasses.replace(law, clearance_power=0.0, free_power=0.0) for law in laws)
    as_stiff = dataclasses.replace(config.physics, coarse_share=1.0)  # a soft mesh settles on the body for long
    return dataclasses.replace(config, normal_error=along, tangential_error=across, physics=as_stiff)


@PRESETS
@pytest.mark.parametrize("worn", [False, True], ids=["cloth alone", "body"])
def test_grows_while_nothing_is_measured_and_shrinks_after(preset, worn):
    """Everywhere: each frame, or each five by the default, whose laws know the strain: it relaxes meanwhile.

    By the default in the mean at first: strain goes in the first frame without measurements, the angle to the planes too. On a
    body from then on: what the body holds is known better along the cloth than what a cloud shows of a tube.
    """
    body = inner_body(GARMENT) if worn else None
    tracker = Tracker(GARMENT, body=body, config=without_clearance(CONFIGS[preset]))
    more = {"body_vertices": body.vertices} if worn else {}
    for k in range(1, 11):
        result = tracker.step(CLOUDS[k % 6], timestamp=k / 30, **more)
    sizes = [traces(result.covariance)]
    for k in range(11, 50):
        drift = tracker._track.drift.covariance.diagonal()
        result = tracker.step(CLOUDS[0][:0], timestamp=k / 30, **more)
        sizes.append(traces(result.covariance))
        assert not result.observed.any()
        if preset == "default":  # the recursion itself, of all patches in all directions
            assert (tracker._track.drift.covariance.diagonal() > drift).all()
    stride = 5 if preset == "default" else 1
    before, after = np.array(sizes[:-stride]), np.array(sizes[stride:])
    growing = np.array(sizes[:-stride]) < 0.9 * 3 * CONFIGS[preset].uncertainty.ceiling_sd ** 2
    assert growing.mean() > 0.5
    first = 1 if worn and preset == "default" else 0
    assert (after.mean(axis=1) > before.mean(axis=1))[first:][growing.all(axis=1)[first:]].all()
    relaxed = 3 if first else 1  # a hem's vertices go on for two frames
    assert (after > before)[relaxed:][growing[relaxed:]].all()
    if preset == "paper":
        assert (after > before)[0][growing[0]].all()
    again = tracker.step(CLOUDS[0], timestamp=50 / 30, **more)
    if not (worn and preset == "default"):  # whose laws know by the clearance how hidden cloth beside a body strays
        assert (traces(again.covariance)[again.observed] < sizes[-1][again.observed]).all()


def test_cloth_on_a_body_is_less_certain_after_a_gap_than_when_it_is_seen_again():
    body = inner_body(GARMENT)
    tracker = Tracker(GARMENT, body=body)
    for k in range(1, 50):
        cloud = CLOUDS[k % 6] if k <= 10 else CLOUDS[0][:0]
        hidden = tracker.step(cloud, timestamp=k / 30, body_vertices=body.vertices)
    seen = tracker.step(CLOUDS[50 % 6], timestamp=50 / 30, body_vertices=body.vertices)
    assert seen.sigma[seen.observed].mean() < hidden.sigma[seen.observed].mean()


def test_hidden_vertices_are_less_certain_than_seen_ones():
    tracker = Tracker(GARMENT)
    for k in range(1, 16):
        result = tracker.step(KINDS["lower part"](k), timestamp=k / 30)
    far = GARMENT.vertices[:, 1] > 0.18
    assert result.sigma[far].min() > np.median(result.sigma[result.observed])


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


# One update of a noisy garment -----------------------------------------------------------------------------------------

MESHES = {"sheet": sheet(), "larger sheet": sheet(8, 8), "tube": tube(around=10, along=6)}
SEEN = {
    "all": lambda x: np.ones(len(x), bool),
    "half": lambda x: x[:, 0] > np.median(x[:, 0]),
    "every other": lambda x: np.arange(len(x)) % 2 == 0,
    "two": lambda x: np.arange(len(x)) < 2,
}
LIMP = dataclasses.replace(Config(), physics=dataclasses.replace(Config().physics, bend=0.0))  # no term beyond one-rings


class Solved(NamedTuple):
    problem: Problem
    update: Estimate
    prior: State
    state: State
    garment: model.Model
    jacobian: dict  # of all terms of the MAP problem, (C, 3V) each

    def exact(self, *terms: str) -> np.ndarray:
        """(3V, 3V) information of these terms, of all if none is named."""
        chosen = {name: J for name, J in self.jacobian.items() if not terms or name.startswith(terms)}
        return dense.gauss_newton(chosen, majorised=False)

    def report(self, config=LIMP, sd=0.005, still=None, clearance=None, slack=None, offset2=0.0005**2):
        """The reported covariance and the drift, started with ``sd``."""
        still = self.state.position if still is None else still
        update = self.update if clearance is None else self.update._replace(contacts=contacts_at(clearance))
        last = self.problem.last._replace(drift=Drift.at(self.garment, sd))
        health = Health(offset=offset2)
        problem = self.problem._replace(model=self.garment, config=config, last=last, motion_start=still, health=health)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(body_anchor, "slack", lambda problem: slack)
            return marginals(problem, update, self.state)


def contacts_at(clearance) -> Contacts:
    """Contacts of which the distances alone are known."""
    return Contacts(Contact(None, None, None, None, clearance), None)


def solved(mesh: Mesh, seen, config=LIMP, seed=0, scale=1.0) -> Solved:
    rng = np.random.default_rng(seed)
    garment, n = model.build(mesh), mesh.n_vertices
    alone = np.arange(n, dtype=np.int32)  # nothing is averaged
    ends = np.column_stack([np.repeat(alone, np.diff(garment.start.astype(int))), garment.neighbour])
    garment = garment._replace(patch=alone, crossing=model.crossings(ends, alone), likeness=likeness(mesh.vertices))
    prior = random_state(scale * mesh.vertices + rng.uniform(-0.002, 0.002, (n, 3)), rng)
    normal = np.array([0.0, 0.0, 1.0]) + rng.normal(scale=0.3, size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    used = SEEN[seen](mesh.vertices)
    measurement = measured(prior.position + rng.normal(scale=0.003, size=(n, 3)), normal, used)
    problem = dense.Problem(
        mesh, garment, config, prior, measurement, used.astype(float), np.tile(0.004**2 * np.eye(3), (n, 1, 1))
    )
    rotation = rigidity.rotations(prior.position, garment)
    last = Track(None, None, Drift.at(garment, 0.005), 0.0, Health(), None, None, None)
    frame = problem_of(garment, prior, config, motion_start=mesh.vertices, rotation=rotation, last=last)
    update = fuse.begin(frame)
    terms = UpdateTerms(measurement, problem.weight, problem.R, energies.linearize(frame, update))
    update = fuse.fuse(frame, update, terms, 1.0)
    rigid = (
        (mesh.vertices, update.rest.weight, dense.transforms(update.rest)),
        (mesh.vertices, update.motion.weight, dense.transforms(update.motion)),
    )
    _, jacobian = dense.linearised(lambda x, held: dense.residuals(x, held, problem, rigid), prior.position)
    return Solved(frame, update, prior, uncertainty.posterior(frame, update).state, garment, jacobian)


def likeness(vertices) -> np.ndarray:
    distance = np.linalg.norm(vertices[:, None] - vertices, axis=2)
    return np.exp(-0.5 * (distance / Config().discretisation.correlation_length) ** 2).astype(np.float32)


def diagonal_blocks(matrix):
    n = len(matrix) // 3
    return matrix.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n)]


@pytest.mark.parametrize("seen", list(SEEN))
def test_stored_blocks_are_the_covariance_given_the_neighbours(seen):
    """Never more than the marginals; equal to the inverse of the diagonal blocks but for the bound on bending."""
    run = solved(MESHES["tube"], seen, Config())
    conditional = traces(np.linalg.inv(diagonal_blocks(run.exact())))
    assert (traces(run.state.P_pp) <= conditional * (1 + 1e-4)).all()
    assert (traces(run.state.P_pp) > 0.2 * conditional).all()
    assert_positive_definite(full(run.state))


# The drift, against dense matrices of the MAP problem -----------------------------------------------------------------


def patches_of(run: Solved):
    problem = run.problem._replace(model=run.garment, config=LIMP, motion_start=run.prior.position)
    surface = uncertainty.Surface(run.state.position, vertex_normals(run.state.position, run.garment.faces))
    return uncertainty._patch_statistics(problem, run.update, run.update.planes.weight, surface)


@pytest.mark.parametrize("seen", list(SEEN))
@pytest.mark.parametrize("name", every(3, MESHES))
def test_drift_becomes_the_exact_marginals_where_the_coupling_is_all_that_was_known(name, seen):
    """With a prior that is just what couples the vertices, the gain is the best one, and F P F' + G M G is (C + M)^-1."""
    run = solved(MESHES[name], seen)
    patches, n = patches_of(run), run.garment.mesh.n_vertices
    C = run.exact("stretch", "shear", "rigid") + Uncertainty().least_information * np.eye(3 * n)
    got = uncertainty._updated(problem_of(run.garment, None), np.linalg.inv(C).astype(np.float32), patches, run.update.system.B)
    exact = np.linalg.inv(C + dense.blockdiag(patches.means.information))
    ratio = traces(diagonal_blocks(got)) / traces(diagonal_blocks(exact))
    np.testing.assert_allclose(ratio, 1.0, rtol=0.02)


@pytest.mark.parametrize("seen", list(SEEN))
def test_drift_is_the_covariance_of_errors_that_go_through_the_update(seen):
    """Errors drawn from P and noise drawn from M, moved by (C + M)^-1 M: their covariance, in float64, is the recursion's."""
    run = solved(MESHES["larger sheet"], seen)
    patches, n = patches_of(run), run.garment.mesh.n_vertices
    root = np.random.default_rng(1).normal(scale=0.003, size=(3 * n, 3 * n))
    P = root @ root.T
    M = dense.blockdiag(patches.means.information)
    gain = np.linalg.inv(run.exact("stretch", "shear", "rigid") + Uncertainty().least_information * np.eye(3 * n) + M)
    left, noise = (np.eye(3 * n) - gain @ M) @ root, gain @ np.linalg.cholesky(M + 1e-9 * np.eye(3 * n))
    expected = left @ left.T + noise @ noise.T
    got = uncertainty._updated(problem_of(run.garment, None), P.astype(np.float32), patches, run.update.system.B)
    assert np.abs(got - expected).max() < 0.01 * np.abs(expected).max()
    best = np.linalg.inv(np.linalg.inv(P) + M)  # no gain does better than the one that suits P
    assert (traces(diagonal_blocks(got)) >= 0.99 * traces(diagonal_blocks(best))).all()


@pytest.mark.parametrize("name", list(MESHES))
def test_measurements_count_as_one_per_patch_for_a_few_frames(name):
    run = solved(MESHES[name], "all")
    one_each = patches_of(run).means.information
    together = run.garment._replace(patch=np.zeros_like(run.garment.patch), likeness=np.ones((1, 1), np.float32))
    total = run._replace(garment=together)
    np.testing.assert_allclose(patches_of(total).means.information[0], one_each.mean(axis=0), rtol=1e-9)


# What is reported -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seen", list(SEEN))
@pytest.mark.parametrize("name", every(3, MESHES))
def test_reported_covariances_are_positive_definite(name, seen):
    covariance, drift = solved(MESHES[name], seen).report()
    assert_positive_definite(covariance)
    values = np.linalg.eigvalsh(drift.covariance.astype(float))
    assert values[0] > -1e-6 * values[-1]  # but for float32


def test_a_measurement_makes_its_vertex_more_certain():
    seen, unseen = (solved(MESHES["larger sheet"], which).report()[0] for which in ("all", "two"))
    assert (traces(seen)[2:] < traces(unseen)[2:]).all()


def test_a_plane_tells_more_along_its_normal_than_across():
    run = solved(MESHES["tube"], "half")
    covariance, _ = run.report()
    used = run.update.terms.weight > 0
    n = run.update.planes.normal[used]
    along = np.einsum("va,vab,vb->v", n, covariance[used], n)
    assert (along < 0.5 * (traces(covariance[used]) - along)).all()


def test_strained_cloth_is_less_certain():
    """A garment that slides along itself is stretched in one place and pressed together in another."""
    calm, strained = (solved(MESHES["larger sheet"], "all", scale=scale).report()[0] for scale in (1.0, 1.1))
    assert traces(strained).mean() > 1.1 * traces(calm).mean()


def test_what_moves_unseen_is_less_certain_and_a_rigid_motion_of_all_tells_nothing():
    run = solved(MESHES["tube"], "half")
    hidden = run.update.terms.weight == 0
    position = run.state.position
    turned = position @ np.array([[0.8, 0.0, 0.6], [0.0, 1.0, 0.0], [-0.6, 0.0, 0.8]])
    starts = position, position * [1.2, 1.0, 0.8], turned, position + [0.1, 0.0, -0.2]
    rest, moved, *rigid = (run.report(still=still)[0] for still in starts)
    assert (traces(moved)[hidden] > traces(rest)[hidden]).all()
    for each in rigid:
        np.testing.assert_allclose(each, rest, rtol=1e-3)


def test_the_farther_an_unseen_vertex_is_from_the_body_the_less_certain():
    run = solved(MESHES["tube"], "half")
    unseen = run.update.terms.weight == 0
    n = run.garment.mesh.n_vertices
    near, far, beyond = (run.report(clearance=np.full(n, distance))[0] for distance in (0.0, 0.05, np.inf))
    assert (traces(near) < traces(far))[unseen].all()
    assert (traces(far) < traces(beyond))[unseen].all()
    assert np.isfinite(beyond).all()
    assert (traces(near) <= traces(far)).all()


def test_the_looser_the_garment_hangs_on_the_body_the_less_certain_is_what_is_not_seen():
    run = solved(MESHES["tube"], "half")
    unseen, n = run.update.terms.weight == 0, run.garment.mesh.n_vertices
    unknown, tight, loose, looser = (
        run.report(clearance=np.zeros(n), slack=slack and np.full(n, slack))[0] for slack in (None, 0.005, 0.05, 0.1)
    )
    assert (traces(unknown) <= traces(tight)).all()
    assert (traces(tight) < traces(loose))[unseen].all()
    assert (traces(loose) < traces(looser))[unseen].all()
    assert (traces(tight) <= traces(looser)).all()


def test_without_a_body_the_farther_along_the_cloth_from_what_is_seen_the_less_certain():
    garment = model.build(MESHES["larger sheet"])
    seen = garment.mesh.vertices[:, 0] < 0.03
    distance = error_size.along_cloth(seen, garment)
    order = np.argsort(garment.mesh.vertices[:, 0][~seen], kind="stable")
    assert np.corrcoef(np.arange(len(order)), distance[~seen][order])[0, 1] > 0.9
    assert (distance[seen] == 0.0).all()
    nothing = error_size.along_cloth(np.zeros_like(seen), garment)
    assert (nothing == nothing.max()).all()
    assert nothing.max() >= distance.max()
    for law in (Config().normal_error, Config().tangential_error):
        assert law.distance_power > 0.0


def test_a_cloud_that_lies_off_the_surface_makes_all_less_certain():
    run = solved(MESHES["tube"], "half")
    sizes = [traces(run.report(offset2=offset**2)[0]) for offset in (0.0, 0.001, 0.01)]
    assert (sizes[0] < sizes[1]).all()
    assert (sizes[1] < sizes[2]).all()


@pytest.mark.parametrize("seen", list(SEEN))
def test_the_bases_of_the_laws_scale_the_standard_deviations_of_their_group(seen):
    run = solved(MESHES["tube"], seen)
    laws = {
        name: dataclasses.replace(law, seen=2 * law.seen, hidden=3 * law.hidden)
        for name, law in (("normal_error", LIMP.normal_error), ("tangential_error", LIMP.tangential_error))
    }
    one, other = run.report()[0], run.report(dataclasses.replace(LIMP, **laws))[0]
    factor = np.where(run.update.terms.weight > 0, 4.0, 9.0)[:, None, None]
    np.testing.assert_allclose(other, factor * one, rtol=1e-9)


@pytest.mark.parametrize("reliability", [0.0, 0.4, 1.0])
@pytest.mark.parametrize("seen", ["all", "half"])
def test_errors_fade_the_sooner_the_more_is_seen_and_the_more_reliable_it_is(seen, reliability):
    run = solved(MESHES["tube"], seen)
    patches, times = patches_of(run), np.array([0.5, 1.0, 2.0])
    coverage = patches.observed.sum() / patches.size.sum()
    assert coverage == (1.0 if seen == "all" else 0.5)
    shares = []
    for seconds in times:
        limits = dataclasses.replace(LIMP.uncertainty, return_time=seconds)
        config, health = dataclasses.replace(LIMP, uncertainty=limits), Health(reliability=reliability)
        problem = run.problem._replace(model=run.garment, config=config, health=health)
        shares.append(uncertainty.remaining(problem, patches))
    np.testing.assert_allclose(shares, np.exp(-2.0 * reliability * coverage * run.problem.dt / times))


def test_what_nothing_shows_stays_on_a_body_and_is_lost_without():
    """In half a second without points."""
    body = inner_body(GARMENT)
    sizes = []
    for worn in (True, False):
        tracker = Tracker(GARMENT, body=body if worn else None)
        for k in range(1, 26):
            cloud = CLOUDS[k % 6] if k <= 10 else CLOUDS[0][:0]
            result = tracker.step(cloud, timestamp=k / 30, body_vertices=body.vertices if worn else None)
        sizes.append(np.median(result.sigma))
    assert sizes[0] < 0.3 * sizes[1]


def test_a_rejected_frame_measures_nothing():
    run = solved(MESHES["tube"], "all")
    taken = run.report()[0]
    refused = run._replace(update=run.update._replace(rejected=True)).report()[0]
    assert (traces(refused) > traces(taken)).all()


def test_a_place_found_anew_forgets_the_drift():
    """After a loss and a new placement the garment is as uncertain as at a start, whatever was before."""
    tracker = Tracker(GARMENT)
    for k in range(1, 4):
        tracker.step(CLOUDS[k % 6], timestamp=k / 30)
    for k in range(90):
        lost = tracker.step(CLOUDS[0][:0], timestamp=1 + k / 30)
    assert lost.state == "lost"
    found = tracker.step(CLOUDS[0] + np.float32([0.5, 0.0, 0.0]), timestamp=4.1)
    assert np.median(found.sigma) < 0.5 * np.median(lost.sigma)


@pytest.mark.parametrize(("before", "share"), [(0.0, 1.0), (2.0, 1.0 - Config().uncertainty.innovation_memory)])
def test_innovations_are_remembered_per_second_and_the_first_counts_in_full(before, share):
    dt, garment = 0.1, model.build(tube())
    n = len(garment.likeness)
    last = Tracker(tube())._track._replace(drift=Drift.at(garment, 0.01)._replace(speed2=before, missed=before * np.eye(3)))
    ones, zeros = np.ones(n), np.zeros(n)
    means = PatchMeans(np.zeros((n, 6)), ones, zeros, 0.04 * ones, zeros, zeros)
    patches, coupling = PatchStatistics(ones, ones, means, zeros, False, 0.09 * np.eye(3)), uncertainty.Coupling(None, 0.0, False)
    grown, speed2, missed = uncertainty._growth(problem_of(garment, last=last, dt=dt), patches, coupling)
    assert speed2 == pytest.approx((1.0 - share) * before + share * 0.04 / dt**2)
    np.testing.assert_allclose(missed, ((1.0 - share) * before + share * 0.09 / dt**2) * np.eye(3))
    assert (grown > 0).all()


# Turns that nothing shows -------------------------------------------------------------------------------------------


def plain_skirt(folds: float, around=60, along=22, spacing=0.022) -> Mesh:
    """Round, wider below; folds of that amplitude, metres, 10 cm wide at the hem."""
    angle, height = np.meshgrid(np.linspace(0, 2 * np.pi, around, endpoint=False), spacing * np.arange(along))
    radius = 0.25 - 0.25 * height + folds * np.cos(15 * angle)
    flat = tube(around=around, along=along)
    return Mesh(np.stack([radius * np.cos(angle), height, radius * np.sin(angle)], axis=-1).reshape(-1, 3), flat.faces)


PLAIN, FOLDED = plain_skirt(0.0), plain_skirt(0.006)


def joined(mesh: Mesh) -> Mesh:
    """The mesh twice side by side, with a strip between both: two openings more than a tube."""
    n, aside = mesh.n_vertices, 1.1 * (mesh.vertices.max(axis=0) - mesh.vertices.min(axis=0)) * [1.0, 0.0, 0.0]
    right, left = 0, n + 30  # of both upper rims, which look at each other
    strip = np.array([[left, right, right + 1], [left, right + 1, left - 1]])
    both = np.concatenate([mesh.vertices - 0.5 * aside, mesh.vertices + 0.5 * aside])
    return Mesh(both, np.concatenate([mesh.faces, mesh.faces + n, strip]))


def standing(mesh, body=None, frames=30):
    """The last result of a garment that stands still, seen from all around, and its true vertices."""
    tracker = Tracker(mesh, body=body)
    tracker.reset(mesh.vertices)
    for k in range(frames):
        cloud = scan(mesh.vertices, mesh, 8000, 0.003, seed=k)
        pose = None if body is None else body.vertices
        result = tracker.step(cloud, timestamp=k / 30, body_vertices=pose)
    return tracker, result


def test_a_smooth_round_garment_may_have_turned_and_says_so():
    tracker, result = standing(PLAIN)
    off = result.vertices - PLAIN.vertices
    inside = np.einsum("va,vab,vb->v", off, np.linalg.inv(result.covariance), off) < 6.25
    assert inside.mean() > 0.9
    assert result.reliability < 0.6
    assert result.state == "tracking"  # there is nothing to search
    radial = PLAIN.vertices * [1, 0, 1] / np.linalg.norm(PLAIN.vertices[:, [0, 2]], axis=1, keepdims=True)
    along = np.einsum("va,vab,vb->v", radial, result.covariance, radial)
    assert np.median(along) < 0.1 * np.median(np.trace(result.covariance, axis1=1, axis2=2))
    later = snapshot.load(tracker.snapshot(), Tracker)
    assert later._track.drift.unseen_turn == tracker._track.drift.unseen_turn > 0.2


@pytest.mark.parametrize("shown_by", ["folds", "body"])
def test_what_shows_a_turn_leaves_the_garment_reliable(shown_by):
    body = inner_body(PLAIN) if shown_by == "body" else None
    tracker, result = standing(FOLDED if shown_by == "folds" else PLAIN, body, frames=15)
    assert tracker._track.drift.unseen_turn < 1e-3
    assert result.reliability > 0.9


def turned_back_and_forth(mesh, seconds=1.0, one_sided=False, body=None):
    """The tracker and the last result of 30 frames of a garment that turns by 20 degrees to either side in so many seconds."""
    tracker = Tracker(mesh, body=body)
    tracker.reset(mesh.vertices)
    for k in range(30):
        angle = np.radians(20.0) * np.sin(2 * np.pi * k / (30 * seconds))
        turn = np.array([[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]])
        cloud, sensor = scan(mesh.vertices @ turn.T, mesh, 8000, 0.003, seed=k), None
        if one_sided:
            cloud, sensor = cloud[cloud[:, 2] > 0], [0.0, 0.3, 3.0]
        pose = None if body is None else body.vertices @ turn.T
        result = tracker.step(cloud, timestamp=k / 30, sensor_origin=sensor, body_vertices=pose)
    return tracker, result


def test_folds_show_that_a_skirt_turns_and_not_how_far():
    """The faster, and the less of it is seen, the farther the estimate may be behind."""
    degrees = {}
    for name, options in {"slow": {"seconds": 4.0}, "fast": {}, "one side": {"one_sided": True}}.items():
        tracker, result = turned_back_and_forth(FOLDED, **options)
        degrees[name] = np.degrees(tracker._track.drift.unseen_turn), result.reliability
    assert 1.0 < degrees["slow"][0] < 6.0 < 10.0 < degrees["fast"][0] < 20.0 < degrees["one side"][0]
    assert degrees["slow"][1] > 0.8 > degrees["fast"][1] > 0.3


def test_on_a_body_a_skirt_may_be_behind_its_turns_for_a_while():
    """By less than without one: its waistband holds."""
    body = inner_body(FOLDED)
    tracker, result = turned_back_and_forth(FOLDED, body=body)
    alone = turned_back_and_forth(FOLDED)[0]._track.drift.unseen_turn
    first = tracker._track.drift
    assert first.unseen_turn == 0.0
    assert 0.1 * alone < first.behind < 0.5 * alone
    restored = snapshot.load(tracker.snapshot(), Tracker)
    for k in range(30, 90):
        cloud = scan(FOLDED.vertices, FOLDED, 8000, 0.003, seed=k)
        later = tracker.step(cloud, timestamp=k / 30, body_vertices=body.vertices)
        if k == 30:
            assert_same(later, restored.step(cloud, timestamp=k / 30, body_vertices=body.vertices))
    assert tracker._track.drift.behind < 0.2 * first.behind
    assert later.sigma.mean() < result.sigma.mean()


def test_legs_show_how_far_a_garment_turns():
    """Two such tubes side by side and joined."""
    tracker, result = turned_back_and_forth(joined(FOLDED))
    assert tracker._track.drift.unseen_turn == 0.0
    assert result.reliability > 0.9


@pytest.mark.slow
def test_a_garment_in_view_is_as_certain_after_many_seconds_as_after_a_few():
    """Also its hidden half: nothing shows that it strays."""
    tracker, sizes = Tracker(FOLDED), []
    tracker.reset(FOLDED.vertices)
    for k in range(1, 241):
        cloud = scan(FOLDED.vertices, FOLDED, 4000, 0.003, seed=k)
        result = tracker.step(cloud[cloud[:, 2] > 0], timestamp=k / 30, sensor_origin=[0.0, 0.3, 3.0])
        sizes.append([np.median(result.sigma[chosen]) for chosen in (result.observed, ~result.observed)])
    early, late = np.mean(sizes[30:60], axis=0), np.mean(sizes[-30:], axis=0)
    assert (late < 1.1 * early).all()


def test_a_garment_may_have_turned_by_a_part_of_a_circle_at_most():
    tracker, _ = standing(PLAIN, frames=2)
    track = tracker._track
    tracker._track = track._replace(drift=track.drift._replace(unseen_turn=1.999))
    for k in (2, 3, 4):
        tracker.step(scan(PLAIN.vertices, PLAIN, 8000, 0.003, seed=k), timestamp=k / 3)
    assert tracker._track.drift.unseen_turn == uncertainty.MOST_TURNED
