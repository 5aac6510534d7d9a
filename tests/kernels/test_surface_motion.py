"""Rotations of the body's surface against linear algebra."""

import numpy as np
from scipy.spatial.transform import Rotation

from ddakf.kernels import surface_motion


def test_quaternion_of_every_kind_of_rotation():
    """Random ones, and turns by 180 degrees, where the trace is at its least."""
    turns = [*Rotation.random(50, random_state=0), *(Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3))]
    frame = Rotation.random(random_state=1).as_matrix()
    for turn in turns:
        moved = turn.as_matrix() @ frame
        w, x, y, z = surface_motion.quaternion(*(tuple(column) for column in [*frame.T, *moved.T]))
        assert abs(np.dot(turn.as_quat(scalar_first=True), (w, x, y, z))) > 1.0 - 1e-12


def test_rotation_of_a_face_is_the_polar_factor():
    """One face, deformed at random: the orthogonal factor of its deformation, normal to normal."""
    rng = np.random.default_rng(4)
    faces = np.array([[0, 1, 2]], np.int32)
    for _ in range(20):
        last, now = rng.normal(size=(2, 3, 3))
        edges = [np.stack([x[1] - x[0], x[2] - x[0]], axis=1) for x in (last, now)]
        normals = [np.cross(*e.T) / np.linalg.norm(np.cross(*e.T)) for e in edges]
        deformation = np.column_stack([edges[1], normals[1]]) @ np.linalg.inv(np.column_stack([edges[0], normals[0]]))
        u, _, vt = np.linalg.svd(deformation)
        rotation, needed = np.empty((3, 4)), np.empty(3, np.uint8)
        surface_motion.vertex_rotations(last, now, faces, np.array([0], np.int32), needed, rotation)
        for quaternion in rotation:
            np.testing.assert_allclose(Rotation.from_quat(quaternion, scalar_first=True).as_matrix(), u @ vt, atol=1e-9)
