"""Contact: how close a garment may come to the body, and what moves that."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config
from ddakf.body import contact
from ddakf.config import Physics
from ddakf.physics import collision
from ddakf.types import Health, Track
from tests.physics.shapes import ball, sheet
from tests.stages.scenes import posed, problem_of

MESH, BODY, RADIUS = sheet(), ball(3), 0.2
CONFIG = Physics(thickness=0.004, gap_time=0.5)
HEIGHTS = np.linspace(-0.05, 0.02, MESH.n_vertices)  # m, of the vertices above the body


def above(heights):
    """(V, 3) points above the middle of a face, where the distance is the height."""
    corners = BODY.vertices[BODY.faces[0]]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    return corners.mean(axis=0) + np.outer(heights, normal)


MODEL = contact.build(BODY, 0.1)


def contact_at(heights):
    """The body under vertices that start at these heights."""
    return contact.start(MODEL, above(heights), CONFIG)


def residuals(track, heights):
    position = above(heights)
    constants, pose = collision.build(MESH, CONFIG.thickness), contact.posed(MODEL, track)
    return collision.linearize(position, constants, contact.nearest(pose, position).closest, track.gap).residual


def after(track, heights, observed, dt, searched=True):
    """The body after a frame in which vertices were found at these heights."""
    last = Track(None, None, None, 0.0, Health(), None, track, None)
    pose, position = contact.posed(MODEL, track), above(heights)
    problem = problem_of(None, None, dataclasses.replace(Config(), physics=CONFIG), last=last, body=pose, dt=dt)
    return contact.learned(problem, contact.nearest(pose, position) if searched else None, position, observed)


def test_what_starts_inside_may_stay_and_may_not_go_deeper():
    track, allowed = contact_at(HEIGHTS), -Physics.deepest_gap <= HEIGHTS
    np.testing.assert_allclose(residuals(track, HEIGHTS)[allowed], 0.0, atol=1e-9)
    np.testing.assert_allclose(residuals(track, HEIGHTS)[~allowed], (HEIGHTS + Physics.deepest_gap)[~allowed], atol=1e-9)
    deeper = residuals(track, HEIGHTS - 0.003)
    np.testing.assert_allclose(deeper, np.minimum(0.0, HEIGHTS - 0.003 - track.gap), atol=1e-9)
    assert (deeper[CONFIG.thickness > HEIGHTS] < 0).all()


def test_what_starts_outside_keeps_the_thickness():
    track = contact_at(np.abs(HEIGHTS) + CONFIG.thickness)
    np.testing.assert_allclose(residuals(track, HEIGHTS), np.minimum(0.0, HEIGHTS - CONFIG.thickness), atol=1e-9)


def test_seen_vertices_change_their_gap_and_the_others_do_not():
    start, end = np.full_like(HEIGHTS, -0.010), np.full_like(HEIGHTS, -0.002)
    track, observed = contact_at(start), np.arange(len(HEIGHTS)) % 2 == 0
    for _ in range(60):
        track = after(track, end, observed, 1 / 30)
    np.testing.assert_allclose(track.gap[~observed], -0.010, atol=1e-9)
    np.testing.assert_allclose(track.gap[observed], -0.002 - 0.008 * np.exp(-2.0 / 0.5), atol=1e-9)


def test_the_gap_follows_time_and_not_frames():
    start, end = np.full_like(HEIGHTS, 0.003), np.full_like(HEIGHTS, -0.005)
    gaps, all_seen = [], np.ones(len(HEIGHTS), bool)
    for frames in (12, 3):
        track = contact_at(start)
        for _ in range(frames):
            track = after(track, end, all_seen, 0.3 / frames)
        gaps.append(track.gap)
    np.testing.assert_allclose(*gaps, atol=1e-12)


@pytest.mark.parametrize("searched", [False, True])
def test_no_body_in_reach_leaves_the_gap_alone(searched):
    track = contact_at(HEIGHTS)
    far = after(track, np.full_like(HEIGHTS, 0.5), np.ones(len(HEIGHTS), bool), 1.0, searched)
    np.testing.assert_array_equal(far.gap, track.gap)


def test_a_frame_leaves_the_last_track_as_it_was():
    track = contact_at(HEIGHTS)
    gap = track.gap.copy()
    changed = after(track, HEIGHTS + 0.001, np.ones(len(HEIGHTS), bool), 1.0)
    assert not np.array_equal(changed.gap, gap)
    np.testing.assert_array_equal(track.gap, gap)


def test_another_configuration_has_its_own_gaps():
    track, position = contact_at(HEIGHTS), above(HEIGHTS)
    none = contact.configured(MODEL, track, position, Physics(gap_time=0.0))
    assert none.gap is None
    again = contact.configured(MODEL, none, position, CONFIG)
    np.testing.assert_array_equal(again.gap, track.gap)
    thinner = contact.configured(MODEL, track, position, Physics(thickness=0.001, gap_time=0.5))
    np.testing.assert_array_equal(thinner.gap, np.minimum(track.gap, 0.001))


def test_a_search_of_the_nearest_vertices_finds_what_a_search_of_all_finds():
    """However far the vertices moved since, in whatever direction: only those that cannot touch keep their old points."""
    rng = np.random.default_rng(0)
    position, pose = above(np.abs(HEIGHTS)), posed(BODY)
    contacts = contact.nearest(pose, position)
    for _ in range(5):
        position = position + rng.normal(size=position.shape) * rng.uniform(0, 0.02, (len(position), 1))
        contacts = contact.closest(pose, position, contacts, CONFIG.thickness)
        found, exact = contacts.closest, contact.nearest(posed(BODY), position).closest
        near = exact.distance < CONFIG.thickness
        assert near.any()
        np.testing.assert_array_equal(found.face[near], exact.face[near])
        np.testing.assert_array_equal(found.distance[near], exact.distance[near])
        np.testing.assert_array_equal(found.normal[near], exact.normal[near])


def test_a_vertex_that_was_far_from_the_body_is_searched_at_once():
    position = above(np.abs(HEIGHTS))
    track = contact.start(MODEL, position, CONFIG)
    exact = contact.nearest(contact.posed(MODEL, track), position)
    far = exact.closest._replace(face=np.full(len(position), -1, np.int32))
    pose = contact.posed(MODEL, track._replace(contacts=contact.Contacts(far, position), turn=1))
    last, health = Track(None, None, None, 0.0, Health(), None, track, None), Health(state="tracking")
    found = contact.followed(problem_of(None, None, last=last, body=pose, health=health), position)
    np.testing.assert_array_equal(found.closest.face, exact.closest.face)


def test_each_vertex_is_searched_in_the_whole_body_once_in_a_round_of_frames(monkeypatch):
    """Nothing follows the body's surface, so that only searches find it, until every vertex had one."""
    monkeypatch.setattr(contact.proximity.walk_kernels, "walk", lambda *_: None)
    every, position = CONFIG.faces_followed, above(np.abs(HEIGHTS))
    track = contact.start(MODEL, position, CONFIG)
    wrong = contact.nearest(contact.posed(MODEL, track), -position)  # on the other side
    track = track._replace(contacts=contact.Contacts(wrong.closest, position))
    exact = contact.nearest(contact.posed(MODEL, track), position).closest.face
    for turn in range(every):
        last, health = Track(None, None, None, 0.0, Health(), None, track, None), Health(state="tracking")
        pose, config = contact.posed(MODEL, track), dataclasses.replace(Config(), physics=CONFIG)
        problem = problem_of(None, None, config, last=last, body=pose, health=health)
        found = contact.followed(problem, position)
        right = found.closest.face == exact
        assert right[turn::every].all()
        assert right.sum() == sum(len(right[t::every]) for t in range(turn + 1))
        track = contact.learned(problem, found, position, np.ones(len(position), bool))
    assert right.all()


def test_all_vertices_are_searched_in_the_whole_body_while_the_garment_is_not_tracked():
    position = above(np.abs(HEIGHTS))
    track = contact.start(MODEL, position, CONFIG)
    wrong = contact.nearest(contact.posed(MODEL, track), -position)
    pose = contact.posed(MODEL, track._replace(contacts=wrong))
    for health in (Health(), Health(state="lost"), Health(state="tracking", settling=2)):
        last = Track(None, None, None, 0.0, health, None, track, None)
        problem = problem_of(None, None, Config(), last=last, body=pose, health=health)
        found, exact = contact.followed(problem, position), contact.nearest(pose, position)
        np.testing.assert_array_equal(found.closest.face, exact.closest.face)
