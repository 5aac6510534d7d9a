"""Stage E, stretch and shear of a triangle at once (paper, section 2.4), for the fused update.

The three constraints of a triangle depend on its corners through w_u and w_v alone, sums over the corners whose coefficients
add up to nothing. So the block of two corners is a sum of w_u w_u', w_v w_v', w_v w_u' and w_u w_v', and a diagonal block is
minus the sum of its row: neither Jacobians nor diagonal blocks are formed. ``stretch.py`` and ``shear.py`` are the reference.
"""

from __future__ import annotations

import numpy as np

from ddakf.kernels.strain import StrainConstants
from ddakf.mesh import Mesh
from ddakf.physics.rest import rest_frames


def build(mesh: Mesh) -> StrainConstants:
    """Constants of a garment."""
    frames = rest_frames(mesh, None)
    order = np.argsort(mesh.faces, axis=1)
    corner = np.take_along_axis(mesh.faces, order, axis=1).astype(np.int64)
    keys = mesh.edges[:, 0].astype(np.int64) * mesh.n_vertices + mesh.edges[:, 1]
    pairs = np.stack([corner[:, a] * mesh.n_vertices + corner[:, b] for a, b in ((0, 1), (0, 2), (1, 2))], axis=1)
    warp, weft = (np.take_along_axis(side, order, axis=1) for side in (frames.warp, frames.weft))
    return StrainConstants(corner.astype(np.uint32), np.searchsorted(keys, pairs).astype(np.uint32), warp, weft, frames.area)
