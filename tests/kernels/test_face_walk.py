"""The walk to a point's closest face: on a convex body the nearest of all, elsewhere no farther than where it began."""

import numpy as np
import pytest

from ddakf.body import proximity
from ddakf.mesh import Mesh
from tests.physics.shapes import ball

BALL, RADIUS = ball(3), 10.0
DUMBBELL = Mesh(
    np.concatenate([BALL.vertices, BALL.vertices + [0.5, 0, 0]]), np.concatenate([BALL.faces, BALL.faces + BALL.n_vertices])
)


def points_around(rng, n=300, reach=0.4):
    return rng.normal(size=(n, 3)) * reach / 2


def followed(mesh, points, face, due=slice(0), radius=RADIUS):
    body = proximity.build(mesh)
    return proximity.followed_points(body, proximity.refresh(body, mesh.vertices), points, radius, face, due)


def exact(mesh, points, radius=RADIUS):
    body = proximity.build(mesh)
    return proximity.closest_points(body, proximity.refresh(body, mesh.vertices), points, radius)


@pytest.mark.parametrize("seed", range(3))
def test_outside_a_convex_body_every_walk_ends_at_the_closest_point(seed):
    rng = np.random.default_rng(seed)
    points = points_around(rng)
    points = points[np.linalg.norm(points, axis=1) > 0.21]
    near = exact(BALL, points + rng.normal(scale=0.02, size=points.shape)).face
    found, truth = followed(BALL, points, near), exact(BALL, points)
    np.testing.assert_allclose(found.distance, truth.distance, atol=1e-12)
    np.testing.assert_allclose(found.point, truth.point, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_no_walk_goes_away(seed):
    rng = np.random.default_rng(seed)
    points, face = points_around(rng), rng.integers(0, DUMBBELL.n_faces, 300).astype(np.int32)
    body = proximity.build(DUMBBELL)
    corners = DUMBBELL.vertices[body.faces[face]]
    begun = np.linalg.norm(points[:, None] - corners, axis=2).min(axis=1)  # no face is farther than its corners
    found, truth = followed(DUMBBELL, points, face), exact(DUMBBELL, points)
    assert (np.abs(found.distance) <= begun + 1e-12).all()
    assert (np.abs(found.distance) >= np.abs(truth.distance) - 1e-12).all()


def test_a_walk_stays_on_its_part_of_the_body_until_the_point_is_due():
    between = np.array([[0.3, 0.0, 0.0]])  # nearer to the second ball
    face = exact(DUMBBELL, np.array([[0.2, 0.0, 0.0]])).face
    assert followed(DUMBBELL, between, face).point[0, 0] < 0.25
    for found in (followed(DUMBBELL, between, face, slice(None)), exact(DUMBBELL, between)):
        assert found.point[0, 0] > 0.25


def test_a_point_beyond_the_radius_has_no_face():
    points = np.array([[0.3, 0.0, 0.0], [0.21, 0.0, 0.0]])
    face = exact(BALL, points).face
    assert (followed(BALL, points, face, radius=0.05).face >= 0).tolist() == [False, True]
    np.testing.assert_array_equal(followed(BALL, points, np.full(2, -1, np.int32)).face, face)
