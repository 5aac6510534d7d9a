"""Relocalization: a garment that stands elsewhere is found; one that is where it should be is left alone."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.config import Start
from ddakf.data import sample
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors import Sensor, sample_surface
from ddakf.evaluation.sensors.texture import Texture
from ddakf.garment import model
from ddakf.mesh import vertex_normals
from ddakf.physics import rigidity
from ddakf.search import relocalize
from ddakf.search.relocalize import LONGEST_WAIT, MOST_ROUNDS, Fit, _cost_of_staying, interrupted, locate, search_due
from ddakf.stages.predict import predict
from ddakf.types import Drift, Health, State, Track
from tests.lanes import every
from tests.search.test_candidate_poses import flat_tube
from tests.stages.scenes import FPS, frame_of, problem_of, random_state, rms, scan, tube, turn

SAMPLE = sample()
SHIRT = Mesh(SAMPLE.template, SAMPLE.garment_faces)
SHIRT_MODEL = model.build(SHIRT)
TUBE = tube()
RULE = Config().relocalization


def captured(view, vertices, seed):
    """What a sensor sees of the sample's garment alone, moved to ``vertices``."""
    rng = np.random.default_rng(seed)
    if view == "full":
        return (sample_surface(vertices, SHIRT.faces, 5000, rng) + 0.003 * rng.normal(size=(5000, 3))).astype(np.float32), None
    eye = vertices.mean(axis=0) + [0.0, 0.2, 2.0]
    points = sample_surface(vertices, SHIRT.faces, 9000, rng)
    normals = vertex_normals(vertices, SHIRT.faces)
    # the half turned to the camera: enough to be a partial view
    from scipy.spatial import cKDTree

    nearest = cKDTree(vertices).query(points)[1]
    seen = np.einsum("na,na->n", normals[nearest], eye - points) > 0
    return (points[seen] + 0.003 * rng.normal(size=(seen.sum(), 3))).astype(np.float32), eye


@pytest.mark.parametrize("view", ["full", "front"])
@pytest.mark.parametrize("degrees", every(2, [30, -30]))
@pytest.mark.parametrize("direction", [[0.3, 0.0, 0.0], [-0.15, 0.1, 0.24]])
def test_a_garment_moved_by_30_cm_and_turned_by_30_degrees_is_found(view, degrees, direction):
    start = SAMPLE.garment_vertices[0].astype(float)
    centre = start.mean(axis=0)
    truth = (start - centre) @ turn(degrees).T + centre + direction
    tracker = Tracker(SHIRT)
    tracker.reset(start)
    for k in range(8):
        points, eye = captured(view, truth, k)
        result = tracker.step(points, timestamp=k / FPS, sensor_origin=eye)
    assert result.state == "tracking"
    assert rms(result.vertices - truth) < (0.02 if view == "full" else 0.04)
    assert rms(start - truth) > 0.25


def test_a_garment_in_its_place_stays_there_while_one_side_is_not_seen():
    """It moves by 14 mm in the first frame; a search would squeeze the hidden side into the cloud."""
    start = SAMPLE.garment_vertices[0].astype(float)
    tracker = Tracker(SHIRT)
    tracker.reset(start)
    truth = start + [0.0, 0.0, 0.014]
    points = captured("full", truth, 0)[0]
    seen = points[points[:, 0] < np.quantile(points[:, 0], 0.6)]
    result = tracker.step(seen, timestamp=0.0)
    assert rms(result.vertices - truth) < 0.006


@pytest.mark.parametrize("view", ["full", "front"])
def test_a_garment_that_jumps_between_slow_frames_is_caught_at_once(view):
    """Its prediction stands still, and the passes do not reach as far."""
    start = SAMPLE.garment_vertices[0].astype(float)
    tracker = Tracker(SHIRT)
    tracker.reset(start)
    for k, shift in enumerate([0.0, 0.0, 0.0, 0.25]):
        truth = start + [0.6 * shift, 0.8 * shift, 0.0]
        points, eye = captured(view, truth, k)
        result = tracker.step(points, timestamp=0.1 * k, sensor_origin=eye)
    assert rms(result.vertices - truth) < 0.04
    assert result.reliability > 0.5


def test_a_prediction_is_registered_only_over_a_long_step_and_where_it_misses_the_cloud(monkeypatch):
    start, calls = SAMPLE.garment_vertices[0].astype(float), []
    register = relocalize.register
    monkeypatch.setattr(relocalize, "register", lambda *given: calls.append(1) or register(*given))

    def registered(dt, shift):
        tracker = Tracker(SHIRT)
        tracker.reset(start)
        for k in range(3):
            calls.clear()
            tracker.step(captured("full", start + [shift * (k == 2), 0.0, 0.0], k)[0], timestamp=k * dt)
        return len(calls)  # of the last frame

    assert (registered(1 / 30, 0.05), registered(0.1, 0.0), registered(0.1, 0.05)) == (0, 0, 1)


