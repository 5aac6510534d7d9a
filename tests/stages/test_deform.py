"""Bending: a garment in another pose follows the cloud; patches carry its vertices."""

import numpy as np
import pytest

from ddakf import deform, model
from ddakf.evaluation.sensors import sample_surface
from tests.stages.scenes import about, rms, scan, tube

TUBE = tube()
MODEL = model.build(TUBE, 0.003)


def bent(vertices, angle):
    """The tube, its upper half turned about a horizontal axis by a growing angle."""
    out = vertices.copy()
    height = vertices[:, 1].max()
    for i, v in enumerate(vertices):
        share = max(0.0, v[1] / height - 0.4) / 0.6
        out[i] = about([0, 0, 1], angle * share) @ (v - [0, 0.4 * height, 0]) + [0, 0.4 * height, 0]
    return out


@pytest.mark.parametrize("angle", [0.3, -0.5])
def test_a_bent_garment_is_followed(angle):
    truth = bent(TUBE.vertices, angle)
    found = deform.follow(TUBE.vertices, scan(truth, TUBE), None, MODEL)
    assert rms(TUBE.vertices - truth) > 0.03
    assert rms(found - truth) < 0.5 * rms(TUBE.vertices - truth)


def test_a_garment_in_place_stays():
    found = deform.follow(TUBE.vertices, scan(TUBE.vertices, TUBE), None, MODEL)
    assert rms(found - TUBE.vertices) < 0.01


def test_the_side_that_no_sensor_sees_is_carried_along():
    eye = np.array([0.0, 0.2, 2.0])
    truth = TUBE.vertices + [0.03, 0.0, 0.0]
    points = sample_surface(truth, TUBE.faces, 6000, np.random.default_rng(0))
    points = points[points[:, 2] > 0.05]
    found = deform.follow(TUBE.vertices, points, eye, MODEL)
    back = TUBE.vertices[:, 2] < -0.05
    assert rms(found[back] - truth[back]) < rms(TUBE.vertices[back] - truth[back])


def test_without_points_near_nothing_moves():
    assert deform.follow(TUBE.vertices, TUBE.vertices + 5.0, None, MODEL) is TUBE.vertices


def test_patches_that_move_as_one_move_every_vertex_so():
    patches = deform.graph(TUBE.vertices, MODEL, np.arange(TUBE.n_vertices))
    turn = about([1, 2, 3], 0.7)
    moved = deform.moved(
        TUBE.vertices, patches, patches.middle @ turn.T + 0.3, np.tile(turn, (MODEL.n_clusters, 1, 1))
    )
    np.testing.assert_allclose(moved, TUBE.vertices @ turn.T + 0.3, atol=1e-12)
    np.testing.assert_allclose(patches.weight.sum(axis=1), 1.0)
