"""Scripted degradations of a stream of captured clouds: faults in windows of frames, with seeded random numbers.

    script = Script("occlusion", (Event(10, 30, HalfSpace(0.5)),))
    for frame, degraded in script.apply(source, seed=3):
        ...

``source`` is any iterable of :class:`ddakf.evaluation.sensors.captured_frame.CapturedFrame`. Frames are counted from 0, the
first one that the tracker is given. Every event has random numbers of its own, so that other events do not change its effect on
a frame.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple, Protocol

import numpy as np
from numpy.random import Generator

from ddakf.evaluation.sensors.captured_frame import CapturedFrame

OUTLIER_MARGIN = 0.3  # m: outliers fill the cloud's bounding box, enlarged by this on every side
EYE_DISTANCE = 2.0  # m: viewing distance of an occluder where the cloud has no sensor; that of the virtual cameras


class Degradation(Protocol):
    """A fault that changes the frames of a window, or drops them."""

    def degrade(self, frame: CapturedFrame, age: int, once: Generator, rng: Generator) -> CapturedFrame | None:
        """The degraded frame, or None if the frame does not arrive.

        Args:
            frame: before the degradation.
            age: frames since the window began.
            once: random numbers that are the same in every frame of the window.
            rng: random numbers of this frame.
        """


@dataclass(frozen=True)
class Noise:
    """A burst of isotropic Gaussian noise on top of the sensor's; ``sd`` in metres."""

    sd: float

    def degrade(self, frame: CapturedFrame, age: int, once: Generator, rng: Generator) -> CapturedFrame:
        noisy = frame.points + self.sd * rng.normal(size=frame.points.shape)
        return replace(frame, points=noisy.astype(np.float32))


@dataclass(frozen=True)
class Dropout:
    """A share of the points is missing at random; 1 leaves an empty cloud."""

    share: float

    def degrade(self, frame: CapturedFrame, age: int, once: Generator, rng: Generator) -> CapturedFrame:
        return selected(frame, rng.random(len(frame.points)) >= self.share)


@dataclass(frozen=True)
class HalfSpace:
    """All points on one side of a plane are missing. The direction is the same throughout the window.

    Attributes:
        share: of each frame's points that are missing.
        direction: (3,) toward the missing side; None for a random, nearly horizontal one.
    """

    share: float
    direction: tuple[float, float, float] | None = None

    def degrade(self, frame: CapturedFrame, age: int, once: Generator, rng: Generator) -> CapturedFrame:
        if len(frame.points) == 0:
            return frame
        angle, rise = once.uniform(0, 2 * np.pi), once.uniform(-0.5, 0.5)
        drawn = np.array([np.cos(angle), rise, np.sin(angle)])
        height = frame.points @ (drawn if self.direction is None else np.asarray(self.direction, np.float64))
        return selected(frame, height <= np.quantile(height, 1.0 - self.share))


@dataclass(frozen=True)
class Disc:
    """A disc in front of the garment that hides all points behind it, as an arm or a passer-by does; ``radius`` in metres.

    The eye is the sensor. Where the cloud has none, the eye is :data:`EYE_DISTANCE` away in a random direction, and the disc
    hides the near and the far side of the garment. The disc goes with the middle of the cloud, and the garment moves behind it.
    """

    radius: float

    def degrade(self, frame: CapturedFrame, age: int, once: Generator, rng: Generator) -> CapturedFrame:
        if len(frame.points) == 0:
            return frame
        centre = frame.points.mean(axis=0, dtype=np.float64)
        angle = once.uniform(0, 2 * np.pi)
        eye = frame.sensor_origin
        if eye is None:
            eye = centre + EYE_DISTANCE * np.array([np.sin(angle), 0.0, np.cos(angle)])
        spread = np.sqrt(frame.points.var(axis=0, dtype=np.float64))
        middle = centre + once.uniform(-1.0, 1.0, 3) * spread
        ray, axis = frame.points - eye, middle - eye
        axis = axis / np.linalg.norm(axis, axis=-1, keepdims=True)
        along = np.einsum("na,na->n", ray, np.broadcast_to(axis, ray.shape))
        away = np.sqrt(np.maximum(np.einsum("na,na->n", ray, ray) - along**2, 0.0))
        return selected(frame, away > self.radius)


@dataclass(frozen=True)
class Outliers:
    """A share of the points is replaced by points that are uniform in the enlarged bounding box."""

    share: float

    def degrade(self, frame: CapturedFrame, age: int, once: Generator, rng: Generator) -> CapturedFrame:
        bad = rng.random(len(frame.points)) < self.share
        if not bad.any():
            return frame
        low, high = frame.points.min(axis=0) - OUTLIER_MARGIN, frame.points.max(axis=0) + OUTLIER_MARGIN
        points = np.where(bad[:, None], rng.uniform(low, high, frame.points.shape), frame.points)
        return replace(frame, points=points.astype(np.float32))


