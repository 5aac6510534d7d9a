"""Procedural motions of the body that ships: each starts in the rest pose, at rest, and eases in.

Angles are made of sines of time; wrists that must be at a place (crossed arms, arms up) are brought there by two-bone
inverse kinematics. The feet stay on the ground: the body is shifted so that the lower foot is where it is at rest, but for
jumps. All happens on the spot, so that fixed cameras see it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from ddakf.data.body import Body, Pose
from ddakf.errors import InvalidArgument

EASE_IN = 0.9  # s
GRAVITY = 9.81  # m/s^2
SAMPLES_PER_FRAME = 4  # a motion is made so much finer, smoothed, and then taken frame by frame
SMOOTHING = 0.02  # s, of the places of the root and the joint angles
ARMS_DOWN = 20.0  # degrees from the rest pose's A, which leaves the arms clear of the trunk
FOOT_BLEND = 0.01  # m within which the lower foot hands over to the other one
SIDES = (("l", 1.0), ("r", -1.0))  # letter in the names of joints, sign of x


@dataclass(frozen=True)
class Style:
    """Parameters of a motion that vary with the seed.

    Attributes:
        pace: multiplies frequencies.
        size: multiplies angles.
        side: 1 or -1, which side begins.
    """

    pace: float = 1.0
    size: float = 1.0
    side: float = 1.0


def make(name: str, body: Body, n_frames: int, fps: float = 30.0, seed: int = 0) -> Pose:
    """A motion of ``n_frames`` frames.

    Args:
        name: of :data:`MOTIONS`.
        body: that moves.
        n_frames: T >= 1; frame 0 is the rest pose.
        fps: frames per second.
        seed: varies pace and size by up to a seventh, and the side; 0 leaves them as they are.

    Raises:
        InvalidArgument: no such motion, no frame, or no positive frame rate.
    """
    if name not in MOTIONS:
        raise InvalidArgument("motion", f"one of {', '.join(MOTIONS)}", name)
    if n_frames < 1 or not 1 <= fps <= 1000:
        raise InvalidArgument("frames", "at least one, at 1 to 1000 per second", f"{n_frames} at {fps:g}")
    style = Style()
    if seed:
        random = np.random.default_rng(seed)
        style = Style(random.uniform(0.87, 1.15), random.uniform(0.87, 1.1), random.choice([-1.0, 1.0]))
    time = np.arange((n_frames - 1) * SAMPLES_PER_FRAME + 1) / (fps * SAMPLES_PER_FRAME)
    pose = MOTIONS[name](_Stage(body, time, style))
    sigma = SMOOTHING * fps * SAMPLES_PER_FRAME
    smooth = (gaussian_filter1d(part, sigma, axis=0, mode="nearest") for part in (pose.rotations, pose.shift))
    rotations, shift = (part[::SAMPLES_PER_FRAME] for part in smooth)
    return Pose(rotations - rotations[0], shift - shift[0])


class _Stage:
    """A body and the times (T,) at which its pose is wanted; ``ease`` goes from 0 to 1, with no velocity at the start."""

    def __init__(self, body: Body, time: np.ndarray, style: Style):
        self.body, self.time, self.style = body, time, style
        share = np.clip(time / EASE_IN, 0, 1)
        self.ease = share**2 * (3 - 2 * share)

    def wave(self, hertz: float, phase: float = 0.0) -> np.ndarray:
        """(T,) sin(2 pi f t + phase), at the style's pace and side."""
        return np.sin(2 * np.pi * hertz * self.style.pace * self.time + phase) * self.style.side

    def bump(self, hertz: float, phase: float = 0.0) -> np.ndarray:
        """(T,) smooth repeated bumps from 0 to 1 and back; at phase 0 they begin at 0."""
        return (1 - np.cos(2 * np.pi * hertz * self.style.pace * self.time + phase)) / 2

    def turn(self, *turns: tuple[str, np.ndarray | float]) -> np.ndarray:
        """(T, 3) rotation vectors of turns about the axes x, y, z, applied in this order, in degrees, eased in."""
        total = Rotation.identity(len(self.time))
        for axis, degrees in turns:
            vectors = np.zeros((len(self.time), 3))
            vectors[:, "xyz".index(axis)] = np.radians(degrees * self.ease * self.style.size)
            total = Rotation.from_rotvec(vectors) * total
        return total.as_rotvec()

    def arm(self, side: str, sign: float, down, forward, elbow) -> dict[str, np.ndarray]:
        """An arm that is lowered from the rest pose, swung forward, and bent at the elbow, by so many degrees."""
        upper, lower = self._bones(side)
        hinge = np.cross(upper, lower) / np.linalg.norm(np.cross(upper, lower))
        bend = np.radians(elbow * self.ease * self.style.size)
        return {
            f"upperarm_{side}": self.turn(("z", -sign * down), ("x", -forward)),
            f"lowerarm_{side}": np.outer(np.broadcast_to(bend, self.time.shape), hinge),
        }

    def reach(self, side: str, wrist: np.ndarray, elbow: np.ndarray) -> dict[str, np.ndarray]:
        """An arm whose wrist is brought from its place at rest to (T, 3) or (3,), in the resting chest's frame, the elbow
        pointing toward ``elbow`` (3,)."""
        upper, lower = self._bones(side)
        shoulder, rest = self.body.head(f"upperarm_{side}"), self.body.head(f"hand_{side}")
        a, b = np.linalg.norm(upper), np.linalg.norm(lower)
        ease = self.ease[:, None]
        to_wrist = rest + ease * (wrist - rest) - shoulder
        distance = np.clip(np.linalg.norm(to_wrist, axis=1, keepdims=True), abs(a - b) + 1e-3, 0.999 * (a + b))
        along = to_wrist / np.linalg.norm(to_wrist, axis=1, keepdims=True)
        pole = upper + ease * (elbow - shoulder - upper)
        aside = pole - (pole * along).sum(axis=1, keepdims=True) * along
        aside /= np.linalg.norm(aside, axis=1, keepdims=True)
        cosine = (a**2 + distance**2 - b**2) / (2 * a * distance)
        new_upper = a * (cosine * along + np.sqrt(1 - cosine**2) * aside)
        new_lower = distance * along - new_upper
        first = Rotation.from_rotvec(_between(np.broadcast_to(upper, new_upper.shape), new_upper))
        second = _between(np.broadcast_to(lower, new_lower.shape), first.inv().apply(new_lower))
        return {f"upperarm_{side}": first.as_rotvec(), f"lowerarm_{side}": second}

    def legs(self, bend) -> dict[str, np.ndarray]:
        """Both knees bent, feet flat and below the hips: thighs by so many degrees, knees by twice as many."""
        turns = {}
        for side, _ in SIDES:
            turns |= {
                f"thigh_{side}": self.turn(("x", -bend)),
                f"calf_{side}": self.turn(("x", 2 * bend)),
                f"foot_{side}": self.turn(("x", -bend)),
            }
        return turns

    def grounded(self, rotations: dict[str, np.ndarray], lift: np.ndarray | float = 0.0, aside: np.ndarray | float = 0.0) -> Pose:
        """The pose with the lower foot on the ground, lifted by (T,) and moved sideways by (T,), metres."""
        zero = np.zeros((len(self.time), 3))
        pose = self.body.pose(rotations, zero)
        feet = self.body.transforms(pose)[1][:, [self.body.index("foot_l"), self.body.index("foot_r")], 1]
        lower = -FOOT_BLEND * np.logaddexp(*(-feet.T / FOOT_BLEND))
        zero[:, 1] = lower[0] - lower + lift
        zero[:, 0] = aside * self.ease
        return Pose(pose.rotations, zero)

    def _bones(self, side: str) -> tuple[np.ndarray, np.ndarray]:
        shoulder, elbow, wrist = (self.body.head(f"{name}_{side}") for name in ("upperarm", "lowerarm", "hand"))
        return elbow - shoulder, wrist - elbow


