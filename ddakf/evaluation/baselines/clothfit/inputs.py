"""Inputs of ClothFit's network: names, units and arrays of what it reads and learns from."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.evaluation.baselines.clothfit.motion import SWINGS

LENGTH, ACCELERATION = 0.05, 10.0  # m, m/s^2: units of the vectors
CLOTH, CLOTH_REACHES = 32, (0.05, 0.12)  # samples of the garment, likewise; m
STILL = ("skin's normal", "offset", "cloth's normal", "down", "nearest skin's normal")
CHANGE = (
    "down since the start", "acceleration", "mean acceleration", *(f"swing of {frequency:g} Hz" for frequency, _ in SWINGS),
    *(f"cloth within {100 * reach:g} cm" for reach in CLOTH_REACHES), "body nearby",
)  # fmt: skip
VECTORS = STILL + CHANGE
SCALARS = ("distance", "height on the body", "height in the garment", "hem", "time", "depth")

class Inputs(NamedTuple):
    """Inputs of the network in one frame, for Q vertices."""

    carried: np.ndarray  # (Q, 3) m, in the world
    rotation: np.ndarray  # (Q, 3, 3) from the frame's axes to the world's
    vectors: np.ndarray  # (Q, len(VECTORS), 3) in the frame, in their units
    scalars: np.ndarray  # (Q, len(SCALARS)) in their units


class Examples(NamedTuple):
    """N vertices of some frames, float16, whose relative precision of 0.0005 exceeds that of a simulation."""

    vectors: np.ndarray  # (N, K, 3) as in :class:`.features.Inputs`
    scalars: np.ndarray  # (N, S) likewise
    offsets: np.ndarray  # (N, 3) of the truth from the carried place, in the frame, LENGTH
