"""Trained weights, kept in the user's cache by what they were made from; made where they are not there."""

from __future__ import annotations

import hashlib
import json
import os
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile, NotApplicable
from ddakf.evaluation.baselines import Scored
from ddakf.evaluation.baselines.clothfit import library
from ddakf.evaluation.baselines.clothfit.examples import Examples, examples
from ddakf.evaluation.baselines.clothfit.library import Source
from ddakf.evaluation.baselines.clothfit.network import INPUTS, OUTPUTS, Network
from ddakf.evaluation.baselines.clothfit.training import Progress, Settings, fit, torch
from ddakf.sequence import load_sequence


def folder() -> Path:
    """Where weights are kept: DDAKF_CACHE, or ``ddakf`` in the user's cache folder."""
    chosen = os.environ.get("DDAKF_CACHE")
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(chosen) if chosen else Path(home, "ddakf")


def key(chosen: list[Source], settings: Settings) -> str:
    """Of the code, the settings and the data that weights are made from; what is left out is not among these."""
    code = [library.digest(path) for path in sorted(Path(__file__).parent.glob("*.py"))]
    made = [code, asdict(settings), [[source.scored.name, library.digest(source.path)] for source in chosen]]
    return hashlib.sha256(json.dumps(made).encode()).hexdigest()[:16]


def network(scored: Scored, settings: Settings | None = None) -> Network:
    """The network for what is about to be scored: from the cache, or trained, which takes minutes
    and shows its progress on stderr.

    Raises:
        NotApplicable: nothing is left to learn from, or it has to be trained and PyTorch is not installed.
    """
    settings, chosen = Settings() if settings is None else settings, library.allowed(scored, library.sources())
    if not chosen:
        raise NotApplicable(f"clothfit has nothing to learn from once {_named(scored)} is left out")
    path = folder() / f"clothfit-{key(chosen, settings)}.npz"
    if not path.is_file():
        torch()  # refuses before any work
        save(path, _trained(chosen, settings, _named(scored)))
    return load(path)


def save(path: Path, network: Network) -> None:
    """Writes weights; whoever reads meanwhile finds all or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, suffix=".part", delete=False) as file:
        np.savez(file, **network.arrays())
    os.replace(file.name, path)


def load(path: Path) -> Network:
    """Reads weights.

    Raises:
        InvalidFile: they are not of this network.
    """
    with np.load(path, allow_pickle=False) as archive:
        network = Network.of({name: archive[name] for name in archive.files})
    sizes = [len(network.mean), *(matrix.shape[1] for matrix, _ in network.layers)]
    if (sizes[0], sizes[-1]) != (INPUTS, OUTPUTS):
        raise InvalidFile(str(path), f"weights of {INPUTS} inputs and {OUTPUTS} outputs", str(sizes))
    return network


def _named(scored: Scored) -> str:
    return ", ".join(filter(None, scored)) or "nothing"


def _trained(chosen: list[Source], settings: Settings, without: str) -> Network:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    console = Console(stderr=True)
    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("time left"), TimeRemainingColumn()
    with Progress(*columns, console=console, transient=not sys.stderr.isatty()) as bar:
        task = bar.add_task("clothfit: reading", total=None)

        def progress(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total, description=f"clothfit: {what}, without {without}")

        return train(chosen, settings, progress)


def train(chosen: list[Source], settings: Settings, progress: Progress) -> Network:
    """A network trained on recordings, with files that need not be read twice."""
    shipped: list[Examples] = []
    at_hand: list[Examples] = []
    for done, source in enumerate(chosen):
        progress(done, len(chosen), f"following {source.scored.name}")
        (shipped if source.shipped else at_hand).append(examples(load_sequence(source.path), settings.cut, settings.seed + done))
    return fit(shipped, at_hand, settings, progress)[0]
