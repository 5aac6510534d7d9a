"""Per-frame embedded deformation with as-rigid-as-possible smoothness (Opt-ED).

A graph of nodes g_j is spread over the start's shape s; each has an affine matrix A_j and a position p_j, and moves the vertices
around it (Sumner, Schmid and Pauly 2007, "Embedded deformation for shape manipulation"):

    x_i = sum_j w_ij (A_j (s_i - g_j) + p_j)

with w_ij proportional to (1 - d_ij / d_max)^2 over the nearest nodes, distances d along the mesh. Per frame, from where the last
one ended, and with correspondences found anew in every iteration, Gauss-Newton minimises

    sum_i w_i [(n_i . (x_i - c_i))^2 + point |x_i - c_i|^2]          points c_i with normals n_i, robust weights w_i
    + rotation l^2 sum_j Rot(A_j)                                   Sumner's: columns orthonormal; l is the nodes' distance
    + regularisation sum_jk |A_j (g_k - g_j) + p_j - p_k|^2          Sumner's: neighbours agree
    + smoothness sum_ab |(x_a - x_b) - (R_a + R_b) / 2 (s_a - s_b)|^2  over the mesh's edges, R_a = sum_j w_aj A_j, as Sorkine and
                                                                   Alexa 2007 with the rotations that the nodes have

All but the second term are linear in the unknowns inside, and alike for the three coordinates: their matrix never changes. It
is factorised once, and preconditions the conjugate gradients that solve each Gauss-Newton step.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import dijkstra

from ddakf.evaluation.baselines.body_support import support_of
from ddakf.evaluation.baselines.linear_algebra import conjugate_gradients, factorised
from ddakf.evaluation.baselines.matching import LEAST_POINTS, Matches, MatchSettings, Scan, VertexNormals
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

TYPICAL_WEIGHT = 0.4  # of a correspondence along any one axis, for the preconditioner
TYPICAL_ROTATION = 2.0  # eigenvalue of Rot's Hessian at a rotation, likewise
PRIOR = 1e-6  # keeps unknowns that nothing determines where they are
SOLVER_STEPS, SOLVER_TOLERANCE = 12, 0.1  # of conjugate gradients in one Gauss-Newton step: the next step corrects the rest
CARRIED_WEIGHT = 100.0  # of the vertices of a carried garment, onto which the graph is laid
CARRYING_STEPS = 2  # of Gauss-Newton, in which the nodes follow the garment that the body has carried on
STILL = 5e-4  # m: a frame is done when its vertices move less, RMS


@dataclass(frozen=True)
class EmbeddedSettings(MatchSettings):
    """Numbers of the method, beside those of matching; the defaults are the best of ``benchmarks/results/tuning.json``.

    Attributes:
        nodes: of the graph.
        influences: nearest nodes that move a vertex.
        point, rotation, regularisation, smoothness: weights of the terms, see the module.
        iterations: of Gauss-Newton per frame, at most.
        hold: weight of a hidden vertex on the body, see :mod:`.body_support`.
    """

    nodes: int = 675
    influences: int = 4
    point: float = 0.003
    rotation: float = 1.0
    regularisation: float = 1.0
    smoothness: float = 1.0
    iterations: int = 8
    hold: float = 0.03
    gate: float = 0.1


TUNED = EmbeddedSettings()


class EmbeddedDeformation:
    """See the module. Uses no time. A body carries the graph on, holds hidden vertices, and pushes out the vertices, not the
    graph."""

    def __init__(self, settings: EmbeddedSettings = TUNED):
        self.settings = settings

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        settings, vertices = self.settings, np.array(vertices, np.float64)
        self._normals = VertexNormals(garment)
        graph = DeformationGraph(Mesh(vertices, garment.faces), settings.nodes, settings.influences)
        self._graph, n = graph, 4 * len(graph.nodes)
        self._rotation = settings.rotation * graph.spacing**2
        smooth = settings.regularisation * graph.regularity.T @ graph.regularity
        self._smooth = sparse.csr_array(smooth + settings.smoothness * graph.rigidity.T @ graph.rigidity)
        affine = sparse.diags_array(np.tile([1.0, 1.0, 1.0, 0.0], len(graph.nodes)))
        data = TYPICAL_WEIGHT * graph.blend.T @ graph.blend
        self._factor = factorised(self._smooth + data + self._rotation * TYPICAL_ROTATION * affine + PRIOR * sparse.eye_array(n))
        self._unknowns = graph.moved(np.eye(3), np.zeros(3))
        self._support = support_of(body, vertices, settings.hold)

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        x = self._graph.blend @ self._unknowns
        carried = self._support.begin(frame, x)
        if carried is not x:
            self._lay_onto(carried, CARRYING_STEPS)
            x = self._graph.blend @ self._unknowns
        if len(frame.points) < LEAST_POINTS:
            return self._support.outside(x)
        scan = Scan(frame, self.settings)
        for _ in range(self.settings.iterations):
            self._unknowns = self._unknowns + self._step(*self._targets(scan.match(x, self._normals(x))))
            before, x = x, self._graph.blend @ self._unknowns
            if np.square(x - before).sum(axis=1).mean() < STILL**2:
                break
        return self._support.outside(x)

    def _lay_onto(self, vertices: np.ndarray, steps: int) -> None:
        """Moves the graph so that the garment comes near to vertices (V, 3)."""
        everywhere = np.full((len(vertices), 1), CARRIED_WEIGHT)
        for _ in range(steps):
            self._unknowns = self._unknowns + self._step(vertices, np.zeros_like(vertices), everywhere, 1.0)

    def _targets(self, found: Matches) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Targets, normals, weights and shares of the point term: matches, and places on the body where there are none."""
        held = self._support.held(found.weight)[:, None]
        hidden = held > 0
        targets, normals = np.where(hidden, self._support.place, found.points), np.where(hidden, 0.0, found.normals)
        return targets, normals, found.weight[:, None] + held, np.where(hidden, 1.0, self.settings.point)

    def _step(self, points: np.ndarray, normals: np.ndarray, weight: np.ndarray, point: np.ndarray | float) -> np.ndarray:
        """Gauss-Newton's, of the unknowns."""
        blend, smooth, u = self._graph.blend, self._smooth, self._unknowns
        blend_transposed = self._graph.blend_transposed
        value, slope = orthonormality(u)

        def pulled(vectors: np.ndarray) -> np.ndarray:
            return weight * (normals * (normals * vectors).sum(axis=1, keepdims=True) + point * vectors)

        def system(d: np.ndarray) -> np.ndarray:
            product = blend_transposed @ pulled(blend @ d) + smooth @ d + PRIOR * d
            turned = np.einsum("jrab,jab->jr", slope, _matrices(d))
            _matrices(product)[:] += self._rotation * np.einsum("jrab,jr->jab", slope, turned)
            return product

        descent = blend_transposed @ pulled(points - blend @ u) - smooth @ u
        _matrices(descent)[:] -= self._rotation * np.einsum("jrab,jr->jab", slope, value)
        return conjugate_gradients(system, descent, self._factor.solve, SOLVER_STEPS, SOLVER_TOLERANCE)


