"""Linear algebra of the baselines: graph Laplacian, factorisation, conjugate gradients, best rotations."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import SuperLU, splu

from ddakf.mesh import Mesh

Product = Callable[[np.ndarray], np.ndarray]


def graph_laplacian(garment: Mesh) -> sparse.csr_array:
    """(V, V) sum over the edges of |x_i - x_j|^2 as a matrix."""
    n, (first, second) = garment.n_vertices, garment.edges.T
    i, j = np.concatenate([first, second]), np.concatenate([second, first])
    adjacency = sparse.csr_array((np.ones(len(i)), (i, j)), (n, n))
    return sparse.csr_array(sparse.diags_array(adjacency.sum(axis=1)) - adjacency)


def factorised(matrix: sparse.sparray) -> SuperLU:
    """Factors of a symmetric positive definite matrix, ordered as a Cholesky factorisation would be."""
    return splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})


def conjugate_gradients(product: Product, right: np.ndarray, precondition: Product, steps: int, tolerance: float) -> np.ndarray:
    """Solves A u = b by preconditioned conjugate gradients from u = 0 (Hestenes and Stiefel 1952).

    Args:
        product: u -> A u, A symmetric and positive definite.
        right: b, of any shape.
        precondition: r -> M^-1 r.
        steps: at most.
        tolerance: it stops where r' M^-1 r has fallen to the square of this share of its first value.
    """
    u, r = np.zeros_like(right), right
    z = precondition(r)
    direction, now = z, np.vdot(r, z)
    end = tolerance**2 * now
    for _ in range(steps):
        if now <= end:
            break
        image = product(direction)
        length = now / np.vdot(direction, image)
        u = u + length * direction
        r = r - length * image
        z = precondition(r)
        before, now = now, np.vdot(r, z)
        direction = z + (now / before) * direction
    return u


def best_rotations(matrices: np.ndarray) -> np.ndarray:
    """(n, 3, 3) rotations R that maximise trace(R' M) for matrices M (n, 3, 3), by singular values (Kabsch 1976)."""
    u, _, vt = np.linalg.svd(matrices)
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    return u @ vt
