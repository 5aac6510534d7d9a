"""Examples to learn from: stretches of a recording, each carried from its own first frame on as in use."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ddakf.evaluation.baselines.clothfit.features import LENGTH, Features
from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh


@dataclass(frozen=True)
class Stretches:
    """How a recording is cut.

    Attributes:
        count: of stretches, which begin at even distances and overlap.
        frames: of each, at most.
        every: one frame in so many is learned from; the motion is followed through all.
        vertices: of each, chosen at random.
        shortest: frames; a recording needs one more.
    """

    count: int = 8
    frames: int = 75
    every: int = 3
    vertices: int = 400
    shortest: int = 30


class Examples(NamedTuple):
    """N vertices of some frames, float16: half of a thousandth is more than a simulation knows."""

    vectors: np.ndarray  # (N, K, 3) as in :class:`.features.Inputs`
    scalars: np.ndarray  # (N, S) likewise
    offsets: np.ndarray  # (N, 3) of the truth from the carried place, in the frame, LENGTH


def examples(sequence: Sequence, cut: Stretches, seed: int) -> Examples:
    """Cuts a recording with a body into examples; the same seed chooses the same vertices."""
    rng, garment = np.random.default_rng(seed), Mesh(sequence.template, sequence.garment_faces)
    latest = max(len(sequence) - 1 - cut.shortest, 0)
    firsts = np.unique(np.linspace(0, latest, cut.count).astype(int))
    parts = [part for first in firsts for part in _stretch(sequence, garment, int(first), cut, rng)]
    return Examples(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _stretch(sequence: Sequence, garment: Mesh, first: int, cut: Stretches, rng: np.random.Generator) -> list[Examples]:
    queries = np.sort(rng.permutation(garment.n_vertices)[: cut.vertices])
    body = Mesh(sequence.body_vertices[first], sequence.body_faces)
    features, parts = Features(garment, sequence.garment_vertices[first], body, queries), []
    for number in range(first + 1, min(first + cut.frames, len(sequence))):
        inputs = features.step(sequence.body_vertices[number], sequence.timestamp(number))
        if (number - first) % cut.every == 1 % cut.every:
            away = sequence.garment_vertices[number][queries] - inputs.carried
            offset = np.einsum("qba,qb->qa", inputs.rotation, away) / LENGTH
            parts.append(Examples(*(array.astype(np.float16) for array in (inputs.vectors, inputs.scalars, offset))))
    return parts