def _between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(T, 3) the shortest rotations that turn directions (T, 3) into others."""
    axis = np.cross(start, end)
    sine, cosine = np.linalg.norm(axis, axis=1), (start * end).sum(axis=1)
    return axis / np.maximum(sine, 1e-12)[:, None] * np.arctan2(sine, cosine)[:, None]


def _walk(stage: _Stage) -> Pose:
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


def _swing(stage: _Stage) -> Pose:
    """Both arms swung forward and up, then sideways and up, the trunk swaying."""
    up, side_up = stage.bump(0.55), stage.bump(0.4)
    turns = {"spine_01": stage.turn(("z", 8 * stage.wave(0.4))), "spine_03": stage.turn(("x", -6 * up))}
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN - 55 * side_up, 75 * up * (1 - 0.4 * side_up), -10.0)
        turns[f"clavicle_{side}"] = stage.turn(("z", sign * 10 * side_up))
    return stage.grounded(turns)


def _crossed_arms(stage: _Stage) -> Pose:
    """The forearms are crossed before the chest, opened, and crossed again, hiding it from a camera in front."""
    closed = stage.bump(0.38)[:, None]
    turns = {"spine_02": stage.turn(("y", 8 * stage.wave(0.3))), "spine_01": stage.turn(("x", 5 * closed[:, 0]))}
    for side, sign in SIDES:
        above = sign * stage.style.side > 0
        over = np.array([-sign * 0.05, 1.17, 0.305]) if above else np.array([-sign * 0.05, 1.07, 0.26])
        apart = np.array([sign * 0.40, 1.0, 0.24])
        turns |= stage.reach(side, apart + closed * (over - apart), np.array([sign * 0.55, 1.15, 0.25]))
    return stage.grounded(turns)


def _jump(stage: _Stage) -> Pose:
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


def _twist(stage: _Stage) -> Pose:
    """The trunk turns left and right, the arms out."""
    turn = stage.wave(0.6)
    turns = {f"spine_0{n}": stage.turn(("y", 15 * turn)) for n in (1, 2, 3)}
    turns["pelvis"] = stage.turn(("y", 12 * turn))
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN - 30.0, 14 * sign * turn, 12.0)
    return stage.grounded({**turns, **stage.legs(5.0 + 5 * stage.bump(1.2))})


def _squat(stage: _Stage) -> Pose:
    """Deep knee bends, the arms forward."""
    down = stage.bump(0.45)
    turns = {"spine_01": stage.turn(("x", 24 * down)), "spine_03": stage.turn(("x", 8 * down)), **stage.legs(58 * down)}
    for side, sign in SIDES:
        turns |= stage.arm(side, sign, ARMS_DOWN, 62 * down, -8.0)
    return stage.grounded(turns)


def _dance(stage: _Stage) -> Pose:
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


MOTIONS: dict[str, Callable[[_Stage], Pose]] = {
    "walk": _walk,
    "swing": _swing,
    "crossed-arms": _crossed_arms,
    "jump": _jump,
    "twist": _twist,
    "squat": _squat,
    "dance": _dance,
}
