"""Stage E, shear (paper, section 2.4): warp and weft stay at right angles.

Per triangle one constraint, r = w_u . w_v (Baraff and Witkin 1998, section 4.3), not divided by the lengths: a
polynomial, hence smooth and finite on a collapsed triangle, and close to the sine of the shear angle at the strains of
clothing. Weight: half the rest area, A / 2. Then stretch and shear with one stiffness k are, to first order,
k A / 2 times the squared Frobenius norm of the strain, which no choice of thread direction changes; k is in
J/m^2 = N/m.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.kernels import shear as kernels
from ddakf.mesh import Mesh
from ddakf.physics import Linearization, allocate
from ddakf.physics.rest import rest_frames


class ShearConstants(NamedTuple):
    """One constraint per face; C = F."""

    stencil: np.ndarray  # (C, 3) int32
    warp: np.ndarray  # (C, 3) 1/m: w_u = sum_a warp[a] p_a
    weft: np.ndarray  # (C, 3) 1/m: w_v = sum_a weft[a] p_a
    weight: np.ndarray  # (C,) m^2


def build(mesh: Mesh, warp=None) -> ShearConstants:
    """Constants of a garment; ``warp`` as in :func:`ddakf.physics.rest.rest_frames`."""
    frames = rest_frames(mesh, warp)
    stencil = np.ascontiguousarray(mesh.faces, np.int32)
    return ShearConstants(stencil, frames.warp, frames.weft, 0.5 * frames.area)


def linearize(positions: np.ndarray, constants: ShearConstants, out: Linearization | None = None) -> Linearization:
    """Residuals (about the sine of the shear angle, dimensionless) and Jacobians at positions (V, 3) metres.

    ``out``, a former result for the same constants, is overwritten and returned.
    """
    lin = allocate(constants.stencil, constants.weight) if out is None else out
    kernels.linearize(positions, constants.stencil, constants.warp, constants.weft, lin.residual, lin.jacobian)
    return lin
