"""The deformation graph is Sumner's: weights, terms and derivatives, on shapes with known answers."""

import numpy as np
import pytest

from ddakf.evaluation.baselines.embedded_deformation import (
    DeformationGraph,
    EmbeddedDeformation,
    EmbeddedSettings,
    influence,
    orthonormality,
    spread,
)
from ddakf.evaluation.metrics import rmse_mm
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh
from tests.evaluation.baselines.shapes import moved, tube, widened


@pytest.fixture(scope="module")
def garment():
    return tube()


@pytest.fixture(scope="module")
def graph(garment):
    return DeformationGraph(garment, 40, 4)


def turn(angle):
    return moved(np.eye(3), angle, 0).T


def test_nodes_are_spread_and_distances_go_along_the_mesh(garment):
    nodes, distance = spread(garment, 40)
    assert len(set(nodes)) == 40
    assert (distance >= np.linalg.norm(garment.vertices[nodes][:, None] - garment.vertices, axis=2) - 1e-9).all()
    apart = distance[:, nodes][~np.eye(40, dtype=bool)].min()
    assert distance.min(axis=0).max() <= apart + 1e-9, "no vertex is farther from all nodes than two nodes from each other"


def test_weights_are_sumner_s_and_sum_to_one():
    distance = np.array([[0.1], [0.2], [0.4], [0.5]])
    node, weight = influence(distance, 2)
    expected = np.array([(1 - 0.1 / 0.4) ** 2, (1 - 0.2 / 0.4) ** 2])
    assert node.tolist() == [[0, 1]]
    assert weight[0] == pytest.approx(expected / expected.sum(), rel=1e-4)


def test_a_node_moves_nothing_of_another_part():
    one = tube(8, 4)
    vertices = np.concatenate([one.vertices, one.vertices + [0.5, 0, 0]])
    both = Mesh(vertices, np.concatenate([one.faces, one.faces + one.n_vertices]))
    graph = DeformationGraph(both, 12, 4)
    unknowns = graph.moved(np.eye(3), np.zeros(3)).reshape(-1, 4, 3)
    unknowns[graph.nodes >= one.n_vertices, 3] += [0, 1, 0]
    moved_by = graph.blend @ unknowns.reshape(-1, 3) - both.vertices
    assert moved_by == pytest.approx(np.repeat([[0, 0, 0], [0, 1.0, 0]], one.n_vertices, axis=0), abs=1e-9)


def test_a_rigid_motion_moves_all_vertices_and_costs_nothing(garment, graph):
    unknowns = graph.moved(turn(2.0), np.array([1.0, 2.0, 3.0]))
    assert graph.blend @ unknowns == pytest.approx(moved(garment.vertices, 2.0, [1, 2, 3]))
    assert graph.regularity @ unknowns == pytest.approx(0, abs=1e-9)
    assert graph.rigidity @ unknowns == pytest.approx(0, abs=1e-9)
    assert orthonormality(unknowns)[0] == pytest.approx(0, abs=1e-9)


def test_a_stretch_violates_orthonormality_only(garment, graph):
    unknowns = graph.moved(np.eye(3), np.zeros(3)).reshape(-1, 4, 3) * [1.2, 1, 1]
    flat = unknowns.reshape(-1, 3)
    assert graph.blend @ flat == pytest.approx(garment.vertices * [1.2, 1, 1])
    assert graph.regularity @ flat == pytest.approx(0, abs=1e-9)
    assert orthonormality(flat)[0] == pytest.approx(np.tile([0, 0, 0, 0.44, 0, 0], (40, 1)), abs=1e-9)


def test_the_regularity_is_sumner_s_formula(garment, graph):
    rng = np.random.default_rng(0)
    unknowns = rng.normal(size=(160, 3))
    affine, place = unknowns.reshape(-1, 4, 3)[:, :3].transpose(0, 2, 1), unknowns[3::4]
    g = garment.vertices[graph.nodes]
    rows = {tuple(np.round(row, 9)) for row in graph.regularity @ unknowns}
    pairs = [(j, k) for j in range(40) for k in range(40) if j != k]
    formula = {tuple(np.round(affine[j] @ (g[k] - g[j]) + place[j] - place[k], 9)) for j, k in pairs}
    assert len(rows) > 2 * 40
    assert rows <= formula


def test_derivatives_of_orthonormality_are_those_of_finite_differences():
    rng, h = np.random.default_rng(0), 1e-6
    unknowns = rng.normal(size=(4, 3))
    value, slope = orthonormality(unknowns)
    for a in range(3):
        for b in range(3):
            ahead = unknowns.copy()
            ahead[a, b] += h
            assert (orthonormality(ahead)[0] - value)[0] / h == pytest.approx(slope[0, :, a, b], abs=1e-4)


def test_gauss_newton_descends_to_where_the_energy_has_no_slope(garment):
    settings = EmbeddedSettings(nodes=40)
    method, rng = EmbeddedDeformation(settings), np.random.default_rng(0)
    method.start(garment, garment.vertices, None)
    points = widened(garment.vertices, 0.1)
    normals, weight = rng.normal(size=points.shape), rng.random((len(points), 1))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    def energy(u):
        offset = method._graph.blend @ u - points
        data = (weight[:, 0] * ((normals * offset).sum(axis=1) ** 2 + settings.point * (offset**2).sum(axis=1))).sum()
        rotation = settings.rotation * method._graph.spacing**2 * np.square(orthonormality(u)[0]).sum()
        regular = settings.regularisation * np.square(method._graph.regularity @ u).sum()
        return data + rotation + regular + settings.smoothness * np.square(method._graph.rigidity @ u).sum()

    energies = [energy(method._unknowns)]
    for _ in range(60):
        method._unknowns = method._unknowns + method._step(points, normals, weight, settings.point)
        energies.append(energy(method._unknowns))
    assert energies[-1] < 0.9 * energies[0]
    assert max(energies[-5:]) == pytest.approx(energies[-1], rel=1e-4)
    for _ in range(20):
        nearby = method._unknowns + 1e-3 * rng.normal(size=method._unknowns.shape)
        assert energy(nearby) > energies[-1]


def test_it_starts_where_it_is_told_whatever_the_turn(garment):
    method, start = EmbeddedDeformation(), moved(widened(garment.vertices, 0.1), 3.0, [1, 0, 0])
    method.start(garment, start, None)
    assert rmse_mm(method.step(CapturedFrame(0, 0.1, np.zeros((0, 3)))), start) < 1
