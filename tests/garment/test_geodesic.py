"""Geodesic distance: scipy's shortest paths and nearest neighbours, on pieces and on points in a row."""

import numpy as np
import pytest
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from ddakf import data
from ddakf.garment import geodesic
from ddakf.mesh import Mesh
from tests.garment.shapes import sheet


def graph_of(mesh: Mesh) -> geodesic.Graph:
    return geodesic.graph_of(mesh.edges, np.linalg.norm(np.subtract(*mesh.vertices[mesh.edges.T]), axis=1), mesh.n_vertices)


def sparse(graph: geodesic.Graph) -> csr_array:
    n = len(graph.start) - 1
    return csr_array((graph.length, graph.neighbour, graph.start), shape=(n, n))


@pytest.fixture(scope="module")
def two_pieces():
    """The sample's garment twice, the second one apart."""
    sequence = data.sample()
    vertices, faces = sequence.template, sequence.garment_faces
    return Mesh(np.concatenate([vertices, vertices + [3.0, 0, 0]]), np.concatenate([faces, faces + len(vertices)]))


def test_distances_from_one_vertex_are_the_shortest_to_the_bit(two_pieces):
    graph = graph_of(two_pieces)
    for seed in (0, 17, two_pieces.n_vertices - 1):
        distance, owner = geodesic.distances(graph, [seed])
        assert np.array_equal(distance, dijkstra(sparse(graph), indices=seed))
        assert np.array_equal(owner < 0, np.isinf(distance))


def test_the_owner_is_the_seed_at_the_end_of_the_shortest_path(two_pieces):
    graph, half = graph_of(two_pieces), two_pieces.n_vertices // 2
    seeds = np.random.default_rng(1).choice(half, 90, replace=False)
    distance, owner = geodesic.distances(graph, seeds)
    expected, _, source = dijkstra(sparse(graph), indices=seeds, min_only=True, return_predecessors=True)
    assert np.array_equal(distance, expected)
    assert np.array_equal(seeds[owner[:half]], source[:half])
    assert (owner[half:] == -1).all()


def test_specks_without_a_seed_belong_to_the_nearest_one_through_the_air():
    """Specks of one triangle each beside a sheet."""
    rng, mesh = np.random.default_rng(0), sheet()
    corners = rng.normal(scale=0.3, size=(20, 1, 3)) + rng.normal(scale=0.02, size=(20, 3, 3))
    n = mesh.n_vertices
    specks = n + np.arange(60).reshape(-1, 3)
    both = Mesh(np.concatenate([mesh.vertices, corners.reshape(-1, 3)]), np.concatenate([mesh.faces, specks]))
    seeds = np.arange(0, n, 7)
    owner = geodesic.owners(both.vertices, graph_of(both), seeds)
    assert np.array_equal(owner[n:], cKDTree(mesh.vertices[seeds]).query(both.vertices[n:])[1])
    assert np.array_equal(owner[:n], geodesic.distances(graph_of(mesh), seeds)[1])


def test_ties_of_a_regular_mesh_are_decided_as_scipy_decides_them():
    graph = graph_of(sheet())
    n = len(graph.start) - 1
    seeds = np.arange(0, n, 7)
    _, _, source = dijkstra(sparse(graph), indices=seeds, min_only=True, return_predecessors=True)
    assert np.array_equal(seeds[geodesic.distances(graph, seeds)[1]], source)


def test_a_path_may_begin_with_a_length(two_pieces):
    """As if one more vertex were joined to the seeds by edges of these lengths."""
    graph, n = graph_of(two_pieces), two_pieces.n_vertices
    rng = np.random.default_rng(2)
    seeds, begun = rng.choice(n, 30, replace=False), rng.uniform(0, 0.5, 30)
    whole = sparse(graph).tocoo()
    rows, columns = np.append(whole.row, np.full(30, n)), np.append(whole.col, seeds)
    joined = csr_array((np.append(whole.data, begun), (rows, columns)), shape=(n + 1, n + 1))
    assert np.array_equal(geodesic.distances(graph, seeds, begun)[0], dijkstra(joined, indices=n)[:n])


def test_pieces_are_counted_and_edges_found(two_pieces):
    graph = graph_of(two_pieces)
    assert graph.pieces() == connected_components(sparse(graph))[0] == 2
    a, b = two_pieces.edges[::7].T
    np.testing.assert_array_equal(graph.between(b, a), np.linalg.norm(np.subtract(*two_pieces.vertices[[a, b]]), axis=1))


@pytest.mark.parametrize("spread", [(1, 1, 1), (1e-6, 1, 1), (0, 0, 1), (0, 0, 0), (1e3, 1, 1e-3)])
@pytest.mark.parametrize("count", [1, 2, 300])
def test_the_nearest_point_is_as_near_as_any(spread, count):
    rng = np.random.default_rng(count)
    points, queries = rng.normal(size=(count, 3)) * spread, rng.normal(size=(400, 3))
    nearest = geodesic.nearest_points(points, queries)
    found = np.linalg.norm(queries - points[nearest], axis=1)
    np.testing.assert_allclose(found, cKDTree(points).query(queries)[0], rtol=1e-12)
