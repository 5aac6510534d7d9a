"""How close a garment may come to the body, and what moves that."""

import numpy as np
import pytest

from ddakf.body.contact import DEEPEST, BodyContact
from ddakf.config import Physics
from ddakf.mesh import Mesh
from ddakf.physics import collision
from tests.physics.shapes import ball, sheet

MESH, BODY, RADIUS = sheet(), ball(3), 0.2
CONFIG = Physics(thickness=0.004, gap_time=0.5)
HEIGHTS = np.linspace(-0.05, 0.02, MESH.n_vertices)  # m, of the vertices above the body


def above(heights):
    """(V, 3) points above the middle of a face, where the distance is the height."""
    corners = BODY.vertices[BODY.faces[0]]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    normal /= np.linalg.norm(normal)
    return corners.mean(axis=0) + np.outer(heights, normal)


def contact_at(heights):
    contact = BodyContact(BODY, 0.1)
    contact.start(above(heights), CONFIG.thickness)
    return contact


def residuals(contact, heights):
    position = above(heights)
    constants = collision.build(MESH, CONFIG.thickness)
    return collision.linearize(position, constants, contact.nearest(position), contact.gap).residual


def test_what_starts_inside_may_stay_and_may_not_go_deeper():
    contact, allowed = contact_at(HEIGHTS), HEIGHTS >= -DEEPEST
    np.testing.assert_allclose(residuals(contact, HEIGHTS)[allowed], 0.0, atol=1e-9)
    np.testing.assert_allclose(residuals(contact, HEIGHTS)[~allowed], (HEIGHTS + DEEPEST)[~allowed], atol=1e-9)
    deeper = residuals(contact, HEIGHTS - 0.003)
    np.testing.assert_allclose(deeper, np.minimum(0.0, HEIGHTS - 0.003 - contact.gap), atol=1e-9)
    assert (deeper[CONFIG.thickness > HEIGHTS] < 0).all()


def test_what_starts_outside_keeps_the_thickness():
    contact = contact_at(np.abs(HEIGHTS) + CONFIG.thickness)
    np.testing.assert_allclose(residuals(contact, HEIGHTS), np.minimum(0.0, HEIGHTS - CONFIG.thickness), atol=1e-9)


def test_seen_vertices_change_their_gap_and_the_others_do_not():
    start, end = np.full_like(HEIGHTS, -0.010), np.full_like(HEIGHTS, -0.002)
    contact, observed = contact_at(start), np.arange(len(HEIGHTS)) % 2 == 0
    contact.nearest(above(end))
    for _ in range(60):
        contact.learn(above(end), observed, 1 / 30, CONFIG)
    np.testing.assert_allclose(contact.gap[~observed], -0.010, atol=1e-9)
    np.testing.assert_allclose(contact.gap[observed], -0.002 - 0.008 * np.exp(-2.0 / 0.5), atol=1e-9)


def test_the_gap_follows_time_and_not_frames():
    start, end = np.full_like(HEIGHTS, 0.003), np.full_like(HEIGHTS, -0.005)
    often, seldom, all_seen = contact_at(start), contact_at(start), np.ones(len(HEIGHTS), bool)
    for contact, frames in ((often, 12), (seldom, 3)):
        contact.nearest(above(end))
        for _ in range(frames):
            contact.learn(above(end), all_seen, 0.3 / frames, CONFIG)
    np.testing.assert_allclose(often.gap, seldom.gap, atol=1e-12)


@pytest.mark.parametrize("height", [-0.2, 0.5])
def test_no_body_in_reach_leaves_the_gap_alone(height):
    contact = contact_at(HEIGHTS)
    before, far = contact.gap, above(np.full_like(HEIGHTS, height))
    if height > 0:
        contact.nearest(far)
    contact.learn(far, np.ones(len(HEIGHTS), bool), 1.0, CONFIG)
    np.testing.assert_array_equal(contact.gap, before)


def test_a_reset_forgets_and_a_mark_remembers():
    contact = contact_at(HEIGHTS)
    contact.nearest(above(HEIGHTS))
    mark, gap = contact.mark(), contact.gap
    contact.learn(above(HEIGHTS + 0.001), np.ones(len(HEIGHTS), bool), 1.0, CONFIG)
    assert not np.array_equal(contact.gap, gap)
    contact.back_to(mark)
    np.testing.assert_array_equal(contact.gap, gap)
    contact.reset()
    assert contact.gap is None


def test_touching_finds_what_a_search_of_all_vertices_finds():
    """However far the vertices moved since, in whatever direction: only those that cannot touch keep their old points."""
    rng = np.random.default_rng(0)
    position = above(np.abs(HEIGHTS))
    contact = BodyContact(Mesh(BODY.vertices, BODY.faces), 0.1)
    contact.nearest(position)
    for _ in range(5):
        position = position + rng.normal(size=position.shape) * rng.uniform(0, 0.02, (len(position), 1))
        held = contact.touching(position, CONFIG.thickness)
        exact = BodyContact(BODY, 0.1).nearest(position)
        near = exact.distance < CONFIG.thickness
        assert near.any()
        np.testing.assert_array_equal(held.face[near], exact.face[near])
        np.testing.assert_array_equal(held.distance[near], exact.distance[near])
        np.testing.assert_array_equal(held.normal[near], exact.normal[near])
