"""Trial: one run of a method on a recording, described by its settings alone."""

from __future__ import annotations

from dataclasses import dataclass, fields

from ddakf.evaluation.sensors.virtual_sensor import Sensor

PAIR_STEPS = 10  # in which the second frame of a pair is shown: a method that moves a gate's width per frame needs some

@dataclass(frozen=True)
class Trial:
    """One run. The fields are flat, as those of the row whose key the trial is: rows in files name a sensor's settings so, and a
    row without one of them means its default.

    Attributes:
        sequence: ``sample`` or another one that ships (``skirt_walk``), the name of a recording under DDAKF_DATA (``faust_s3_p7``
            of FAUST's clips), or a path.
        view: of :class:`ddakf.evaluation.sensors.virtual_sensor.Sensor`.
        body: the tracker gets the body of every frame.
        seed: of the sensor's noise.
        variant: see :func:`ddakf.evaluation.trials.methods.method_factory`.
        frames: tracked at most; None for all.
        first: frame in which the garment is known.
        segmented: only the garment's points.
        points: per cloud at most.
        noise: standard deviation, metres.
        start: number of a random start, see :func:`ddakf.evaluation.trials.runs.displaced_template`; None starts at the truth.
        disturbance: name of one of :data:`ddakf.evaluation.sensors.degradations.DISTURBANCES`, or None.
        drop, outliers, depth_noise, depth_step, fliers, occlude, occluded, every: of
            :class:`ddakf.evaluation.sensors.virtual_sensor.Sensor`.
        surfaces: also measure Hausdorff distances and silhouettes, which takes longer than a frame.
    """

    sequence: str
    view: str = "full"
    body: bool = False
    seed: int = 1
    variant: str = "default"
    frames: int | None = None
    first: int = 0
    segmented: bool = True
    points: int = 10_000
    noise: float = 0.003
    start: int | None = None
    disturbance: str | None = None
    drop: float = 0.0
    outliers: float = 0.0
    depth_noise: float = 0.0
    depth_step: float = 0.0
    fliers: float = 0.0
    occlude: tuple[int, int] | None = None
    occluded: float = 0.4
    every: int = 1
    surfaces: bool = False

    @classmethod
    def from_row(cls, row: dict) -> Trial:
        """The trial of a row. Fields that the row lacks have their defaults."""
        known = {field.name: row[field.name] for field in fields(cls) if field.name in row}
        return cls(**{name: tuple(value) if isinstance(value, list) else value for name, value in known.items()})


def sensor_of(trial: Trial) -> Sensor:
    return Sensor(**{field.name: getattr(trial, field.name) for field in fields(Sensor)})
