"""The garment's size: what all edges are strained by alike is a stretch of the template, learned where it is seen."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy import ndimage

from ddakf import Config, Mesh, Tracker, snapshot
from ddakf.errors import InvalidSnapshot
from ddakf.evaluation.sensors import Sensor
from ddakf.evaluation.sensors.camera import Camera, Intrinsics
from ddakf.garment import model
from ddakf.mesh import vertex_normals
from ddakf.physics import rigidity, size
from ddakf.stages.associate import RIM_NONE, RIM_WHOLE
from ddakf.types import Health, Hem, Measurement
from tests.lanes import every
from tests.stages.scenes import FPS, problem_of, rms, scan, tube
from tests.tracker_runs import SAMPLE, SHIRT, WEARER, assert_same

TUBE = tube()
GARMENT = model.build(TUBE, Config())
NUMBERS = Config().physics
OF_ONE_SIZE = dataclasses.replace(Config(), physics=dataclasses.replace(NUMBERS, size_memory=0.0))
DEPTH_CAMERA = Intrinsics(width=320, height=240, fx=285.0, fy=285.0, cx=159.5, cy=119.5)
STRETCH = np.array([[0.05, 0.01, -0.02], [0.01, -0.04, 0.0], [-0.02, 0.0, 0.02]])


def worn(scale, config=None, frames=30, *, placed=False, view="full", body=False):
    """A tracker of the sample with a template so large, after some frames, and its errors in metres."""
    poses = [pose if body else None for pose in SAMPLE.body_vertices]
    wearer = Mesh(poses[0], SAMPLE.body_faces) if body else None
    tracker = Tracker(Mesh(SHIRT.vertices * scale, SHIRT.faces), body=wearer, config=config)
    start, rng, errors = SAMPLE.garment_vertices[0], np.random.default_rng(1), []
    tracker.reset(vertices=start if placed else start.mean(axis=0) + (start - start.mean(axis=0)) * scale)
    for k in range(1, frames + 1):
        cloud = Sensor(view).capture(SAMPLE, k, rng)
        result = tracker.step(cloud.points, timestamp=k / FPS, sensor_origin=cloud.sensor_origin, body_vertices=poses[k])
        errors.append(rms(result.vertices - SAMPLE.garment_vertices[k]))
    return tracker, np.array(errors)


def cut_out(margin, frames=20):
    """A tracker of the sample on its body, seen by a camera whose mask is so many pixels too narrow, and its errors in metres."""
    tracker, rng, errors = Tracker(SHIRT, body=WEARER), np.random.default_rng(1), []
    tracker.reset(vertices=SAMPLE.garment_vertices[0])
    middle = SAMPLE.garment_vertices[0].mean(axis=0)
    camera = Camera.looking_at(DEPTH_CAMERA, middle + [0.0, 0.2, 2.0], middle)
    for k in range(1, frames + 1):
        shirt, body = SAMPLE.garment_vertices[k], SAMPLE.body_vertices[k]
        depth, face = camera.render([(shirt, SAMPLE.garment_faces), (body, SAMPLE.body_faces)])
        mask = (face >= 0) & (face < len(SAMPLE.garment_faces))
        if margin:
            mask = ndimage.binary_erosion(mask, iterations=margin)
        points = camera.unproject(depth, mask)
        points = points + 0.003 * rng.normal(size=points.shape)
        result = tracker.step(points, timestamp=k / FPS, sensor_origin=camera.eye, body_vertices=body)
        errors.append(rms(result.vertices - shirt))
    return tracker, np.array(errors)


def strain_of(position, measured=None):
    measured = np.ones(len(position), bool) if measured is None else measured
    return size.common_strain(position, measured, GARMENT, GARMENT.rest_length)


def test_a_stretch_of_the_whole_template_is_found():
    found, share = strain_of(TUBE.vertices @ (np.eye(3) + STRETCH))
    assert share == 1.0
    np.testing.assert_allclose(found, STRETCH, atol=0.006)


def test_a_rigid_motion_is_no_stretch():
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    assert np.abs(strain_of(TUBE.vertices @ turn.T + [1.0, 2.0, 3.0])[0]).max() < 1e-6


def test_only_edges_that_are_measured_count():
    upper = TUBE.vertices[:, 1] > 0.2
    position = np.where(upper[:, None], 1.05 * TUBE.vertices, TUBE.vertices)
    found, share = strain_of(position, upper)
    np.testing.assert_allclose(found, 0.05 * np.eye(3), atol=2e-3)
    assert 0.3 < share < 0.6
    none, share = strain_of(position, np.zeros(len(position), bool))
    assert not none.any()
    assert share == 0.0


def test_across_a_sheet_it_is_the_mean_of_its_other_directions():
    x, y = np.meshgrid(np.arange(8) * 0.03, np.arange(8) * 0.03)
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(64)], axis=1)
    corner = (np.arange(7)[:, None] * 8 + np.arange(7)).ravel()
    faces = np.concatenate([np.stack([corner, corner + 1, corner + 8], 1), np.stack([corner + 1, corner + 9, corner + 8], 1)])
    sheet = model.build(Mesh(vertices, faces), Config())
    found, _ = size.common_strain(vertices * [1.06, 1.02, 1.0], np.ones(64, bool), sheet, sheet.rest_length)
    assert found[2, 2] == pytest.approx(0.04, abs=0.01)
    assert found[0, 0] > found[2, 2] > found[1, 1]


@pytest.mark.parametrize("scale", [0.93, 1.0, 1.05])
def test_a_start_has_the_size_that_it_shows_up_to_the_slack(scale):
    found = size.at_start(scale * TUBE.vertices, GARMENT, NUMBERS)
    expected = np.sign(scale - 1.0) * max(abs(scale - 1.0) - NUMBERS.size_slack, 0.0)
    np.testing.assert_allclose(found, expected * np.eye(3), atol=4e-3)


def test_noise_of_a_start_is_no_size():
    noisy = TUBE.vertices + 0.03 * np.random.default_rng(1).normal(size=TUBE.vertices.shape)
    assert np.abs(size.at_start(noisy, GARMENT, NUMBERS)).max() < 0.3 * np.abs(strain_of(noisy)[0]).max()


@pytest.mark.parametrize("scale", every(3, [[1.05, 0.98, 1.05], [0.95, 0.95, 0.95], [1.05, 1.05, 1.05]]), ids=str)
def test_a_template_of_another_size_is_followed_nearly_as_the_right_one(scale):
    _, right = worn(1.0)
    tracker, errors = worn(np.array(scale))
    _, given = worn(np.array(scale), OF_ONE_SIZE)
    assert errors[-10:].mean() < 1.5 * right[-10:].mean()
    assert errors[-10:].mean() < 0.8 * given[-10:].mean()
    np.testing.assert_allclose(np.diag(tracker._track.size), -np.log(scale), atol=0.02)


@pytest.mark.parametrize("scale", [[0.95, 0.95, 0.95], [1.05, 0.98, 1.05]], ids=str)
def test_where_the_caller_places_a_garment_of_another_size_it_has_that_size_at_once(scale):
    tracker, errors = worn(np.array(scale), frames=5, placed=True)
    assert errors.mean() < 1.2 * worn(1.0, frames=5)[1].mean()
    np.testing.assert_allclose(np.diag(tracker._track.size), -np.log(scale), atol=0.012)


def test_a_garment_of_its_templates_size_keeps_it():
    tracker, _ = worn(1.0)
    assert np.abs(tracker._track.size).max() < 0.005


@pytest.mark.parametrize("scale", every(2, [0.93, 1.07]))
def test_one_side_of_a_garment_on_a_body_tells_its_size_in_the_mean_of_all_directions(scale):
    tracker, errors = worn(scale, view="front", body=True)
    learned = np.diag(tracker._track.size) / -np.log(scale)
    assert np.ptp(learned) < 1e-9
    assert 0.2 < learned[0] < 1.1
    assert errors[-10:].mean() < 0.95 * worn(scale, OF_ONE_SIZE, view="front", body=True)[1][-10:].mean()


@pytest.mark.parametrize(("scale", "body"), [(1.0, True), (1.07, False)])
def test_one_side_of_a_garment_of_its_templates_size_or_without_a_body_teaches_nothing(scale, body):
    tracker, _ = worn(scale, view="front", body=body)
    assert not tracker._track.size.any()


def test_little_that_is_seen_teaches_no_size():
    height, last = TUBE.vertices[:, 1], SimpleNamespace(size=np.zeros((3, 3)), health=Health(state="tracking"))
    problem = problem_of(GARMENT, None, Config(), last=last, body=object())
    seen = [height > np.quantile(height, q) for q in (0.5, 0.9)]
    sizes = [size.learn(problem, estimate_of(None, learnable), 1.05 * TUBE.vertices, 1.0) for learnable in seen]
    assert [learned.any() for learned in sizes] == [True, False]


def estimate_of(hem, learnable=None, position=None):
    measurement = Measurement.none(len(TUBE.vertices))._replace(hem=hem)
    return SimpleNamespace(learnable=learnable, terms=SimpleNamespace(measurement=measurement), position=position)


def hems_of(ends, turn=None, noise=0.0, velocity=0.0):
    """The tube's hems, and a problem, where the cloud ends at (V, 3) ``ends`` of its vertices; all turned."""
    turn, (vertex, before, after) = np.eye(3) if turn is None else turn, GARMENT.boundary.T
    rest, normals = TUBE.vertices, vertex_normals(TUBE.vertices, TUBE.faces)
    outward = np.cross(rest[after] - rest[before], normals[vertex])
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    offset = np.einsum("ha,ha->h", outward, (ends - rest)[vertex])
    offset += noise * np.random.default_rng(1).normal(size=len(offset))
    hem = Hem(outward @ turn.T, offset, np.ones(len(vertex)))
    last = SimpleNamespace(state=SimpleNamespace(position=rest @ turn.T))
    problem = problem_of(GARMENT, None, Config(), rotation=np.tile(turn, (len(rest), 1, 1)), last=last)
    return problem, estimate_of(hem, position=last.state.position + problem.dt * velocity)


