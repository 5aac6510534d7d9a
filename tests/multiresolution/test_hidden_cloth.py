"""Hidden cloth of a garment without a body follows the seen cloth near it."""

from __future__ import annotations

import dataclasses
from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker, snapshot
from ddakf.multiresolution import hidden_cloth
from tests.stages.scenes import inner_body, scan, tube

GARMENT = tube()
ALONE = dataclasses.replace(Config(), follow=dataclasses.replace(Config().follow, reach=0.0))


def turned(vertices: np.ndarray, angle: float) -> np.ndarray:
    """(V, 3) turned about the direction of sight, which a camera sees best."""
    c, s = np.cos(angle), np.sin(angle)
    return vertices @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])


def front(vertices: np.ndarray, frame: int) -> np.ndarray:
    points = scan(vertices, GARMENT, 3000, 0.001, frame)
    return points[points[:, 2] > vertices[:, 2].mean() + 0.02]


def tracked(config: Config, body: Mesh | None = None, frames: int = 30):
    """A tube that turns by a degree in each frame and comes nearer, seen from the front: tracker, last result, truth."""
    tracker = Tracker(GARMENT, body=body, config=config)
    for k in range(1, frames + 1):
        truth = turned(GARMENT.vertices, np.radians(1.0 * k)) + [0.0, 0.0, 0.002 * k]
        more = {} if body is None else {"body_vertices": body.vertices}
        result = tracker.step(front(truth, k), timestamp=k / 30, sensor_origin=[0.0, 0.0, 3.0], **more)
    return tracker, result, truth


def test_hidden_cloth_is_nearer_to_where_the_seen_cloth_carries_it():
    errors, trackers = [], (Tracker(GARMENT, config=ALONE), Tracker(GARMENT))
    for k in range(1, 61):
        truth = turned(GARMENT.vertices, np.radians(1.0 * k)) + [0.0, 0.0, 0.005 * k]
        seen = {"timestamp": k / 30, "sensor_origin": [0.0, 0.0, 3.0]}
        alone, led = (tracker.step(front(truth, k), **seen) for tracker in trackers)
        hidden = ~led.observed & ~alone.observed
        assert hidden.mean() > 0.3
        errors.append([np.sqrt(np.square(each.vertices - truth)[hidden].sum(axis=1).mean()) for each in (alone, led)])
    before, after = np.mean(errors[20:], axis=0)
    assert after < before


def test_seen_cloth_stays_where_it_is_and_the_offset_sets_in_with_distance():
    tracker, result, _ = tracked(Config())
    size = np.linalg.norm(tracker._track.offset, axis=1)
    assert (size[result.observed] == 0).all()
    border = np.unique(GARMENT.faces[result.observed[GARMENT.faces].any(axis=1)])
    assert size[border].mean() < 0.5 * size[~result.observed].mean()


@pytest.mark.parametrize("config", [ALONE, Config.paper()], ids=["off", "paper"])
def test_without_it_the_result_is_the_state(config):
    tracker, result, _ = tracked(config, frames=3)
    assert tracker._track.offset is None
    np.testing.assert_array_equal(result.vertices, tracker._track.state.position)


def test_with_a_body_it_does_nothing():
    assert tracked(Config(), inner_body(GARMENT), 3)[0]._track.offset is None


def test_what_is_shown_fades_while_nothing_is_seen():
    """Hidden cloth does not jump back in an empty frame, nor in the one after it."""
    tracker, _, truth = tracked(Config())
    shown = [tracker._track.offset]
    for k, points in ((31, np.empty((0, 3))), (32, front(truth, 32))):
        tracker.step(points, timestamp=k / 30, sensor_origin=[0.0, 0.0, 3.0])
        shown.append(tracker._track.offset)
    faded = np.exp(-1 / 30 / Config().follow.time)
    assert shown[0].any()
    for before, after in pairwise(shown):
        np.testing.assert_allclose(after, faded * before)
    for k in range(120):
        lost = tracker.step(np.empty((0, 3)), timestamp=2 + k / 30)
    assert lost.state == "lost"
    assert tracker._track.offset is None


def test_what_is_shown_does_not_jump_where_more_and_more_is_seen():
    """The offset of the same garment, were so many of its vertices seen."""
    tracker, _, _ = tracked(Config())
    track, model = tracker._track, tracker._setup.model
    health, resting = track.health, track.resting
    problem = SimpleNamespace(config=Config(), model=model, body=None, health=health, resting=resting, dt=1 / 30)
    order, sizes = np.argsort(-GARMENT.vertices[:, 2]), []
    for count in range(len(order) // 3, len(order)):
        seen = np.zeros(len(order), bool)
        seen[order[:count]] = True
        posterior = SimpleNamespace(state=track.state, _replace=lambda state: state)
        _, offset = hidden_cloth.follow_seen(problem, SimpleNamespace(learnable=seen), posterior)
        sizes.append(0.0 if offset is None else np.linalg.norm(offset, axis=1).max())
    assert sizes[-1] == 0 < sizes[0]
    assert np.abs(np.diff(sizes)).max() < 0.15 * max(sizes)


def test_a_rigid_motion_is_found_whatever_is_seen():
    tracker, _, _ = tracked(Config(), frames=3)
    model, rng = tracker._setup.model, np.random.default_rng(0)
    start, truth = GARMENT.vertices, turned(GARMENT.vertices, 0.7) + [0.1, 0.2, 0.3]
    problem = type("Frame", (), {"model": model, "config": Config()})
    rotation, translation = hidden_cloth._motions(start, truth, rng.random(len(start)) < 0.5, problem)
    np.testing.assert_allclose(start @ rotation[0].T + translation[0], truth, atol=1e-9)
    assert np.allclose(np.linalg.det(rotation), 1.0)


def test_a_snapshot_and_a_prediction_know_what_was_shown():
    tracker, result, _ = tracked(Config())
    again = snapshot.load(snapshot.save(tracker, 1), Tracker)
    np.testing.assert_array_equal(again._track.offset, tracker._track.offset)
    at_once, soon = (tracker.predicted(result, seconds).vertices for seconds in (0.0, 1e-6))
    np.testing.assert_allclose(soon, at_once, atol=1e-5)
