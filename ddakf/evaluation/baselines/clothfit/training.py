"""Training of ClothFit's network, in PyTorch on one thread: seeded, and the same again on the same machine."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np

from ddakf.errors import NotApplicable
from ddakf.evaluation.baselines.clothfit.inputs import Examples
from ddakf.evaluation.baselines.clothfit.network import INPUTS, OUTPUTS, Committee, Network, basis, invariants
from ddakf.evaluation.baselines.clothfit.settings import TrainingSettings

SAMPLED = 8  # stride of the examples for the mean and spread of the inputs
SMALLEST_SD = np.float32(1e-3)  # of an input
Progress = Callable[[int, int, str], None]  # done, of how many, what


def torch():
    """PyTorch, on one thread.

    Raises:
        NotApplicable: it is not installed.
    """
    try:
        import torch
    except ImportError as error:
        sentence = "clothfit has to be trained for this, and torch is not installed: pip install 'ddakf[learned]'"
        raise NotApplicable(sentence) from error
    torch.set_num_threads(1)
    return torch


def committee(own: list[Examples], external: list[Examples], settings: TrainingSettings, progress: Progress) -> Committee:
    """Trains :attr:`.settings.TrainingSettings.members` networks, each without its share of the recordings; see :func:`fit`."""
    count, whole, members = settings.members, settings.members * (settings.steps + settings.tuning_steps), []
    for member in range(count):
        done = member * (settings.steps + settings.tuning_steps)
        parts = [[part for k, part in enumerate(group) if k % count != member or len(group) < count] for group in (own, external)]

        def step(number: int, what: str, done: int = done) -> None:
            progress(done + number, whole, what)

        members.append(fit(*parts, settings, settings.seed + member, step)[0])
    return Committee(tuple(members))


def fit(
    own: list[Examples], external: list[Examples], settings: TrainingSettings, seed: int, progress: Callable[[int, str], None]
) -> tuple[Network, list[float]]:
    """Trains a network, and then tunes it.

    Args:
        own: the project's recordings, to train on.
        external: others, to tune on; trained on where there are none of the first kind.
        settings: see :class:`.settings.TrainingSettings`.
        seed: of this network.
        progress: called after every step.

    Returns:
        The network, and the loss of every step: the mean over the batch of sqrt(|error|^2 + robust^2) in LENGTH.
    """
    t = torch()
    t.manual_seed(seed)
    mean, sd = _spread_of_inputs([*own, *external])
    sizes = INPUTS, settings.hidden, settings.hidden, OUTPUTS
    layers = [t.nn.Linear(a, b) for a, b in pairwise(sizes)]
    t.nn.init.zeros_(layers[-1].weight)
    t.nn.init.zeros_(layers[-1].bias)
    net = t.nn.Sequential(layers[0], t.nn.SiLU(), layers[1], t.nn.SiLU(), layers[2])
    rng, losses, middle, scale = np.random.default_rng(seed), [], t.from_numpy(mean), t.from_numpy(sd)

    def phase(groups: list[list[Examples]], steps: int, rate: float, what: str) -> None:
        optimiser = t.optim.AdamW(net.parameters(), lr=rate, weight_decay=settings.decay)
        schedule = t.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps)
        for _ in range(steps):
            drawn = _batch(groups, settings.batch, rng)
            seen, vectors, offsets = invariants(drawn.vectors, drawn.scalars), basis(drawn.vectors, settings.gate), drawn.offsets
            x = ((t.from_numpy(seen) - middle) / scale).clamp(-Network.limit, Network.limit)
            error = (net(x)[:, :, None] * t.from_numpy(vectors)).sum(dim=1) - t.from_numpy(offsets.astype(np.float32))
            loss = ((error**2).sum(dim=1) + settings.robust**2).sqrt().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(float(loss.detach()))
            progress(len(losses), what)

    phase([own or external], settings.steps, settings.rate, "training")
    if own and external:
        phase([own, external], settings.tuning_steps, settings.tuning_rate, "tuning")
    arrays = [(layer.weight.detach().numpy().T.copy(), layer.bias.detach().numpy().copy()) for layer in layers]
    return Network(mean, sd, tuple(arrays)), losses


def _spread_of_inputs(parts: list[Examples]) -> tuple[np.ndarray, np.ndarray]:
    """(INPUTS,) mean and standard deviation of the network's inputs, float32; the latter never 0."""
    count, total, squares = 0, np.zeros(INPUTS), np.zeros(INPUTS)
    for part in parts:
        seen = invariants(part.vectors[::SAMPLED], part.scalars[::SAMPLED]).astype(np.float64)
        count, total, squares = count + len(seen), total + seen.sum(axis=0), squares + np.square(seen).sum(axis=0)
    mean = total / count
    sd = np.sqrt(np.maximum(squares / count - mean**2, 0))
    return mean.astype(np.float32), sd.astype(np.float32) + SMALLEST_SD


def _batch(groups: list[list[Examples]], size: int, rng: np.random.Generator) -> Examples:
    """A batch with equal numbers of examples from every group, and within it from every recording."""
    chosen = []
    for group in groups:
        for part in group:
            row = rng.integers(0, len(part.vectors), max(size // (len(groups) * len(group)), 1))
            chosen.append(Examples(*(array[row] for array in part)))
    return Examples(*(np.concatenate(arrays) for arrays in zip(*chosen, strict=True)))
