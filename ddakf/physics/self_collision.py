"""Stage E, self-collision (paper, section 2.4): two layers of a garment stay a thickness apart.

Each vertex i with another layer under or above it has one constraint, r = min(0, s n . (p_i - p_j) - gap) in metres: j is the
nearest vertex of that layer, n its normal, s the side of vertex i after the last frame. Vertices close at rest are of one layer.
Pairs are sought once per frame. The gap is the thickness, or the height at which the layers already were. Weight: the vertex's
share of the rest area, m^2, as in body collision.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.config.physics import Physics
from ddakf.kernels import self_collision as kernels
from ddakf.kernels.normals import vertex_normals
from ddakf.mesh import Mesh
from ddakf.physics import Linearization, allocate


class LayerConstants(NamedTuple):
    """Constants of a garment's layers."""

    mesh: Mesh  # at rest
    area: np.ndarray  # (V,) m^2, each vertex's share of the rest area
    thickness: float  # m, of the fabric
    reach: float  # m, within which a vertex of another layer is sought
    separation: float  # m: vertices closer at rest are of one layer


class Layers(NamedTuple):
    """Pairs of vertices of two layers; C of them."""

    stencil: np.ndarray  # (C, 2) int32, vertex and its partner
    normal: np.ndarray  # (C, 3) unit, of the partner, toward the vertex's side
    gap: np.ndarray  # (C,) m
    area: np.ndarray  # (C,) m^2


def build(mesh: Mesh, area: np.ndarray, thickness: float, config: Physics | None = None) -> LayerConstants:
    """Constants of a garment.

    Args:
        mesh: the garment at rest.
        area: (V,) each vertex's share of the rest area, m^2.
        thickness: of the fabric, metres.
        config: distances of layers; ``Physics()`` if None.
    """
    config = Physics() if config is None else config
    reach, separation = config.layer_reach * mesh.edge_length, config.layer_separation * mesh.edge_length
    return LayerConstants(mesh, area, thickness, reach, separation)


def find(last: np.ndarray, position: np.ndarray, constants: LayerConstants) -> Layers:
    """The pairs that may touch.

    Args:
        last: (V, 3) after the last frame, for the side of each vertex, metres.
        position: (V, 3) in this frame, for the normals of the layers, metres.
        constants: of the garment.
    """
    n, mesh, area = len(position), constants.mesh, constants.area
    faces = mesh.faces.astype(np.int32)
    before, now = np.empty((n, 3)), np.empty((n, 3))
    vertex_normals(last, faces, before)
    vertex_normals(position, faces, now)
    partner, side = np.empty(n, np.int32), np.empty(n)
    kernels.find_opposite(np.ascontiguousarray(last), before, mesh.vertices, constants.reach, constants.separation, partner, side)
    i = np.flatnonzero(partner >= 0)
    j = partner[i]
    height = np.einsum("ca,ca->c", before[j], last[i] - last[j])
    stencil = np.stack([i, j], axis=1).astype(np.int32)
    return Layers(stencil, side[i, None] * now[j], np.minimum(constants.thickness, np.abs(height)), area[i])


def linearize(position: np.ndarray, layers: Layers) -> Linearization:
    """Residuals (metres, at most 0) and Jacobians at (V, 3) ``position`` metres; the partners' normals are constant."""
    out = allocate(layers.stencil, np.zeros(len(layers.stencil)))
    kernels.linearize(position, *layers, out.residual, out.jacobian, out.weight)
    return out
