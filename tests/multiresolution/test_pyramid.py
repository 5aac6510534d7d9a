"""Coarser versions of a garment, and the passes on them."""

import dataclasses

import numpy as np
import pytest

from ddakf import Config, Mesh
from ddakf.body import contact
from ddakf.config import InnovationNoise, NearestPoint
from ddakf.garment import model
from ddakf.kernels import pyramid as kernels
from ddakf.multiresolution import pyramid
from ddakf.stages import associate, fuse
from ddakf.types import State
from tests.stages.scenes import about, cloud_of, frame_of, inner_body, posed, problem_of, rms, scan, tube

CONFIG = Config()
MESH = tube(around=60, along=40, spacing=0.01)
GARMENT = model.build(MESH, CONFIG)
COARSER = GARMENT.coarser


def spread(coarser: model.Coarser, base: np.ndarray, displacement: np.ndarray) -> np.ndarray:
    """(V, 3) base plus the displacement between the vertices of a coarser version."""
    moved = np.empty_like(base)
    kernels.interpolate(base, displacement, coarser.corner, coarser.share, moved)
    return moved


def descended(truth, config=CONFIG):
    """Estimate (V, 3) and number of passes, from the rest shape as prediction and a scan of ``truth``."""
    prior = State.at(MESH.vertices, np.zeros_like(MESH.vertices), 0.01, 0.5, 0.004)
    points = scan(truth, MESH, 8000, 0.002)
    cloud = cloud_of(points, None, prior.position, GARMENT.area, config)
    problem = problem_of(GARMENT, prior, config, cloud=cloud, frame=frame_of(points), garment=frame_of(points))
    estimate = pyramid.descend(problem, fuse.begin(problem))
    return estimate.position, estimate.passes


def test_a_coarser_version_is_the_same_surface_with_about_a_quarter_of_the_vertices():
    coarse = COARSER.model.mesh
    assert 0.15 * MESH.n_vertices < coarse.n_vertices < 0.4 * MESH.n_vertices
    np.testing.assert_array_equal(coarse.vertices, MESH.vertices[COARSER.vertex])
    assert COARSER.model.area == pytest.approx(GARMENT.area, rel=0.05)
    assert coarse.boundary_vertices[MESH.boundary_vertices[COARSER.vertex]].all()
    # a tube: two hems, and as many edges as vertices and faces together
    assert coarse.n_vertices - len(coarse.edges) + coarse.n_faces == 0


def test_each_vertex_lies_on_the_coarser_version():
    np.testing.assert_allclose(COARSER.share.sum(axis=1), 1.0)
    assert COARSER.share.min() > -1e-12
    foot = np.einsum("vc,vca->va", COARSER.share, COARSER.model.mesh.vertices[COARSER.corner])
    assert np.abs(foot - MESH.vertices).max() < MESH.edge_length
    own = COARSER.share[COARSER.vertex] * (COARSER.corner[COARSER.vertex] == np.arange(len(COARSER.vertex))[:, None])
    np.testing.assert_allclose(own.sum(axis=1), 1.0, atol=1e-9)


def test_what_all_vertices_have_in_common_is_interpolated_exactly():
    np.testing.assert_allclose(
        spread(COARSER, MESH.vertices, np.full((len(COARSER.vertex), 3), 0.07)), MESH.vertices + 0.07, atol=1e-12
    )
    R = about([0.2, 1.0, -0.4], np.radians(20.0))
    turned = MESH.vertices @ R.T
    error = spread(COARSER, MESH.vertices, turned[COARSER.vertex] - MESH.vertices[COARSER.vertex]) - turned
    assert rms(error) < 0.02 * rms(turned - MESH.vertices)  # what the tube bulges between the vertices


def test_the_numbering_of_the_vertices_does_not_matter():
    order = np.random.default_rng(0).permutation(MESH.n_vertices)
    number = np.argsort(order)
    other = model.build(Mesh(MESH.vertices[order], number[MESH.faces]), CONFIG).coarser
    np.testing.assert_array_equal(np.sort(order[other.vertex]), np.sort(COARSER.vertex))


def test_a_small_garment_has_no_coarser_version():
    assert model.build(tube()).coarser is None


def test_pieces_without_a_coarser_version_follow_the_nearest():
    """Specks of one triangle each beside a garment: they take part in its motion."""
    rng = np.random.default_rng(0)
    corners = rng.normal(scale=0.3, size=(20, 1, 3)) + rng.normal(scale=0.02, size=(20, 3, 3))
    n = MESH.n_vertices
    faces = np.concatenate([MESH.faces, n + np.arange(60).reshape(-1, 3)])
    coarser = model.build(Mesh(np.concatenate([MESH.vertices, corners.reshape(-1, 3)]), faces)).coarser
    shift = np.tile([0.1, 0.0, -0.2], (len(coarser.vertex), 1))
    moved = spread(coarser, np.zeros((n + 60, 3)), shift)
    np.testing.assert_allclose(moved, np.broadcast_to(shift[0], moved.shape), atol=1e-12)


def test_motion_is_found():
    middle = MESH.vertices.mean(axis=0)
    truth = (MESH.vertices - middle) @ about([1, 0, 0.2], np.radians(4.0)).T + middle + [0.02, -0.01, 0.01]
    found, passes = descended(truth)
    assert rms(found - truth) < 0.3 * rms(MESH.vertices - truth)
    assert 1 <= passes <= 2 * CONFIG.pyramid.iterations


def test_no_passes_no_change():
    still = dataclasses.replace(CONFIG, pyramid=dataclasses.replace(CONFIG.pyramid, iterations=0))
    found, passes = descended(MESH.vertices + [0.02, 0, 0], still)
    np.testing.assert_array_equal(found, MESH.vertices)
    assert passes == 0


def test_a_good_prediction_is_left_alone():
    found, passes = descended(MESH.vertices)
    np.testing.assert_array_equal(found, MESH.vertices)
    assert passes >= 1


def test_points_without_normals_have_no_coarser_passes():
    points = dataclasses.replace(CONFIG, associate=NearestPoint(), adapt=InnovationNoise())
    assert descended(MESH.vertices + [0.02, 0, 0], points)[1] == 0


def test_the_body_pushes_out_what_no_sensor_sees():
    """A body wider than the garment, and a cloud of its upper half only: the lower half gives way."""
    body = inner_body(MESH, 1.03)
    pose = posed(body)
    prior = State.at(MESH.vertices, np.zeros_like(MESH.vertices), 0.01, 0.5, 0.004)
    upper = MESH.vertices[MESH.vertices[:, 1] > 0.25].astype(np.float32)
    cloud = cloud_of(upper, None, prior.position, GARMENT.area, CONFIG)
    inside = []
    for beneath in (None, pose):
        problem = problem_of(GARMENT, prior, CONFIG, cloud=cloud, body=beneath, garment=frame_of())
        position = pyramid.descend(problem, fuse.begin(problem)).position
        inside.append(np.minimum(contact.nearest(pose, position).closest.distance[MESH.vertices[:, 1] < 0.2], 0.0).mean())
    assert inside[1] > 0.5 * inside[0]
    assert inside[0] < -0.001


def test_passes_over_all_vertices_go_on_where_the_coarser_ones_left_off():
    cloud = cloud_of(scan(MESH.vertices, MESH, 3000), None, MESH.vertices, GARMENT.area, CONFIG)
    problem = problem_of(config=CONFIG, cloud=cloud)
    whole = list(associate.gates(problem))
    assert list(associate.gates(problem, 3)) == whole[3:]
    assert list(associate.gates(problem, 100)) == whole[-1:]
