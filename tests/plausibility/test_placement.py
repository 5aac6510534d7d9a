"""Placement: points out of reach, an origin amid its points, a body that the garment is not on, or that is late."""

import numpy as np
import pytest
from scipy import ndimage

from ddakf import Mesh, Tracker
from ddakf.evaluation.sensors import Camera, Intrinsics, Sensor
from tests.stages.scenes import FPS
from tests.tracker_runs import BODY, EYE, SAMPLE, SHIRT, TUBE, WEARER, cloud, swaying, worn


def front(k):
    """The points that a sensor at ``EYE`` sees."""
    points = cloud(k)
    return points[points[:, 2] > TUBE.vertices[:, 2].mean()]


def last_of(frames, body=None):
    """The warnings of the last frame by code, and the number of frames without any."""
    tracker, quiet = Tracker(TUBE, body=body), 0
    for k, (points, how) in enumerate(frames):
        result = tracker.step(points, timestamp=k / FPS, **how)
        quiet += not result.warnings
    return {warning.code: warning for warning in result.warnings}, quiet


def test_points_that_stay_out_of_reach_are_told_with_their_distance():
    wall = np.random.default_rng(1).uniform(-1, 1, (3000, 3)) * [1.0, 0.5, 0.001] + [0.0, 0.2, -3.0]
    frames = [(front(k), {"sensor_origin": EYE}) for k in range(3)]
    frames += [(wall.astype(np.float32), {"sensor_origin": EYE})] * 10
    found, quiet = last_of(frames)
    assert found.keys() == {"nothing_in_reach"}
    assert "3000 points" in found["nothing_in_reach"].message
    assert "2.8" in found["nothing_in_reach"].message
    assert quiet >= 3 + 4


def test_a_garment_that_jumps_and_is_found_is_no_sign():
    frames = [(cloud(k) + np.float32([0.0 if k < 5 else 0.8, 0, 0]), {}) for k in range(20)]
    assert last_of(frames) == ({}, 20)


def test_empty_frames_are_no_sign():
    """A search between them may rightly tell that a tube looks alike when it is turned."""
    tracker, told = Tracker(TUBE), set()
    for k in range(20):
        result = tracker.step(cloud(k)[: 0 if k % 4 else None], timestamp=k / FPS)
        told |= {warning.code for warning in result.warnings}
    assert told <= {"heading_uncertain"}


@pytest.mark.parametrize("view", ["full", "front"])
@pytest.mark.parametrize("given", ["the garment", "the person", "the person and the body", "the person, a body without its pose"])
def test_a_whole_person_is_told_unless_the_body_explains_it(view, given):
    frames, sensor = [], Sensor(view, points=4000, segmented=given == "the garment")
    for k in range(1, 15):
        points, eye = sensor.capture(SAMPLE, k, np.random.default_rng([1, k]))
        body = SAMPLE.body_vertices[k] if given.endswith("the body") else None
        frames.append((points, {"sensor_origin": eye, "body_vertices": body}))
    tracker = Tracker(SHIRT, body=WEARER if "body" in given else None)
    tracker.reset(SAMPLE.garment_vertices[0])
    told = [tracker.step(points, timestamp=k / FPS, **how).warnings for k, (points, how) in enumerate(frames)]
    assert not any(told[:9])
    due = [("whole_person", "points")] if given == "the person" else []
    assert [(warning.code, warning.field) for warning in told[-1]] == due


def test_a_room_about_the_garment_is_no_whole_person():
    """Its points may be so few among the others that none is in the sample."""
    wall = np.random.default_rng(1).uniform(-1.5, 1.5, (200_000, 3)) * [1.0, 1.0, 0.001] + [0.0, 0.0, -1.5]
    scenes = (np.concatenate([wall[:1], front(k), wall[1:]]).astype(np.float32) for k in range(14))
    assert last_of([(points, {"sensor_origin": EYE}) for points in scenes]) == ({}, 14)


@pytest.mark.parametrize("each", [False, True], ids=["one origin", "one per point"])
def test_an_origin_amid_its_points_is_told(each):
    def origin(points, place):
        return np.tile(place, (len(points), 1)) if each else np.asarray(place)

    frames = [(cloud(k), {"sensor_origin": origin(cloud(k), cloud(k).mean(axis=0))}) for k in range(4)]
    found, _ = last_of(frames)
    assert found["points_behind_sensor"].field == "sensor_origin"
    assert last_of([(front(k), {"sensor_origin": origin(front(k), EYE)}) for k in range(4)]) == ({}, 4)


def test_cameras_on_all_sides_are_no_sign():
    eyes = 2.0 * np.array([[0, 0.1, 1], [1, 0.1, 0], [0, 0.1, -1], [-1, 0.1, 0]])
    frames = []
    for k in range(4):
        points = cloud(k)
        nearest = np.linalg.norm(points[:, None] - eyes, axis=2).argmin(axis=1)
        frames.append((points, {"sensor_origin": eyes[nearest]}))
    assert last_of(frames) == ({}, 4)


def test_a_body_elsewhere_is_told():
    def frames(shift):
        for k in range(6):
            worn = BODY.vertices + swaying(k)[0] - TUBE.vertices[0] + shift
            yield cloud(k), {"body_vertices": worn}

    assert last_of(frames(0.0), BODY) == ({}, 6)
    tracker = Tracker(TUBE, body=BODY)
    results = [tracker.step(points, timestamp=k / FPS, **how) for k, (points, how) in enumerate(frames([3.0, 0.0, 0.0]))]
    told = [warning for result in results for warning in result.warnings if warning.code == "body_apart"]
    assert {warning.field for warning in told} == {"body_vertices"}
    assert any(f"middles are {apart} m apart" in told[0].message for apart in ("2.9", "3"))