class DeformationGraph:
    """Nodes on a mesh, and how they move it. Unknowns are (4 m, 3): of each of the m nodes A' and below it p.

    Attributes:
        nodes: (m,) vertices that are nodes.
        spacing: mean distance of neighbouring nodes, metres.
        blend: (V, 4 m): unknowns to vertices.
        regularity: (pairs, 4 m): A_j (g_k - g_j) + p_j - p_k, for nodes that move a vertex together, in both directions.
        rigidity: (E, 4 m): (x_a - x_b) - (R_a + R_b) / 2 (s_a - s_b), for the edges.

    Args:
        source: the undeformed shape.
        count: of nodes; fewer where the mesh has fewer vertices.
        influences: nodes per vertex.
    """

    def __init__(self, source: Mesh, count: int, influences: int):
        s = source.vertices
        self.nodes, distance = spread(source, min(count, source.n_vertices))
        node, weight = influence(distance, influences)
        g, m = s[self.nodes], len(self.nodes)
        self._places = g
        lever = np.concatenate([s[:, None] - g[node], np.ones((*node.shape, 1))], axis=2)
        self.blend = _rows(node, weight[:, :, None] * lever, m)
        self.blend_transposed = self.blend.T.tocsr()

        member = sparse.csr_array((weight.ravel() > 0, (np.repeat(np.arange(len(s)), node.shape[1]), node.ravel())), (len(s), m))
        together = sparse.coo_array(member.astype(int).T @ member.astype(int))
        j, k = together.coords
        j, k = j[j != k], k[j != k]
        self.spacing = float(np.linalg.norm(g[j] - g[k], axis=1).mean())
        ones = np.ones((len(j), 1))
        ends = np.stack([np.hstack([g[k] - g[j], ones]), np.hstack([np.zeros((len(j), 3)), -ones])], axis=1)
        self.regularity = _rows(np.stack([j, k], axis=1), ends, m)

        a, b = source.edges.T
        edge = (s[a] - s[b])[:, None]
        affine = _rows(np.concatenate([node[a], node[b]], axis=1), np.concatenate(
            [np.concatenate([0.5 * weight[i][:, :, None] * edge, np.zeros((len(a), node.shape[1], 1))], axis=2) for i in (a, b)],
            axis=1), m)  # fmt: skip
        self.rigidity = sparse.csr_array(self.blend[a] - self.blend[b] - affine)

    def moved(self, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
        """(4 m, 3) unknowns of the undeformed shape after a rotation (3, 3) and a shift (3,)."""
        affine = np.tile(turn.T, (len(self.nodes), 1, 1))
        return np.concatenate([affine, (self._places @ turn.T + shift)[:, None]], axis=1).reshape(-1, 3)


def spread(mesh: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices as far from each other as can be, one after the other, along the edges (farthest point sampling).

    Returns:
        (m,) vertices, and (m, V) distances from each, infinite to other parts of the mesh.
    """
    i, j = mesh.edges.T
    length = np.linalg.norm(mesh.vertices[i] - mesh.vertices[j], axis=1)
    graph = sparse.csr_array((length, (i, j)), (mesh.n_vertices, mesh.n_vertices))
    chosen, distance, nearest = [], [], np.full(mesh.n_vertices, np.inf)
    for _ in range(count):
        chosen.append(int(nearest.argmax()))
        distance.append(dijkstra(graph, directed=False, indices=chosen[-1]))
        nearest = np.minimum(nearest, distance[-1])
    return np.array(chosen), np.array(distance)


def influence(distance: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The nearest nodes of every vertex and their weights (1 - d / d_max)^2, summing to 1; d_max is that of the next nearest.

    Args:
        distance: (m, V) of the nodes.
        count: of nodes per vertex; one fewer than there are, at most.

    Returns:
        (V, count) nodes and (V, count) weights, 0 for nodes of other parts.
    """
    count = max(min(count, len(distance) - 1), 1)
    order = np.argsort(distance, axis=0, kind="stable")[: count + 1]
    near = np.take_along_axis(distance, order, axis=0)
    reach = np.where(np.isfinite(near), near, 0).max(axis=0) * (1 + 1e-6)
    reach = np.where(np.isfinite(near[-1]), reach, 2 * reach) + np.finfo(float).tiny
    weight = np.square(np.maximum(1 - near[:count] / reach, 0))
    weight[0] = np.maximum(weight[0], 1e-6)
    return order[:count].T, (weight / weight.sum(axis=0)).T


def orthonormality(unknowns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Sumner's six conditions on the columns of every A: a.b, a.c, b.c, a.a - 1, b.b - 1, c.c - 1.

    Args:
        unknowns: (4 m, 3) of a :class:`DeformationGraph`.

    Returns:
        (m, 6) values, and (m, 6, 3, 3) their derivatives by A'.
    """
    columns = _matrices(unknowns)  # rows of A' are the columns of A
    pairs = ((0, 1), (0, 2), (1, 2), (0, 0), (1, 1), (2, 2))
    slope = np.zeros((len(columns), 6, 3, 3))
    value = np.empty((len(columns), 6))
    for row, (p, q) in enumerate(pairs):
        value[:, row] = (columns[:, p] * columns[:, q]).sum(axis=1) - (p == q)
        slope[:, row, p] += columns[:, q]
        slope[:, row, q] += columns[:, p]
    return value, slope


def _matrices(unknowns: np.ndarray) -> np.ndarray:
    """(m, 3, 3) view of the A' among unknowns (4 m, 3)."""
    return unknowns.reshape(-1, 4, 3)[:, :3]


def _rows(node: np.ndarray, entries: np.ndarray, count: int) -> sparse.csr_array:
    """(n, 4 count) matrix with entries (n, k, 4) in the columns of nodes (n, k); those of one place add up."""
    column = 4 * node[:, :, None] + np.arange(4)
    row = np.broadcast_to(np.arange(len(node))[:, None, None], column.shape)
    return sparse.csr_array((entries.ravel(), (row.ravel(), column.ravel())), (len(node), 4 * count))
