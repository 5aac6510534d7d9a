"""The recording that ships with ddakf: a simulated T-shirt on a moving body, 150 frames, 30 per second (CC0)."""

from __future__ import annotations

from pathlib import Path

from ddakf.sequence import Sequence, load_sequence

SAMPLE = Path(__file__).with_name("sample.npz")


def sample() -> Sequence:
    """Arm swing, twist, squat, crossed arms, raised arms; 2,658 garment and 5,502 body vertices."""
    return load_sequence(SAMPLE)
