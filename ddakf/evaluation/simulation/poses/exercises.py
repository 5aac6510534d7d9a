"""Motions of exercise and dance: walking, swinging, crossed arms, jumping, twisting, squatting, dancing."""

from __future__ import annotations

import numpy as np

from ddakf.data.body import Body, Pose, load_body
from ddakf.evaluation.simulation.poses.stage import ARMS_DOWN, SIDES, Stage

GRAVITY = 9.81  # m/s^2


def walk(stage: Stage) -> Pose:
    """Steps on the spot, arms swinging against the legs, shoulders against the hips."""
    stride = 0.95  # Hz
    turns = {
        "pelvis": stage.turn(("y", 8 * stage.wave(stride))),
        "spine_02": stage.turn(("y", -14 * stage.wave(stride))),
        "spine_01": stage.turn(("x", 4.0)),
    }
    for side, sign in SIDES:
        step, knee = sign * stage.wave(stride), stage.bump(stride, 0.5 * np.pi - 0.5 * np.pi * sign * stage.style.side)
        turns |= stage.arm(side, sign, ARMS_DOWN, -28 * step, 15 + 10 * step)
        turns[f"thigh_{side}"] = stage.turn(("x", -26 * step - 12 * knee))
        turns[f"calf_{side}"] = stage.turn(("x", 8 + 46 * knee))
        turns[f"foot_{side}"] = stage.turn(("x", -6 - 12 * knee))
    return stage.grounded(turns)


def swing(stage: Stage) -> Pose:
    """Both arms swung forward and up, then sideways and up, the trunk swaying."""
    up, side_up = stage.bump(0.55), stage.bump(0.4)
    turns = {"spine_01": stage.turn(("z", 8 * stage.wave(0.4))), "spine_03": stage.turn(("x", -6 * up))}
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN - 55 * side_up, 75 * up * (1 - 0.4 * side_up), -10.0)
        turns[f"clavicle_{side}"] = stage.turn(("z", sign * 10 * side_up))
    return stage.grounded(turns)


def crossed_arms(stage: Stage) -> Pose:
    """The forearms are crossed before the chest, opened, and crossed again, hiding it from a camera in front."""
    closed, size = stage.bump(0.38)[:, None], _chest(stage.body)
    turns = {"spine_02": stage.turn(("y", 8 * stage.wave(0.3))), "spine_01": stage.turn(("x", 5 * closed[:, 0]))}
    for side, sign in SIDES:
        above = sign * stage.style.side > 0
        over = np.array([-sign * 0.05, 1.17, 0.305]) if above else np.array([-sign * 0.05, 1.07, 0.26])
        apart = np.array([sign * 0.40, 1.0, 0.24])
        turns |= stage.reach(side, size * (apart + closed * (over - apart)), size * [sign * 0.55, 1.15, 0.25])
    return stage.grounded(turns)


def jump(stage: Stage) -> Pose:
    """Jumps on the spot: a crouch with the arms back, a flight with the arms up, a landing."""
    height = 0.24 * stage.style.size  # m
    flight = 2 * np.sqrt(2 * height / GRAVITY)
    ground = 0.85 / stage.style.pace  # s between two flights
    phase = np.mod(stage.time, ground + flight)
    crouch = np.where(phase < ground, np.sin(np.pi * np.clip(phase / ground, 0, 1)) ** 2, 0.0)
    in_air = np.clip(phase - ground, 0, flight)
    lift = GRAVITY / 2 * in_air * (flight - in_air)
    raised = np.sin(np.pi * np.clip((phase - 0.6 * ground) / (0.4 * ground + flight), 0, 1)) ** 2
    turns = {"spine_01": stage.turn(("x", 22 * crouch)), "spine_02": stage.turn(("x", 8 * crouch)), **stage.legs(46 * crouch)}
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN - 15 * raised, 85 * raised - 30 * crouch, -5 + 15 * crouch)
    return stage.grounded(turns, lift)


def twist(stage: Stage) -> Pose:
    """The trunk turns left and right, the arms out."""
    turn = stage.wave(0.6)
    turns = {f"spine_0{n}": stage.turn(("y", 15 * turn)) for n in (1, 2, 3)}
    turns["pelvis"] = stage.turn(("y", 12 * turn))
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN - 30.0, 14 * sign * turn, 12.0)
    return stage.grounded({**turns, **stage.legs(5.0 + 5 * stage.bump(1.2))})


def squat(stage: Stage) -> Pose:
    """Deep knee bends, the arms forward."""
    down = stage.bump(0.45)
    turns = {"spine_01": stage.turn(("x", 24 * down)), "spine_03": stage.turn(("x", 8 * down)), **stage.legs(58 * down)}
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN, 62 * down, -8.0)
    return stage.grounded(turns)


def dance(stage: Stage) -> Pose:
    """Hips from side to side, turns to both sides, one arm up and then the other."""
    sway, beat = stage.wave(0.8), stage.bump(1.6)
    turns = {
        "pelvis": stage.turn(("z", 7 * sway), ("y", 35 * stage.wave(0.27))),
        "spine_01": stage.turn(("z", -9 * sway)),
        "spine_02": stage.turn(("y", 16 * stage.wave(0.8, 0.4))),
    }
    for side, sign in SIDES:
        up = stage.bump(0.4, 0.5 * np.pi - 0.5 * np.pi * sign * stage.style.side)
        turns |= stage.arm(side, sign, ARMS_DOWN - 75 * up, 25 * up + 18 * sign * sway, 20 * (1 - up))
        turns[f"clavicle_{side}"] = stage.turn(("z", sign * 10 * up))
    return stage.grounded({**turns, **stage.legs(6 + 12 * beat)}, aside=0.05 * sway)


def _chest(body: Body) -> np.ndarray:
    """(3,) breadth of the shoulders, height and front of the chest, relative to the body that ships."""

    def sizes(of: Body) -> np.ndarray:
        front = of.vertices[of.skin.share([of.index("spine_03")]) > 0.5, 2].max()
        return np.array([of.head("upperarm_l")[0], of.head("spine_03")[1], front])

    return sizes(body) / sizes(load_body())
