"""Cluster alignment: clusters that move rigidly."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh, Tracker
from ddakf.config import InnovationNoise, NearestPoint
from ddakf.garment import clusters, model
from ddakf.kernels import cluster_alignment as kernels
from ddakf.kernels.rigidity import LocalRigidity
from ddakf.multiresolution import cluster_alignment
from ddakf.physics.fabric import Fabric
from ddakf.types import Health, State
from tests.stages.scenes import about, cloud_of, inner_body, posed, problem_of, rms, scan, tube

CONFIG = Config()
MESH = tube(around=36, along=20, spacing=0.02)
GARMENT = model.build(MESH, CONFIG)


def moved_by(rotation, shift) -> np.ndarray:
    """(V, 3) the tube turned about its middle, and shifted."""
    middle = MESH.vertices.mean(axis=0)
    return (MESH.vertices - middle) @ rotation.T + middle + shift


def aligned(truth, config=CONFIG, body=None, seen=None, health=None) -> np.ndarray:
    """(V, 3) the estimate after the coarse passes, from the rest shape as prediction and a scan of ``truth``, or a part of it."""
    prior = State.at(MESH.vertices, np.zeros_like(MESH.vertices), 0.01, 0.5, 0.004)
    points = scan(truth, MESH, 5000, 0.002)
    cloud = cloud_of(points if seen is None else points[seen(points)], None, prior.position, GARMENT.area, config)
    problem = problem_of(GARMENT, prior, config, cloud=cloud, body=body, health=health or Health())
    return cluster_alignment.align(problem).position


def system(position, target, normal, weight):
    """Normal equations of the clusters at ``position`` with planes alone."""
    k, c = GARMENT.n_clusters, GARMENT.clusters
    A, b, center = np.zeros((6 * k, 6 * k)), np.zeros(6 * k), np.empty((k, 3))
    kernels.centers(position, GARMENT.cluster, center)
    frames, planes = kernels.ClusterFrames(GARMENT.cluster, center), kernels.SamplePlanes(target, normal, weight)
    kernels.add_planes(position, position, c.sample, frames, planes, kernels.SampleNoise(1e-4, 1e-2, 3.0, 2.0), A, b)
    return A, b, center


def test_every_vertex_follows_its_own_cluster_most():
    c = GARMENT.clusters
    np.testing.assert_array_equal(c.nearest[:, 0], GARMENT.cluster)
    np.testing.assert_allclose(c.share.sum(axis=1), 1.0)
    assert (c.share[:, 0] >= c.share[:, 1:].max(axis=1) - 1e-9).all()
    assert (GARMENT.cluster[c.seam[:, 0]] != GARMENT.cluster[c.seam[:, 1]]).all()
    np.testing.assert_array_equal(GARMENT.neighbour[c.seam[:, 2]], c.seam[:, 1])
    assert 0.0 < c.weakening < 1.0


def test_parts_without_a_seam_follow_their_own_clusters():
    one, n = tube(around=16, along=8), 16 * 8
    from_seed = np.full((4, 2 * n), np.inf)
    ends = np.concatenate([one.edges, one.edges + n])
    ends = np.concatenate([ends, ends[:, ::-1]])
    two = type(one)(np.concatenate([one.vertices, one.vertices + [1.0, 0, 0]]), np.concatenate([one.faces, one.faces + n]))
    for k, seed in enumerate((0, 70, n, n + 70)):
        part = slice(0, n) if seed < n else slice(n, 2 * n)
        from_seed[k, part] = np.linalg.norm(two.vertices[part] - two.vertices[seed], axis=1)
    c = clusters.build(two, from_seed, ends, CONFIG.discretisation)
    assert (c.share[:n][c.nearest[:n] >= 2] == 0.0).all()
    np.testing.assert_allclose(c.share.sum(axis=1), 1.0)


def test_equations_are_those_of_the_residuals():
    """b is minus the gradient of the energy of the planes, and A its Gauss-Newton matrix, by finite differences of the motion."""
    rng = np.random.default_rng(0)
    n, k = len(MESH.vertices), GARMENT.n_clusters
    target = MESH.vertices + rng.normal(scale=0.01, size=(n, 3))
    normal = rng.normal(size=(n, 3))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    weight = rng.uniform(0, 1, n) * (rng.random(n) < 0.8)
    A, b, center = system(MESH.vertices, target, normal, weight)
    A = np.tril(A) + np.tril(A, -1).T
    sample = GARMENT.clusters.sample

    def residuals(motion):
        """(S, 7): along the normal, in the plane, and to the prior, each times the root of its information."""
        q = GARMENT.cluster[sample]
        arm = MESH.vertices[sample] - center[q]
        x = MESH.vertices[sample] + np.cross(motion[q, :3], arm) + motion[q, 3:]
        y, m = target[sample] - x, normal[sample]
        along = np.einsum("sa,sa->s", m, y)
        w = np.sqrt(2.0 * weight[sample])
        across = (y - along[:, None] * m) * (w / np.sqrt(1e-2))[:, None]
        prior = (MESH.vertices[sample] - x) * np.sqrt(2.0 * 3.0)
        return np.concatenate([(along * w / np.sqrt(1e-4))[:, None], across, prior], axis=1).ravel()

    zero = np.zeros((k, 6))
    at_rest = residuals(zero)
    J = np.empty((len(at_rest), 6 * k))
    for column in range(6 * k):
        step = zero.copy()
        step.flat[column] = 1e-4
        J[:, column] = (residuals(step) - at_rest) / 1e-4
    np.testing.assert_allclose(A, J.T @ J, atol=1e-6 * np.abs(A).max())
    np.testing.assert_allclose(b, -J.T @ at_rest, atol=1e-6 * np.abs(b).max())


@pytest.mark.parametrize("scale", [0.5, 1.0])
def test_common_turns_cost_nothing_in_the_seams(scale):
    """Rigid motion of everything: the seams' matrix has it in its null space."""
    k, c = GARMENT.n_clusters, GARMENT.clusters
    A, b, center = np.zeros((6 * k, 6 * k)), np.zeros(6 * k), np.empty((k, 3))
    kernels.centers(MESH.vertices, GARMENT.cluster, center)
    identity = np.tile(np.eye(3), (len(MESH.vertices), 1, 1))
    rotations = identity, np.empty((0, 12), np.float32), np.empty((0, 8), np.float32)
    weights = (np.full(len(MESH.vertices), weight) for weight in (3.0 * scale, 5.0))
    rest, motion = (LocalRigidity(GARMENT.rest_edge, weight, *rotations) for weight in weights)
    frames, stiffness = kernels.ClusterFrames(GARMENT.cluster, center), kernels.SeamStiffness(1.0, 7.0, 0.1)
    kernels.add_seams(MESH.vertices, frames, c.seam, rest, motion, stiffness, A, b)
    A = np.tril(A) + np.tril(A, -1).T
    np.testing.assert_allclose(b, 0.0, atol=1e-5)
    turn, shift = np.array([0.3, -0.2, 0.5]), np.array([0.1, 0.2, -0.3])
    motion = np.column_stack([np.tile(turn, (k, 1)), shift + np.cross(turn, center)]).ravel()
    assert motion @ A @ motion < 1e-9 * (motion @ motion) * np.abs(A).max()
    bent = motion * np.repeat(np.random.default_rng(0).uniform(0.5, 1.5, k), 6)
    assert bent @ A @ bent > 1e-4 * (bent @ bent)


