"""Stage E, stretch (paper, section 2.4): warp and weft threads keep their length.

Per triangle two constraints, r_u = |w_u| - 1 and r_v = |w_v| - 1 (Baraff and Witkin 1998, equation 10), on the tangents
of ``rest.py``. Weight: the rest area A of the triangle, so that k is in J/m^2 = N/m, the resistance of a strip per
width, and does not depend on the triangulation. A triangle measures strain in two directions with the area as its
weight, which springs along edges only do on regular meshes.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.kernels import stretch as kernels
from ddakf.mesh import Mesh
from ddakf.physics import Linearization, allocate
from ddakf.physics.rest import rest_frames


class StretchConstants(NamedTuple):
    """Two constraints per face: all warp ones first, then all weft ones; C = 2 F."""

    stencil: np.ndarray  # (C, 3) int32
    coefficient: np.ndarray  # (C, 3) 1/m: w = sum_a coefficient[a] p_a
    weight: np.ndarray  # (C,) m^2


def build(mesh: Mesh, warp=None) -> StretchConstants:
    """Constants of a garment; ``warp`` as in :func:`ddakf.physics.rest.rest_frames`."""
    frames = rest_frames(mesh, warp)
    stencil = np.ascontiguousarray(np.tile(mesh.faces, (2, 1)), np.int32)
    return StretchConstants(stencil, np.concatenate([frames.warp, frames.weft]), np.tile(frames.area, 2))


def linearize(
    positions: np.ndarray, constants: StretchConstants, out: Linearization | None = None
) -> Linearization:
    """Residuals (strain, dimensionless) and Jacobians at positions (V, 3) metres.

    ``out``, a former result for the same constants, is overwritten and returned.
    """
    lin = allocate(constants.stencil, constants.weight) if out is None else out
    kernels.linearize(positions, constants.stencil, constants.coefficient, lin.residual, lin.jacobian)
    return lin
