"""Recordings that ship with ddakf (CC0): a sample, and simulated ones from which learned methods may learn."""

from __future__ import annotations

from pathlib import Path

from ddakf.files.sequence import Sequence, load_sequence

SAMPLE = Path(__file__).with_name("sample.npz")
TRAINING = Path(__file__).with_name("training")


def sample() -> Sequence:
    """A T-shirt: arm swing, twist, squat, crossed arms, raised arms; 150 frames, 30 per second; 2,658 garment and 5,502 body
    vertices."""
    return load_sequence(SAMPLE)


def training() -> list[Sequence]:
    """Garments in motion, about 900 vertices and 96 frames each, with the body; in the order of their names.

    ``garment`` and ``motion`` of each say what it is, so that a method that is scored on a garment can leave it out.
    """
    return [load_sequence(path) for path in sorted(TRAINING.glob("*.npz"))]
