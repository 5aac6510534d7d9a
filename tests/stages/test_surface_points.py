"""Stages B and F, points on faces: which face a point measures, and what it adds to the normal equations."""

import numpy as np
import pytest

from ddakf import Config, Tracker
from ddakf.config import Discretisation, PlaneAssociation
from ddakf.evaluation.sensors import Sensor
from ddakf.garment import model as garment_model
from ddakf.kernels import fuse as fuse_kernels
from ddakf.kernels import surface_points as kernels
from ddakf.kernels import uncertainty as uncertainty_kernels
from ddakf.kernels.surface_points import NO_FACE, Agreement, FoundFaces, Sample
from ddakf.stages import fuse, uncertainty
from ddakf.stages.grid import nearest_vertices
from tests.stages.scenes import FPS, scan, tube
from tests.tracker_runs import SAMPLE, SHIRT

GARMENT = tube()
MODEL = garment_model.build(GARMENT)
AGREEMENT = Agreement(0.5, 0.006)


def nothing(n):
    return FoundFaces(np.full(n, NO_FACE), np.empty((n, 3)), np.empty((n, 3)), np.empty(n), np.empty(n, bool))


def on_faces(rng, n, height=0.0, least=0.05):
    """Points above faces of the tube, inside them: faces, barycentric coordinates, normals, points."""
    corners = GARMENT.vertices[GARMENT.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    face, share = rng.integers(0, GARMENT.n_faces, n), least + (1 - 3 * least) * rng.dirichlet(np.ones(3), n)
    place = np.einsum("pc,pca->pa", share, corners[face])
    return face, share, normal[face], place + np.asarray(height)[..., None] * normal[face]


def beneath(points, normal, oriented=True, position=GARMENT.vertices):
    found, reach = nothing(len(points)), 1.25 * MODEL.edge_length
    vertex, _ = nearest_vertices(points, position, reach)
    kernels.faces_beneath(position, MODEL.rings, vertex, Sample(points, normal, oriented), AGREEMENT, found)
    return found


def test_a_point_measures_its_height_above_the_face_beneath_it():
    rng = np.random.default_rng(0)
    height = rng.uniform(-0.002, 0.002, 300)
    face, share, normal, points = on_faces(rng, 300, height)
    found = beneath(points, normal)
    same = found.face == face
    assert same.mean() > 0.95  # the nearest vertex of a flat triangle may belong to its neighbour alone
    assert found.agrees[same].all()
    np.testing.assert_allclose(found.offset[same], height[same], atol=1e-9)
    np.testing.assert_allclose(found.share[same], share[same], atol=1e-6)
    np.testing.assert_allclose(found.normal[same], normal[same], atol=1e-9)


@pytest.mark.parametrize("oriented", [True, False])
def test_a_point_whose_plane_disagrees_measures_nothing(oriented):
    _, _, normal, points = on_faces(np.random.default_rng(1), 50)
    assert not beneath(points, np.tile([0.0, 1.0, 0.0], (50, 1)), oriented).agrees.any()
    assert beneath(points, -normal, oriented).agrees.any() != oriented
    assert beneath(points, 0.0 * normal, oriented).agrees.all()  # of noise as wide as the cells no plane is known


def test_a_point_past_the_end_of_the_cloth_measures_nothing():
    hem = GARMENT.vertices[MODEL.boundary[:, 0]]
    beyond = hem + np.sign(hem[:, 1:2] - hem[:, 1].mean()) * [0.0, 0.01, 0.0]
    outward = hem * [1.0, 0.0, 1.0] / np.linalg.norm(hem * [1.0, 0.0, 1.0], axis=1, keepdims=True)
    assert not beneath(beyond, outward).agrees.any()
    assert not beneath(hem + 1.0, outward).agrees.any()  # and so does one that is far from all


def test_points_follow_their_faces_from_pass_to_pass():
    """After the garment has slid by half an edge the walk finds what a search finds."""
    rng = np.random.default_rng(2)
    _, _, normal, points = on_faces(rng, 400, rng.normal(0.0, 0.002, 400))
    found = beneath(points, normal)
    moved = GARMENT.vertices + [0.0, 0.5 * MODEL.edge_length, 0.0]
    searched, none = beneath(points, normal, position=moved), np.full(len(points), -1, np.int32)
    kernels.faces_beneath(moved, MODEL.rings, none, Sample(points, normal, True), AGREEMENT, found)
    both = found.agrees & searched.agrees
    assert both.mean() > 0.85
    assert (found.face == searched.face)[both].mean() > 0.9
    assert np.abs(found.offset - searched.offset)[both].max() < 1e-3


def test_points_enter_the_normal_equations_as_least_squares_does():
    """With J the derivative of a height: the blocks add J'J k and the force J'k offset, in the rows of the one-rings."""
    rng, n = np.random.default_rng(3), GARMENT.n_vertices
    face, share, normal, _ = on_faces(rng, 60)
    offset, k = rng.normal(0.0, 0.002, 60), rng.uniform(0.5, 2.0, 60)
    found = FoundFaces(face.astype(np.int32), share, normal, offset, np.ones(60, bool))
    D, blocks, force = np.zeros((n, 3, 3)), np.zeros((len(GARMENT.edges), 12), np.float32), np.zeros((n, 4))
    kernels.add_points(MODEL.rings, found, k, D, blocks, force)
    B = np.empty((len(MODEL.neighbour), 12), np.float32)
    fuse_kernels.add_coupling(MODEL.start, MODEL.neighbour, MODEL.edge, blocks, np.zeros(n), D, D, B)
    dense = np.zeros((n, 3, n, 3))
    dense[np.arange(n), :, np.arange(n), :] = D
    row = np.repeat(np.arange(n), np.diff(MODEL.start.astype(np.int64)))
    dense[row, :, MODEL.neighbour, :] = B.reshape(-1, 3, 4)[:, :, :3].transpose(0, 2, 1)
    J = np.zeros((60, n, 3))
    for p in range(60):
        J[p, GARMENT.faces[face[p]]] = share[p][:, None] * normal[p]
    np.testing.assert_allclose(dense, np.einsum("pia,p,pjb->iajb", J, k, J), atol=1e-5)
    np.testing.assert_allclose(force[:, :3], np.einsum("pia,p->ia", J, k * offset), atol=1e-12)


def test_a_coarse_mesh_follows_folds_that_are_finer_than_its_planes():
    """The sample on a mesh of other and wider triangles than those that the cloud is taken from."""
    sensor, rms = Sensor("full"), []
    for points in (0, PlaneAssociation.points):
        pieces = Discretisation(working_edge=0.033, working_vertices_least=500, working_finest=1.0)
        tracker = Tracker(SHIRT, config=Config(discretisation=pieces, associate=PlaneAssociation(points=points)))
        tracker.reset(SAMPLE.garment_vertices[0])
        error = []
        for k in range(1, 40):
            cloud = sensor.capture(SAMPLE, k, np.random.default_rng([1, k]))
            result = tracker.step(cloud.points, timestamp=k / FPS)
            error.append(np.square(result.vertices - SAMPLE.garment_vertices[k]).sum(axis=1).mean())
        rms.append(np.sqrt(np.mean(error)))
    assert rms[1] < 0.9 * rms[0]


def test_a_fine_garment_has_no_such_points():
    config = PlaneAssociation()
    assert config.wanted_points(1.0, config.points_finest) == 0
    assert config.wanted_points(2.0, 1.0) == 2 * config.wanted_points(1.0, config.points_edge) == 2 * round(config.points)


def test_points_are_no_coupling_between_patches(monkeypatch):
    """What a point on a face of two patches adds is a measurement: taken for a force of the cloth it would make errors grow."""
    kept, posterior = [], uncertainty.posterior
    monkeypatch.setattr(uncertainty, "posterior", lambda *frame: kept.append(frame) or posterior(*frame))
    tracker = Tracker(GARMENT)
    for k in range(3):
        tracker.step(scan(GARMENT.vertices, GARMENT, seed=k), timestamp=k / FPS)
    problem, estimate = kept[-1]
    assert estimate.planes.points is not None
    least = []
    for B in (uncertainty._elastic(problem, estimate), estimate.system.B):
        n = len(problem.model.likeness)
        matrix = np.empty((3 * n, 3 * n), np.float32)
        uncertainty_kernels.couple_patches(B, problem.model.crossing, np.zeros((n, 6)), 0.0, matrix)
        values = np.linalg.eigvalsh(0.5 * (matrix + matrix.T).astype(float))
        least.append(values[0] / values[-1])
    assert least[0] > -1e-4
    assert least[1] < least[0] - 1e-4


def test_points_of_a_noisy_sensor_count_less(monkeypatch):
    """A plane averages many points, and one point none."""
    seen, found, information = [], {}, fuse._information

    def kept(problem, points, variance):
        seen.append(variance * information(problem, points, variance))  # beside that of a plane
        return seen[-1] / variance

    monkeypatch.setattr(fuse, "_information", kept)
    for noise in (0.001, 0.003, 0.010):
        tracker = Tracker(GARMENT)
        for k in range(4):
            tracker.step(scan(GARMENT.vertices, GARMENT, 6000, noise, seed=k), timestamp=k / FPS)
        found[noise] = np.median(seen[-1][seen[-1] > 0.0])
    assert found[0.003] == pytest.approx(found[0.001], rel=0.3)
    assert found[0.010] < 0.6 * found[0.003]
