"""What is trained on and what is scored: FAUST by subject, garments by category.

The paper leaves subjects out of FAUST (training on 8, testing on the other 2) and garment categories out of CLOTH3D. A method
that learns is told by a :class:`Scored` what it is about to be scored on, and leaves it out.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

from ddakf.evaluation.datasets.faust import CLIP
from ddakf.files.sequence import Sequence, read_names

FAUST_TRAINING_SUBJECTS = frozenset(range(8))
BODY = "whole body"
# By the words of a garment, or of a sequence's name; CLOTH3D's garments are Tshirt, Top, Trousers, Skirt, Jumpsuit and Dress.
# Some recordings are named by where they are from, and hold one garment.
CATEGORIES = {
    "T-shirt": ("tshirt", "shirt", "tee"),
    "tank top": ("tank", "top", "vest"),
    "skirt": ("skirt",),
    "dress": ("dress", "robe", "gown"),
    "trousers": ("trousers", "pants", "shorts"),
    "jumpsuit": ("jumpsuit", "overall"),
    "jacket": ("jacket", "hoodie", "coat"),
    BODY: ("whole", "body"),
}
ORIGINS = {"sample": "T-shirt", "pergamo": "T-shirt", "faust": BODY}
MADE_BY = frozenset({"sim", "simulated"})  # words that say neither garment nor motion


class RecordingLabels(NamedTuple):
    """What a method is about to be scored on; empty where nobody says. Only what was trained looks at it, to leave it out."""

    name: str = ""  # of the sequence
    garment: str = ""
    motion: str = ""


NO_LABELS = RecordingLabels()


class Split(NamedTuple):
    """Names of sequences to train on and to score."""

    train: tuple[str, ...]
    test: tuple[str, ...]


def labels_of(sequence: Sequence | str) -> RecordingLabels:
    """What scoring on a sequence, or on one of that name, means: its garment's category and its motion.

    A sequence that says its garment or motion is believed. What it leaves open is read off the name: ``sim_skirt_dance`` is a
    skirt and a dance, ``samba_dress`` and ``samba_whole`` one motion. A name that says no category is one of its own.
    """
    if isinstance(sequence, str):
        return RecordingLabels(sequence, *_by_name(sequence))
    return _said(sequence.name, sequence.garment, sequence.motion)


def labels_of_file(path: Path) -> RecordingLabels:
    """:func:`scored` of a sequence file, of which only the two names are read.

    Raises:
        InvalidFile: not a sequence file, or names that are no words.
    """
    return _said(path.stem, *read_names(path))


def _said(name: str, garment: str, motion: str) -> RecordingLabels:
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


def faust_split(clips: Iterable[str]) -> Split:
    """Clips of FAUST (``s3_p7``) as the paper parts them: those of subjects 0 to 7 to train on, the rest to score."""
    clips = tuple(clips)
    train = tuple(clip for clip in clips if int(CLIP.fullmatch(clip)[1]) in FAUST_TRAINING_SUBJECTS)
    return Split(train, tuple(clip for clip in clips if clip not in train))