def test_hems_tell_how_much_too_large_a_garment_is_wherever_it_is_turned():
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    for placed in (np.eye(3), turn):
        found = size.hem_strain(*hems_of(0.95 * TUBE.vertices + [0.01, 0.02, 0.0], placed))
        assert found == pytest.approx(-0.05, abs=0.003)


def test_clouds_that_end_farther_out_or_beside_the_hems_are_no_size():
    assert size.hem_strain(*hems_of(1.05 * TUBE.vertices)) == 0.0
    assert size.hem_strain(*hems_of(TUBE.vertices + [0.0, 0.02, 0.0])) == pytest.approx(0.0, abs=1e-3)
    assert size.hem_strain(problem_of(GARMENT, None, Config()), estimate_of(None)) == 0.0


def test_hems_that_disagree_tell_less():
    clear, blurred = (size.hem_strain(*hems_of(0.95 * TUBE.vertices, noise=noise)) for noise in (0.0, 0.02))
    assert clear < 1.5 * blurred < 0.0


def test_hems_that_are_believed_by_half_tell_half():
    problem, estimate = hems_of(0.95 * TUBE.vertices)
    hem = estimate.terms.measurement.hem
    doubted = estimate_of(hem._replace(weight=0.5 * hem.weight, belief=0.5), position=estimate.position)
    assert size.hem_strain(problem, doubted) == pytest.approx(0.5 * size.hem_strain(problem, estimate), rel=1e-3)


