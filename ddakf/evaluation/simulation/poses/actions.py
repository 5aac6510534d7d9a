"""Everyday motions: turning on the spot, sitting down, running, raising the arms, lying down, random smooth poses."""

from __future__ import annotations

import numpy as np

from ddakf.data.body import Pose
from ddakf.evaluation.simulation.poses.stage import ARMS_DOWN, SIDES, Stage

TURN_RATE = 100.0  # degrees per second
BED = 0.02  # m between the lying body and the ground, room for cloth
EVERY = 7  # the body's height above the ground is found from every so many vertices
WAVES = 3  # of a random angle
RANDOM_HERTZ = (0.15, 0.55)
RANDOM_TURNS = {
    "pelvis": {"y": (-25, 25), "z": (-6, 6)},
    "spine_01": {"x": (-6, 16), "z": (-8, 8)},
    "spine_02": {"y": (-14, 14), "z": (-8, 8)},
    "spine_03": {"x": (-6, 10), "y": (-10, 10)},
    "neck_01": {"x": (-10, 15), "y": (-20, 20)},
}  # fmt: skip ; degrees about the axes
RANDOM_ARM = {"down": (-70, 12), "forward": (-20, 80), "elbow": (-8, 60)}  # degrees
RANDOM_LEG = {"thigh": (-8, 45), "aside": (0, 14), "knee": (5, 50)}  # degrees


def turn(stage: Stage) -> Pose:
    """Once around on the spot with small steps."""
    yaw = np.radians(TURN_RATE) * stage.style.side * stage.style.pace * np.cumsum(stage.ease) * (stage.time[-1] / len(stage.time))
    turns = {"pelvis": np.outer(yaw, [0.0, 1.0, 0.0]), "spine_02": stage.turn(("y", 8 * stage.wave(0.5)))}
    for side, sign in SIDES:
        step = np.maximum(sign * stage.wave(0.9), 0) ** 2
        turns |= stage.arm(side, sign, ARMS_DOWN - 15, -12 * sign * stage.wave(0.9), 12.0)
        turns |= _leg(stage, side, 14 * step, 26 * step)
    return stage.grounded(turns)


def sit(stage: Stage) -> Pose:
    """Down onto a seat that is not there, and up again; the feet stay."""
    down = stage.span(0.3, 1.7) * (1 - stage.span(2.4, 3.9))
    lean = 26 * np.sin(np.pi * down) + 4 * down
    turns = {"spine_01": stage.turn(("x", lean)), "spine_02": stage.turn(("y", 6 * stage.wave(0.4)))}
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN - 8, 34 * down, 18 * down)
        turns |= _leg(stage, side, 80 * down, 82 * down, 5 * sign * down)
    return stage.planted(turns)


def run(stage: Stage) -> Pose:
    """Running on the spot, elbows bent."""
    stride = 1.25  # Hz
    turns = {
        "pelvis": stage.turn(("y", 8 * stage.wave(stride))),
        "spine_02": stage.turn(("y", -16 * stage.wave(stride))),
        "spine_01": stage.turn(("x", 9.0)),
    }
    for side, sign in SIDES:
        step, knee = sign * stage.wave(stride), stage.bump(stride, 0.5 * np.pi - 0.5 * np.pi * sign * stage.style.side)
        turns |= stage.arm(side, sign, ARMS_DOWN - 8, 8 - 34 * step, 48 + 8 * step)
        turns |= _leg(stage, side, 14 + 26 * step + 8 * knee, 18 + 52 * knee)
    return stage.grounded(turns, lift=0.035 * stage.bump(2 * stride) * stage.ease)


def overhead(stage: Stage) -> Pose:
    """Both arms raised sideways until they are overhead, the trunk bending to both sides, and lowered."""
    up = stage.span(0.4, 1.7) * (1 - stage.span(2.7, 3.9))
    turns = {"spine_01": stage.turn(("z", 9 * up * stage.wave(0.5))), "spine_03": stage.turn(("z", 7 * up * stage.wave(0.5)))}
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN * (1 - up) - 92 * up, 12 * up, 8 + 14 * up)
        turns[f"clavicle_{side}"] = stage.turn(("z", sign * 22 * up))
    return stage.grounded({**turns, **stage.legs(4.0)})


def lie(stage: Stage) -> Pose:
    """Lowered onto the back: hips and knees bend and straighten while the body tilts until it lies above the ground."""
    tilt = stage.span(0.4, 3.2)
    bent = np.sin(np.pi * tilt) ** 2
    turns = {
        "pelvis": np.outer(-np.radians(88) * tilt, [1.0, 0.0, 0.0]),
        "spine_01": stage.turn(("x", 14 * bent)),
        "spine_02": stage.turn(("x", 10 * bent)),
        "neck_01": stage.turn(("x", 12 * bent)),
    }
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN * (1 - tilt), 22 * bent, 14 * bent)
        turns |= _leg(stage, side, 52 * bent, 66 * bent)
    pose = stage.grounded(turns)
    frames = stage.body.skinned(pose, stage.body.attach(stage.body.vertices[::EVERY], stage.body.faces))
    lowest = frames[:, :, 1].min(axis=1)
    shift = pose.shift.copy()
    shift[:, 1] += lowest[0] - lowest + BED * tilt
    return Pose(pose.rotations, shift)


def random_poses(stage: Stage) -> Pose:
    """Every joint by sums of slow waves between its limits."""
    random = np.random.default_rng(stage.style.seed)

    def angle(limits: tuple[float, float]) -> np.ndarray:
        hertz, phase = random.uniform(*RANDOM_HERTZ, WAVES), random.uniform(0, 2 * np.pi, WAVES)
        waves = np.sin(2 * np.pi * np.outer(stage.time * stage.style.pace, hertz) + phase).sum(axis=1) / np.sqrt(WAVES)
        low, high = limits
        return (low + high) / 2 + (high - low) / 2 * np.tanh(waves)

    turns = {joint: stage.turn(*((axis, angle(limits)) for axis, limits in axes.items())) for joint, axes in RANDOM_TURNS.items()}
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, *(angle(limits) for limits in RANDOM_ARM.values()))
        thigh, aside, knee = (angle(limits) for limits in RANDOM_LEG.values())
        turns |= _leg(stage, side, thigh, knee, sign * aside)
    return stage.grounded(turns)


def _leg(stage: Stage, side: str, thigh, knee, aside=0.0) -> dict[str, np.ndarray]:
    """A leg with thigh and knee bent, the foot level if the body is upright, and spread sideways, by so many degrees."""
    return {
        f"thigh_{side}": stage.turn(("x", -thigh), ("z", aside)),
        f"calf_{side}": stage.turn(("x", knee)),
        f"foot_{side}": stage.turn(("x", thigh - knee)),
    }