@dataclass(frozen=True)
class Gap:
    """No frame arrives; the next one's timestamp shows for how long."""

    def degrade(self, frame: CapturedFrame, age: int, once: Generator, rng: Generator) -> None:
        return None


@dataclass(frozen=True)
class Fast:
    """Only every ``nth`` frame arrives, with timestamps of the full rate: the garment moves ``nth`` times as fast."""

    nth: int

    def degrade(self, frame: CapturedFrame, age: int, once: Generator, rng: Generator) -> CapturedFrame | None:
        return None if (age + 1) % self.nth else frame


class Event(NamedTuple):
    """A degradation of the frames ``first`` to ``last - 1``."""

    first: int
    last: int
    degradation: Degradation


@dataclass(frozen=True)
class Script:
    """Events over a stream. Where windows overlap, the events act in their order."""

    name: str
    events: tuple[Event, ...]

    def degrades(self, number: int) -> bool:
        """True if an event changes the frame of this number."""
        return any(event.first <= number < event.last for event in self.events)

    def apply(self, frames: Iterable[CapturedFrame], seed: int) -> Iterator[tuple[CapturedFrame, bool]]:
        """The frames that arrive, each with a flag: degraded or not. The first frame after a gap counts as degraded.

        The times that :class:`Fast` removes are subtracted from all later timestamps, so that later frames keep their distances.
        """
        after_gap, saved, last = False, 0.0, None
        for number, frame in enumerate(frames):
            step = 0.0 if last is None else frame.timestamp - last
            last, degraded, hurried = frame.timestamp, self.degrades(number), False
            for k, event in enumerate(self.events):
                if frame is None or not event.first <= number < event.last:
                    continue
                once, rng = np.random.default_rng([seed, k]), np.random.default_rng([seed, k, number])
                frame = event.degradation.degrade(frame, number - event.first, once, rng)
                hurried |= frame is None and isinstance(event.degradation, Fast)
            if hurried:
                saved += step
                continue
            if frame is None:
                after_gap = True
                continue
            yield replace(frame, timestamp=frame.timestamp - saved), degraded or after_gap
            after_gap = False


def selected(frame: CapturedFrame, keep: np.ndarray) -> CapturedFrame:
    """The frame with the points for which (N,) ``keep`` holds, the origins of their sensors, and their colours."""
    origin = frame.sensor_origin
    if origin is not None and origin.ndim == 2:
        origin = origin[keep]
    colors = None if frame.colors is None else frame.colors[keep]
    return replace(frame, points=frame.points[keep], sensor_origin=origin, colors=colors)


# Disturbances from which a tracker must recover ------------------------------------------------------------------------

DISTURBED_FROM = 30  # frame at which each begins


def _disturbance(name: str, frames: int, degradation: Degradation) -> Script:
    return Script(name, (Event(DISTURBED_FROM, DISTURBED_FROM + frames, degradation),))


DISTURBANCES = (
    _disturbance("half a second without frames", 15, Gap()),
    _disturbance("40 % of the points missing", 20, Dropout(0.4)),
    _disturbance("half of the garment occluded", 20, HalfSpace(0.5)),
    _disturbance("10 % uniform outliers", 20, Outliers(0.1)),
)

# Runs that judge the reliability score ---------------------------------------------------------------------------------

CLEAN = Script("clean", ())
SCRIPTS = (
    Script(
        "noise",
        (
            Event(12, 22, Noise(0.010)),
            Event(40, 50, Noise(0.025)),
            Event(68, 78, Outliers(0.10)),
            Event(94, 104, Noise(0.018)),
        ),
    ),
    Script(
        "occlusion",
        (
            Event(12, 27, HalfSpace(0.5)),
            Event(48, 60, Disc(0.20)),
            Event(82, 97, HalfSpace(0.75)),
        ),
    ),
    Script(
        "loss",
        (
            Event(14, 24, Dropout(0.6)),
            Event(42, 57, Gap()),
            Event(72, 84, Dropout(1.0)),
            Event(98, 108, Dropout(0.95)),
        ),
    ),
    Script(
        "speed",
        (
            Event(12, 36, Fast(2)),
            Event(60, 90, Fast(3)),
            Event(98, 106, Noise(0.015)),
            Event(102, 110, Dropout(0.4)),
        ),
    ),
)
FRAMES = 120  # of every run, before the script


class DegradedRun(NamedTuple):
    """One run: the first :data:`FRAMES` frames of a sequence, seen by a sensor, through a script."""

    sequence: str
    view: str
    give_body: bool
    script: Script
    seed: int


def degraded_runs(sequences: Iterable[tuple[str, bool]]) -> list[DegradedRun]:
    """The fixed list: every script on every sequence in the views full and front, and in front with the body where there is one.

    Args:
        sequences: name of each, and True if it has a body.
    """
    runs = []
    for name, has_body in sequences:
        for view, give_body in (("full", False), ("front", False), ("front", True))[: 3 if has_body else 2]:
            for k, script in enumerate(SCRIPTS):
                runs.append(DegradedRun(name, view, give_body, script, seed=11 + k))
    return runs