@pytest.mark.slow
def test_large_motion_is_found():
    truth = moved_by(about([1, 0, 0.2], np.radians(9.0)), [0.03, -0.01, 0.02])
    assert rms(aligned(truth) - truth) < 0.5 * rms(MESH.vertices - truth)


def test_a_good_prediction_is_left_alone():
    np.testing.assert_array_equal(aligned(moved_by(np.eye(3), [0.001, 0.0, 0.0])), MESH.vertices)


def end_moved(vertices) -> np.ndarray:
    """The vertices of which only those of an end have moved, by 25 mm: in the mean of the garment that is little."""
    along = vertices[:, 1]
    share = np.clip((along - np.quantile(MESH.vertices[:, 1], 0.85)) / 0.02, 0.0, 1.0)
    return vertices + 0.025 * share[:, None] * [1.0, 0.0, 0.0]


def test_a_part_that_moves_alone_is_found():
    """As far as rigid clusters can shear off."""
    truth = end_moved(MESH.vertices)
    assert rms(aligned(truth) - truth) < 0.9 * rms(MESH.vertices - truth)


def test_seams_are_as_stiff_as_the_faces():
    """Which have the mean of stretch and shear, so that fabrics of the same mean are alike."""
    truth, fabrics = end_moved(MESH.vertices), [Fabric(stretch=stretch, shear=2.0 - stretch) for stretch in (1.0, 0.25)]
    one, other = (aligned(truth, CONFIG.with_fabric(fabric)) for fabric in fabrics)
    np.testing.assert_array_equal(one, other)
    assert (one != MESH.vertices).any()


def test_a_part_alone_does_not_drag_a_hidden_side_along():
    truth = end_moved(MESH.vertices)
    np.testing.assert_array_equal(aligned(truth, seen=lambda points: points[:, 2] > MESH.vertices[:, 2].mean()), MESH.vertices)


LONG_FORWARD = moved_by(np.eye(3), [0.02, 0.06, 0.0])  # along the tube too, which no normal shows


def test_what_lies_beyond_all_vertices_pulls_them():
    without = dataclasses.replace(CONFIG, coarse=dataclasses.replace(CONFIG.coarse, points=0))
    only_garment = Health(least_unexplained=0.0)
    one, other = (aligned(LONG_FORWARD, config, health=only_garment) for config in (CONFIG, without))
    assert rms(one - LONG_FORWARD) < 0.9 * rms(other - LONG_FORWARD)


