"""What ClothFit learns from, and what not: garments in motion with the body beneath, without what will be scored."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddakf import data
from ddakf.evaluation.baselines.clothfit.rehearsal import Part, parts
from ddakf.evaluation.splits import RecordingLabels, labels_of, labels_of_file


class Source(NamedTuple):
    """A recording, not yet read, or not yet made."""

    labels: RecordingLabels  # its name, garment and motion
    what: Path | Part
    at_hand: bool = False  # and not the project's own (CC0)

    @property
    def digest(self) -> str:
        """Of what it is made from."""
        made_from = repr(self.what).encode() if isinstance(self.what, Part) else self.what.read_bytes()
        return hashlib.sha256(made_from).hexdigest()


def sources() -> list[Source]:
    """Everything there is to learn from: rehearsals, the bundled sample, those that ship for learning, and the
    recordings with a body in the folder ``sequences`` of DDAKF_DATA."""
    rehearsed = [Source(labels_of(part.name)._replace(name=f"rehearsed {part.name}"), part) for part in parts()]
    shipped = [data.SAMPLE, *sorted(data.TRAINING.glob("*.npz"))]
    root = os.environ.get("DDAKF_DATA")
    at_hand = sorted(Path(root, "sequences").glob("*.npz")) if root else []
    read = [Source(labels_of_file(path), path, path in at_hand) for path in [*shipped, *at_hand] if _has_body(path)]
    return [*rehearsed, *read]


def allowed(scored: RecordingLabels, among: Iterable[Source]) -> list[Source]:
    """The sources without the scored sequence, its garment and its motion."""
    return [source for source in among if not any(a and a == b for a, b in zip(scored, source.labels, strict=True))]


def _has_body(path: Path) -> bool:
    """By the names in the archive, without reading it; what is none is read later, and then refused in a sentence."""
    if not zipfile.is_zipfile(path):
        return True
    with np.load(path, allow_pickle=False) as archive:
        return not {"body_F", "body_rotations"}.isdisjoint(archive.files)
