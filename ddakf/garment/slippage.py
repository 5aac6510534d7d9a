"""Slippage: whether a surface can move along itself, which a cloud of it does not show."""

from __future__ import annotations

import numpy as np

from ddakf.kernels import slippage as kernels

TINY = 1e-9  # of the mean squared distance from the middle, so that a line, which nothing turns about itself, has a result


def least_normal_share(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Share, in [0, 1], of the squared motion of a surface that is along its normals, in the rigid motion where that is least.

    0 is a surface of revolution, which can turn unnoticed; 1/3 is a surface that faces all directions alike and has no axis.
    Skirts and trousers have 0.02 to 0.05, sleeved shirts 0.08 to 0.15. From the slippage analysis of Gelfand and Guibas ("Shape
    segmentation using local slippage analysis", 2004), its eigenvalues relative to the motions instead of absolute.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3).
    """
    along, moved = np.empty((6, 6)), np.empty((6, 6))
    if kernels.rigid_motions(vertices, np.ascontiguousarray(faces), along, moved) == 0.0:
        return 0.0
    return min(max(kernels.smallest_share(along, moved, TINY), 0.0), 1.0)