def test_hems_that_fly_tell_less_and_hems_that_move_together_do_not():
    ends = 0.95 * TUBE.vertices
    still, moved, flown = (size.hem_strain(*hems_of(ends, velocity=v)) for v in (0.0, np.ones(3), -1.0 * TUBE.vertices))
    assert moved == pytest.approx(still, rel=1e-3)
    assert 0.5 * still < flown < 0.0


def test_the_papers_preset_has_the_templates_size():
    tracker, _ = worn(1.05, Config.paper(), frames=2, placed=True)
    assert not tracker._track.size.any()
    assert not tracker._track.resting.size.any()


def test_size_is_bounded():
    tracker = Tracker(Mesh(1.5 * TUBE.vertices, TUBE.faces))
    tracker.reset(vertices=TUBE.vertices)
    assert np.linalg.eigvalsh(tracker._track.size)[0] == pytest.approx(-np.log1p(NUMBERS.size_most), abs=1e-6)


def test_a_shape_at_rest_is_made_anew_only_where_its_size_has_changed():
    tracker = Tracker(TUBE)
    tracker.reset(vertices=TUBE.vertices)
    shape, setup = tracker._track.resting, tracker._setup
    assert rigidity.resize(shape, shape.size + 0.5 * rigidity.NOTICED * np.eye(3), setup) is shape
    larger = rigidity.resize(shape, shape.size + 0.05 * np.eye(3), setup)
    np.testing.assert_allclose(larger.length, np.exp(0.05) * shape.length, rtol=1e-5)
    np.testing.assert_allclose(larger.edge, np.exp(0.05) * shape.edge, atol=1e-4)
    assert rigidity.resize(None, np.zeros((3, 3)), setup) is None
    assert not rigidity.resize(None, 0.05 * np.eye(3), setup).given