@pytest.mark.parametrize("view", ["full", "front"])
@pytest.mark.parametrize("degrees", [90, 180, -120])
def test_a_garment_that_was_never_found_may_face_any_way(view, degrees):
    """A T-shirt is nearly alike from front and back: its shape tells, where the heading of the template does not."""
    truth = SAMPLE.garment_vertices[0].astype(float)
    centre = truth.mean(axis=0)
    points, eye = captured(view, truth, 3)
    tracker = Tracker(Mesh((SHIRT.vertices - centre) @ turn(degrees).T + centre + [0.4, 0.0, 0.2], SHIRT.faces))
    for k in range(3):
        result = tracker.step(points, timestamp=k / FPS, sensor_origin=eye)
    assert rms(result.vertices - truth) < 0.03


@pytest.mark.parametrize(("given", "doubt"), [(True, 0.0), (False, RULE.heading_doubt)])
def test_the_heading_of_a_given_start_is_not_doubted(given, doubt, monkeypatch):
    """Between alike sides noise would decide, and turn a person's shirt back to front for good."""
    doubts, best = [], relocalize._best_fit
    monkeypatch.setattr(relocalize, "_best_fit", lambda *given: doubts.append(given[-1].doubt) or best(*given))
    truth = SAMPLE.garment_vertices[0] + [0.05, 0.0, 0.0]
    tracker = Tracker(SHIRT)
    if given:
        tracker.reset(SAMPLE.garment_vertices[0])
    points, eye = captured("front", truth, 3)
    tracker.step(points, timestamp=0.1, sensor_origin=eye)
    assert doubts == [doubt]


@pytest.mark.parametrize("given", [True, False])
def test_that_a_garment_fits_turned_as_well_is_told_unless_its_start_was_given(given):
    truth = TUBE.vertices + [0.1, 0.0, 0.0]
    tracker, told = Tracker(TUBE), set()
    if given:
        tracker.reset(TUBE.vertices)
    for k in range(3):
        result = tracker.step(scan(truth, TUBE, seed=k), timestamp=k / FPS)
        told |= {warning.code for warning in result.warnings}
    assert ("heading_uncertain" in told) is not given


@pytest.mark.parametrize(("gap", "doubtful"), [(0.5, False), (6.0, True)])
def test_a_gap_in_which_a_garment_of_alike_sides_may_have_turned_is_told(gap, doubtful):
    """Its heading before is the best guess, which is worth the less the longer nobody saw it."""
    flat, told = flat_tube(0.6), set()
    tracker = Tracker(flat)
    tracker.reset(flat.vertices)
    for k in range(6):
        truth = flat.vertices + [0.15 if k > 2 else 0.0, 0.0, 0.0]
        result = tracker.step(scan(truth, flat, seed=k), timestamp=k / FPS + (gap if k > 2 else 0.0))
        told |= {warning.code for warning in result.warnings}
    assert rms(result.vertices - truth) < 0.02
    assert ("heading_uncertain" in told) == doubtful
    assert (result.reliability < 0.4) == doubtful


@pytest.mark.parametrize(("garment", "alike"), [(TUBE, True), (SHIRT, False)], ids=["tube", "shirt"])
def test_the_covariance_of_a_found_garment_knows_of_the_headings_that_suit_it(garment, alike):
    """The state does not: neither stiffer cloth nor another search would help."""
    truth, results = garment.vertices + np.float32([0.1, 0.0, 0.0]), {}
    for given in (True, False):
        tracker = Tracker(garment)
        if given:
            tracker.reset(garment.vertices)
        for k in range(6):
            results[given] = tracker.step(scan(truth, garment, 5000, seed=k), timestamp=k / FPS)
    wider = np.median(results[False].sigma) / np.median(results[True].sigma)
    assert (wider > 4.0) == alike
    assert (results[False].reliability < 0.6 * results[True].reliability) == alike
    assert {result.state for result in results.values()} == {"tracking"}


@pytest.mark.parametrize("name", ["trousers_dance_loose_11", "shorts_jump_loose_59"])
def test_trousers_that_face_the_other_way_are_found_by_their_shape(name):
    """Front and back differ by centimetres alone, and the legs stand otherwise than the template's."""
    sequence, first = collection.load(name), 40
    template = sequence.template @ turn(180).T + [0.5, 0.0, 0.3]
    tracker = Tracker(Mesh(template, sequence.garment_faces))
    for k in range(first, first + 3):
        points = Sensor("full").capture(sequence, k, np.random.default_rng([1, k])).points
        result = tracker.step(points, timestamp=k / FPS)
    assert rms(result.vertices - sequence.garment_vertices[k]) < 0.02


