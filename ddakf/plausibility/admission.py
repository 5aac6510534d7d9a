"""Admission of a frame: its arguments are checked, a sensor that is not given is estimated, and several are aligned."""

from __future__ import annotations

from ddakf.plausibility import sensor_poses, sidedness, units
from ddakf.stages import frame_input
from ddakf.types import FrameInput, Setup, Track


def admit(setup: Setup, last: Track, given: FrameInput) -> tuple[FrameInput, Track]:
    """The checked frame, and the track with what the cloud says of its sensors.

    Args:
        setup: constants of the tracker.
        last: after the last frame.
        given: the arguments of ``Tracker.step``.

    Raises:
        InvalidFrame: input that cannot be used.
    """
    frame = frame_input.check(given, last.time, None if setup.body is None else setup.body.mesh)
    units.require_scale(setup, last, frame)
    frame, view = sidedness.estimate_origin(setup, last, frame)
    frame, sensors = sensor_poses.correct(setup, last, frame)
    return frame, last._replace(view=view, sensors=sensors)
