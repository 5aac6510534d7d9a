"""Stretch and shear at once against the Jacobians of each."""

import numpy as np
import pytest

from ddakf.garment import model
from ddakf.kernels import fuse, strain
from ddakf.physics import gradient, shear, stretch
from ddakf.physics.energies import softened
from ddakf.physics.rigidity import padded
from tests.physics.shapes import ball, sheet

STRETCH, SHEAR, SCALE = 3e5, 1e5, 0.05
MESHES = {"sheet": sheet(), "ball": ball(1)}


def linearised(x, garment):
    soft = softened(stretch.linearize(x, garment.stretch), SCALE)
    sheared = shear.linearize(x, garment.shear)
    return [part._replace(weight=k * part.weight) for part, k in ((soft, STRETCH), (sheared, SHEAR))]


def dense(x, garment):
    """Gradient (V, 3) and sum of w J' J (V, 3, V, 3)."""
    n = len(x)
    A, g = np.zeros((n, 3, n, 3)), np.zeros((n, 3))
    for part in linearised(x, garment):
        gradient(part, n, g)
        for vertices, J, w in zip(part.stencil, part.jacobian, part.weight, strict=True):
            A[np.ix_(vertices, range(3), vertices, range(3))] += w * np.einsum("sa,tb->satb", J, J)
    return g, A


@pytest.mark.parametrize("flat", [False, True], ids=["random", "collapsed"])
@pytest.mark.parametrize("name", MESHES)
def test_force_and_blocks_are_those_of_the_jacobians(name, flat):
    garment, rng = model.build(MESHES[name]), np.random.default_rng(0)
    n = garment.mesh.n_vertices
    x = garment.mesh.vertices + rng.normal(scale=0.003, size=(n, 3))
    if flat:
        x[garment.mesh.faces[0]] = x[garment.mesh.faces[0, 0]]  # a face without an area has tangents without a direction
    force, blocks = np.zeros((n, 4)), np.zeros((len(garment.mesh.edges), 12), np.float32)
    strain.add_strain(padded(x), garment.strain, STRETCH, SHEAR, SCALE**2, blocks, force)
    D, B = np.zeros((n, 3, 3)), np.empty((len(garment.neighbour), 12), np.float32)
    rigid = rng.uniform(300.0, 1100.0, n)
    fuse.add_coupling(garment.start, garment.neighbour, garment.edge, blocks, rigid, np.zeros((n, 3, 3)), D, B)

    g, A = dense(x, garment)
    i, j = garment.mesh.edges.T
    for a in range(3):
        for row, column, sign in ((i, i, 1), (j, j, 1), (i, j, -1), (j, i, -1)):
            np.add.at(A, (row, a, column, a), 0.5 * (rigid[i] + rigid[j]) * sign)
    row = np.repeat(np.arange(n), np.diff(garment.start))
    scale = np.abs(A).max()
    np.testing.assert_allclose(force[:, :3], -g, rtol=0, atol=4e-6 * np.abs(g).max())
    by_columns = B.reshape(-1, 3, 4)[:, :, :3].transpose(0, 2, 1)
    np.testing.assert_allclose(by_columns, A[row, :, garment.neighbour], rtol=0, atol=4e-6 * scale)
    np.testing.assert_allclose(D, A[np.arange(n), :, np.arange(n)], rtol=0, atol=4e-6 * scale)
    assert not B[:, 3::4].any(), "the padding is zero"
