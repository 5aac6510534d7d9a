"""Stage G: s_k by its formula, the product's score, and when a track is poor or lost."""

import dataclasses
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf import Config, Mesh, Tracker
from ddakf.config import KnnFilter, PaperReliability, Start
from ddakf.data import sample
from ddakf.evaluation.sensors import Sensor
from ddakf.garment import model
from ddakf.kernels import reliability as kernels
from ddakf.stages.grid import nearest_vertices
from ddakf.stages.reliability import (
    Outcome,
    advance,
    clumped,
    misfit,
    missing,
    paper_score,
    score,
    vertex_error,
    widening,
)
from ddakf.types import Health, Measurement
from tests.stages.scenes import FPS, blocks, frame_of, problem_of, rms, scan, tube
from tests.tracker_runs import SHIRT

CONFIG, EVIDENCE_CONFIG = Config().reliability, Config().evidence
LAW = Config().frame_error
PAPER = PaperReliability()
GOOD, DT = 0.9, 1 / FPS
SAMPLE = sample()

# Scores -------------------------------------------------------------------------------------------------------------


@given(seed=st.integers(0, 2**32 - 1), scale=st.sampled_from([0.0, 1e-3, 0.01, 1.0]))
@settings(max_examples=30, deadline=None, derandomize=True)
def test_s_k_is_the_papers_formula(seed, scale):
    rng = np.random.default_rng(seed)
    n = 25
    y, R, found = scale * rng.normal(size=(n, 3)), blocks(n, 3, rng) * 1e-4, rng.random(n) < 0.8
    y[~found] = 0.0
    energy = sum(y[i] @ y[i] / np.trace(R[i]) for i in range(n)) / n
    assert paper_score(y, R, found) == pytest.approx(np.exp(-energy) if found.any() else 0.0, rel=1e-12)


def test_s_k_of_a_tracker_is_that_of_its_frame():
    """An exact cloud on the vertices has no innovation, so that s_k is 1; a raised one lowers it, by however much."""
    mesh = tube()
    scores = []
    for away in (0.0, 0.002, 0.005, 0.01):
        everything = dataclasses.replace(Config.paper(), preprocess=KnnFilter(ratio=10.0))  # removes no point
        tracker = Tracker(mesh, config=everything)
        scores.append(tracker.step(mesh.vertices + [0.0, away, 0.0], timestamp=0.0).paper_score)
    assert scores[0] == pytest.approx(1.0, abs=1e-3)
    assert (np.diff(scores) < 0).all()
    assert all(0 <= s <= 1 for s in scores)


def test_without_measurements_s_k_is_zero():
    assert paper_score(np.zeros((5, 3)), np.tile(np.eye(3), (5, 1, 1)), np.zeros(5, bool)) == 0.0


def test_s_k_tends_to_the_same_value_at_every_noise():
    """R follows the innovations, so that their ratio tends to 1: s_k says nothing about how large a lasting error is."""
    mesh, early, late = tube(), [], []
    for noise in (0.004, 0.015):
        tracker = Tracker(mesh, config=Config.paper())
        scores = [tracker.step(scan(mesh.vertices, mesh, seed=k, noise=noise), timestamp=k * DT).paper_score for k in range(60)]
        early.append(np.mean(scores[:5]))
        late.append(np.mean(scores[30:]))
    assert early[1] < 0.7 * early[0]
    assert late == pytest.approx([np.exp(-1)] * 2, abs=0.06)


@given(error=st.floats(1e-6, 1.0), unexplained=st.floats(0, 1.0), factor=st.floats(1.0, 10.0), more=st.floats(0, 1.0))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_score_is_a_share_that_no_sign_of_error_raises(error, unexplained, factor, more):
    wider = widening(unexplained, LAW)
    here, worse = score(error * wider, CONFIG), score(factor * error * wider, CONFIG)
    missed = score(error * widening(unexplained + more, LAW), CONFIG)
    assert 0.0 <= worse <= here <= 1.0
    assert 0.0 <= missed <= here
    assert wider >= 1.0


