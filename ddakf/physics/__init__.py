"""Stage E, cloth energies (paper, section 2.4), in residual form.

Every energy is ``E(x) = 1/2 sum_c w_c r_c(x)^2`` over scalar constraints c, each on a fixed stencil of S vertices. A
fabric's stiffness k multiplies it from outside. As pseudo-measurements the constraints read z = 0, h = r_c, variance
1 / (lambda k w_c).

Each module has ``build(mesh, ...) -> constants`` and ``linearize(positions, constants, ...) -> Linearization``.

The compiled sums are imported when they are called: a program that reads the names of the fabrics needs no numba.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.physics.fabric import Fabric

__all__ = ["Fabric", "Linearization", "allocate", "diagonal_blocks", "gradient"]


class Linearization(NamedTuple):
    """C constraints on stencils of S vertices, linearised at one position of the garment."""

    stencil: np.ndarray  # (C, S) int32, vertex indices
    residual: np.ndarray  # (C,) r, unit of the energy's residual
    jacobian: np.ndarray  # (C, S, 3) dr/dp, residual's unit per metre
    weight: np.ndarray  # (C,) w, so that k w r^2 / 2 is an energy, of stiffness k


def allocate(stencil: np.ndarray, weight: np.ndarray) -> Linearization:
    """A Linearization to be written into; the constant arrays are shared, not copied."""
    count, size = stencil.shape
    return Linearization(stencil, np.zeros(count), np.zeros((count, size, 3)), weight)


def gradient(linearization: Linearization, n_vertices: int, out: np.ndarray | None = None) -> np.ndarray:
    """(V, 3) dE/dp = sum w r J^T, exact, for unit stiffness: the paper's h_phys.

    ``out`` (V, 3), where given, is added to, so that energies sum up without temporaries.
    """
    from ddakf.kernels import assembly

    total = np.zeros((n_vertices, 3)) if out is None else out
    assembly.add_gradient(*linearization, total)
    return total


def diagonal_blocks(linearization: Linearization, n_vertices: int, out: np.ndarray | None = None) -> np.ndarray:
    """(V, 3, 3) sum w J J^T per vertex: the diagonal blocks of the Gauss-Newton approximation of H_phys.

    ``out`` (V, 3, 3), where given, is added to.
    """
    from ddakf.kernels import assembly

    total = np.zeros((n_vertices, 3, 3)) if out is None else out
    stencil, _, jacobian, weight = linearization
    assembly.add_diagonal_blocks(stencil, jacobian, weight, total)
    return total
