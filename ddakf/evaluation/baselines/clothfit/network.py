"""ClothFit's network: a small perceptron for all vertices with outputs in local axes, and committees of them; NumPy only.

Of the vectors v_k of a vertex it sees what no rotation changes, their inner products, and the scalars; its outputs are the
coefficients a_k of the offset sum_k a_k v_k. The offset turns with the frame and is mirrored with it (Villar et al. 2021,
"Scalars are universal", show that any such function can be written so). Vectors that are there when nothing has changed since
the start count in it by as much as something has, so that a body that does not move leaves the garment in place.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ddakf.evaluation.baselines.clothfit.inputs import LENGTH, SCALARS, STILL, VECTORS, Inputs
from ddakf.evaluation.baselines.clothfit.settings import AnswerSettings

TINY = 1e-12  # against division by 0
UPPER = np.triu_indices(len(VECTORS))
INPUTS, OUTPUTS = len(UPPER[0]) + len(SCALARS), len(VECTORS)


def invariants(vectors: np.ndarray, scalars: np.ndarray) -> np.ndarray:
    """(Q, INPUTS) float32: inner products of the vectors (Q, K, 3), squashed by asinh, and the scalars (Q, S)."""
    vectors = np.asarray(vectors, np.float32)
    products = (vectors @ vectors.transpose(0, 2, 1))[:, UPPER[0], UPPER[1]]
    return np.concatenate([np.arcsinh(products), np.asarray(scalars, np.float32)], axis=1)


def basis(vectors: np.ndarray, gate: float) -> np.ndarray:
    """(Q, K, 3) float32 vectors that combine to the offset: the still vectors times c / (gate + c), then those of change; c^2 is
    the sum of the squares of the latter."""
    vectors = np.array(vectors, np.float32)
    change = np.sqrt(np.square(vectors[:, len(STILL) :]).sum(axis=(1, 2)))
    vectors[:, : len(STILL)] *= (change / np.maximum(gate + change, TINY))[:, None, None]
    return vectors


@dataclass(frozen=True, eq=False)
class Network:
    """Weights, all float32.

    Attributes:
        mean, sd: (INPUTS,) of the inputs; values farther off are clipped to :attr:`limit` standard deviations.
        layers: pairs of a matrix (in, out) and a bias (out,); x sigmoid(x) between them.
    """

    mean: np.ndarray
    sd: np.ndarray
    layers: tuple[tuple[np.ndarray, np.ndarray], ...]

    limit = 3.0

    @classmethod
    def zero(cls) -> Network:
        """The network that carries the garment with the body and adds nothing."""
        nothing = np.zeros((INPUTS, OUTPUTS), np.float32), np.zeros(OUTPUTS, np.float32)
        return cls(np.zeros(INPUTS, np.float32), np.ones(INPUTS, np.float32), (nothing,))

    def coefficients(self, inputs: np.ndarray) -> np.ndarray:
        """(Q, OUTPUTS) of invariants (Q, INPUTS)."""
        x = np.clip((inputs - self.mean) / self.sd, -self.limit, self.limit)
        for matrix, bias in self.layers[:-1]:
            x = x @ matrix + bias
            x /= 1 + np.exp(-np.clip(x, -60, 60))
        matrix, bias = self.layers[-1]
        return x @ matrix + bias

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays by the names under which they are saved."""
        named = {"mean": self.mean, "sd": self.sd}
        for k, (matrix, bias) in enumerate(self.layers):
            named |= {f"matrix{k}": matrix, f"bias{k}": bias}
        return named

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Network:
        """Inverse of :meth:`arrays`."""
        count = sum(name.startswith("matrix") for name in arrays)
        return cls(arrays["mean"], arrays["sd"], tuple((arrays[f"matrix{k}"], arrays[f"bias{k}"]) for k in range(count)))


@dataclass(frozen=True, eq=False)
class Committee:
    """Networks that learned from different recordings (Breiman 1996, "Bagging predictors"). They answer with their mean m, and
    the less of it the more they differ: m |m|^2 / (|m|^2 + caution s^2), s^2 the mean squared distance of their answers from
    it."""

    members: tuple[Network, ...]

    def offsets(self, inputs: Inputs, settings: AnswerSettings) -> np.ndarray:
        """(Q, 3) metres, in the frame's axes."""
        seen, vectors = invariants(inputs.vectors, inputs.scalars), basis(inputs.vectors, settings.gate)
        answers = np.array([np.einsum("qk,qka->qa", member.coefficients(seen), vectors) for member in self.members])
        mean = answers.mean(axis=0)
        square, spread = np.square(mean).sum(axis=1), np.square(answers - mean).sum(axis=2).mean(axis=0)
        return LENGTH * mean * (square / np.maximum(square + settings.caution * spread, TINY))[:, None]

    def arrays(self) -> dict[str, np.ndarray]:
        """Arrays by the names under which they are saved."""
        return {f"{k}.{name}": array for k, member in enumerate(self.members) for name, array in member.arrays().items()}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> Committee:
        """Inverse of :meth:`arrays`."""
        split: dict[int, dict[str, np.ndarray]] = {}
        for name, array in arrays.items():
            member, _, rest = name.partition(".")
            split.setdefault(int(member), {})[rest] = array
        return cls(tuple(Network.from_arrays(split[k]) for k in sorted(split)))
