"""Interpolation between poses: the ends are met, rigid parts stay rigid, limbs turn as one through any angle."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ddakf.errors import InvalidArgument
from ddakf.evaluation.datasets.pose_interpolation import Interpolation, minimum_jerk
from ddakf.mesh import Mesh


def tube(rings=24, around=8, length=1.2, radius=0.05):
    """An open tube along x."""
    angle = np.arange(around) * 2 * np.pi / around
    x = np.repeat(np.linspace(0, length, rings), around)
    vertices = np.column_stack([x, radius * np.tile(np.cos(angle), rings), radius * np.tile(np.sin(angle), rings)])
    ring, k = np.divmod(np.arange((rings - 1) * around), around)
    a, b = ring * around + k, ring * around + (k + 1) % around
    return Mesh(vertices, np.concatenate([np.column_stack([a, b, a + around]), np.column_stack([b, b + around, a + around])]))


def rolled_up(mesh, angle):
    """The tube bent into an arc of so many radians, its axis as long as before."""
    length = mesh.vertices[:, 0].max()
    turn = Rotation.from_rotvec(mesh.vertices[:, :1] / length * [[0, 0, angle]])
    radius, phi = length / angle, mesh.vertices[:, 0] / length * angle
    axis = np.column_stack([radius * np.sin(phi), radius * (1 - np.cos(phi)), 0 * phi])
    return axis + turn.apply(mesh.vertices * [0, 1, 1])


def lengths(mesh, vertices):
    return np.linalg.norm(np.diff(vertices[mesh.edges], axis=1)[:, 0], axis=1)


TUBE = tube()


def test_the_ends_are_the_poses():
    last = rolled_up(TUBE, 2.0) + [0.3, -0.2, 0.5]
    way = Interpolation(TUBE, last)
    assert way(0.0) == pytest.approx(TUBE.vertices, abs=1e-9)
    assert way(1.0) == pytest.approx(last, abs=1e-9)


@pytest.mark.parametrize("degrees", [10, 90, 170])
def test_a_rigid_motion_is_done_in_equal_steps(degrees):
    axis, move = np.array([0.6, 0.0, 0.8]), np.array([0.1, 0.2, 0.3])
    centre = TUBE.vertices.mean(axis=0)

    def pose(share):
        turn = Rotation.from_rotvec(np.deg2rad(share * degrees) * axis)
        return turn.apply(TUBE.vertices - centre) + centre + share * move

    way = Interpolation(TUBE, pose(1.0))
    for share in (0.25, 0.5, 0.75):
        assert way(share) == pytest.approx(pose(share), abs=1e-9)


def test_a_limb_that_turns_by_more_than_half_a_turn_turns_as_one():
    angle = np.deg2rad(300)
    last = rolled_up(TUBE, angle)
    way = Interpolation(TUBE, last)
    assert np.rad2deg(np.ptp(way.turn[:, 2])) == pytest.approx(300, rel=0.06)  # a face has a ring's share of the arc
    expected = 0.5 * (lengths(TUBE, TUBE.vertices) + lengths(TUBE, last))
    assert lengths(TUBE, way(0.5)) == pytest.approx(expected, rel=0.03)
    linear = 0.5 * (TUBE.vertices + last)
    assert (lengths(TUBE, linear) / expected).min() < 0.5
    halfway = rolled_up(TUBE, angle / 2)
    shape = way(0.5)
    turn, _ = Rotation.align_vectors(halfway - halfway.mean(axis=0), shape - shape.mean(axis=0))
    assert turn.apply(shape - shape.mean(axis=0)) == pytest.approx(halfway - halfway.mean(axis=0), abs=0.005)


def test_a_stretch_grows_linearly():
    way = Interpolation(TUBE, TUBE.vertices * [2.0, 1.0, 1.0])
    assert np.ptp(way(0.5)[:, 0]) == pytest.approx(1.5 * np.ptp(TUBE.vertices[:, 0]))


def test_the_way_moves_with_the_poses():
    turn, move = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix(), np.array([1.0, 2.0, 3.0])
    last = rolled_up(TUBE, 2.5)
    moved = Interpolation(Mesh(TUBE.vertices @ turn.T + move, TUBE.faces), last @ turn.T + move)
    assert moved(0.4) == pytest.approx(Interpolation(TUBE, last)(0.4) @ turn.T + move, abs=1e-6)


def test_parts_that_do_not_hang_together_each_go_their_way():
    n = TUBE.n_vertices
    two = Mesh(np.concatenate([TUBE.vertices, TUBE.vertices + [0, 1, 0]]), np.concatenate([TUBE.faces, TUBE.faces + n]))
    last = np.concatenate([rolled_up(TUBE, 2.0), TUBE.vertices + [0, 3, 0]])
    way = Interpolation(two, last)
    assert way(0.5)[:n] == pytest.approx(Interpolation(TUBE, last[:n])(0.5), abs=1e-9)
    assert way(0.5)[n:] == pytest.approx(TUBE.vertices + [0, 2, 0], abs=1e-9)


def test_a_reach_starts_and_ends_at_rest():
    time = np.linspace(0, 1, 1001)
    reach = np.array([minimum_jerk(t) for t in time])
    speed = np.gradient(reach, time)
    assert (reach[0], reach[-1]) == (0.0, 1.0)
    assert (np.diff(reach) > 0).all()
    assert speed[[0, -1]] == pytest.approx(0, abs=1e-4)
    assert speed.max() == pytest.approx(1.875, rel=1e-4)


def test_poses_of_different_meshes_are_refused():
    with pytest.raises(InvalidArgument, match="last"):
        Interpolation(TUBE, TUBE.vertices[:-1])
