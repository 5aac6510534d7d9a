"""Nonrigid registration: a garment in another pose follows the cloud, its vertices follow their clusters."""

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from ddakf.config import Registration
from ddakf.evaluation.sensors import sample_surface
from ddakf.garment import model
from ddakf.kernels import nonrigid_registration as kernels
from ddakf.kernels.cluster_alignment import centers
from ddakf.kernels.normals import vertex_normals
from ddakf.kernels.relocalize import OrientedPoints, OrientedVertices, Pairing, correspond, mean_distance
from ddakf.search.nonrigid_registration import Target, register, rows
from tests.stages.scenes import about, rms, scan, tube

TUBE = tube()
MODEL = model.build(TUBE)
CONFIG = Registration()


def target_of(points, sensor_origin=None):
    return Target.from_points(points, sensor_origin, CONFIG)


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
    found = register(TUBE.vertices, target_of(scan(truth, TUBE)), MODEL, CONFIG)
    assert rms(TUBE.vertices - truth) > 0.03
    assert rms(found - truth) < 0.6 * rms(TUBE.vertices - truth)


def test_a_garment_in_place_stays():
    found = register(TUBE.vertices, target_of(scan(TUBE.vertices, TUBE)), MODEL, CONFIG)
    assert rms(found - TUBE.vertices) < 0.01


def test_the_side_that_no_sensor_sees_is_carried_along():
    eye = np.array([0.0, 0.2, 2.0])
    truth = TUBE.vertices + [0.03, 0.0, 0.0]
    points = sample_surface(truth, TUBE.faces, 6000, np.random.default_rng(0))
    normal = np.empty_like(truth)
    vertex_normals(truth, MODEL.faces, normal)
    facing = np.einsum("va,va->v", normal, eye - truth) > 0
    points = points[facing[cdist(points, truth).argmin(axis=1)]]
    found = register(TUBE.vertices, target_of(points, eye), MODEL, CONFIG)
    back = TUBE.vertices[:, 2] < -0.05
    assert rms(found[back] - truth[back]) < rms(TUBE.vertices[back] - truth[back])


def test_without_points_near_nothing_moves():
    assert register(TUBE.vertices, target_of(TUBE.vertices + 5.0), MODEL, CONFIG) is TUBE.vertices


def test_clusters_that_move_as_one_move_every_vertex_so():
    turn, K = about([1, 2, 3], 0.7), MODEL.n_clusters
    middle = np.random.default_rng(0).normal(size=(K, 3))
    moved = np.empty_like(TUBE.vertices)
    clusters = MODEL.clusters
    kernels.blend(TUBE.vertices, clusters.nearest, clusters.share, middle, middle @ turn.T + 0.3, np.tile(turn, (K, 1, 1)), moved)
    np.testing.assert_allclose(moved, TUBE.vertices @ turn.T + 0.3, atol=1e-12)


@pytest.mark.slow
def test_clusters_settle_on_a_rigid_motion_of_their_goals():
    turn, K, cluster = about([1, 2, 3], 0.4), MODEL.n_clusters, MODEL.cluster
    middle, rotation = np.empty((K, 3)), np.tile(np.eye(3), (K, 1, 1))
    centers(TUBE.vertices, cluster, middle)
    centre, ends = middle.copy(), MODEL.clusters.ends
    goal = np.ascontiguousarray((TUBE.vertices @ turn.T + 0.2).T)
    arm = np.ascontiguousarray((TUBE.vertices - centre[cluster]).T)
    graph = kernels.ClusterGraph(ends, centre[ends[:, 1]] - centre[ends[:, 0]], 0.01)
    kernels.settle(kernels.Goals(cluster, arm, np.ones(len(cluster)), goal), graph, 100, middle, rotation)
    np.testing.assert_allclose(middle, centre @ turn.T + 0.2, atol=1e-4)
    np.testing.assert_allclose(rotation, np.tile(turn, (K, 1, 1)), atol=1e-3)


def test_a_cloud_is_even_however_near_one_of_its_sensors_is():
    near, far = scan(TUBE.vertices, TUBE, 20_000), scan(TUBE.vertices + [1.0, 0.0, 0.0], TUBE, 2_000)
    target = target_of(np.concatenate([near, far]))
    share = (target.points.T + target.origin)[:, 0] > 0.5
    assert len(share) >= 300
    assert 0.25 < share.mean() < 0.5


@pytest.mark.parametrize("seen_from", ["all around", "one place", "two places"])
def test_normals_of_a_cloud_point_to_the_outside(seen_from):
    points = scan(TUBE.vertices, TUBE, 6000)
    outward = points * [1.0, 0.0, 1.0]
    eye = np.array([0.0, 0.2, 2.0])
    origin = {"all around": None, "one place": eye, "two places": np.where(points[:, 2:] > 0, eye, -eye)}[seen_from]
    if seen_from != "all around":  # what a sensor sees hardly turned to it has no side
        kept = outward[:, 2] > 0.06 if seen_from == "one place" else np.abs(outward[:, 2]) > 0.06
        points, origin = points[kept], origin if origin.ndim == 1 else origin[kept]
    target = target_of(points, origin)
    placed = target.points.T + target.origin
    assert target.signed.mean() > 0.9
    assert 300 <= len(placed) <= 600
    assert (np.einsum("na,an->n", placed * [1.0, 0.0, 1.0], target.normals)[target.signed] > 0).mean() > 0.95


def test_one_to_one_correspondences_are_the_identity_of_a_garment_in_place():
    vertices = rows(TUBE.vertices)
    normal = np.empty_like(TUBE.vertices)
    vertex_normals(TUBE.vertices, MODEL.faces, normal)
    n = len(normal)
    pair, mass, goal = np.empty((n, n), np.float32), np.empty(n, np.float32), np.empty((3, n), np.float32)
    signed = np.ones(n, bool)
    garment = OrientedVertices(vertices, rows(normal), np.ones(n, np.float32))
    cloud = OrientedPoints(vertices, rows(normal), signed)
    correspond(garment, cloud, Pairing(0.02, 2, 0.01), pair, mass, goal)
    np.testing.assert_allclose(mass, 1.0, atol=0.02)
    np.testing.assert_allclose(goal, vertices, atol=2e-3)


def test_distances_are_those_to_the_nearest():
    rng = np.random.default_rng(0)
    start, end = rng.uniform(size=(40, 3)), rng.uniform(size=(60, 3))
    answers = (rng.uniform(size=60) < 0.5).astype(np.float32)
    expected = np.minimum(cdist(start, end[answers > 0]).min(axis=1), 0.15).mean()
    found = mean_distance(rows(start), rows(end), np.ones(40, np.float32), answers, 0.15)
    assert found == pytest.approx(expected, abs=1e-5)
