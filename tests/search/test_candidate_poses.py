"""Candidate poses: rigid motions about the vertical that lay a garment on a cloud."""

import numpy as np
import pytest

from ddakf import Config, Mesh
from ddakf.data import sample
from ddakf.evaluation.sensors import sample_surface
from ddakf.garment import model
from ddakf.mesh import vertex_normals
from ddakf.search.candidate_poses import HeadingPrior, Search, Surface, candidate_poses, cost_in_place
from ddakf.search.nonrigid_registration import Target, register
from tests.stages.scenes import rms, scan, tube, turn

SAMPLE = sample()
SHIRT = Mesh(SAMPLE.template, SAMPLE.garment_faces)
TUBE = tube()
RULE = Config().relocalization
KNOWN = HeadingPrior(np.radians(RULE.heading_sd))
GUESSED = KNOWN._replace(doubt=RULE.heading_doubt)


@pytest.mark.parametrize("degrees", [0, 15, 30, 45, 100, -80])
def test_a_candidate_pose_recovers_the_motion(degrees):
    start = SAMPLE.garment_vertices[40].astype(float)
    truth = start @ turn(degrees).T + [0.25, -0.1, 0.1]
    rng = np.random.default_rng(0)
    points = sample_surface(truth, SHIRT.faces, 5000, rng) + 0.003 * rng.normal(size=(5000, 3))
    search = search_of(points, model.build(SHIRT))
    pose = candidate_poses(start, search, KNOWN)[0]
    assert rms(pose.apply(start) - truth) < 0.03
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-9)
    np.testing.assert_allclose(pose.rotation[1], [0, 1, 0], atol=1e-9)  # about the vertical alone
    assert pose.cost < 0.5 * cost_in_place(start, search)


def search_of(points, garment):
    config = Config()
    return Search(garment, Target.from_points(points, None, config.registration), config)


def flat_tube(depth):
    """A tapering tube about the vertical, ``depth`` times as deep as it is wide."""
    angle = np.arange(24) * 2 * np.pi / 24
    ring = 0.2 * np.stack([np.cos(angle), np.zeros(24), depth * np.sin(angle)], axis=1)
    return Mesh(np.concatenate([ring * (1 - 0.03 * k) + [0, 0.04 * k, 0] for k in range(12)]), TUBE.faces[: 48 * 11])


def headings(found):
    return [float(np.degrees(np.arctan2(p.rotation[0, 2], p.rotation[0, 0]))) for p in found]


def alternating(mesh):
    """The mesh with its vertices in another order: in turn one of its front and one of its back, as in a grid of two panels."""
    z = mesh.vertices[:, 2]
    front, back = np.flatnonzero(z > np.median(z)), np.flatnonzero(z <= np.median(z))
    order = np.concatenate([np.stack([front, back[: len(front)]], axis=1).ravel(), back[len(front) :]])
    return Mesh(mesh.vertices[order], np.argsort(order)[mesh.faces])


def test_the_order_of_the_vertices_has_no_influence():
    """What looks at every second vertex of two panels may see one of them alone."""
    points = scan(SHIRT.vertices, SHIRT, 5000, seed=1)
    for heading in (0, 180):
        costs, shares = [], []
        front = vertex_normals(SHIRT.vertices, SHIRT.faces)[:, 2] * np.cos(np.radians(heading)) > 0
        for mesh in (SHIRT, alternating(SHIRT)):
            search, position = search_of(points, model.build(mesh)), mesh.vertices @ turn(heading).T
            costs.append(cost_in_place(register(position, search.target, search.model, search.config.registration), search))
            some = Surface.from_garment(position, search.model, search.target).sampled(RULE.rough_vertices)
            shares.append((some.normal[:, 2] > 0).mean())
        assert costs[0] == pytest.approx(costs[1], rel=0.02)
        assert shares == pytest.approx([front.mean()] * 2, abs=0.03)


def test_candidate_poses_have_different_headings_and_the_nearest_of_equals_comes_first():
    flat = flat_tube(0.6)
    search = search_of(scan(flat.vertices @ turn(20).T + [0.5, 0.0, 0.2], flat), model.build(flat))
    found = headings(candidate_poses(flat.vertices, search, HeadingPrior(5.0)))
    assert found[0] == pytest.approx(20, abs=8)
    assert any(abs(heading + 160) < 8 for heading in found[1:])
    apart = np.abs(np.subtract.outer(found, found)) % 360
    assert (np.minimum(apart, 360 - apart)[~np.eye(len(found), dtype=bool)] >= 29.9).all()


def test_a_round_garment_keeps_its_heading():
    round_one = flat_tube(1.0)
    search = search_of(scan(round_one.vertices @ turn(20).T + [0.5, 0.0, 0.2], round_one), model.build(round_one))
    for prior in (KNOWN, GUESSED):
        assert abs(headings(candidate_poses(round_one.vertices, search, prior))[0]) < 25


def test_a_doubted_heading_costs_little_and_a_known_one_more_the_farther_it_is():
    far = np.radians([0.0, 60.0, 90.0, 180.0])
    known, guessed = ([prior.cost(heading) for heading in far] for prior in (KNOWN, GUESSED))
    assert known == sorted(known)
    assert known[-1] == pytest.approx(0.5 * (180 / RULE.heading_sd) ** 2)
    assert guessed == sorted(guessed)
    assert guessed[-1] - guessed[0] < 4.0


@pytest.mark.parametrize(("height", "facing"), [(1.0, [1, 0]), (5.0, [0, 1])])
def test_vertices_face_a_sensor_on_their_normal_s_side(height, facing):
    up = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    surface = Surface(np.full((2, 3), [0.0, 0.0, height]), up, np.ones(2))
    target = Target.from_points(scan(TUBE.vertices, TUBE), np.array([0.0, 0.0, 3.0]), Config().registration)
    np.testing.assert_array_equal(surface.facing(target), facing)
