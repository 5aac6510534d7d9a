"""Stage E, sums over the constraints of one energy (paper, section 2.4)."""

from numba import njit


@njit(nogil=True, cache=True)
def add_gradient(stencil, residual, jacobian, weight, gradient):
    """gradient[i] += w r J_i for every vertex i of every constraint."""
    for c in range(stencil.shape[0]):
        force = weight[c] * residual[c]
        if force == 0.0:
            continue
        for s in range(stencil.shape[1]):
            i = stencil[c, s]
            for a in range(3):
                gradient[i, a] += force * jacobian[c, s, a]


@njit(nogil=True, cache=True)
def add_diagonal_blocks(stencil, jacobian, weight, blocks):
    """blocks[i] += w J_i J_i^T for every vertex i of every constraint."""
    for c in range(stencil.shape[0]):
        w = weight[c]
        if w == 0.0:
            continue
        for s in range(stencil.shape[1]):
            i = stencil[c, s]
            x, y, z = jacobian[c, s, 0], jacobian[c, s, 1], jacobian[c, s, 2]
            blocks[i, 0, 0] += w * x * x
            blocks[i, 1, 1] += w * y * y
            blocks[i, 2, 2] += w * z * z
            blocks[i, 0, 1] += w * x * y
            blocks[i, 1, 0] += w * x * y
            blocks[i, 0, 2] += w * x * z
            blocks[i, 2, 0] += w * x * z
            blocks[i, 1, 2] += w * y * z
            blocks[i, 2, 1] += w * y * z
