"""Depth images: what is believed, and where it is."""

import numpy as np
import pytest

from ddakf.files import depth as depths
from ddakf.files.depth import Intrinsics, largest_step, seen, unproject, without_fliers

LENS = Intrinsics(200.0, 200.0, 31.5, 23.5)


def plane(normal, distance: float) -> np.ndarray:
    """(48, 64) depth of the plane n . x = distance."""
    v, u = np.mgrid[0:48, 0:64]
    rays = np.stack([(u - LENS.cx) / LENS.fx, (v - LENS.cy) / LENS.fy, np.ones(u.shape)], axis=-1)
    return distance / (rays @ np.asarray(normal))


def test_fliers_are_the_far_side_of_a_jump_and_nothing_else():
    depth = np.full((5, 6), 2.0)
    depth[:, 3:] = 2.5
    depth[0, 0] = 0
    keep = without_fliers(depth, 0.03)
    assert np.array_equal(keep[:, 1], np.ones(5))
    assert not keep[:, 3].any()
    assert keep[:, 4:].all()
    assert not keep[0, 0]


@pytest.mark.parametrize("tilt", [0.0, 45.0, 60.0, 75.0])
def test_a_slope_is_no_edge_and_a_step_twice_as_steep_as_any_slope_is(tilt):
    angle = np.deg2rad(tilt)
    slope = plane([np.sin(angle), 0.0, np.cos(angle)], 1.5 * np.cos(angle))
    assert without_fliers(slope, largest_step(slope, 200.0)).all()
    step = plane([0.0, 0.0, 1.0], 1.5)
    step[:, 32:] += 2 * largest_step(step, 200.0)[0, 0]
    keep = without_fliers(step, largest_step(step, 200.0))
    assert keep[:, :32].all()
    assert not keep[:, 32].any()
    assert keep[:, 33:].all()


def test_noise_makes_no_edges():
    noisy = plane([0.0, 0.0, 1.0], 2.0)
    sd = depths.NOISE_NEAR + depths.NOISE_FAR * (2.0 - depths.NOISE_LEAST_AT) ** 2
    noisy += np.random.default_rng(0).normal(0, sd, noisy.shape)
    assert without_fliers(noisy, largest_step(noisy, 200.0)).mean() > 0.999


def test_pixels_between_two_surfaces_are_left_out():
    scene = plane([0.0, 0.0, 1.0], 1.5)
    scene[:, 32:] = 3.0
    mixed = scene.copy()
    mixed[:, 32] = np.linspace(1.7, 2.9, 48)
    keep = without_fliers(mixed, largest_step(mixed, 200.0))
    assert not keep[:, 32].any()
    assert keep[:, :32].all()


def test_points_are_where_the_pose_says():
    turn = np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    pose = np.column_stack([turn, [1.0, 2.0, 3.0]])
    image = np.zeros((48, 64), np.float32)
    image[10, 20] = 2.0
    (point,) = unproject(image, seen(image), LENS, pose)
    inside = np.array([(20 - 31.5) / 200 * 2, (10 - 23.5) / 200 * 2, 2.0])
    assert np.allclose(point, turn @ inside + [1, 2, 3])


def test_what_is_no_measurement():
    image = np.array([[0.0, -1.0, np.nan, np.inf, 1.0]], np.float32)
    assert seen(image).tolist() == [[False, False, False, False, True]]
    assert without_fliers(image, 0.1).tolist() == seen(image).tolist()
