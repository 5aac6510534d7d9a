"""Configuration of the start and of the search for a garment without a track."""

from __future__ import annotations

from dataclasses import dataclass

from ddakf.config.checked import Checked, bounded


@dataclass(frozen=True)
class Start(Checked):
    """Knowledge before the first frame."""

    sd: float = bounded(0.003, 1e-6, 10)  # m, of the start's position
    speed_sd: float = bounded(0.5, 1e-6, 100)  # m/s, of its velocity
    search: bool = True  # search for the garment when the first cloud, or the first after a loss, lies elsewhere
    least_points: int = bounded(100, 1, 1_000_000)  # points of a cloud that is searched
