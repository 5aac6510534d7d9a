"""Scope of the paper's evaluation: systems and their titles, seeds, levels of the sweeps, frames of the error maps."""

from __future__ import annotations

from collections.abc import Iterable

SYSTEMS = ("ddakf", "paper", "kf", "icp", "pf", "clothfit", "opt-ed", "nicp")
ALL_SYSTEMS = (*SYSTEMS, "icp-rigid")
CLOUD_SYSTEMS = tuple(name for name in ALL_SYSTEMS if name != "clothfit")  # systems that need no body
TITLES = {
    "kf": "Kalman filter", "icp": "ICP, non-rigid point-to-plane", "icp-rigid": "ICP, rigid", "pf": "particle filter",
    "clothfit": "ClothFit", "opt-ed": "Opt-ED", "nicp": "non-rigid ICP (ARAP)", "paper": "DD-AKF as printed", "ddakf": "DD-AKF",
}  # fmt: skip
ORDER = ("kf", "icp-rigid", "icp", "pf", "clothfit", "opt-ed", "nicp", "paper", "ddakf")

RUNS = 5  # seeds per cell
NOISE_MM = (0, 1, 3, 5)  # Table 5
DROP_PERCENT = (0, 10, 20, 30, 40)  # Table 6
ERROR_MAPS = {  # figure: view, noise in metres, recording, frame
    "figure-1": ("front+body", 0.003, "sample", 110),
    "figure-2": ("full+body", 0.010, "skirt_walk", 60),
}


def ordered(methods: Iterable[str]) -> list[str]:
    """Systems in the order of the paper's columns, others at the end."""
    methods = list(methods)
    return [m for m in ORDER if m in methods] + [m for m in methods if m not in ORDER]
