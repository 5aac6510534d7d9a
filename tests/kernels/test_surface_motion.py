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


def test_vertices_turn_as_the_faces_around_them_do():
    """The sum of the faces' quaternions by area, also beside faces without an area; elsewhere the identity."""
    rng = np.random.default_rng(5)
    faces = np.stack([rng.permutation(40)[:3] for _ in range(45)]).astype(np.int32)
    faces[7, 1] = faces[7, 0]
    last, now = rng.normal(size=(2, 40, 3))
    now[faces[11]] = now[faces[11, 0]]
    rotation, needed, used = np.empty((40, 4)), np.empty(40, np.uint8), np.array([3, -1, 7, 11, 30], np.int32)
    surface_motion.vertex_rotations(last, now, faces, used, needed, rotation)
    expected = np.tile([surface_motion.FACE_AREA, 0.0, 0.0, 0.0], (40, 1))
    for face in faces:
        frames = [[x[face[1]] - x[face[0]], x[face[2]] - x[face[0]]] for x in (last, now)]
        area = [np.linalg.norm(np.cross(*edges)) for edges in frames]
        if min(area) < 1e-12:
            continue
        frames = [np.column_stack([*edges, np.cross(*edges) / a]) for edges, a in zip(frames, area, strict=True)]
        u, _, vt = np.linalg.svd(frames[1] @ np.linalg.inv(frames[0]))
        quaternion = min(area) * Rotation.from_matrix(u @ vt).as_quat(scalar_first=True)
        for v in face:
            expected[v] += quaternion if expected[v] @ quaternion >= 0.0 else -quaternion
    expected[np.setdiff1d(np.arange(40), faces[used[used >= 0]])] = [1.0, 0.0, 0.0, 0.0]
    expected /= np.linalg.norm(expected, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.sum(rotation * expected, axis=1)), 1.0, atol=1e-9)