@pytest.mark.parametrize("growth", [-0.05, 0.015, 0.05])
def test_a_garment_that_nobody_placed_rests_as_its_template_at_that_size(growth):
    shape = rigidity.of_template(growth * np.eye(3), Tracker(TUBE)._setup)
    np.testing.assert_allclose(shape.edge, np.exp(growth) * GARMENT.rest_edge, atol=1e-6)
    np.testing.assert_allclose(shape.strain.area, np.exp(2.0 * growth) * GARMENT.strain.area, rtol=1e-6)
    corners = shape.position[shape.strain.corner]
    np.testing.assert_allclose(np.linalg.norm(np.einsum("fa,fab->fb", shape.strain.warp, corners), axis=1), 1.0, atol=1e-6)


@pytest.mark.parametrize("placed", [False, True])
def test_a_snapshot_has_the_size(placed):
    tracker, _ = worn(1.05, frames=12, placed=placed)
    assert np.abs(tracker._track.size).max() > 0.01
    goes_on_exactly(tracker)


def test_a_snapshot_has_the_size_of_a_garment_that_nobody_placed():
    tracker = Tracker(Mesh(0.93 * TUBE.vertices, TUBE.faces))
    for k in range(30):
        tracker.step(scan(TUBE.vertices, TUBE, 4000, 0.002, seed=k), timestamp=k / FPS)
    assert tracker._track.resting is not None
    assert not tracker._track.resting.given
    small = rigidity.of_template(0.3 * rigidity.NOTICED * np.eye(3), tracker._setup)  # as when a size goes back
    tracker._track = tracker._track._replace(resting=small, size=small.size)
    tracker.configured(Config.fast())
    twin = Tracker.restore(tracker.snapshot())
    points = scan(TUBE.vertices, TUBE, 4000, 0.002, seed=30)
    assert_same(*(each.step(points, timestamp=1.0) for each in (tracker, twin)))


def goes_on_exactly(tracker):
    twin, rng = Tracker.restore(tracker.snapshot()), np.random.default_rng(2)
    for k in range(13, 17):
        points = Sensor("full").capture(SAMPLE, k, rng).points
        assert_same(*(each.step(points, timestamp=k / FPS) for each in (tracker, twin)))
    assert twin.snapshot() == tracker.snapshot()


@pytest.mark.parametrize("name", ["size", "resting_size"])
@pytest.mark.parametrize("value", [np.zeros((2, 2)), np.full((3, 3), np.inf), np.triu(np.ones((3, 3))), 9.0 * np.eye(3)])
def test_a_size_that_is_none_is_refused(name, value):
    numbers, arrays = snapshot.parts(worn(1.05, frames=2, placed=True)[0])
    with pytest.raises(InvalidSnapshot, match=name):
        Tracker.restore(snapshot.pack(numbers, arrays | {name: value}))


def test_a_lighter_tracker_goes_on_with_the_size_and_its_shape():
    tracker, errors = worn(1.05, placed=True)
    lighter = tracker.configured(Config.fast())
    np.testing.assert_array_equal(lighter._track.size, tracker._track.size)
    cloud = Sensor("full").capture(SAMPLE, 31, np.random.default_rng(1))
    found = lighter.step(cloud.points, timestamp=31 / FPS).vertices
    assert rms(found - SAMPLE.garment_vertices[31]) < 1.5 * errors[-5:].mean()
    grown = lighter._track.size + 0.05 * np.eye(3)
    lighter._track = lighter._track._replace(size=grown, resting=rigidity.resize(lighter._track.resting, grown, lighter._setup))
    tracker.continue_from(lighter)
    assert tracker._track.resting.source is None  # the shape of the start itself, and none that was carried over
    np.testing.assert_array_equal(tracker._track.size, grown)


def test_a_mask_that_is_too_narrow_makes_no_smaller_garment():
    """Its cloud ends before the hems do, but it ends before the rim as well, where cloth turns away from the camera."""
    (exact, _), (narrow, errors) = cut_out(0), cut_out(3)
    of_exact, of_narrow = (np.trace(tracker._track.size) / 3.0 for tracker in (exact, narrow))
    gaps = [tracker._track.health.rim_gap for tracker in (exact, narrow)]
    assert gaps[0] < RIM_WHOLE < RIM_NONE < gaps[1]
    assert (of_exact, of_narrow) == pytest.approx((0.0, 0.0), abs=0.01)
    assert errors[-1] < 0.02
