"""Garments are manifold, consistently wound, open at their hems, outside the body, of about the wanted size and even."""

import numpy as np
import pytest

from ddakf.body import proximity
from ddakf.commands import simulate
from ddakf.data.body import load_body
from ddakf.data.body_shape import random_shape, shaped
from ddakf.errors import InvalidArgument
from ddakf.evaluation.simulation import fabrics, garments
from ddakf.mesh import Mesh, vertex_normals
from tests.lanes import every

HEMS = {
    "tshirt": 4, "tank": 4, "skirt": 2, "dress": 4, "long-shirt": 4, "trousers": 3, "shorts": 3, "straight-skirt": 2,
    "jacket": 3, "hoodie": 4, "cape": 1,
}  # fmt: skip
WANTED = 300


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module", params=every(3, garments.GARMENTS))
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


def test_the_command_offers_every_garment_fit_and_fabric():
    assert set(simulate.GARMENTS) == set(garments.GARMENTS)
    assert set(simulate.FITS) == set(garments.FITS)
    assert set(simulate.FABRICS) == set(fabrics.FABRICS)


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


def test_what_hangs_from_the_waist_or_the_neck_is_held_by_its_uppermost_hem(garment):
    if garment.name in garments.HELD:
        assert garment.pinned.sum() > 6
        assert garment.mesh.boundary_vertices[garment.pinned].all()
        assert np.ptp(garment.mesh.vertices[garment.pinned, 1]) < 0.03
        assert garment.mesh.vertices[garment.pinned, 1].max() == garment.mesh.vertices[:, 1].max()
    else:
        assert not garment.pinned.any()


@pytest.mark.parametrize("name", every(4, ["trousers", "long-shirt", "jacket", "cape"]))
def test_a_loose_fit_takes_more_cloth_than_a_close_one(body, name):
    def area(fit):
        a, b, c = (mesh := garments.make(name, body, WANTED, fit=fit).mesh).vertices[mesh.faces].transpose(1, 0, 2)
        return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2

    assert area("loose") > 1.1 * area("close")


@pytest.mark.slow
def test_sleeves_and_legs_end_where_they_should(body):
    shirt, trousers, shorts = (garments.make(name, body, WANTED).mesh.vertices for name in ("long-shirt", "trousers", "shorts"))
    elbow, wrist = (abs(body.head(f"{joint}_l")[0]) for joint in ("lowerarm", "hand"))
    knee, ankle = (body.head(f"{joint}_l")[1] for joint in ("calf", "foot"))
    assert (elbow + wrist) / 2 < np.abs(shirt[:, 0]).max() < wrist + 0.03
    assert ankle < trousers[:, 1].min() < (knee + ankle) / 2
    assert knee < shorts[:, 1].min() < body.head("thigh_l")[1]


@pytest.mark.parametrize("name", every(3, ["trousers", "hoodie", "cape"]))
@pytest.mark.parametrize("seed", [2, 3])
def test_garments_fit_bodies_of_other_shapes(name, seed):
    body = shaped(load_body(), random_shape(seed))
    mesh = garments.make(name, body, WANTED, seed, "close").mesh
    tree = proximity.build(Mesh(body.vertices, body.faces))
    found = proximity.closest_points(tree, proximity.refresh(tree, body.vertices), mesh.vertices, radius=np.inf)
    assert found.distance.min() > 0.9 * garments.GAP
    assert hem_loops(mesh.faces) == HEMS[name]


def test_the_hood_goes_over_the_head_and_leaves_the_face_open(body):
    mesh = garments.make("hoodie", body, WANTED).mesh
    head = body.vertices[body.skin.share([body.index("head")]) > 0.9]
    assert mesh.vertices[:, 1].max() > head[:, 1].max()
    nose = head[head[:, 2].argmax()]
    assert np.linalg.norm(mesh.vertices - nose, axis=1).min() > 0.04


def test_seeds_vary_the_measures_by_up_to_a_tenth_and_repeat_them():
    plain = garments.measures("dress")
    first, again, other = (np.array(garments.measures("dress", seed)) for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)
    assert (np.abs(first - plain) <= 0.1 * np.abs(plain) + 1e-12).all()


@pytest.mark.parametrize(
    ("arguments", "named"), [(("toga", 500), "garment"), (("skirt", 3), "vertices"), (("skirt", 500, "tight"), "fit")]
)
def test_what_cannot_be_cut_is_refused(body, arguments, named):
    name, vertices, *fit = arguments
    with pytest.raises(InvalidArgument, match=named):
        garments.make(name, body, vertices, 0, *fit)