@pytest.mark.parametrize(("texture", "error"), [(None, 0.013), (Texture("plain"), 0.006)], ids=["points", "colours"])
def test_a_garment_is_found_at_once_in_the_cloud_of_its_wearer(texture, error):
    start = (SHIRT.vertices - SHIRT.vertices.mean(axis=0)) @ turn(30).T + SHIRT.vertices.mean(axis=0) + [0.4, 0.0, 0.2]
    seen = Sensor("full", points=6000, segmented=False).capture(SAMPLE, 0, np.random.default_rng(1), texture)
    found = {}
    for distance in (0.0, RULE.narrow_distance):
        config = dataclasses.replace(Config(), relocalization=dataclasses.replace(RULE, narrow_distance=distance))
        tracker = Tracker(Mesh(start, SHIRT.faces), config=config)
        result = tracker.step(seen.points, timestamp=0.0, colors=seen.colors if texture else None)
        found[distance] = rms(result.vertices - SAMPLE.garment_vertices[0])
    assert found[RULE.narrow_distance] < error < 0.5 * found[0.0]


def test_a_garment_that_was_found_is_bent_further_for_a_few_frames():
    first = located(prior_at(TUBE.vertices), scan(TUBE.vertices + 0.4, TUBE), Health())
    assert first.health.settling == RULE.settling_frames
    health = Health(state="tracking", settling=RULE.settling_frames)
    moved = TUBE.vertices * [1.1, 1.0, 0.9] + 0.4
    normal = vertex_normals(moved, TUBE.faces)

    def off(position):
        return np.sqrt(np.square(np.einsum("va,va->v", position - moved, normal)).mean())

    for seed in range(RULE.settling_frames):
        last = located(first.prior._replace(position=TUBE.vertices + 0.4), scan(moved, TUBE, seed=seed), health)
        assert last.last.drift is DRIFT  # that of the track, which no search has replaced
        assert off(last.prior.position) < 0.5 * off(TUBE.vertices + 0.4)
        assert last.motion_start is last.prior.position
        health = last.health
    assert health.settling == 0
    assert located(first.prior, scan(moved, TUBE), health).prior is first.prior


def test_a_garment_that_was_found_learns_from_bending_that_it_moves():
    travel = np.array([0.04, -0.06, 0.0])  # m, of a frame
    known = State.at(TUBE.vertices, np.zeros(TUBE.vertices.shape), 0.005, 0.5, 1.0)
    settling = Health(state="tracking", settling=3)
    prior = predict(known, DT, None, Config().predict)
    moved = located(prior, scan(TUBE.vertices + travel, TUBE), settling).prior
    np.testing.assert_allclose(moved.velocity.mean(axis=0), travel / DT, rtol=0.35, atol=0.15)
    # of what is known for sure nothing is learned
    certain = located(prior._replace(P_pu=0 * prior.P_pu), scan(TUBE.vertices + travel, TUBE), settling).prior
    assert not certain.velocity.any()
    resting = located(prior, scan(TUBE.vertices, TUBE), settling).prior
    assert np.linalg.norm(resting.velocity.mean(axis=0)) < 0.2


def prior_at(position):
    return random_state(position, np.random.default_rng(0))


MODEL = model.build(TUBE)
UNTURNED = rigidity.identity(TUBE.n_vertices)
DRIFT = Drift.at(MODEL, 0.01)
DT = 1 / FPS


def located(prior, points, health, dt=DT, config=None, last=TUBE.vertices):
    track = Track(None, UNTURNED, DRIFT, 0.0, health, None, None, None)
    whole = dataclasses.replace(Config(), start=config or Start())
    problem = problem_of(MODEL, prior, whole, last=track, motion_start=last, rotation=UNTURNED)
    return locate(problem._replace(frame=frame_of(points), health=health, dt=dt))


def test_a_garment_in_place_is_left_alone():
    prior = prior_at(TUBE.vertices)
    same = located(prior, scan(TUBE.vertices, TUBE), Health())
    assert same.prior is prior
    assert same.motion_start is TUBE.vertices
    assert same.rotation is UNTURNED
    assert same.health.settling == 0


@pytest.mark.parametrize("state", ["tracking", "recovering"])
def test_a_garment_that_is_tracked_is_never_searched(state):
    prior = prior_at(TUBE.vertices)
    far = scan(TUBE.vertices + 0.4, TUBE)
    assert located(prior, far, Health(state=state)).prior is prior


@pytest.mark.parametrize(
    "health",
    [
        Health(),
        Health(state="lost"),
        Health(state="tracking", empty_for=0.1),
        Health(state="recovering", poor_for=0.1),
        Health(state="recovering", doubtful=True),
    ],
    ids=["start", "lost", "out of sight", "without a fit", "doubtful"],
)
def test_a_garment_that_was_not_seen_lately_is_searched(health):
    prior = prior_at(TUBE.vertices)._replace(acceleration=np.ones(TUBE.vertices.shape))
    moved = located(prior, scan(TUBE.vertices + 0.4, TUBE), health).prior
    assert rms(moved.position - TUBE.vertices - 0.4) < 0.05
    assert not moved.velocity.any()
    assert not moved.acceleration.any()


