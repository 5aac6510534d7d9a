"""What ClothFit learns from, and what not: recordings of garments with the body beneath, without what will be scored."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddakf import data
from ddakf.evaluation.baselines import Scored


class Source(NamedTuple):
    """A recording, not yet read."""

    scored: Scored  # its name, garment and motion
    path: Path
    shipped: bool  # with the project (CC0), and not only at hand


def sources() -> list[Source]:
    """Everything there is to learn from: the bundled sample, the simulations in ``ddakf/data/training``, and the recordings with
    a body in the folder ``sequences`` of DDAKF_DATA."""
    from ddakf.evaluation.protocols import scored  # which imports the baselines

    shipped = [data.SAMPLE, *sorted(data.SAMPLE.parent.glob("training/*.npz"))]
    root = os.environ.get("DDAKF_DATA")
    at_hand = sorted(Path(root, "sequences").glob("*.npz")) if root else []
    return [Source(scored(path.stem), path, path in shipped) for path in [*shipped, *at_hand] if _has_body(path)]


def allowed(scored: Scored, among: Iterable[Source]) -> list[Source]:
    """The sources without the scored sequence, its garment and its motion."""
    return [source for source in among if not any(a and a == b for a, b in zip(scored, source.scored, strict=True))]


def digest(path: Path) -> str:
    """SHA-256 of a file."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _has_body(path: Path) -> bool:
    """By the names in the archive, without reading it; what is none is read later, and then refused in a sentence."""
    if not zipfile.is_zipfile(path):
        return True
    with np.load(path, allow_pickle=False) as archive:
        return not {"body_F", "body_rotations"}.isdisjoint(archive.files)
