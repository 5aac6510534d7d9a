"""Motions start at rest in the rest pose, are continuous, keep the feet on the ground, and match their names."""

import numpy as np
import pytest

from ddakf.body import proximity
from ddakf.commands import simulate
from ddakf.data.body import load_body
from ddakf.errors import InvalidArgument
from ddakf.evaluation.simulation import motions
from ddakf.mesh import Mesh

FPS = 30.0


@pytest.fixture(scope="module")
def body():
    return load_body()


@pytest.fixture(scope="module", params=[(name, seed) for name in motions.MOTIONS for seed in (0, 3)], ids=str)
def joints(request, body):
    """Name of a motion, and the places (T, J, 3) of the joints over four seconds."""
    name, seed = request.param
    return name, body.transforms(motions.make(name, body, 120, FPS, seed))[1]


def test_the_command_offers_every_motion():
    assert set(simulate.MOTIONS) == set(motions.MOTIONS)


def test_motions_start_in_the_rest_pose_and_at_rest(joints, body):
    places = joints[1]
    assert np.abs(places[0] - body.heads).max() < 1e-6
    assert np.abs(places[1] - places[0]).max() < 0.01  # 0.3 m/s after one frame


def test_motions_are_continuous(joints):
    velocity = np.diff(joints[1], axis=0) * FPS
    acceleration = np.diff(velocity, axis=0) * FPS
    assert np.linalg.norm(velocity, axis=2).max() < 6.0  # m/s; hands are the fastest
    assert np.linalg.norm(acceleration, axis=2).max() < 60.0


def test_the_lower_foot_stays_where_it_is_at_rest_but_in_a_jump(joints, body):
    name, places = joints
    feet = [body.index("foot_l"), body.index("foot_r")]
    lift = places[:, feet, 1].min(axis=1) - body.heads[feet, 1].min()
    assert lift.min() > -0.02
    assert lift.max() < 0.02 if name != "jump" else 0.15 < lift.max() < 0.35


def test_crossed_arms_cross_before_the_chest(body):
    places = body.transforms(motions.make("crossed-arms", body, 90, FPS))[1]
    left, right = (places[:, body.index(f"hand_{side}")] for side in "lr")
    crossed = left[:, 0] < right[:, 0]
    assert not crossed[0]
    assert crossed.any()
    assert (left[crossed, 2] > body.head("spine_03")[2] + 0.1).all()


@pytest.mark.parametrize("name", motions.MOTIONS)
def test_forearms_and_hands_stay_clear_of_the_trunk(body, name):
    sides = [f"{bone}_{side}" for bone in ("lowerarm", "hand") for side in "lr"]
    forearms = body.skin.share([body.index(joint) for joint in sides]) > 0.95
    arms = body.skin.share([body.index(joint) for joint in (*sides, "upperarm_l", "upperarm_r")])
    trunk, kept = Mesh.cleaned(body.vertices, body.faces[(arms[body.faces] < 0.1).all(axis=1)])
    tree = proximity.build(trunk)
    for posed in body.skinned(motions.make(name, body, 100, FPS))[::12].astype(float):
        surface = proximity.refresh(tree, posed[kept])
        found = proximity.closest_points(tree, surface, np.ascontiguousarray(posed[forearms]), radius=np.inf)
        assert found.distance.min() > 0.03


def test_seeds_change_a_motion_and_repeat_it(body):
    first, again, other = (motions.make("walk", body, 30, FPS, seed).rotations for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert np.abs(first - other).max() > 0.01


def test_the_frame_rate_samples_the_same_motion(body):
    slow, fast = motions.make("swing", body, 31, 30.0), motions.make("swing", body, 61, 60.0)
    assert np.abs(slow.rotations - fast.rotations[::2]).max() < 0.02


@pytest.mark.parametrize(("arguments", "named"), [(("moonwalk", 10), "motion"), (("walk", 0), "frames")])
def test_what_cannot_be_made_is_refused(body, arguments, named):
    with pytest.raises(InvalidArgument, match=named):
        motions.make(arguments[0], body, arguments[1])
