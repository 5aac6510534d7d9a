"""Configuration of the plausibility of the input."""

from __future__ import annotations

from dataclasses import dataclass

from ddakf.config.checked import Checked, bounded


@dataclass(frozen=True)
class Sidedness(Checked):
    """The side that a cloud without a sensor origin was seen from: along that direction it has one layer."""

    estimate: bool = True  # the estimated side takes the place of a missing sensor origin
    interval: int = bounded(8, 1, 1000)  # frames from one look at the cloud to the next
    points: int = bounded(1500, 100, 10_000)  # most points of a cloud that are looked at
    least_points: int = bounded(400, 100, 10_000)  # least points near the garment that tell one layer from two
    directions: int = bounded(32, 4, 128)  # number of directions along which a cloud is looked at, spread over a half-sphere
    points_per_cell: float = bounded(4.0, 1, 100)  # points of a cell in a garment seen all around, which sets its width
    gap: float = bounded(1.5, 0.1, 10)  # in cells: a point deeper than that behind another is of a second layer
    one_sided: float = bounded(0.12, 0, 1)  # share of the points in a second layer, below which a cloud shows one side
    all_sides: float = bounded(0.2, 0, 1)  # the same, above which it shows more
    plateau: float = bounded(0.02, 0, 1)  # directions with so much more in a second layer are as good as the best
    memory: float = bounded(0.5, 0, 1)  # share that the looks before have in the running means
    distance: float = bounded(20.0, 1, 1e4)  # m from the cloud to the place where its sensor is assumed
    blind_error: float = bounded(0.06, 0, 10)  # m, least error of a one-sided cloud without an origin, and of a garment not found
    margin: float = bounded(0.3, 0, 100)  # m around the garment; farther points do not count


@dataclass(frozen=True)
class SensorPoses(Checked):
    """How far each of several sensors is misplaced, from the places where two of them see the same surface."""

    sd: float = bounded(0.01, 0, 1)  # m, of a sensor's place in each direction; 0: sensors are where they are said to be
    distance_sd: float = bounded(0.01, 1e-4, 1)  # m, of the distance between two sensors' surfaces around one point
    memory: float = bounded(3.0, 0.1, 1e4)  # s, time constant with which looks are forgotten
    interval: int = bounded(3, 1, 1000)  # frames from one look to the next
    points: int = bounded(8000, 100, 100_000)  # near the garment that are looked at, at most about
    neighbourhoods: int = bounded(400, 10, 10_000)  # of these points around which surfaces are compared, at most about
    radius: float = bounded(0.03, 0.005, 0.2)  # m, of such a neighbourhood; up to twice that where points are few
