"""The body that ships: a closed surface, skinned; at rest it is itself, a turned root turns it rigidly."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from ddakf.data.body import load_body
from ddakf.errors import InvalidArgument

STILL = np.zeros((1, 3))


@pytest.fixture(scope="module")
def body():
    return load_body()


def edge_counts(faces):
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    return np.unique(edges, axis=0, return_counts=True)[1]


def test_the_skin_is_closed_and_faces_outward(body):
    a, b, c = body.vertices[body.faces].transpose(1, 0, 2)
    assert (edge_counts(body.faces) == 2).all()
    assert 0.03 < np.einsum("fa,fa->", a, np.cross(b, c)) / 6 < 0.12  # m^3, positive: normals point outward


def test_parents_come_before_children_and_weights_sum_to_one(body):
    assert body.parents[0] == -1
    assert (body.parents[1:] < np.arange(1, len(body.names))).all()
    assert np.allclose(body.skin.weights.sum(axis=1), 1)


def test_skinning_of_the_rest_pose_is_the_identity(body):
    for skin in (body.skin, body.tights):
        assert np.abs(body.skinned(body.pose({}, STILL), skin)[0] - skin.vertices).max() < 1e-6


def test_turning_the_root_moves_everything_rigidly(body):
    turn, shift = Rotation.from_rotvec([0.3, -0.8, 0.2]), np.array([0.1, 0.5, -2.0])
    moved = body.skinned(body.pose({"pelvis": turn.as_rotvec()[None]}, shift[None]))[0]
    expected = turn.apply(body.vertices - body.head("pelvis")) + body.head("pelvis") + shift
    assert np.abs(moved - expected).max() < 1e-5


def test_a_bent_elbow_moves_the_forearm_only(body):
    moved = body.skinned(body.pose({"lowerarm_l": np.array([[0.0, 1.0, 0.0]])}, STILL))[0]
    forearm = body.skin.share([body.index("lowerarm_l"), body.index("hand_l")])
    change = np.linalg.norm(moved - body.vertices, axis=1)
    assert change[forearm == 0].max() < 1e-6
    assert change[body.skin.share([body.index("hand_l")]) == 1].min() > 0.1


def test_an_unknown_joint_is_refused(body):
    with pytest.raises(InvalidArgument, match="tail"):
        body.pose({"tail": STILL}, STILL)
