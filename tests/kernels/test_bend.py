"""The bending kernel against NumPy, and its Jacobian against finite differences of the slow angle."""

import numpy as np

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


def test_sums_over_the_hinges_are_those_of_the_jacobian():
    x, stencil, rest = hinges(4)
    least, weight = np.full((60, 2), 1e-6), np.random.default_rng(5).uniform(1, 2, 60)
    residual, jacobian = run(x, stencil, rest, least)
    force, blocks = np.zeros((30, 4)), np.zeros((30, 3, 3))
    bend.add_hinges(x, stencil, rest, least, weight, 0.7, blocks, force)
    k, expected_force, expected_blocks = 0.7 * weight[:, None, None], np.zeros((30, 3)), np.zeros((30, 3, 3))
    np.add.at(expected_force, stencil, -k * residual[:, None, None] * jacobian)
    np.add.at(expected_blocks, stencil, 4 * k[..., None] * jacobian[..., :, None] * jacobian[..., None, :])
    np.testing.assert_allclose(force[:, :3], expected_force, rtol=0, atol=1e-9 * np.abs(expected_force).max())
    np.testing.assert_allclose(blocks, expected_blocks, rtol=0, atol=1e-9 * np.abs(expected_blocks).max())
