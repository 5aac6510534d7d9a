"""Garments are manifold, consistently wound, open at their hems, outside the body, of about the wanted size and even."""

import numpy as np
import pytest

from ddakf.body import proximity
from ddakf.commands import simulate
from ddakf.data.body import load_body
from ddakf.errors import InvalidArgument
from ddakf.evaluation.simulation import garments
from ddakf.mesh import Mesh, vertex_normals

HEMS = {"tshirt": 4, "tank": 4, "skirt": 2, "dress": 4}
WANTED = 300


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module", params=garments.GARMENTS)
def garment(request, body):
    return garments.make(request.param, body, WANTED)


@pytest.fixture(scope="module")
def contact(garment, body):
    tree = proximity.build(Mesh(body.vertices, body.faces))
    return proximity.closest_points(tree, proximity.refresh(tree, body.vertices), garment.mesh.vertices, radius=np.inf)


def directed_edges(faces):
    return np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])


def hem_loops(faces):
    """Number of closed boundary curves; each boundary vertex has one way in and one way out."""
    edges = {tuple(edge) for edge in directed_edges(faces).tolist()}
    following = {a: b for a, b in edges if (b, a) not in edges}
    assert len(following) == sum((b, a) not in edges for a, b in edges)
    loops = 0
    while following:
        loops += 1
        _, vertex = following.popitem()
        while vertex in following:
            vertex = following.pop(vertex)
    return loops


def test_the_command_offers_every_garment():
    assert set(simulate.GARMENTS) == set(garments.GARMENTS)


@pytest.mark.slow
def test_garments_are_manifold_and_consistently_wound(garment):
    directed = directed_edges(garment.mesh.faces)
    assert len(np.unique(directed, axis=0)) == len(directed)  # no edge is run twice in one direction


def test_garments_are_open_at_their_hems_and_have_no_other_holes(garment):
    mesh = garment.mesh
    assert hem_loops(mesh.faces) == HEMS[garment.name]
    euler = mesh.n_vertices - len(mesh.edges) + mesh.n_faces
    assert euler == 2 - HEMS[garment.name]  # a sphere with as many holes, in one piece


def test_garments_are_outside_the_body_and_face_away_from_it(garment, contact):
    assert contact.distance.min() > 0.9 * garments.GAP
    normals = vertex_normals(garment.mesh.vertices, garment.mesh.faces)
    near = (contact.distance < 0.03) & ~garment.mesh.boundary_vertices
    assert ((normals * contact.normal).sum(axis=1)[near] > 0).mean() > 0.98


def test_garments_have_the_wanted_size_and_even_edges(garment):
    mesh = garment.mesh
    assert abs(mesh.n_vertices / WANTED - 1) < 0.1
    ends = mesh.vertices[mesh.edges]
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    assert length.max() < 2.2 * mesh.edge_length
    assert length.std() < 0.25 * mesh.edge_length


def test_only_the_skirt_is_held_by_its_waistband(garment, body):
    if garment.name == "skirt":
        assert garment.mesh.boundary_vertices[garment.pinned].all()
        assert np.ptp(garment.mesh.vertices[garment.pinned, 1]) < 0.02
    else:
        assert not garment.pinned.any()


def test_seeds_vary_the_measures_by_up_to_a_tenth_and_repeat_them():
    plain = garments.measures("dress")
    first, again, other = (np.array(garments.measures("dress", seed)) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)
    assert (np.abs(first - plain) <= 0.1 * np.abs(plain) + 1e-12).all()


@pytest.mark.parametrize(("name", "vertices", "named"), [("toga", 500, "garment"), ("skirt", 3, "vertices")])
def test_what_cannot_be_cut_is_refused(body, name, vertices, named):
    with pytest.raises(InvalidArgument, match=named):
        garments.make(name, body, vertices)
