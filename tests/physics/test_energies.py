"""Properties that every cloth energy has."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf import physics
from ddakf.mesh import Mesh
from ddakf.physics import bend, shear, stretch
from tests.physics.shapes import energy, rotation, sheet

MESH = sheet()
ENERGIES = pytest.mark.parametrize("module", [stretch, shear, bend], ids=lambda module: module.__name__.split(".")[-1])
SEEDS = st.integers(0, 2**32 - 1)


def deformed(seed):
    """Every vertex moved by up to 4 mm, a fifth of an edge: bending is not held back, no dihedral angle wraps."""
    return MESH.vertices + np.random.default_rng(seed).uniform(-0.0023, 0.0023, size=MESH.vertices.shape)


@ENERGIES
@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_jacobian_is_the_derivative_of_the_residual(module, seed):
    constants = module.build(MESH)
    lin = module.linearize(deformed(seed), constants)
    step = 1e-7
    for slot in range(lin.stencil.shape[1]):
        for axis in range(3):
            ahead = _moved(module, constants, deformed(seed), slot, axis, step)
            behind = _moved(module, constants, deformed(seed), slot, axis, -step)
            numeric = (ahead - behind) / (2 * step)
            np.testing.assert_allclose(lin.jacobian[:, slot, axis], numeric, rtol=2e-5, atol=2e-4)


def _moved(module, constants, x, slot, axis, step):
    """Every constraint's residual with one of its own vertices moved."""
    residual = np.empty(len(constants.stencil))
    for vertex in range(len(x)):
        moved = x.copy()
        moved[vertex, axis] += step
        mine = constants.stencil[:, slot] == vertex
        residual[mine] = module.linearize(moved, constants).residual[mine]
    return residual


@ENERGIES
@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_gradient_is_the_derivative_of_the_energy(module, seed):
    constants, x, step = module.build(MESH), deformed(seed), 1e-7
    direction = np.random.default_rng(seed).normal(size=x.shape)
    ahead = energy(module.linearize(x + step * direction, constants))
    behind = energy(module.linearize(x - step * direction, constants))
    along = np.sum(physics.gradient(module.linearize(x, constants), len(x)) * direction)
    scale = np.linalg.norm(physics.gradient(module.linearize(x, constants), len(x))) * np.linalg.norm(direction)
    assert along == pytest.approx((ahead - behind) / (2 * step), abs=1e-5 * scale)


@ENERGIES
def test_sums_agree_with_dense_algebra(module):
    lin = module.linearize(deformed(1), module.build(MESH))
    v = MESH.n_vertices
    dense = np.zeros((len(lin.residual), v, 3))
    for c in range(len(lin.residual)):
        for s in range(lin.stencil.shape[1]):
            dense[c, lin.stencil[c, s]] += lin.jacobian[c, s]
    J = dense.reshape(len(dense), 3 * v)
    hessian = (J.T @ np.diag(lin.weight) @ J).reshape(v, 3, v, 3)
    np.testing.assert_allclose(physics.gradient(lin, v).ravel(), J.T @ (lin.weight * lin.residual), atol=1e-12)
    np.testing.assert_allclose(physics.diagonal_blocks(lin, v), hessian[np.arange(v), :, np.arange(v)], atol=1e-9)


@ENERGIES
@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_rest_shape_has_no_energy_wherever_it_is(module, seed):
    x = MESH.vertices @ rotation(seed).T + np.random.default_rng(seed).normal(size=3)
    lin = module.linearize(x, module.build(MESH))
    assert energy(lin) < 1e-20
    assert np.abs(physics.gradient(lin, len(x))).max() < 1e-8


@ENERGIES
@given(seed=SEEDS)
@settings(max_examples=20, deadline=None)
def test_rigid_motion_turns_the_gradient_and_keeps_the_energy(module, seed):
    constants, x, R = module.build(MESH), deformed(seed), rotation(seed)
    here = module.linearize(x, constants)
    there = module.linearize(x @ R.T + [1.0, -2.0, 0.5], constants)
    assert energy(there) == pytest.approx(energy(here), rel=1e-9)
    expected = physics.gradient(here, len(x)) @ R.T
    np.testing.assert_allclose(physics.gradient(there, len(x)), expected, atol=1e-9 * np.abs(expected).max())


@ENERGIES
def test_no_net_force_and_no_net_torque(module):
    x = deformed(2)
    force = physics.gradient(module.linearize(x, module.build(MESH)), len(x))
    scale = np.abs(force).max()
    assert np.abs(force.sum(axis=0)).max() < 1e-10 * scale
    assert np.abs(np.cross(x, force).sum(axis=0)).max() < 1e-10 * scale


@ENERGIES
def test_vertex_numbering_does_not_matter(module):
    order = np.random.default_rng(3).permutation(MESH.n_vertices)  # vertex i is called order[i]
    renamed = Mesh(MESH.vertices[np.argsort(order)], order[MESH.faces][::-1])
    x = deformed(3)
    here = module.linearize(x, module.build(MESH))
    there = module.linearize(x[np.argsort(order)], module.build(renamed))
    assert energy(there) == pytest.approx(energy(here), rel=1e-12)
    expected = physics.gradient(here, len(x))
    np.testing.assert_allclose(physics.gradient(there, len(x))[order], expected, atol=1e-9 * np.abs(expected).max())


@ENERGIES
def test_unit_of_the_weight(module):
    """Twice as large: membrane energies four times the weight (m^2), bending the same (dimensionless)."""
    ratio = module.build(Mesh(2.0 * MESH.vertices, MESH.faces)).weight / module.build(MESH).weight
    np.testing.assert_allclose(ratio, 1.0 if module is bend else 4.0)


@ENERGIES
@pytest.mark.parametrize("collapse", ["point", "line", "plane", "edge", "tiny", "far"])
def test_degenerate_positions_stay_finite(module, collapse):
    x = deformed(4)
    if collapse in ("point", "line", "plane"):
        x[:, {"point": 0, "line": 1, "plane": 2}[collapse] :] = 0.0
    elif collapse == "edge":
        x[MESH.faces[:, 1]] = x[MESH.faces[:, 0]]
    else:
        x *= 1e-9 if collapse == "tiny" else 1e6
    lin = module.linearize(x, module.build(MESH))
    assert all(np.isfinite(array).all() for array in lin)


@ENERGIES
def test_a_former_result_is_overwritten(module):
    constants = module.build(MESH)
    first = module.linearize(deformed(5), constants)
    again = module.linearize(deformed(6), constants, first)
    fresh = module.linearize(deformed(6), constants)
    assert again.residual is first.residual
    assert again.jacobian is first.jacobian
    np.testing.assert_array_equal(again.jacobian, fresh.jacobian)
    np.testing.assert_array_equal(again.residual, fresh.residual)


def test_sums_add_to_what_is_there():
    lin = stretch.linearize(deformed(7), stretch.build(MESH))
    v = MESH.n_vertices
    twice = physics.gradient(lin, v, physics.gradient(lin, v))
    np.testing.assert_allclose(twice, 2.0 * physics.gradient(lin, v))
    blocks = physics.diagonal_blocks(lin, v, physics.diagonal_blocks(lin, v))
    np.testing.assert_allclose(blocks, 2.0 * physics.diagonal_blocks(lin, v))