def test_score_is_a_half_at_the_configured_error():
    assert score(CONFIG.half_error, CONFIG) == pytest.approx(0.5)
    assert score(0.0, CONFIG) == 1.0


@pytest.mark.parametrize("share", [0.0, 0.2])
def test_the_error_of_a_frame_is_that_of_its_reported_sigma(share):
    """Also where the surface misses a share of the cloud: the sigmas of all vertices are larger then."""
    mesh = tube()
    points = scan(mesh.vertices, mesh, seed=1, noise=0.003)
    away = int(share * len(points))
    points[:away] = points[:away] + [0.0, 0.3, 0.0]
    result = Tracker(mesh).step(points, timestamp=0.0)
    claimed = np.sqrt(3 * np.square(result.sigma).mean())
    assert result.reliability == pytest.approx(score(LAW.sigma_share * claimed, CONFIG))
    assert result.sigma == pytest.approx(np.sqrt(np.trace(result.covariance, axis1=1, axis2=2) / 3))


def test_sigma_grows_where_the_surface_misses_the_cloud(monkeypatch):
    mesh = tube()
    points = scan(mesh.vertices, mesh, seed=1, noise=0.003)
    points = np.concatenate([points, points[: len(points) // 4] + [0.0, 0.3, 0.0]])
    wide = Tracker(mesh).step(points, timestamp=0.0)
    monkeypatch.setattr("ddakf.stages.reliability.widening", lambda unexplained, config: 1.0)
    narrow = Tracker(mesh).step(points, timestamp=0.0)
    assert wide.sigma.min() > 1.5 * narrow.sigma.min()
    factor = np.square(wide.sigma / narrow.sigma)
    assert wide.covariance == pytest.approx(factor[:, None, None] * narrow.covariance)


# Evidence -----------------------------------------------------------------------------------------------------------


def misfit_of(points, mesh, patches=40):
    patch = (np.arange(mesh.n_vertices) * patches // mesh.n_vertices).astype(np.int32)
    nearest, away = nearest_vertices(points, mesh.vertices, EVIDENCE_CONFIG.reach)
    none = np.zeros(mesh.n_vertices, bool)
    return kernels.squared_offset(points, mesh.vertices, nearest, away, 0.1, none, patch, patches), away


def slow_misfit(points, mesh, patches):
    """The definition, by brute force."""
    patch = np.arange(mesh.n_vertices) * patches // mesh.n_vertices
    away = np.linalg.norm(points[:, None] - mesh.vertices[None], axis=2)
    nearest, far = away.argmin(axis=1), away.min(axis=1) >= 0.1
    d, p = (points - mesh.vertices[nearest])[~far], patch[nearest[~far]]
    pairs = offset = 0.0
    for c in range(patches):
        mine = p == c
        pairs += mine.sum() * (mine.sum() - 1)
        offset += (d[mine].sum(axis=0) ** 2).sum() - (d[mine] ** 2).sum()
    return max(offset / pairs, 0) if pairs else 0.0, np.where(far, np.inf, away.min(axis=1))


@pytest.mark.parametrize("shift", [[0, 0, 0], [0.03, 0, 0.02], [0, 0.3, 0]])
def test_misfit_is_its_definition(shift):
    mesh = tube()
    points = scan(mesh.vertices + shift, mesh, count=500, noise=0.01).astype(float)
    offset, away = misfit_of(points, mesh, 20)
    expected, distances = slow_misfit(points, mesh, 20)
    assert offset == pytest.approx(expected, rel=1e-6, abs=1e-12)
    assert away == pytest.approx(distances, rel=1e-6)


@pytest.mark.parametrize("noise", [0.002, 0.01])
def test_misfit_tells_a_displaced_surface_from_noise(noise):
    mesh = tube()
    in_place, _ = misfit_of(scan(mesh.vertices, mesh, noise=noise), mesh)
    grown = Mesh(mesh.vertices * [1.1, 1.0, 1.1], mesh.faces)
    displaced, _ = misfit_of(scan(grown.vertices, grown, noise=noise), mesh)
    assert displaced > 10 * in_place
    assert in_place < 0.006**2


def test_points_that_no_vertex_is_near_do_not_count_as_offset():
    mesh = tube()
    points = scan(mesh.vertices, mesh).astype(float)
    offset, away = misfit_of(np.concatenate([points, points[:50] + 3.0]), mesh)
    assert offset == misfit_of(points, mesh)[0]
    assert np.isinf(away[-50:]).all()
    assert misfit_of(points[:0], mesh)[0] == 0.0


def test_a_garment_that_is_not_found_claims_no_place():
    mesh = tube()
    garment, other = scan(mesh.vertices, mesh).astype(float), np.random.default_rng(0).normal([3, 0, 0], 0.3, (1000, 3))
    found, missed = (Tracker(mesh).step(points, timestamp=0.0) for points in (garment, other))
    assert (found.state, missed.state) == ("tracking", "initializing")
    assert missed.reliability < 0.4 < 0.9 < found.reliability
    assert missed.sigma.min() > 0.06


def test_a_limb_of_points_is_a_clump_and_stray_points_are_none():
    rng = np.random.default_rng(0)
    limb = rng.uniform(0, 1, (60, 3)) * [0.4, 0.1, 0.1]
    stray = rng.uniform(-2, 2, (80, 3))
    assert clumped(limb, EVIDENCE_CONFIG) > 50
    assert clumped(stray, EVIDENCE_CONFIG) < 10
    assert clumped(np.concatenate([limb, limb + 1e30]), EVIDENCE_CONFIG) >= clumped(limb, EVIDENCE_CONFIG)
    assert clumped(limb[:0], EVIDENCE_CONFIG) == 0


def shown(garment, count, removed=0):
    """The problem of a frame with so many points, of which some were removed as skin or by their colours."""
    frame = frame_of()._replace(points=np.zeros((count + removed, 3)))
    last = SimpleNamespace(body=None, anchor=None, palette=None)
    return problem_of(garment, dt=DT)._replace(frame=frame, garment=frame.only(np.arange(count)), last=last)


def test_of_a_garment_that_was_just_found_the_frame_alone_counts():
    mesh = tube()
    garment, points = model.build(mesh), scan(mesh.vertices, mesh).astype(float)
    limb = np.random.default_rng(0).uniform(0, 1, (len(points) // 8, 3)) * [0.4, 0.1, 0.1] + mesh.vertices.max(axis=0) + 0.1
    seen = np.concatenate([points, limb])
    problem, known = shown(garment, len(seen)), Health(least_unexplained=0.0)
    found, tracked = (misfit(problem, known._replace(settling=left), seen, mesh.vertices + 0.01) for left in (2, 0))
    assert found.unexplained == pytest.approx(1 / 9, abs=0.03)
    assert tracked.unexplained < 0.1 * found.unexplained
    assert tracked.offset < 0.1 * found.offset
    # and what it says is believed as soon when it is good
    good = misfit(problem, found, points, mesh.vertices)
    assert good.unexplained < 0.01
    assert good.offset < 0.1 * found.offset
    first = misfit(problem, Health(), seen, mesh.vertices + 0.01)
    assert (first.unexplained, first.offset) == (found.unexplained, tracked.offset)


def test_points_are_of_something_else_only_where_the_garment_is_shown():
    """Sleeves that hang where they are not expected are no other clothes."""
    mesh = tube()
    garment, points = model.build(mesh), scan(mesh.vertices, mesh).astype(float)
    other = points[: len(points) // 2] + [0.8, 0.0, 0.0]
    seen = np.concatenate([points, other])
    problem = shown(garment, len(seen))
    assert misfit(problem, Health(), seen, mesh.vertices).unexplained == 0.0
    assert misfit(problem, Health(), seen, mesh.vertices, absent=True).unexplained > 0.3


def test_of_a_whole_person_only_points_beside_the_cloth_are_unexplained():
    mesh = tube()
    garment, points = model.build(mesh), scan(mesh.vertices, mesh).astype(float)
    clump, (side, top, _) = 0.02 * np.random.default_rng(0).random((150, 3)), mesh.vertices.max(axis=0)
    above, beside = clump + [side, top + 0.05, 0.0], clump + [side + 0.05, 0.5 * top, 0.0]

    def unexplained(more, removed):
        seen = np.concatenate([points, more])
        return misfit(shown(garment, len(seen), removed), Health(), seen, mesh.vertices).unexplained

    assert len(above) / len(points) < EVIDENCE_CONFIG.foreign_share
    assert unexplained(above, removed=0) == pytest.approx(150 / (len(points) + 150))
    assert unexplained(above, removed=len(points)) == 0.0
    assert unexplained(beside, removed=len(points)) == unexplained(beside, removed=0) > 0.0


def test_nearly_empty_frames_do_not_hide_that_a_cloud_is_of_more_than_the_garment():
    mesh = tube()
    garment, points = model.build(mesh), scan(mesh.vertices, mesh).astype(float)
    person = np.concatenate([points, points[: len(points) // 2] + [0.8, 0.0, 0.0]])
    problem = shown(garment, len(person))
    known = misfit(problem, Health(), person, mesh.vertices)
    sparse = misfit(problem, known, person[::100], mesh.vertices)
    assert sparse.least_unexplained == known.least_unexplained > EVIDENCE_CONFIG.foreign_share
    assert misfit(problem, sparse, person, mesh.vertices).unexplained < 0.01


@pytest.mark.parametrize("lacking", ["pose", "colours", "nothing"])
def test_what_body_or_colours_explain_in_other_frames_speaks_of_no_offset_without_them(lacking):
    mesh = tube()
    garment, points = model.build(mesh), scan(mesh.vertices, mesh).astype(float)
    skin = points[: len(points) // 2] + [0.8, 0.0, 0.0]
    person, explained = np.concatenate([points, skin]), shown(garment, len(points), removed=len(skin))
    known = misfit(explained, Health(), points, mesh.vertices)
    posed = SimpleNamespace(vertices=mesh.vertices + 0.1), SimpleNamespace(bound=SimpleNamespace(pose=mesh.vertices))
    body, anchor = posed if lacking == "pose" else (None, None)
    last = SimpleNamespace(body=body, anchor=anchor, palette=object() if lacking == "colours" else None)
    without = misfit(shown(garment, len(person))._replace(last=last), known, person, mesh.vertices)
    assert (without.unexplained < 0.01) == (lacking != "nothing")
    assert without.least_unexplained == known.least_unexplained
    again = misfit(explained, without, person, mesh.vertices)  # now they are beside the garment although skin was removed
    assert again.unexplained > without.unexplained


@pytest.mark.parametrize(
    ("visible", "shown", "absent"), [(1.0, 0.9, False), (1.0, 0.6, True), (0.5, 0.3, False), (0.0, 0.0, False)]
)
def test_a_garment_is_missing_where_its_vertices_are_in_view_and_not_found(visible, shown, absent):
    n = 200
    measurement = Measurement.none(n)._replace(
        visible=np.arange(n) < visible * n, distance=np.where(np.arange(n) < shown * n, 0.01, -1.0)
    )
    assert missing(measurement) is absent


def test_strain_is_that_of_the_edges():
    mesh = tube()
    garment = model.build(mesh)
    for stretched in (1.0, 1.2):
        rings, edges = np.empty(mesh.n_vertices), (garment.start, garment.neighbour, garment.rest_length)
        mean = kernels.strains(stretched * mesh.vertices, *edges, rings)
        assert mean == pytest.approx((stretched - 1.0) ** 2, abs=1e-6)
        assert rings == pytest.approx(np.full(len(rings), mean), abs=1e-6)


def test_score_falls_where_the_surface_leaves_its_cloud():
    mesh = tube()
    tracker, scores = Tracker(mesh, config=dataclasses.replace(Config(), start=Start(search=False))), []
    for k in range(6):
        shift = 0.0 if k < 3 else 0.25
        result = tracker.step(scan(mesh.vertices + [shift, 0, 0], mesh, seed=k), timestamp=k * DT)
        scores.append((result.reliability, rms(result.vertices - mesh.vertices - [shift, 0, 0])))
    assert scores[3][1] > 5 * scores[2][1]
    assert scores[3][0] < 0.8 * scores[2][0]


@given(variance=st.lists(st.floats(1e-9, 1.0), min_size=2, max_size=20), error=st.floats(1e-4, 1.0))
@settings(max_examples=100, deadline=None, derandomize=True)
def test_errors_of_vertices_are_the_frames_and_in_proportion_to_their_deviations(variance, error):
    errors, sd = vertex_error(error, np.array(variance)), np.sqrt(variance)
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(error)
    assert errors / errors[0] == pytest.approx(sd / sd[0])


# The tracker's state ------------------------------------------------------------------------------------------------


def run(health, seconds, dt=DT, score=GOOD, coverage=0.5, points=1000, rejected=False, config=CONFIG):
    """The health after frames of one kind."""
    for _ in range(max(1, round(seconds / dt))):
        health = advance(health, Outcome(score, coverage, points, rejected), dt, config)
    return health


def test_clouds_of_which_nothing_is_left_count_as_searched_and_empty_ones_do_not():
    """As where all points are skin: a search costs the time of several frames, and shall not be repeated in each."""
    health, counts = TRACKING, []
    for searchable in (True, True, True, False, True):
        health = advance(health, Outcome(GOOD, 0.0, 0, False, searchable), DT, CONFIG)
        counts.append(health.frames_unplaced)
    assert counts == [0, 1, 2, 2, 3], "the first of them still has a garment in view"


@pytest.mark.parametrize("bad", [{"coverage": 0.0}, {"rejected": True}, {"score": 0.0}])
def test_frames_too_sparse_to_be_searched_do_not_count_as_searched(bad):
    health = Health(state="lost")
    what = {"score": GOOD, "coverage": 0.5, "n_points": 20, "rejected": False} | bad
    for searchable in (False, False, True, False):
        health = advance(health, Outcome(**what, searchable=searchable), DT, CONFIG)
    assert health.frames_unplaced == 1


TRACKING = run(Health(), 0.1)
BAD = [{"coverage": 0.03}, {"coverage": 0.0}, {"rejected": True}]


def test_a_good_first_frame_is_tracking():
    assert run(Health(), DT).state == "tracking"
    assert TRACKING.physics_lambda == 1.0


@pytest.mark.parametrize("bad", BAD, ids=str)
@pytest.mark.parametrize("dt", [1 / 60, 1 / 30, 1 / 10])
def test_lost_after_half_a_second_without_a_fit(bad, dt):
    assert run(TRACKING, 0.5 - 1.5 * dt, dt, **bad).state == "recovering"
    assert run(TRACKING, 0.5 + 1.5 * dt, dt, **bad).state == "lost"


@pytest.mark.parametrize("bad", BAD, ids=str)
def test_a_good_frame_in_between_starts_the_count_anew(bad):
    almost = run(TRACKING, 0.4, **bad)
    again = run(run(almost, DT), 0.4, **bad)
    assert again.state == "recovering"


def test_five_per_cent_coverage_is_a_fit():
    assert run(TRACKING, 3.0, coverage=0.051).state == "tracking"
    assert run(TRACKING, 3.0, coverage=0.049).state == "lost"


def test_lost_after_two_seconds_of_empty_clouds_and_not_before():
    assert run(TRACKING, 1.9, points=0, coverage=0.0, score=0.0).state == "recovering"
    assert run(TRACKING, 2.1, points=0, coverage=0.0, score=0.0).state == "lost"


def test_empty_clouds_leave_the_state_until_the_score_is_low():
    """Where nothing measures the garment it is tracking no longer than its score says so."""
    fair, low = CONFIG.recovery_below + 0.01, CONFIG.recovery_below - 0.01
    assert run(TRACKING, 1.0, points=0, coverage=0.0, score=fair).state == "tracking"
    assert run(TRACKING, DT, points=0, coverage=0.0, score=low).state == "recovering"
    assert run(run(TRACKING, DT, points=0, coverage=0.0, score=low), DT).state == "tracking"
    assert run(Health(), DT, points=0, coverage=0.0, score=low).state == "initializing"


def test_empty_clouds_do_not_count_towards_a_poor_fit():
    mixed = TRACKING
    for _ in range(6):
        mixed = run(run(mixed, 0.06, coverage=0.0), 0.3, points=0, coverage=0.0, score=0.0)
        assert mixed.state != "lost"
    assert run(mixed, 0.2, coverage=0.0).state == "lost"


@pytest.mark.parametrize("gap", [0.6, 2.5, 60.0, 86_400.0])
def test_a_gap_before_a_good_frame_is_no_loss(gap):
    assert run(TRACKING, gap, dt=gap).state == "tracking"


@pytest.mark.parametrize("frame", [{"points": 0, "coverage": 0.0, "score": 0.0}, {"coverage": 0.0}], ids=["empty", "poor"])
@pytest.mark.parametrize("gap", [3.0, 60.0])
def test_a_gap_before_one_bad_frame_is_no_loss(frame, gap):
    """A gap without frames is never by itself a loss, and one frame is neither 0.5 s of poor nor 2 s of empty ones."""
    assert run(TRACKING, gap, dt=gap, **frame).state != "lost"


def test_a_loss_ends_with_the_first_fit():
    lost = run(TRACKING, 1.0, coverage=0.0)
    assert lost.state == "lost"
    assert run(lost, 0.2, points=0, coverage=0.0).state == "lost"
    assert run(lost, DT, coverage=0.0).state == "lost"
    assert run(lost, DT).state == "tracking"


def test_an_unfinished_start_is_lost_too_after_half_a_second():
    assert run(Health(), 0.3, coverage=0.0).state == "initializing"
    assert run(Health(), 0.7, coverage=0.0).state == "lost"
    assert run(Health(), 0.3, points=0, coverage=0.0).state == "initializing"


def test_recovery_has_hysteresis_and_stiffens_the_cloth():
    between = 0.5 * (CONFIG.recovery_below + CONFIG.recovery_above)
    assert CONFIG.recovery_below < between < CONFIG.recovery_above
    low, stiff = CONFIG.recovery_below - 0.01, replace(CONFIG, recovery_lambda=2.0)
    assert run(TRACKING, 1.0, score=between, config=stiff).state == "tracking"
    recovering = run(TRACKING, DT, score=low, config=stiff)
    assert recovering.state == "recovering"
    assert recovering.physics_lambda == 2.0
    assert run(recovering, 1.0, score=between, config=stiff).state == "recovering"
    calm = run(recovering, DT, score=CONFIG.recovery_above + 0.01, config=stiff)
    assert calm.state == "tracking"
    assert calm.physics_lambda == 1.0


def test_a_doubtful_fit_is_looked_for_but_is_no_loss():
    """However low the score: half of a garment may be hidden for long, and what is left is tracked."""
    doubtful = run(TRACKING, 5.0, score=CONFIG.doubt_below - 0.01)
    assert doubtful.state == "recovering"
    assert doubtful.unplaced
    assert not run(doubtful, DT).unplaced


@pytest.mark.parametrize("bad", BAD, ids=str)
def test_a_frame_without_a_fit_is_not_called_tracking_however_good_its_score(bad):
    assert run(TRACKING, DT, score=1.0, **bad).state == "recovering"


def test_the_papers_recovery_is_a_threshold_on_s_k():
    assert run(TRACKING, DT, score=PAPER.threshold - 1e-6, config=PAPER).state == "recovering"
    assert run(TRACKING, DT, score=PAPER.threshold - 1e-6, config=PAPER).physics_lambda == PAPER.recovery_lambda
    assert run(TRACKING, DT, score=PAPER.threshold + 1e-6, config=PAPER).state == "tracking"
    assert run(TRACKING, DT, score=PAPER.threshold + 1e-6, config=PAPER).physics_lambda == 1.0


@given(
    frames=st.lists(
        st.tuples(st.floats(0, 1), st.floats(0, 1), st.integers(0, 3), st.booleans(), st.floats(1e-3, 100)), max_size=60
    )
)
@settings(max_examples=50, deadline=None, derandomize=True)
def test_any_sequence_of_frames_leaves_a_known_state_and_stiffness(frames):
    for config in (replace(CONFIG, recovery_lambda=2.0), PAPER):
        health = Health()
        for quality, coverage, points, rejected, dt in frames:
            health = advance(health, Outcome(quality, coverage, points, rejected), dt, config)
            assert health.state in ("initializing", "tracking", "recovering", "lost")
            assert 1.0 <= health.physics_lambda <= config.recovery_lambda


# Through the tracker ------------------------------------------------------------------------------------------------


def test_score_coverage_and_reliability_of_a_frame_are_shares():
    mesh = tube()
    tracker = Tracker(mesh)
    for k in range(3):
        result = tracker.step(scan(mesh.vertices, mesh, seed=k), timestamp=k * DT)
        assert 0 <= result.reliability <= 1
        assert 0 <= result.paper_score <= 1
        assert result.coverage == pytest.approx(result.observed.mean())
        assert ((result.vertex_reliability >= 0) & (result.vertex_reliability <= 1)).all()


def test_half_a_garment_is_less_reliable_than_a_whole_one():
    mesh, results = tube(), {}
    for share in (1.0, 0.5):
        tracker = Tracker(mesh)
        tracker.reset(mesh.vertices)
        for k in range(10):
            points = scan(mesh.vertices, mesh, seed=k)
            points = points[points[:, 1] <= share * mesh.vertices[:, 1].max() + 0.01]
            results[share] = tracker.step(points, timestamp=k * DT)
    assert results[0.5].reliability < results[1.0].reliability
    assert results[0.5].coverage < results[1.0].coverage
    hidden = mesh.vertices[:, 1] > 0.7 * mesh.vertices[:, 1].max()
    assert results[0.5].vertex_reliability[hidden].mean() < results[0.5].vertex_reliability[~hidden].mean()


def test_points_that_the_garment_cannot_reach_lower_the_score():
    """A template that lacks a sleeve: what it covers fits, and the points of the sleeve are explained by nothing."""
    mesh, scores = tube(), {}
    top = mesh.vertices[:, 1].max()
    for sleeve in (False, True):
        tracker = Tracker(mesh, config=dataclasses.replace(Config(), start=Start(search=False)))
        rng = np.random.default_rng(1)
        for k in range(15):
            points = scan(mesh.vertices, mesh, seed=k)
            if sleeve:
                arm = rng.uniform([0.3, 0.7 * top, -0.05], [0.7, 0.9 * top, 0.05], (len(points) // 10, 3))
                points = np.concatenate([points, arm.astype(points.dtype)])
            result = tracker.step(points, timestamp=k * DT)
        scores[sleeve] = result.reliability
    assert 1 / scores[True] - 1 > 1.5 * (1 / scores[False] - 1), "the predicted error, up to a factor"


def test_thresholds_are_numbers_of_the_configuration():
    quick = dataclasses.replace(CONFIG, lost_after=0.1, lost_after_empty=0.2)
    assert run(TRACKING, 0.15, coverage=0.0, config=quick).state == "lost"
    assert run(TRACKING, 0.3, points=0, coverage=0.0, config=quick).state == "lost"


@pytest.mark.parametrize("room", [20_000, 100_000])
def test_walls_and_floor_of_an_uncut_depth_image_change_nothing(room):
    """From 0.6 m beside the garment on; it is a tenth and a fiftieth of the points."""
    rng, results = np.random.default_rng(0), []
    flat = rng.uniform([-3.0, -0.7, -1.0], [3.0, 2.0, -0.9], (room, 3)).astype(np.float32)
    for around in (flat, flat[:0]):
        tracker = Tracker(SHIRT)
        tracker.reset(SAMPLE.garment_vertices[0])
        for k in range(1, 13):
            cloud = Sensor("front", points=2000).capture(SAMPLE, k, np.random.default_rng(k))
            seen = np.concatenate([around, cloud.points])
            results.append(tracker.step(seen, timestamp=k / 30, sensor_origin=cloud.sensor_origin))
    cut = results[12:]
    for whole, alone in zip(results, cut, strict=False):
        np.testing.assert_allclose(whole.vertices, alone.vertices, atol=1e-3)
        assert whole.reliability == pytest.approx(alone.reliability, abs=0.02)
