"""Procedural motions of the body that ships: each starts in the rest pose, at rest, and eases in.

Angles are made of sines of time; wrists that must be at a place (crossed arms, arms up) are brought there by two-bone
inverse kinematics. The feet stay on the ground: the body is shifted so that the lower foot is where it is at rest, but for
jumps. All happens on the spot, so that fixed cameras see it.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.ndimage import gaussian_filter1d

from ddakf.data.body import Body, Pose
from ddakf.errors import InvalidArgument
from ddakf.evaluation.simulation.poses import actions, exercises
from ddakf.evaluation.simulation.poses.stage import Stage, Style

SAMPLES_PER_FRAME = 4  # a motion is made so much finer, smoothed, and then taken frame by frame
SMOOTHING = 0.02  # s, of the places of the root and the joint angles


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
        style = Style(random.uniform(0.87, 1.15), random.uniform(0.87, 1.1), random.choice([-1.0, 1.0]), seed)
    time = np.arange((n_frames - 1) * SAMPLES_PER_FRAME + 1) / (fps * SAMPLES_PER_FRAME)
    pose = MOTIONS[name](Stage(body, time, style))
    sigma = SMOOTHING * fps * SAMPLES_PER_FRAME
    smooth = (gaussian_filter1d(part, sigma, axis=0, mode="nearest") for part in (pose.rotations, pose.shift))
    rotations, shift = (part[::SAMPLES_PER_FRAME] for part in smooth)
    return Pose(rotations - rotations[0], shift - shift[0])


MOTIONS: dict[str, Callable[[Stage], Pose]] = {
    "walk": exercises.walk,
    "swing": exercises.swing,
    "crossed-arms": exercises.crossed_arms,
    "jump": exercises.jump,
    "twist": exercises.twist,
    "squat": exercises.squat,
    "dance": exercises.dance,
    "turn": actions.turn,
    "sit": actions.sit,
    "run": actions.run,
    "overhead": actions.overhead,
    "lie": actions.lie,
    "random": actions.random_poses,
}
