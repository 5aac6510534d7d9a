"""Library of ClothFit's training data: garments in motion on a body, without the scored recording and its like."""

from __future__ import annotations

import hashlib
import os
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddakf import data
from ddakf.evaluation.baselines.clothfit.rehearsal import Rehearsal, rehearsals
from ddakf.evaluation.splits import RecordingLabels, labels_of, labels_of_file


class Source(NamedTuple):
    """A training recording: a file not yet read, or a rehearsal not yet simulated."""

    labels: RecordingLabels
    origin: Path | Rehearsal
    external: bool = False  # from DDAKF_DATA, not the project's own (CC0)

    @property
    def digest(self) -> str:
        """Hash of the file, or of the rehearsal's fields."""
        made_from = repr(self.origin).encode() if isinstance(self.origin, Rehearsal) else self.origin.read_bytes()
        return hashlib.sha256(made_from).hexdigest()


def sources() -> list[Source]:
    """All training data: rehearsals, the bundled sample, the training recordings that ship, and the recordings with a body in
    the folder ``sequences`` of DDAKF_DATA."""
    rehearsed = [Source(labels_of(one.name)._replace(name=f"rehearsed {one.name}"), one) for one in rehearsals()]
    shipped = [data.SAMPLE, *sorted(data.TRAINING.glob("*.npz"))]
    root = os.environ.get("DDAKF_DATA")
    external = sorted(Path(root, "sequences").glob("*.npz")) if root else []
    read = [Source(labels_of_file(path), path, path in external) for path in [*shipped, *external] if _has_body(path)]
    return [*rehearsed, *read]


def without_scored(scored: RecordingLabels, among: Iterable[Source]) -> list[Source]:
    """The sources without the scored sequence, its garment and its motion."""
    return [source for source in among if not any(a and a == b for a, b in zip(scored, source.labels, strict=True))]


def _has_body(path: Path) -> bool:
    """True if the archive lists a body; arrays are not read. True also for a file that is no archive, whose loader refuses it."""
    if not zipfile.is_zipfile(path):
        return True
    with np.load(path, allow_pickle=False) as archive:
        return not {"body_F", "body_rotations"}.isdisjoint(archive.files)
