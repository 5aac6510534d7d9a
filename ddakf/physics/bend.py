"""Stage E, bending (paper, section 2.4): hinges keep the dihedral angle of the rest shape.

Per interior edge one constraint, r = theta - theta_rest, theta the signed angle between the normals of the two faces
(0 when flat), the difference wrapped to [-pi, pi). Weight: 3 |e|^2 / (A_1 + A_2) from the rest shape, dimensionless,
so that k is in joules (Grinspun, Hirani, Desbrun and Schroeder 2003, "Discrete shells", whose |e| / h_e this is).
Angle by atan2, gradient as in Bridson, Marino and Fedkiw 2003.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.config.physics import Physics
from ddakf.kernels import bend as kernels
from ddakf.mesh import Mesh
from ddakf.physics import Linearization, allocate


class BendConstants(NamedTuple):
    """One constraint per edge with two faces; stencil: its ends, then the corner opposite in either face."""

    stencil: np.ndarray  # (C, 4) int32
    rest_angle: np.ndarray  # (C,) rad
    floor: np.ndarray  # (C, 2) m^4: least squared double area by which the gradient divides, per face
    weight: np.ndarray  # (C,) dimensionless


def build(mesh: Mesh, height_share: float = Physics.bend_height) -> BendConstants:
    """Constants of a garment.

    Args:
        mesh: the garment at rest.
        height_share: the gradient grows as 1 / height of a face; below this share of the rest height it is limited.
    """
    stencil = _hinges(mesh.faces)
    x0, x1, x2, x3 = (mesh.vertices[stencil[:, s]] for s in range(4))
    edge = x1 - x0
    n1, n2 = np.cross(edge, x2 - x0), np.cross(x3 - x0, edge)
    double_area = np.stack([np.linalg.norm(n1, axis=1), np.linalg.norm(n2, axis=1)], axis=1)
    length_squared = np.einsum("ca,ca->c", edge, edge)
    sine = np.einsum("ca,ca->c", np.cross(n1, n2), edge) / np.sqrt(length_squared)
    rest_angle = np.arctan2(sine, np.einsum("ca,ca->c", n1, n2))
    weight = 6.0 * length_squared / double_area.sum(axis=1)
    return BendConstants(stencil, rest_angle, (height_share * double_area) ** 2, weight)


def linearize(positions: np.ndarray, constants: BendConstants, out: Linearization | None = None) -> Linearization:
    """Residuals (rad) and Jacobians at positions (V, 3) metres.

    Exact where both faces have more than ``height_share`` of their rest area. Below, the Jacobian is limited, and a collapsed
    edge or face has none. ``out``, a former result for the same constants, is overwritten and returned.
    """
    lin = allocate(constants.stencil, constants.weight) if out is None else out
    kernels.linearize(positions, constants.stencil, constants.rest_angle, constants.floor, lin.residual, lin.jacobian)
    return lin


class Hinges(NamedTuple):
    """Sum of bending over the hinges, for the fused update."""

    force: np.ndarray  # (V, 4) minus the gradient, padded
    blocks: np.ndarray  # (V, 3, 3) a block-diagonal bound of the Gauss-Newton matrix


def summed(positions: np.ndarray, constants: BendConstants, stiffness: float) -> Hinges:
    """Force and matrix at positions (V, 3) metres; :func:`linearize` is the reference."""
    n = len(positions)
    hinges = Hinges(np.zeros((n, 4)), np.zeros((n, 3, 3)))
    if stiffness > 0:
        stencil, rest_angle, least, weight = constants
        kernels.add_hinges(positions, stencil, rest_angle, least, weight, stiffness, hinges.blocks, hinges.force)
    return hinges


def _hinges(faces: np.ndarray) -> np.ndarray:
    """(C, 4) int32. Where two faces run along the edge in the same direction, the second is read turned over."""
    start, end, opposite = (np.concatenate([faces[:, (c + s) % 3] for c in range(3)]) for s in range(3))
    low, high = np.minimum(start, end), np.maximum(start, end)
    order = np.lexsort((start, high, low))
    first, second = order[:-1], order[1:]
    paired = (low[first] == low[second]) & (high[first] == high[second])
    first, second = first[paired], second[paired]
    return np.stack([start[first], end[first], opposite[first], opposite[second]], axis=1).astype(np.int32)
