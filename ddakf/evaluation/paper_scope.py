"""Scope of the paper's evaluation: systems and their titles, seeds, levels of the sweeps, frames of the error maps."""

from __future__ import annotations

from collections.abc import Iterable

SYSTEMS = ("ddakf", "paper", "kf", "icp", "pf", "clothfit", "opt-ed", "nicp")
REFERENCES = ("still", "carried")  # use no cloud: what a tracker must beat to bring anything
ALL_SYSTEMS = (*SYSTEMS, "printed", "icp-rigid", *REFERENCES)
CLOUD_SYSTEMS = tuple(name for name in ALL_SYSTEMS if name not in ("clothfit", "carried"))  # systems that need no body
CONDITIONS = {"full": "points all around", "front": "one camera", "front+body": "one camera, body given"}  # of every study
TITLES = {
    "kf": "Kalman filter", "icp": "ICP, non-rigid point-to-plane", "icp-rigid": "ICP, rigid", "pf": "particle filter",
    "clothfit": "ClothFit", "opt-ed": "Opt-ED", "nicp": "non-rigid ICP (ARAP)",
    "paper": "DD-AKF as printed, the preset", "printed": "DD-AKF as printed, best",
    "ddakf": "DD-AKF",
    "still": "do nothing", "carried": "carried by the body",
}  # fmt: skip
ORDER = ("still", "carried", "kf", "icp-rigid", "icp", "pf", "clothfit", "opt-ed", "nicp", "paper", "printed", "ddakf")

RUNS = 5  # seeds per cell
NOISE_MM = (0, 1, 3, 5)  # Table 5
DROP_PERCENT = (0, 10, 20, 30, 40)  # Table 6
OUTLIER_PERCENT = (0, 10, 20)
RATE, EVERY = 30, (1, 2, 3)  # frames per second of the recordings that are swept, of which every n-th is seen
ERROR_MAPS = {  # figure: view, noise in metres, recording, frame; of untouched recordings
    "figure-1": ("front+body", 0.003, "tshirt_run_loose_19", 80),
    "figure-2": ("full", 0.010, "skirt_crossed-arms_loose_31", 80),
}


def ordered(methods: Iterable[str]) -> list[str]:
    """Systems in the order of the paper's columns, others at the end."""
    methods = list(methods)
    return [m for m in ORDER if m in methods] + [m for m in methods if m not in ORDER]