def test_of_a_cloud_that_always_has_something_else_nothing_pulls():
    without = dataclasses.replace(CONFIG, coarse=dataclasses.replace(CONFIG.coarse, points=0))
    one, other = (aligned(LONG_FORWARD, config, health=Health(least_unexplained=0.3)) for config in (CONFIG, without))
    np.testing.assert_array_equal(one, other)


def test_no_passes_no_change():
    config = dataclasses.replace(CONFIG, coarse=dataclasses.replace(CONFIG.coarse, iterations=0))
    np.testing.assert_array_equal(aligned(moved_by(np.eye(3), [0.04, 0, 0]), config), MESH.vertices)


def test_with_a_body_beneath_it_moves_all_the_same():
    body = inner_body(MESH)
    truth = moved_by(np.eye(3), [0.03, 0.0, 0.0])
    assert rms(aligned(truth, body=posed(body, body.vertices + [0.03, 0.0, 0.0])) - truth) < 0.5 * 0.03


@pytest.mark.parametrize("kind", ["points", "planes"])
def test_every_association_survives_a_fast_frame(kind):
    """Points without normals have no coarse level."""
    points = dataclasses.replace(CONFIG, associate=NearestPoint(), adapt=InnovationNoise())
    config = {"points": points, "planes": CONFIG}[kind]
    tracker = Tracker(MESH, config=config)
    for k in range(3):
        result = tracker.step(scan(moved_by(np.eye(3), [0.03 * k, 0, 0]), MESH, 3000, 0.002, seed=k), timestamp=k / 30)
        assert np.isfinite(result.vertices).all()
        assert np.isfinite(result.covariance).all()


def test_a_garment_of_more_pieces_than_clusters_is_tracked():
    """A vertex that no seed reaches follows one cluster; after a jump the tracker goes on, and can be saved."""
    rng = np.random.default_rng(0)
    corners = rng.normal(scale=0.3, size=(90, 1, 3)) + rng.normal(scale=0.02, size=(90, 3, 3))
    n = MESH.n_vertices
    soup = Mesh(
        np.concatenate([MESH.vertices, corners.reshape(-1, 3)]),
        np.concatenate([MESH.faces, n + np.arange(270).reshape(-1, 3)]),
    )
    shares = model.build(soup).clusters.share
    assert np.isfinite(shares).all()
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)
    tracker = Tracker(soup, config=dataclasses.replace(CONFIG, start=dataclasses.replace(CONFIG.start, search=False)))
    for k in range(4):
        cloud = scan(soup.vertices + [0.05 * (k > 1), 0, 0], soup, 4000, 0.002, seed=k)
        assert np.isfinite(tracker.step(cloud, timestamp=k / 30).vertices).all()
    assert Tracker.restore(tracker.snapshot()).step(cloud, timestamp=1.0).vertices.shape == soup.vertices.shape


def coupled(ends, k, seed):
    """A positive definite matrix of k clusters that are coupled along ``ends``, and a right side."""
    rng = np.random.default_rng(seed)
    A = np.eye(6 * k)
    for p, q in [*ends, *((c, c) for c in range(k))]:
        unknowns = np.r_[6 * p : 6 * p + 6, 6 * q : 6 * q + 6]
        J = rng.normal(size=(9, 12))
        A[np.ix_(unknowns, unknowns)] += J.T @ J
    return A, rng.normal(size=6 * k)


@pytest.mark.parametrize("k", [1, 2, 7, 30])
@pytest.mark.parametrize("pieces", [1, 2])
def test_the_sparse_factor_solves_what_a_dense_one_does(k, pieces):
    rng = np.random.default_rng(k)
    chain = [(c, c + 1) for c in range(k - 1) if pieces == 1 or c != k // 2]
    pairs = {*chain, *((int(p), int(q)) for p, q in rng.integers(0, k // pieces + 1, (k, 2)) if p < q < k)}
    ends = np.array([pair for p, q in sorted(pairs) for pair in ((p, q), (q, p))], np.int32).reshape(-1, 2)
    (A, b), order = coupled(ends, k, 1), clusters.elimination(ends, k)
    assert sorted(order.order) == list(range(k))
    factor, x = np.full((6 * k, order.width), np.nan, np.float32), np.empty(6 * k)
    assert kernels.factorise(np.tril(A), order, 0.5, factor)
    kernels.substitute(factor, order, b, x)
    np.testing.assert_allclose(x, np.linalg.solve(A + 0.5 * np.eye(6 * k), b), rtol=0, atol=1e-5)
    assert not kernels.factorise(np.tril(A) - 1e3 * np.eye(6 * k), order, 0.5, factor), "not positive definite"


def test_the_elimination_of_a_garment_fills_little():
    order = GARMENT.clusters.elimination
    place = np.argsort(order.order)
    p, q = place[GARMENT.clusters.ends].T
    assert (order.first[p] <= np.minimum(p, q)).all()
    assert (np.arange(len(place)) - order.first + 1).mean() < 0.35 * len(place)
