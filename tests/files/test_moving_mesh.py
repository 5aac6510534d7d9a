"""Coded motion is restored exactly, whatever moves; what moves together leaves nothing."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from ddakf.files import moving_mesh

FACES = np.array([[0, 1, 2], [2, 1, 3], [4, 5, 6]])  # two parts, and vertex 7 in no face


@settings(max_examples=50, deadline=None)
@given(st.integers(1, 6), st.integers(0, 2**32 - 1), st.sampled_from([3, 100, 4000]))
def test_any_motion_is_restored_exactly(n_frames, seed, largest):
    steps = np.random.default_rng(seed).integers(-largest, largest + 1, (n_frames, 8, 3))
    residuals = moving_mesh.encode(steps, FACES)
    assert residuals.shape == (n_frames - 1, 3, 8)
    assert np.array_equal(moving_mesh.decode(steps[0].astype(np.int32), residuals, FACES), steps)


def test_only_one_vertex_of_a_part_that_moves_as_one_leaves_a_residual():
    shift = np.array([[0, 0, 0], [5, -7, 300], [9, 2, -40]])
    steps = np.arange(24).reshape(8, 3) + shift[:, None]
    residuals = moving_mesh.encode(steps, FACES)
    assert residuals.any(axis=(0, 1)).tolist() == [True, False, False, False, True, False, False, True]


def test_small_residuals_take_a_byte_and_large_ones_two():
    steps = np.zeros((2, 8, 3), np.int64)
    steps[1] = 127
    assert moving_mesh.encode(steps, FACES).dtype == np.int8
    steps[1] = 128
    assert moving_mesh.encode(steps, FACES).dtype == np.int16
    steps[1] = 2**15
    with pytest.raises(OverflowError, match="32768"):
        moving_mesh.encode(steps, FACES)
