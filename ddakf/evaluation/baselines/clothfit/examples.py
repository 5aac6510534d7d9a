"""Training examples: stretches of a recording, each tracked from its own first frame on as in use."""

from __future__ import annotations

import numpy as np

from ddakf.evaluation.baselines.clothfit.features import Features
from ddakf.evaluation.baselines.clothfit.inputs import LENGTH, Examples
from ddakf.evaluation.baselines.clothfit.settings import Stretches
from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh


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
