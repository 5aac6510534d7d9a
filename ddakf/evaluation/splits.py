"""Splits of the data into training and test: FAUST by subject, garments by category.

The paper leaves subjects out of FAUST (training on 8, testing on the other 2) and garment categories out of CLOTH3D. A method
that learns gets the :class:`RecordingLabels` of the scored recording, and excludes it from its training.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

from ddakf.evaluation.datasets import collection
from ddakf.evaluation.datasets.faust import CLIP
from ddakf.files.sequence import Sequence, read_names

FAUST_TRAINING_SUBJECTS = frozenset(range(8))  # as in the paper, which tests on the other two
FAUST_NAME = re.compile(r"(?:faust_|#)s(\d+)_p\d+$")
UNTOUCHED, TUNED = "untouched", "tuned"
BODY = "whole body"
# Words of a garment's or a sequence's name. CLOTH3D's garments are Tshirt, Top, Trousers, Skirt, Jumpsuit and Dress.
# The recordings of some origins have one garment only.
CATEGORIES = {
    "T-shirt": ("tshirt", "shirt", "tee"),
    "tank top": ("tank", "top", "vest"),
    "skirt": ("skirt",),
    "dress": ("dress", "robe", "gown"),
    "trousers": ("trousers", "pants", "shorts"),
    "jumpsuit": ("jumpsuit", "overall"),
    "jacket": ("jacket", "hoodie", "coat"),
    "cape": ("cape", "poncho"),
    BODY: ("whole", "body"),
}
ORIGINS = {"sample": "T-shirt", "pergamo": "T-shirt", "faust": BODY}
WITHOUT_LIMBS = frozenset({"tank", "top", "skirt", "dress", "cape"})  # words of garments without sleeves and legs
MADE_BY = frozenset({"sim", "simulated"})  # words that name neither garment nor motion


class RecordingLabels(NamedTuple):
    """Name, garment category and motion of a recording; empty where unknown. Trained methods exclude what shares one of them."""

    name: str = ""  # of the sequence
    garment: str = ""
    motion: str = ""


NO_LABELS = RecordingLabels()


class Split(NamedTuple):
    """Names of sequences to train on and to score."""

    train: tuple[str, ...]
    test: tuple[str, ...]


def labels_of(sequence: Sequence | str) -> RecordingLabels:
    """The labels of a sequence, or of a sequence's name: its garment's category and its motion.

    The sequence's own garment and motion come first, then its name: ``sim_skirt_dance`` is a skirt and a dance, ``samba_dress``
    and ``samba_whole`` have one motion. A name without a category is a category of its own.
    """
    if isinstance(sequence, str):
        return RecordingLabels(sequence, *_by_name(sequence))
    return _labels(sequence.name, sequence.garment, sequence.motion)


def labels_of_file(path: Path) -> RecordingLabels:
    """:func:`labels_of` a sequence file, of which only garment and motion are read.

    Raises:
        InvalidFile: not a sequence file, or names without words.
    """
    return _labels(path.stem, *read_names(path))


def _labels(name: str, garment: str, motion: str) -> RecordingLabels:
    words = _words(garment)
    by_name = _by_name(name)
    return RecordingLabels(name, _category(words) or "_".join(words) or by_name[0], "_".join(_words(motion)) or by_name[1])


def _by_name(name: str) -> tuple[str, str]:
    """Garment and motion."""
    words = [word for word in _words(name) if word not in MADE_BY]
    if words and words[0] == "faust":
        return BODY, words[-1]
    if category := _category(words):
        return category, "_".join(word for word in words if word not in CATEGORIES[category]) or name
    return next((ORIGINS[word] for word in words if word in ORIGINS), name), "_".join(words)


def _category(words: list[str]) -> str | None:
    return next((category for category, known in CATEGORIES.items() if any(word in known for word in words)), None)


def _words(text: str) -> list[str]:
    return [word for word in re.split(r"[^a-z0-9]+", text.lower()) if word]


def unit_of(sequence: str) -> str:
    """The unit of a test: the sequence, or of a clip of FAUST (``faust_s3_p7``, ``MPI-FAUST#s3_p7``) its subject."""
    base, _, rate = sequence.rpartition("@")
    recording = base if rate.isdecimal() and base else sequence  # at whichever rate
    found = FAUST_NAME.search(recording)
    return f"FAUST, subject {found[1]}" if found else recording


def turns_unseen(sequence: str) -> bool:
    """True for garments without sleeves and legs, by their names: turned about the vertical they look alike."""
    return bool(WITHOUT_LIMBS & set(_words(sequence)))


def is_untouched(sequence: str) -> bool:
    """True for the held-out and the fresh recordings of the collection, at any rate: no constant was fitted to them."""
    return Path(sequence).name.partition("@")[0].removesuffix(".npz") in _untouched()


def standing_of(sequence: str) -> str:
    """:data:`UNTOUCHED` or :data:`TUNED`."""
    return UNTOUCHED if is_untouched(sequence) else TUNED


@lru_cache(maxsize=1)
def _untouched() -> frozenset[str]:
    return frozenset(each.name for each in collection.listed() if each.split != collection.TRAINING)


def faust_split(clips: Iterable[str]) -> Split:
    """Clips of FAUST (``s3_p7``) in the paper's split: subjects 0 to 7 for training, the rest for the test."""
    clips = tuple(clips)
    train = tuple(clip for clip in clips if int(CLIP.fullmatch(clip)[1]) in FAUST_TRAINING_SUBJECTS)
    return Split(train, tuple(clip for clip in clips if clip not in train))
