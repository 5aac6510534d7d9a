"""Stage E, stretch and shear of a triangle at once (paper, section 2.4), for the fused update.

The three constraints of a triangle depend on its corners through w_u and w_v alone, sums over the corners whose coefficients
add up to nothing. So the block of two corners is a sum of w_u w_u', w_v w_v', w_v w_u' and w_u w_v', and a diagonal block is
minus the sum of its row: neither Jacobians nor diagonal blocks are formed. ``stretch.py`` and ``shear.py`` are the reference.
"""

from __future__ import annotations

import numpy as np

from ddakf.kernels.strain import StrainConstants
from ddakf.mesh import Mesh
from ddakf.physics.rest import frames_of, rest_frames

SMALLEST = 1e-3  # squared length at rest, over that of the template: a face that has collapsed at the start has none


def build(mesh: Mesh) -> StrainConstants:
    """Constants of a garment."""
    frames = rest_frames(mesh, None)
    order = np.argsort(mesh.faces, axis=1)
    corner = np.take_along_axis(mesh.faces, order, axis=1).astype(np.int64)
    keys = mesh.edges[:, 0].astype(np.int64) * mesh.n_vertices + mesh.edges[:, 1]
    pairs = np.stack([corner[:, a] * mesh.n_vertices + corner[:, b] for a, b in ((0, 1), (0, 2), (1, 2))], axis=1)
    warp, weft = (np.take_along_axis(side, order, axis=1) for side in (frames.warp, frames.weft))
    return StrainConstants(corner.astype(np.uint32), np.searchsorted(keys, pairs).astype(np.uint32), warp, weft, frames.area)


def of_shape(constants: StrainConstants, vertices: np.ndarray) -> StrainConstants:
    """The constants of a garment whose shape at rest has its (V, 3) vertices there, metres."""
    frames = frames_of(vertices[constants.corner])
    return constants._replace(warp=frames.warp, weft=frames.weft, area=frames.area)


def metric_at_start(constants: StrainConstants, position: np.ndarray, kept: float, strain_sd: float) -> np.ndarray:
    """(F, 2, 2) B^-1/2, with B the metric at rest of each face of a garment that starts at (V, 3) ``position``, metres.

    Worn cloth is strained. If all of that strain drew, vertices would slide along the surface in the first frame, and no cloud
    shows it. With D = [w_u w_v] of a face at the start and C = D'D, B = I + s (C - I), for which the tangents are D B^-1/2. The
    share s is ``kept``, and half of that for a face strained by ``strain_sd``.
    """
    corner = position[constants.corner]
    sides = np.stack([corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]], axis=2)
    deformation = sides @ _of_sides(constants)
    excess = deformation.transpose(0, 2, 1) @ deformation - np.eye(2)
    strain2 = 0.25 * np.square(excess).sum(axis=(1, 2))
    share = kept / (1.0 + strain2 / strain_sd**2)
    return _inverse_root(np.eye(2) + share[:, None, None] * excess)


def with_metric(constants: StrainConstants, root: np.ndarray) -> StrainConstants:
    """The constants with another metric at rest, (F, 2, 2) of :func:`metric_at_start`."""
    warp, weft = np.moveaxis(_of_sides(constants) @ root, 2, 0)
    return constants._replace(warp=_from_first(warp), weft=_from_first(weft))


def _of_sides(constants: StrainConstants) -> np.ndarray:
    """(F, 2, 2) coefficients of the sides from the first corner, for w_u and w_v."""
    return np.stack([constants.warp[:, 1:], constants.weft[:, 1:]], axis=2)


def _inverse_root(metric: np.ndarray) -> np.ndarray:
    """M^-1/2 of symmetric (F, 2, 2), their eigenvalues at least :data:`SMALLEST`.

    A function f of a 2 x 2 matrix with the eigenvalues h >= l is f(h) I + (M - h I) (f(h) - f(l)) / (h - l).
    """
    half, difference = 0.5 * (metric[:, 0, 0] + metric[:, 1, 1]), 0.5 * (metric[:, 0, 0] - metric[:, 1, 1])
    radius = np.hypot(difference, metric[:, 0, 1])
    high, low = (np.sqrt(np.maximum(value, SMALLEST)) for value in (half + radius, half - radius))
    slope = np.where(half - radius > SMALLEST, -1.0 / (high * low * (high + low)), 0.0)
    collapsed = (half + radius > SMALLEST) & (half - radius <= SMALLEST)
    slope[collapsed] = (1.0 / high[collapsed] - 1.0 / low[collapsed]) / (2.0 * radius[collapsed])
    return (1.0 / high)[:, None, None] * np.eye(2) + slope[:, None, None] * (metric - (half + radius)[:, None, None] * np.eye(2))


def _from_first(coefficient: np.ndarray) -> np.ndarray:
    """(F, 3) coefficients of the corners, of (F, 2) of the sides from the first one."""
    return np.column_stack([-coefficient.sum(axis=1), coefficient])
