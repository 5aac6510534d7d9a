"""Matrices of rotation vectors."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ddakf.data.rotation import rotation_matrices


@pytest.mark.parametrize("angle", [0.0, 1e-9, 9e-4, 1.1e-3, 0.5, np.pi, 7.0])
def test_matrices_are_those_of_scipy(angle):
    axes = np.random.default_rng(0).normal(size=(5, 3))
    vectors = angle * axes / np.linalg.norm(axes, axis=1)[:, None]
    np.testing.assert_allclose(rotation_matrices(vectors), Rotation.from_rotvec(vectors).as_matrix(), atol=1e-14)
