"""The visible vertices against a slow twin."""

import numpy as np
import pytest

from ddakf.kernels import visibility as kernels
from ddakf.kernels.visibility import DIRECTIONS, VisibilityLimits

LIMITS = VisibilityLimits(cell=0.03, depth_margin=0.02, min_cosine=0.2)


def seen_by(sensor, position, normal, body, cloud, limits):
    """Twin of ``mark_visible`` for one sensor (3,); ``cloud`` (S, 3) metres."""
    view = position.mean(axis=0) - sensor
    distance = np.linalg.norm(view)
    axes = np.empty((3, 3))
    axes[2] = view / distance
    kernels.perpendicular_axes(axes[2], axes)

    def placed(points):
        local = (points - sensor) @ axes.T
        spot = np.floor(local[:, :2] / local[:, 2:] * distance / limits.cell + DIRECTIONS / 2)
        known = (local[:, 2] >= 0.05) & (spot >= 0).all(axis=1) & (spot < DIRECTIONS).all(axis=1)
        return [tuple(s) if k else None for s, k in zip(spot, known, strict=True)], local[:, 2]

    def least(points):
        depths = {}
        for spot, depth in zip(*placed(points), strict=True):
            depths[spot] = min(depth, depths.get(spot, np.inf))
        return depths

    layers, shown, hiding = least(position), least(cloud), least(body)
    towards = sensor - position
    cosine = np.einsum("va,va->v", normal, towards) / np.linalg.norm(towards, axis=1)
    seen = np.zeros(len(position), bool)
    for v, (spot, depth) in enumerate(zip(*placed(position), strict=True)):
        nearest = layers[spot] if len(cloud) == 0 else max(layers[spot], shown.get(spot, np.inf))
        nearest = min(nearest, hiding.get(spot, np.inf))
        slope = np.sqrt(1.0 - cosine[v] ** 2) / max(cosine[v], 1e-3)
        free = spot is None or nearest >= depth - limits.depth_margin - 1.5 * limits.cell * slope
        seen[v] = cosine[v] > limits.min_cosine and free
    return seen


@pytest.mark.parametrize(
    ("n_body", "n_cloud", "sensors"),
    [
        (600, 500, [[0.1, 0.2, 2.0]]),
        (0, 0, [[0.1, 0.2, 2.0]]),
        (300, 300, [[0.1, 0.2, 2.0], [2.0, -0.3, 0.1]]),
        (300, 300, [[0.0, 0.0, 0.2]]),  # inside the garment: much is behind it, or beside the grid
        (300, 300, [[0.0, 0.0, 500.0]]),  # the garment lies in few cells
    ],
)
def test_visible_vertices_are_those_of_the_twin(n_body, n_cloud, sensors):
    rng = np.random.default_rng(n_body + n_cloud)
    position, body = rng.normal(0.0, 0.2, (700, 3)), rng.normal(0.0, 0.15, (n_body, 3))
    normal = rng.normal(size=(700, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    surfels, origin = rng.normal(0.5, 0.2, (6, n_cloud)).astype(np.float32), np.full(3, -0.5)
    visible = np.empty(700, bool)
    kernels.mark_visible(position, normal, body, surfels, origin, np.array(sensors), LIMITS, visible)
    cloud = surfels[:3].T.astype(float) + origin
    known = [seen_by(np.array(s), position, normal, body, cloud, LIMITS) for s in sensors]
    np.testing.assert_array_equal(visible, np.any(known, axis=0))
    assert visible.any()
    assert not visible.all()
