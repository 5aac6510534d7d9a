"""Collection of simulated recordings: what its manifest says of each, and the recordings by name.

The collection lies in ``benchmarks/recordings`` of a source checkout, or where DDAKF_RECORDINGS points; wheels do not have it.
Recordings of the split ``held-out`` are for scores alone: no constant, weight or setting may be fitted to them. Those of
``fresh`` were simulated when all was fixed and scored then; later scores are of later trackers.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import dataclass, fields
from pathlib import Path

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.files.sequence import Sequence, load_sequence

VARIABLE = "DDAKF_RECORDINGS"
CHECKOUT = Path(__file__).resolve().parents[3] / "benchmarks/recordings"
MANIFEST = "manifest.json"
TRAINING, HELD_OUT, FRESH = "training", "held-out", "fresh"
SPLITS = TRAINING, HELD_OUT, FRESH


@dataclass(frozen=True)
class Listed:
    """A recording as the manifest lists it.

    Attributes:
        name: of the file, without its ending.
        garment, fit, fabric, motion: what was simulated.
        split: one of :data:`SPLITS`.
        seed: of the garment's measures, the body's shape and the motion.
        sha256: of the file.
    """

    name: str
    garment: str
    fit: str
    fabric: str
    motion: str
    split: str
    seed: int
    sha256: str


def folder() -> Path:
    """Folder of the collection; it need not exist."""
    return Path(os.environ.get(VARIABLE) or CHECKOUT)


def listed(split: str | None = None, where: Path | None = None) -> list[Listed]:
    """The recordings of the collection, in the order in which they were planned; none without a manifest.

    Args:
        split: only those of this split.
        where: folder of the collection, default :func:`folder`.

    Raises:
        InvalidArgument: no such split. InvalidFile: a manifest that cannot be read.
    """
    if split not in (None, *SPLITS):
        raise InvalidArgument("split", f"one of {', '.join(SPLITS)}", repr(split))
    path = (where or folder()) / MANIFEST
    if not path.is_file():
        return []
    names = [field.name for field in fields(Listed)]
    try:
        rows = json.loads(path.read_text())["recordings"]
        found = [Listed(*(row[name] for name in names)) for row in rows]
    except (ValueError, KeyError, TypeError) as error:
        raise InvalidFile(str(path), "a manifest of recordings", f"{type(error).__name__}: {error!s:.100}") from error
    return [each for each in found if split in (None, each.split)]


def load(name: str, where: Path | None = None) -> Sequence:
    """A recording of the collection.

    Raises:
        InvalidArgument, InvalidFile: as :func:`file_of`; or a file that cannot be read.
    """
    return load_sequence(file_of(name, where))


def file_of(name: str, where: Path | None = None) -> Path:
    """Where a recording of the collection is, whose content is the one that the manifest lists.

    Raises:
        InvalidArgument: no such recording. InvalidFile: a file that is not there, or not the one that the manifest lists.
    """
    where = where or folder()
    known = {each.name: each for each in listed(where=where)}
    if name not in known:
        raise InvalidArgument("recording", f"one of the {len(known)} of {where / MANIFEST}", repr(name))
    path = where / f"{name}.npz"
    if not path.is_file():
        raise InvalidFile(str(path), "the recording that the manifest lists", "nothing there")
    if (found := checksum(path)) != known[name].sha256:
        raise InvalidFile(path.name, f"SHA-256 {known[name].sha256[:12]}... as in {MANIFEST}", f"{found[:12]}...")
    return path


def checksum(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal digits."""
    return hashlib.sha256(path.read_bytes()).hexdigest()