def test_a_garment_is_searched_after_a_gap():
    tracking = Health(state="tracking", spacing=1 / 30)
    moved = located(prior_at(TUBE.vertices), scan(TUBE.vertices + 0.4, TUBE), tracking, dt=0.5).prior
    assert rms(moved.position - TUBE.vertices - 0.4) < 0.05


def test_after_a_loss_the_template_is_sought_however_wrong_the_shape_is():
    torn = prior_at(TUBE.vertices * [1.0, 30.0, 1.0] + 7.0)
    found = located(torn, scan(TUBE.vertices, TUBE), Health(state="lost"), last=torn.position)
    assert rms(found.prior.position - TUBE.vertices) < 0.05
    assert found.motion_start is found.prior.position


@pytest.mark.parametrize("degrees", [0, 120, 180])
def test_the_template_is_sought_as_the_wearer_faced_and_not_as_its_file_does(degrees):
    """The last shape is torn, and stands turned to the template by these degrees."""
    truth, middle = SHIRT.vertices, SHIRT.vertices.mean(axis=0)
    faced = (truth - middle) @ turn(degrees).T + middle
    torn, shapes = faced * [1.0, 1.3, 1.0], []
    tracker = Tracker(SHIRT)
    track, cloth = tracker._track, tracker._setup.model
    problem = problem_of(cloth, prior_at(torn + 3.0), Config(), last=track, motion_start=torn, rotation=track.rotation)
    problem = problem._replace(frame=frame_of(scan(faced, SHIRT)), health=Health(state="lost"), dt=DT)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(relocalize, "_best_fit", lambda found, *_: shapes.extend(found) or Fit(found[0], np.inf, None))
        locate(problem)
    assert rms(shapes[1] - shapes[1].mean(axis=0) - (faced - faced.mean(axis=0))) < 1e-6


def test_the_search_can_be_switched_off_and_needs_enough_points():
    prior, far = prior_at(TUBE.vertices), scan(TUBE.vertices + 0.4, TUBE)
    assert located(prior, far, Health(), config=Start(search=False)).prior is prior
    assert located(prior, far[:50], Health(), config=Start(least_points=51)).prior is prior
    assert located(prior, far[:0], Health()).prior is prior
    assert Config.paper().start.search is False


def test_a_fruitless_search_is_repeated_ever_more_rarely():
    due = [k for k in range(100) if search_due(Health(state="lost", frames_unplaced=k), RULE)]
    assert due[0] == 0
    assert len(due) < 8
    assert (np.diff(due, 2) >= 0).all()
    due = [k for k in range(100_000) if search_due(Health(state="lost", frames_unplaced=k), RULE)]
    assert np.diff(due).max() == MOST_ROUNDS * RULE.search_interval, "who comes after an hour is found"
    for fps in (1, 5, 15):
        due = [k for k in range(10_000) if search_due(Health(state="lost", frames_unplaced=k, spacing=1 / fps), RULE)]
        assert np.diff(due).max() / fps <= max(LONGEST_WAIT, RULE.search_interval / fps), "whatever the rate"


def test_a_start_on_the_garment_is_tracked_from_the_first_frame():
    tracker = Tracker(SHIRT)
    tracker.reset(SAMPLE.garment_vertices[0])
    points, origin = Sensor(view="front", points=6000).capture(SAMPLE, 0, np.random.default_rng(0))
    result = tracker.step(points, timestamp=0.0, sensor_origin=origin)
    assert result.state == "tracking"
    assert rms(result.vertices - SAMPLE.garment_vertices[0]) < 0.012


@pytest.mark.parametrize(
    ("spacing", "dt", "gap"), [(1 / 30, 0.5, True), (0.5, 0.5, False), (1 / 30, 0.2, False), (0.0, 0.5, False)]
)
def test_a_slow_stream_is_no_gap(spacing, dt, gap):
    assert interrupted(Health(spacing=spacing), dt, RULE) is gap


def test_of_a_start_the_points_that_are_there_decide_however_few():
    """Half of the shirt is not in the cloud, which lies on the other half."""
    points, _ = captured("full", SHIRT.vertices, 0)
    problem = problem_of(SHIRT_MODEL, prior_at(SHIRT.vertices))
    cloud = frame_of(points[points[:, 0] > SHIRT.vertices[:, 0].mean()])
    start, later = (_cost_of_staying(cloud, problem._replace(health=Health(state=state))) for state in ("initializing", "lost"))
    assert start < 0.5 * later
