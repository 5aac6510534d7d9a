"""Means of procedural motions: waves and turns in time, arms and legs by angles or by inverse kinematics, feet on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from ddakf.data.body import Body, Pose

EASE_IN = 0.9  # s
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
        seed: of what a motion draws itself.
    """

    pace: float = 1.0
    size: float = 1.0
    side: float = 1.0
    seed: int = 0


class Stage:
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

    def span(self, start: float, end: float) -> np.ndarray:
        """(T,) smooth from 0 before the one time to 1 after the other, seconds at the style's pace."""
        share = np.clip((self.time * self.style.pace - start) / (end - start), 0, 1)
        return share**3 * (10 - 15 * share + 6 * share**2)

    def grounded(self, rotations: dict[str, np.ndarray], lift: np.ndarray | float = 0.0, aside: np.ndarray | float = 0.0) -> Pose:
        """The pose with the lower foot on the ground, lifted by (T,) and moved sideways by (T,), metres."""
        zero = np.zeros((len(self.time), 3))
        pose = self.body.pose(rotations, zero)
        feet = self.body.transforms(pose)[1][:, [self.body.index("foot_l"), self.body.index("foot_r")], 1]
        lower = -FOOT_BLEND * np.logaddexp(*(-feet.T / FOOT_BLEND))
        zero[:, 1] = lower[0] - lower + lift
        zero[:, 0] = aside * self.ease
        return Pose(pose.rotations, zero)

    def planted(self, rotations: dict[str, np.ndarray]) -> Pose:
        """The pose with the middle between the feet where it is at rest."""
        pose = self.grounded(rotations)
        feet = [self.body.index("foot_l"), self.body.index("foot_r")]
        middle = self.body.transforms(pose)[1][:, feet].mean(axis=1)
        away = middle[0] - middle
        return Pose(pose.rotations, pose.shift + away * [1.0, 0.0, 1.0])

    def _bones(self, side: str) -> tuple[np.ndarray, np.ndarray]:
        shoulder, elbow, wrist = (self.body.head(f"{name}_{side}") for name in ("upperarm", "lowerarm", "hand"))
        return elbow - shoulder, wrist - elbow


def _between(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """(T, 3) the shortest rotations that turn directions (T, 3) into others."""
    axis = np.cross(start, end)
    sine, cosine = np.linalg.norm(axis, axis=1), (start * end).sum(axis=1)
    return axis / np.maximum(sine, 1e-12)[:, None] * np.arctan2(sine, cosine)[:, None]
