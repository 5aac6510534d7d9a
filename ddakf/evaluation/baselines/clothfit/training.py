"""Training of ClothFit's network, in PyTorch on one thread: seeded, and the same again on the same machine."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ddakf.errors import NotApplicable
from ddakf.evaluation.baselines.clothfit.examples import Examples, Stretches
from ddakf.evaluation.baselines.clothfit.network import INPUTS, OUTPUTS, Network

Progress = Callable[[int, int, str], None]  # done, of how many, what


@dataclass(frozen=True)
class Settings:
    """Numbers of the training.

    Attributes:
        cut: of every recording.
        hidden: width of the two hidden layers.
        steps: on the recordings that ship.
        tuning_steps: after them, on those and the recordings at hand, half of each batch from either.
        batch: examples of a step, as many from each recording.
        rate, tuning_rate: of learning, at the most; it rises and falls over the steps of either.
        decay: of the weights (AdamW).
        robust: LENGTH; larger errors count linearly.
        seed: of everything.
    """

    cut: Stretches = field(default_factory=Stretches)
    hidden: int = 96
    steps: int = 3000
    tuning_steps: int = 1000
    batch: int = 2048
    rate: float = 3e-3
    tuning_rate: float = 5e-4
    decay: float = 1e-2
    robust: float = 0.2
    seed: int = 0


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


def fit(shipped: list[Examples], at_hand: list[Examples], settings: Settings, progress: Progress) -> tuple[Network, list[float]]:
    """Trains a network, and then tunes it.

    Args:
        shipped: one per recording; to train on.
        at_hand: likewise, to tune on; trained on where nothing ships.
        settings: see :class:`Settings`.
        progress: is told of every step.

    Returns:
        The network, and the loss of every step: the mean over the batch of sqrt(|error|^2 + robust^2) in LENGTH.
    """
    t = torch()
    t.manual_seed(settings.seed)
    inputs = np.concatenate([part.inputs for part in [*shipped, *at_hand]])
    mean, sd = inputs.mean(axis=0), inputs.std(axis=0) + 1e-3
    layers = [t.nn.Linear(INPUTS, settings.hidden), t.nn.Linear(settings.hidden, settings.hidden)]
    last = t.nn.Linear(settings.hidden, OUTPUTS)
    t.nn.init.zeros_(last.weight)
    t.nn.init.zeros_(last.bias)
    silu = t.nn.SiLU()
    net = t.nn.Sequential(layers[0], silu, layers[1], silu, last)
    rng, losses = np.random.default_rng(settings.seed), []
    whole = settings.steps + settings.tuning_steps

    def phase(groups: list[list[Examples]], steps: int, rate: float, what: str) -> None:
        groups = [group for group in groups if group]
        optimiser = t.optim.AdamW(net.parameters(), lr=rate, weight_decay=settings.decay)
        schedule = t.optim.lr_scheduler.OneCycleLR(optimiser, rate, total_steps=steps)
        for _ in range(steps):
            x, vectors, offsets = map(t.from_numpy, _batch(groups, settings.batch, rng))
            x = ((x - t.from_numpy(mean)) / t.from_numpy(sd)).clamp(-Network.limit, Network.limit)
            error = (net(x)[:, :, None] * vectors).sum(dim=1) - offsets
            loss = ((error**2).sum(dim=1) + settings.robust**2).sqrt().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(float(loss.detach()))
            progress(len(losses), whole, what)

    phase([shipped or at_hand], settings.steps, settings.rate, "training")
    if shipped and at_hand:
        phase([shipped, at_hand], settings.tuning_steps, settings.tuning_rate, "tuning")
    arrays = [(layer.weight.detach().numpy().T.copy(), layer.bias.detach().numpy().copy()) for layer in [*layers, last]]
    return Network(mean, sd, tuple(arrays)), losses


def _batch(groups: list[list[Examples]], size: int, rng: np.random.Generator) -> Examples:
    """As many examples from every group, and within it from every recording."""
    chosen = []
    for group in groups:
        for part in group:
            row = rng.integers(0, len(part.inputs), max(size // (len(groups) * len(group)), 1))
            chosen.append(Examples(*(array[row] for array in part)))
    return Examples(*(np.concatenate(arrays) for arrays in zip(*chosen, strict=True)))