@pytest.mark.parametrize(("late", "told"), [(0, False), (3, True)])
def test_a_body_that_is_late_is_told(late, told):
    results = worn("front", lambda k: SAMPLE.body_vertices[max(0, k - late)])
    found = [warning for result, _ in results for warning in result.warnings if warning.code == "body_off"]
    assert bool(found) == told
    assert all(warning.field == "body_vertices" and "mm inside the body" in warning.message for warning in found)


def test_a_garment_that_a_texture_has_split_is_told():
    half = TUBE.vertices[TUBE.faces].mean(axis=1)[:, 1] > TUBE.vertices[:, 1].mean()
    upper, lower = (TUBE.faces[chosen] for chosen in (half, ~half))
    split = Mesh(*_used(np.concatenate([TUBE.vertices, TUBE.vertices]), np.concatenate([upper, lower + TUBE.n_vertices])))
    result = Tracker(split).step(cloud(0), timestamp=0.0, sensor_origin=EYE)
    (warning,) = (each for each in result.warnings if each.code == "split_seams")
    assert (warning.field, str(split.split_edges) in warning.message) == ("garment", True)
    joined, _ = Mesh.cleaned(split.vertices, split.faces)
    assert Tracker(joined).step(cloud(0), timestamp=0.0, sensor_origin=EYE).warnings == ()


@pytest.mark.parametrize(("apart", "told"), [(0.005, True), (0.2, False)])
def test_a_part_beside_the_rest_that_is_not_joined_to_it_is_told(apart, told):
    """As a sleeve beside its armhole, not as trousers below a shirt."""
    half = TUBE.vertices[TUBE.faces].mean(axis=1)[:, 1] > TUBE.vertices[:, 1].mean()
    raised = TUBE.vertices + [0.0, apart, 0.0]
    parts = np.concatenate([TUBE.faces[half], TUBE.faces[~half] + TUBE.n_vertices])
    garment = Mesh(*_used(np.concatenate([raised, TUBE.vertices]), parts))
    result = Tracker(garment).step(cloud(0), timestamp=0.0, sensor_origin=EYE)
    found = [each for each in result.warnings if each.code == "split_seams"]
    assert bool(found) == told
    assert all("5 mm beside another part" in each.message for each in found)


def _used(vertices, faces):
    kept, numbers = np.unique(faces, return_inverse=True)
    return vertices[kept], numbers.reshape(faces.shape)


@pytest.mark.parametrize("pixels", [0, 1, 3])
def test_a_mask_that_is_too_narrow_is_told(pixels):
    """A pixel is 7 mm wide at the garment. One of them is no more than what the template's size may do."""
    middle = SAMPLE.garment_vertices[0].mean(axis=0)
    eye = middle + [0.0, 0.2, 2.0]
    camera = Camera.looking_at(Intrinsics(width=320, height=240, fx=285.0, fy=285.0, cx=159.5, cy=119.5), eye, middle)
    tracker, told = Tracker(SHIRT, body=WEARER), []
    tracker.reset(SAMPLE.garment_vertices[0])
    for k in range(1, 25):
        shirt, wearer = SAMPLE.garment_vertices[k], SAMPLE.body_vertices[k]
        depth, face = camera.render([(shirt, SAMPLE.garment_faces), (wearer, SAMPLE.body_faces)])
        mask = (face >= 0) & (face < len(SAMPLE.garment_faces))
        if pixels:
            mask = ndimage.binary_erosion(mask, iterations=pixels)
        points = camera.unproject(depth, mask).astype(np.float32)
        result = tracker.step(points, timestamp=k / FPS, sensor_origin=eye, body_vertices=wearer)
        told.append([(warning.code, warning.field) for warning in result.warnings])
    assert not any(told[:8])
    assert told[-1] == ([("narrow_mask", "points")] if pixels > 1 else [])


@pytest.mark.parametrize("views", [("front",), ("front", "back"), ("all around",)])
@pytest.mark.parametrize("of_each", [True, False])
def test_one_origin_for_the_points_of_several_cameras_is_told(views, of_each):
    middle = SAMPLE.garment_vertices[0].mean(axis=0)
    eyes = {"front": middle + [0.0, 0.2, 2.0], "back": middle + [0.0, 0.2, -2.0]}
    lens = Intrinsics(width=320, height=240, fx=285.0, fy=285.0, cx=159.5, cy=119.5)
    tracker, told = Tracker(SHIRT), []
    tracker.reset(SAMPLE.garment_vertices[0])
    for k in range(1, 12):
        clouds, origins = [], []
        for view in views:
            if view == "all around":
                clouds.append(Sensor("full", points=4000).capture(SAMPLE, k, np.random.default_rng(k)).points)
                origins.append(np.tile(eyes["front"], (len(clouds[-1]), 1)))
                continue
            camera = Camera.looking_at(lens, eyes[view], middle)
            depth, face = camera.render([(SAMPLE.garment_vertices[k], SAMPLE.garment_faces)])
            clouds.append(camera.unproject(depth, face >= 0))
            origins.append(np.tile(eyes[view], (len(clouds[-1]), 1)))
        origin = np.concatenate(origins) if of_each and "all around" not in views else eyes["front"]
        result = tracker.step(np.concatenate(clouds).astype(np.float32), timestamp=k / FPS, sensor_origin=origin)
        told.append([warning.code for warning in result.warnings])
    due = views == ("all around",) or (len(views) > 1 and not of_each)
    assert ("points_behind_sensor" in told[-1]) == due
