"""Skin removal: points on the body and not on the garment are skin."""

import numpy as np
from scipy.spatial import cKDTree

from ddakf import Mesh
from ddakf.config import SkinRemoval
from ddakf.garment import model
from ddakf.stages import skin_removal
from tests.stages.scenes import frame_of, posed, problem_of


def tube(radius: float, low: float, high: float, around: int = 40, along: int = 40) -> Mesh:
    angle = np.arange(around) * 2 * np.pi / around
    ring = np.stack([radius * np.cos(angle), np.zeros(around), radius * np.sin(angle)], axis=1)
    vertices = np.concatenate([ring + [0.0, y, 0.0] for y in np.linspace(low, high, along)])
    k, a = np.divmod(np.arange((along - 1) * around), around)
    i, j = k * around + a, k * around + (a + 1) % around
    return Mesh(vertices, np.concatenate([np.stack([i, i + around, j], 1), np.stack([j, i + around, j + around], 1)]))


BODY, GARMENT = tube(0.20, -0.5, 0.5), tube(0.205, -0.2, 0.2)
MODEL = model.build(GARMENT)


def skin(points, body, margin=SkinRemoval.cloth_distance):
    return skin_removal.skin(points.astype(np.float32), problem_of(MODEL, body=body), GARMENT.vertices, margin)


def test_skin_beside_the_garment_is_told_from_cloth_on_the_body():
    contact = posed(BODY)
    beside = np.abs(BODY.vertices[:, 1]) > 0.25
    assert skin(BODY.vertices[beside], contact).all()
    assert not skin(BODY.vertices[np.abs(BODY.vertices[:, 1]) < 0.2], contact).any()
    assert not skin(GARMENT.vertices, contact).any()


def test_points_off_the_body_are_no_skin():
    away = BODY.vertices * [1.2, 1.0, 1.2]
    assert not skin(away, posed(BODY)).any()


def test_without_a_body_nothing_is_skin():
    assert not skin(BODY.vertices, None).any()


def test_points_take_their_sensors_with_them():
    contact = posed(BODY)
    origin = np.arange(3.0 * BODY.n_vertices).reshape(-1, 3)
    now = frame_of(BODY.vertices.astype(np.float32), origin, BODY.vertices)
    kept = skin_removal.remove_skin(now, problem_of(MODEL, body=contact), GARMENT.vertices, SkinRemoval.cloth_distance)
    bare = skin(BODY.vertices, contact)
    assert 0 < len(kept.points) == (~bare).sum()
    assert (kept.sensor_origin == origin[~bare]).all()


def test_apart_is_the_distance_to_the_nearest_vertex():
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.4, 0.4, (3000, 3))
    for radius in (0.01, 0.05, 0.2):
        expected = cKDTree(GARMENT.vertices).query(points)[0] > radius
        assert (skin_removal.apart(points.astype(np.float32), GARMENT.vertices, radius) == expected).mean() > 0.999
