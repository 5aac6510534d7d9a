"""Stage E, self-collision (paper, section 2.4): two layers of a garment stay a thickness apart.

Per vertex that has another layer under or above it one constraint, r = min(0, s n . (p_i - p_j) - gap) in metres: j is the
nearest vertex of that layer, n its normal, s the side on which vertex i was after the last frame. What is close at rest is the
same layer. Pairs are sought once per frame. The gap is the thickness, or the height at which the layers already were. Weight:
the vertex's share of the rest area, m^2, as in body collision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.kernels import associate as normals
from ddakf.kernels import self_collision as kernels
from ddakf.mesh import Mesh
from ddakf.physics import Linearization, allocate

REACH = 1.0  # edges within which a layer's vertex is sought
APART = 3.0  # edges: what is closer at rest is the same layer


class Layers(NamedTuple):
    """Pairs of vertices of two layers; C of them."""

    stencil: np.ndarray  # (C, 2) int32, vertex and its partner
    normal: np.ndarray  # (C, 3) unit, of the partner, toward the vertex's side
    gap: np.ndarray  # (C,) m
    area: np.ndarray  # (C,) m^2


def find(last: np.ndarray, position: np.ndarray, mesh: Mesh, area: np.ndarray, thickness: float) -> Layers:
    """The pairs that may touch.

    Args:
        last: (V, 3) after the last frame, which says who is on which side, metres.
        position: (V, 3) in this frame, which says how the layers are turned, metres.
        mesh: the garment, at rest.
        area: (V,) each vertex's share of the rest area, m^2.
        thickness: of the fabric, metres.
    """
    n = len(position)
    faces = mesh.faces.astype(np.int32)
    before, now = np.empty((n, 3)), np.empty((n, 3))
    normals.vertex_normals(last, faces, before)
    normals.vertex_normals(position, faces, now)
    partner, side = np.empty(n, np.int32), np.empty(n)
    kernels.find_opposite(
        np.ascontiguousarray(last), before, mesh.vertices, REACH * mesh.edge_length, APART * mesh.edge_length, partner, side
    )
    i = np.flatnonzero(partner >= 0)
    j = partner[i]
    height = np.einsum("ca,ca->c", before[j], last[i] - last[j])
    stencil = np.stack([i, j], axis=1).astype(np.int32)
    return Layers(stencil, side[i, None] * now[j], np.minimum(thickness, np.abs(height)), area[i])


def linearize(position: np.ndarray, layers: Layers) -> Linearization:
    """Residuals (metres, at most 0) and Jacobians at (V, 3) ``position`` metres, the partners' normals held."""
    out = allocate(layers.stencil, np.zeros(len(layers.stencil)))
    kernels.linearize(position, *layers, out.residual, out.jacobian, out.weight)
    return out
