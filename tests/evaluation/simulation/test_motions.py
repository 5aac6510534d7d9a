"""Motions start at rest in the rest pose, are continuous, keep the feet on the ground, and match their names."""

import numpy as np
import pytest

from ddakf.body import proximity
from ddakf.commands import simulate
from ddakf.data.body import load_body
from ddakf.data.body_shape import random_shape, shaped
from ddakf.errors import InvalidArgument
from ddakf.evaluation.simulation import motions
from ddakf.mesh import Mesh
from tests.lanes import every

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


def test_the_lower_foot_stays_where_it_is_at_rest_but_in_the_air_and_lying(joints, body):
    name, places = joints
    if name in ("lie", "run"):
        return
    feet = [body.index("foot_l"), body.index("foot_r")]
    lift = places[:, feet, 1].min(axis=1) - body.heads[feet, 1].min()
    assert lift.min() > -0.02
    assert lift.max() < 0.02 if name != "jump" else 0.15 < lift.max() < 0.35


def places_of(name, body, *joints):
    places = body.transforms(motions.make(name, body, 120, FPS))[1]
    return [places[:, body.index(joint)] for joint in joints]


def test_a_turn_goes_around_once_on_the_spot(body):
    left, right, pelvis = places_of("turn", body, "upperarm_l", "upperarm_r", "pelvis")
    heading = np.unwrap(np.arctan2((left - right)[:, 2], (left - right)[:, 0]))
    assert 270 < np.degrees(abs(heading[-1] - heading[0])) < 420
    assert np.linalg.norm(pelvis[:, [0, 2]] - pelvis[0, [0, 2]], axis=1).max() < 0.05


def test_sitting_brings_the_thighs_level_and_leaves_the_feet(body):
    hip, knee, foot = places_of("sit", body, "thigh_l", "calf_l", "foot_l")
    lowest = hip[:, 1].argmin()
    assert abs(hip[lowest, 1] - knee[lowest, 1]) < 0.12
    assert hip[lowest, 2] < knee[lowest, 2] - 0.25
    assert np.linalg.norm(foot - foot[0], axis=1).max() < 0.06


def test_arms_go_overhead(body):
    hands, head = places_of("overhead", body, "hand_l", "hand_r"), places_of("overhead", body, "head")[0]
    assert all((hand[:, 1] - head[:, 1]).max() > 0.15 for hand in hands)


def test_a_lying_body_is_level_and_above_the_ground(body):
    posed = body.skinned(motions.make("lie", body, 120, FPS))
    assert posed[:, :, 1].min() > posed[0, :, 1].min() - 0.01
    assert np.ptp(posed[-1, :, 1]) < 0.5
    assert np.ptp(posed[-1, :, 2]) > 1.4


def test_random_poses_differ_by_seed_and_use_every_limb(body):
    one, other = (motions.make("random", body, 120, FPS, seed).rotations for seed in (1, 2))
    limbs = [body.index(f"{bone}_{side}") for bone in ("upperarm", "lowerarm", "thigh", "calf") for side in "lr"]
    assert (np.ptp(one[:, limbs], axis=0).max(axis=1) > 0.1).all()
    assert np.abs(one - other).max() > 0.3


@pytest.mark.parametrize("seed", [2, 5])
def test_crossed_arms_stay_clear_of_the_chest_of_other_bodies(seed):
    body = shaped(load_body(), random_shape(seed))
    assert clearance(body, motions.make("crossed-arms", body, 60, FPS)) > 0.02


def test_crossed_arms_cross_before_the_chest(body):
    places = body.transforms(motions.make("crossed-arms", body, 90, FPS))[1]
    left, right = (places[:, body.index(f"hand_{side}")] for side in "lr")
    crossed = left[:, 0] < right[:, 0]
    assert not crossed[0]
    assert crossed.any()
    assert (left[crossed, 2] > body.head("spine_03")[2] + 0.1).all()


@pytest.mark.parametrize("name", every(4, motions.MOTIONS))
def test_forearms_and_hands_stay_clear_of_the_trunk(body, name):
    assert clearance(body, motions.make(name, body, 100, FPS)) > 0.03


def clearance(body, pose):
    """Smallest distance between forearms and trunk in every twelfth frame, metres."""
    sides = [f"{bone}_{side}" for bone in ("lowerarm", "hand") for side in "lr"]
    forearms = body.skin.share([body.index(joint) for joint in sides]) > 0.95
    arms = body.skin.share([body.index(joint) for joint in (*sides, "upperarm_l", "upperarm_r")])
    trunk, kept = Mesh.cleaned(body.vertices, body.faces[(arms[body.faces] < 0.1).all(axis=1)])
    tree, nearest = proximity.build(trunk), []
    for posed in body.skinned(pose)[::12].astype(float):
        surface = proximity.refresh(tree, posed[kept])
        nearest.append(proximity.closest_points(tree, surface, np.ascontiguousarray(posed[forearms]), radius=np.inf).distance)
    return np.min(nearest)


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
