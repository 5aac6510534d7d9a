"""Recordings by name: the sample, those that ship, the collection, those under ``DDAKF_DATA``; and the frames of a trial."""

from __future__ import annotations

import os
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np

from ddakf import data
from ddakf.errors import InvalidArgument, nearest
from ddakf.evaluation.datasets import Pair, Recording, collection, load_faust, open_dataset
from ddakf.evaluation.trials.trial import PAIR_STEPS, Trial
from ddakf.files.sequence import Sequence, load_sequence

FAUST = "faust_"  # before the name of a clip
SAMPLE = "sample"  # the name of the recording that ships with the project
AT = "@"  # between the name of a recording and a number of frames per second


def recording_names() -> list[str]:
    """The bundled sample, and the recordings under DDAKF_DATA."""
    folder = _folder()
    return [SAMPLE, *(sorted(path.stem for path in folder.glob("*.npz")) if folder else [])]


@lru_cache(maxsize=8)
def find_recording(name: str) -> Sequence | Recording | Pair:
    """A recording by its name or path, see :func:`ddakf.evaluation.datasets.open_dataset`; ``NAME@60`` is :func:`at_rate` 60.

    Raises:
        InvalidArgument: neither a known name nor a path, or a rate of no sequence.
        InvalidFile: an unreadable file at the path.
    """
    base, at, rate = name.rpartition(AT)
    if at and rate.isdecimal():
        sequence = find_recording(base)
        if not isinstance(sequence, Sequence) or int(rate) == 0:
            raise InvalidArgument("sequence", "frames per second above 0 of a recording with truth, as in sample@60", repr(name))
        return at_rate(sequence, int(rate))
    if name == SAMPLE:
        return data.sample()
    if name.startswith(FAUST) and (archive := _faust()):
        return load_faust(archive).clip(name.removeprefix(FAUST))
    if place := _place(name):
        return open_dataset(place)
    if name in _training():
        return load_sequence(data.TRAINING / f"{name}.npz")
    if name in {each.name for each in collection.listed()}:
        return collection.load(name)
    file = _sequence_file(name)
    if file is None:
        known = [*recording_names(), *_training()]
        expected = f"a path, or one of {', '.join(known)} (DDAKF_DATA names a folder of more)"
        raise InvalidArgument("sequence", expected, repr(name) + nearest(name, known))
    return load_sequence(file)


def location(name: str) -> Path | None:
    """The file or folder in which :func:`find_recording` finds a recording; None of those that come with the project."""
    base, at, rate = name.rpartition(AT)
    if at and rate.isdecimal():
        return location(base)
    if name == SAMPLE:
        return None
    if name.startswith(FAUST) and (archive := _faust()):
        return archive
    if place := _place(name):
        return Path(place) if Path(place).exists() else Path(place.partition("#")[0])
    if name in _training() or name in {each.name for each in collection.listed()}:
        return None
    return _sequence_file(name)


def at_rate(sequence: Sequence, fps: int) -> Sequence:
    """The recording with so many frames per second. Between two of its frames garment and body move linearly."""
    last = len(sequence) - 1
    place = np.arange(int(last * fps / sequence.fps) + 1) * (sequence.fps / fps)
    before = np.minimum(place.astype(int), max(last - 1, 0))
    share = (place - before).astype(np.float32)[:, None, None]

    def between(vertices: np.ndarray | None) -> np.ndarray | None:
        if vertices is None:
            return None
        return (1 - share) * vertices[before] + share * vertices[np.minimum(before + 1, last)]

    moved = between(sequence.garment_vertices)
    return replace(sequence, garment_vertices=moved, body_vertices=between(sequence.body_vertices), fps=float(fps))


def faust_names() -> list[str]:
    """Names of FAUST's clips under DDAKF_DATA, as :func:`find_recording` takes them."""
    archive = _faust()
    return [FAUST + clip for clip in load_faust(archive).clips] if archive else []


def depth_recording_names() -> tuple[list[str], list[str]]:
    """Depth recordings without truth, and pairs with scene flow: paths relative to DDAKF_DATA, the same on every machine."""
    root = Path(os.environ.get("DDAKF_DATA") or os.devnull)
    depth = sorted(root.glob("depth/utd-mhad/*_depth.mat"))
    pairs = sorted(path for path in root.glob("depth/deepdeform/*") if path.is_dir())
    return [path.relative_to(root).as_posix() for path in depth], [path.relative_to(root).as_posix() for path in pairs]


def tracked_frames(trial: Trial) -> range:
    """The frames that a trial tracks, by their number in the recording."""
    known = find_recording(trial.sequence)
    if isinstance(known, Pair):
        return range(1, PAIR_STEPS + 1)
    last = len(known) - 1
    if trial.frames is not None:
        last = min(trial.first + trial.frames * trial.every, last)
    return range(trial.first + trial.every, last + 1, trial.every)


def _place(name: str) -> str | None:
    """The path that a name is, by itself or under DDAKF_DATA; with the part behind a ``#``."""
    root = os.environ.get("DDAKF_DATA")
    places = (name, str(Path(root, name))) if root else (name,)
    return next((place for place in places if Path(place.partition("#")[0]).exists()), None)


def _training() -> list[str]:
    return sorted(path.stem for path in data.TRAINING.glob("*.npz"))


def _sequence_file(name: str) -> Path | None:
    folder = _folder()
    file = folder and folder / f"{name}.npz"
    return file if file and file.is_file() else None


def _faust() -> Path | None:
    root = os.environ.get("DDAKF_DATA")
    return next(iter(sorted(Path(root, "faust").glob("*.npz"))), None) if root else None


def _folder() -> Path | None:
    root = os.environ.get("DDAKF_DATA")
    return Path(root, "sequences") if root else None
