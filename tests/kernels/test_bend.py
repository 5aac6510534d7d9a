"""The bending kernel against NumPy, and its Jacobian against finite differences of the slow angle."""

import numpy as np
import pytest

from ddakf.kernels import bend


def slow_angle(x0, x1, x2, x3):
    n1, n2 = np.cross(x1 - x0, x2 - x0), np.cross(x3 - x0, x1 - x0)
    edge = (x1 - x0) / np.linalg.norm(x1 - x0, axis=-1, keepdims=True)
    return np.arctan2(np.sum(np.cross(n1, n2) * edge, axis=-1), np.sum(n1 * n2, axis=-1))


def run(x, stencil, rest, least):
    residual, jacobian = np.full(len(stencil), np.nan), np.full((len(stencil), 4, 3), np.nan)
    bend.linearize(x, stencil, rest, least, residual, jacobian)
    return residual, jacobian


def hinges(seed=0, count=60):
    rng = np.random.default_rng(seed)
    stencil = np.stack([rng.permutation(30)[:4] for _ in range(count)]).astype(np.int32)
    return rng.normal(size=(30, 3)), stencil, rng.uniform(-np.pi, np.pi, count)


def test_residual_is_the_wrapped_difference_of_the_angles():
    x, stencil, rest = hinges()
    residual, _ = run(x, stencil, rest, np.zeros((60, 2)))
    difference = slow_angle(*(x[stencil[:, s]] for s in range(4))) - rest
    np.testing.assert_allclose(residual, np.angle(np.exp(1j * difference)), atol=1e-12)


def test_jacobian_is_the_derivative_of_the_angle():
    x, stencil, rest = hinges(1)
    _, jacobian = run(x, stencil, rest, np.zeros((60, 2)))
    corners, step = x[stencil], 1e-6
    for s in range(4):
        for a in range(3):
            ahead, behind = corners.copy(), corners.copy()
            ahead[:, s, a] += step
            behind[:, s, a] -= step
            change = slow_angle(*ahead.transpose(1, 0, 2)) - slow_angle(*behind.transpose(1, 0, 2))
            numeric = np.angle(np.exp(1j * change)) / (2 * step)
            np.testing.assert_allclose(jacobian[:, s, a], numeric, rtol=1e-5, atol=1e-5)


def test_a_face_below_the_least_area_keeps_the_direction_of_its_gradient():
    x, stencil, rest = hinges(2)
    _, free = run(x, stencil, rest, np.zeros((60, 2)))
    _, held = run(x, stencil, rest, np.full((60, 2), 1e6))
    for s in (2, 3):
        cosine = np.sum(free[:, s] * held[:, s], axis=1)
        np.testing.assert_allclose(
            cosine, np.linalg.norm(free[:, s], axis=1) * np.linalg.norm(held[:, s], axis=1), rtol=1e-9
        )
    assert np.abs(held).max() < 1e-3


def test_coinciding_vertices_stay_finite():
    x, stencil, rest = hinges(3)
    x[:10] = x[0]
    residual, jacobian = run(x, stencil, rest, np.full((60, 2), 1e-6))
    assert np.isfinite(residual).all()
    assert np.isfinite(jacobian).all()


@pytest.mark.parametrize("count", [1, 60, bend.LANES, bend.LANES + 1])
def test_sums_over_the_hinges_are_those_of_the_jacobian(count):
    x, stencil, rest = hinges(4, count)
    expected_force, expected_blocks = slow_sums(x, stencil, rest)
    force, blocks = sums(x, stencil, rest)
    np.testing.assert_allclose(force, expected_force, rtol=0, atol=1e-6 * np.abs(expected_force).max())
    np.testing.assert_allclose(blocks, expected_blocks, rtol=0, atol=1e-6 * np.abs(expected_blocks).max())


def test_sums_far_from_the_origin_lose_no_digits():
    x, stencil, rest = hinges(6)
    expected = sums(x, stencil, rest)
    for found, known in zip(sums(x + 1e4, stencil, rest), expected, strict=True):
        np.testing.assert_allclose(found, known, rtol=0, atol=1e-5 * np.abs(known).max())


def test_sums_of_folded_and_of_flat_hinges_are_those_of_the_jacobian():
    """Angles in every octant, among them 0, a right angle and a full fold."""
    angle = np.linspace(-np.pi, np.pi, 33)[1:]
    corner = np.stack([np.zeros(32), np.cos(angle), np.sin(angle)], axis=1)
    x = np.concatenate([[[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0]], corner])
    stencil = np.array([[0, 1, 2, 3 + k] for k in range(32)], np.int32)
    for found, known in zip(sums(x, stencil, np.zeros(32)), slow_sums(x, stencil, np.zeros(32)), strict=True):
        np.testing.assert_allclose(found, known, rtol=0, atol=1e-6 * np.abs(known).max())


def test_sums_of_coinciding_vertices_stay_finite():
    x, stencil, rest = hinges(3)
    x[:10] = x[0]
    assert all(np.isfinite(found).all() for found in sums(x, stencil, rest))


LEAST, STIFFNESS = 1e-6, 0.7


def weights(count):
    return np.random.default_rng(5).uniform(1, 2, count)


def sums(x, stencil, rest):
    force, blocks, count = np.zeros((len(x), 4)), np.zeros((len(x), 3, 3)), len(stencil)
    bend.add_hinges(x, stencil, rest, np.full((count, 2), LEAST), weights(count), STIFFNESS, blocks, force)
    return force[:, :3], blocks


def slow_sums(x, stencil, rest):
    residual, jacobian = run(x, stencil, rest, np.full((len(stencil), 2), LEAST))
    k, force, blocks = STIFFNESS * weights(len(stencil))[:, None, None], np.zeros(x.shape), np.zeros((len(x), 3, 3))
    np.add.at(force, stencil, -k * residual[:, None, None] * jacobian)
    np.add.at(blocks, stencil, 4 * k[..., None] * jacobian[..., :, None] * jacobian[..., None, :])
    return force, blocks
