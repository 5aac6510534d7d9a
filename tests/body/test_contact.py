"""Contact: how close a garment may come to the body, what moves that, and how contact yields where the body is wrong."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from ddakf import Config
from ddakf.body import contact
from ddakf.config import Physics
from ddakf.physics import collision
from ddakf.types import Health, State, Track, UpdateTerms
from tests.physics.shapes import ball, sheet
from tests.stages.scenes import FPS, about, estimate_at, measured, posed, problem_of
from tests.tracker_runs import SAMPLE, worn

MESH, BODY, RADIUS = sheet(), ball(3), 0.2
CONFIG = Physics(thickness=0.004, gap_time=0.5)
HEIGHTS = np.linspace(-0.05, 0.02, MESH.n_vertices)  # m, of the vertices above the body


def above(heights):
    """(V, 3) points above the middle of a face, where the distance is the height."""
    return CORNERS.mean(axis=0) + np.outer(heights, NORMAL)


CORNERS = BODY.vertices[BODY.faces[0]]
NORMAL = np.cross(CORNERS[1] - CORNERS[0], CORNERS[2] - CORNERS[0])
NORMAL /= np.linalg.norm(NORMAL)
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
    return contact.learn(problem, seen(position, observed, contact.nearest(pose, position) if searched else None), position)


def seen(position, observed, contacts, at=None):
    """An estimate whose observed vertices were measured where they are, or in planes ``at`` these places."""
    measurement = measured(position if at is None else at, np.tile(NORMAL, (len(position), 1)), observed)
    terms = UpdateTerms(measurement, observed.astype(float), None, None)
    return estimate_at(position, terms)._replace(contacts=contacts)


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
    found = contact.nearest_from_last(problem_of(None, None, last=last, body=pose, health=health), position)
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
        found = contact.nearest_from_last(problem, position)
        right = found.closest.face == exact
        assert right[turn::every].all()
        assert right.sum() == sum(len(right[t::every]) for t in range(turn + 1))
        track = contact.learn(problem, seen(position, np.ones(len(position), bool), found), position)
    assert right.all()


def test_all_vertices_are_searched_in_the_whole_body_while_the_garment_is_not_tracked():
    position = above(np.abs(HEIGHTS))
    track = contact.start(MODEL, position, CONFIG)
    wrong = contact.nearest(contact.posed(MODEL, track), -position)
    pose = contact.posed(MODEL, track._replace(contacts=wrong))
    for health in (Health(), Health(state="lost"), Health(state="tracking", settling=2)):
        last = Track(None, None, None, 0.0, health, None, track, None)
        problem = problem_of(None, None, Config(), last=last, body=pose, health=health)
        found, exact = contact.nearest_from_last(problem, position), contact.nearest(pose, position)
        np.testing.assert_array_equal(found.closest.face, exact.closest.face)


# A body that is wrong -------------------------------------------------------------------------------------------------


def intrusions(depths, observed, dt=1 / FPS):
    """The variance of the body after frames with cloth at the height of its gap, seen these depths (frames, V) deeper."""
    track = contact_at(np.full(len(HEIGHTS), CONFIG.thickness))
    for depth in depths:
        last = Track(None, None, None, 0.0, Health(), None, track, None)
        pose, position = contact.posed(MODEL, track), above(track.gap)
        problem = problem_of(None, None, dataclasses.replace(Config(), physics=CONFIG), last=last, body=pose, dt=dt)
        estimate = seen(position, observed, contact.nearest(pose, position), above(track.gap - depth))
        track = contact.learn(problem, estimate, position)
    return contact.error2(contact.posed(MODEL, track))


def test_cloth_that_is_seen_inside_shows_the_error_of_the_body():
    rng, everything = np.random.default_rng(0), np.ones(len(HEIGHTS), bool)
    for sd in (0.002, 0.01):
        found = intrusions(rng.normal(scale=sd, size=(90, len(HEIGHTS))), everything)
        np.testing.assert_allclose(np.sqrt(found), sd, rtol=0.1)


def test_cloth_outside_and_cloth_that_nobody_sees_show_no_error():
    depth, everything = np.full((30, len(HEIGHTS)), 0.01), np.ones(len(HEIGHTS), bool)
    assert intrusions(-depth, everything) == 0.0
    assert intrusions(depth, ~everything) == 0.0
    half = np.arange(len(HEIGHTS)) % 2 == 0
    np.testing.assert_allclose(intrusions(depth, half), 1e-4, rtol=0.1)


def test_a_first_guess_counts_as_much_as_a_few_vertices():
    pose = contact.posed(MODEL, contact_at(HEIGHTS))
    assert contact.error2(pose, 0.006) == 0.006**2
    told = pose._replace(intruded=(0.01**2 * contact.FEW, contact.FEW))
    np.testing.assert_allclose(contact.error2(told, 0.006), (0.006**2 + 0.01**2) / 2)


def test_what_nobody_saw_has_no_first_guess():
    """Before anything is seen, everything has."""
    position, seen = above(np.abs(HEIGHTS)), np.arange(len(HEIGHTS)) % 2 == 0
    track = contact.start(MODEL, position, CONFIG)
    anchor = SimpleNamespace(measured=seen)
    for time, wanted in ((None, np.ones(len(seen), bool)), (1.0, seen)):
        last = Track(None, None, None, 0.0, Health(), time, track, anchor)
        problem = problem_of(None, State.at(position, 0 * position, 0.01, 0.1, 0.01), last=last, body=contact.posed(MODEL, track))
        np.testing.assert_array_equal(contact.variances(problem), np.where(wanted, Physics.body_sd**2, 0.0))


def test_one_vertex_says_little():
    depth, one, every = np.full((30, len(HEIGHTS)), 0.01), np.arange(len(HEIGHTS)) == 0, np.ones(len(HEIGHTS), bool)
    assert intrusions(depth, one) < 0.7 * intrusions(depth, every)


def test_contact_yields_by_the_error_of_the_body():
    """As much as a body that is known, whose surface gives way like a spring of that variance."""
    position, constants = above(np.full(len(HEIGHTS), -0.01)), collision.build(MESH, CONFIG.thickness)
    contacts, stiffness, variance = contact.nearest(posed(BODY), position).closest, 3.0e9, 0.008**2
    firm = collision.linearize(position, constants, contacts).weight * stiffness
    yielding = np.full(len(HEIGHTS), stiffness * variance)
    soft = collision.linearize(position, constants, contacts, yielding=yielding).weight * stiffness
    assert (firm > 0).all()
    np.testing.assert_allclose(1 / soft, 1 / firm + variance)


@pytest.mark.slow
def test_a_body_that_is_misplaced_costs_cloth_that_is_seen_little():
    """By 20 mm in the mean, to and fro, where contact firmer than the measurement would push the cloth along."""

    def misplaced(k):
        body = SAMPLE.body_vertices[k]
        middle, turned = body.mean(axis=0), about([np.cos(0.4 * k), 0.5, 1.0], 0.05 * np.sin(0.5 * k)).T
        return (body - middle) @ turned + middle + 0.012 * np.array([np.sin(0.5 * k), 0.3 * np.sin(0.31 * k), np.cos(0.4 * k)])

    exact, off = (np.mean([error for _, error in worn("full", pose)]) for pose in (SAMPLE.body_vertices.__getitem__, misplaced))
    assert off < 1.25 * exact
