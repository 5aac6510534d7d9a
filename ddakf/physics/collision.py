"""Stage E, body collision (paper, section 2.4): garment vertices stay a gap outside the body.

Per vertex one constraint, r = min(0, n . (p - q) - gap) in metres, with q and n the closest point and outward
normal of the body (``proximity.py``), held while the solver iterates. The gap is the fabric's thickness, or less where
the garment is known to lie deeper (``contact.py``). Weight: the vertex's share of the rest area, m^2, so that k is in
J/m^4 = Pa/m, contact pressure per depth. A vertex that does not touch, or has no body within reach, has weight 0.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.body.proximity import Contact
from ddakf.errors import InvalidConfig
from ddakf.kernels import collision as kernels
from ddakf.mesh import Mesh
from ddakf.physics import Linearization


class CollisionConstants(NamedTuple):
    """One constraint per vertex; C = V."""

    stencil: np.ndarray  # (C, 1) int32
    weight: np.ndarray  # (C,) m^2, of a touching vertex
    thickness: float  # m


def build(mesh: Mesh, thickness: float = 0.002) -> CollisionConstants:
    """Constants of a garment.

    Args:
        mesh: the garment, at rest.
        thickness: distance that the fabric's middle keeps from the skin, metres.

    Raises:
        InvalidConfig: thickness negative or not finite.
    """
    if not 0.0 <= thickness < np.inf:
        raise InvalidConfig("thickness", "metres, at least 0", str(thickness))
    corners = mesh.vertices[mesh.faces]
    area = 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    share = np.bincount(mesh.faces.ravel(), np.repeat(area / 3.0, 3), mesh.n_vertices)
    stencil = np.arange(mesh.n_vertices, dtype=np.int32)[:, None]
    return CollisionConstants(stencil, share, float(thickness))


def linearize(
    positions: np.ndarray,
    constants: CollisionConstants,
    contact: Contact,
    gap: np.ndarray | None = None,
    yielding: np.ndarray | None = None,
) -> Linearization:
    """Residuals (penetration, metres, at most 0) and Jacobians at positions (V, 3) metres.

    Args:
        positions: (V, 3) metres.
        constants: of the garment.
        contact: for every vertex, the body's closest point.
        gap: (V,) metres, negative inside; the thickness if None.
        yielding: (V,) 1/m^2, k times the variance of the body's surface along its normal; 0 if None. A weight w becomes
            w / (1 + yielding w), as if a spring that holds the surface to within its variance were in series.
    """
    if gap is None:
        gap = np.full(len(constants.stencil), constants.thickness)
    count = len(constants.stencil)
    if yielding is None:
        yielding = np.zeros(count)
    out = Linearization(constants.stencil, np.zeros(count), np.zeros((count, 1, 3)), np.zeros(count))
    kernels.linearize(positions, contact, gap, constants.weight, yielding, out.residual, out.jacobian, out.weight)
    return out
