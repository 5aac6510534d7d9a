"""Trained weights in the user's cache, keyed by code, settings and data, and trained where they are missing."""

from __future__ import annotations

import hashlib
import json
import os
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from types import ModuleType

import numpy as np

from ddakf.data import body
from ddakf.errors import InvalidFile, NotApplicable
from ddakf.evaluation.baselines.clothfit import binding, features, inputs, library, motion, network, rehearsal, training
from ddakf.evaluation.baselines.clothfit import examples as example_module
from ddakf.evaluation.baselines.clothfit.examples import examples
from ddakf.evaluation.baselines.clothfit.inputs import Examples
from ddakf.evaluation.baselines.clothfit.library import Source
from ddakf.evaluation.baselines.clothfit.network import INPUTS, OUTPUTS, Committee
from ddakf.evaluation.baselines.clothfit.rehearsal import Rehearsal, rehearse
from ddakf.evaluation.baselines.clothfit.settings import TrainingSettings
from ddakf.evaluation.baselines.clothfit.training import Progress, torch
from ddakf.evaluation.simulation import garments, motions
from ddakf.evaluation.simulation.cutting import extensions, outline, patterns, remesh
from ddakf.evaluation.simulation.poses import exercises, stage
from ddakf.evaluation.splits import RecordingLabels
from ddakf.files.cache import drop_unused, used
from ddakf.files.sequence import Sequence, load_sequence

DEFAULT = TrainingSettings()
BATCH = 7  # rehearsals simulated together
# modules whose code determines the examples, and with LEARNING the weights
CUTS = garments, extensions, outline, patterns, remesh
EXAMPLES = binding, example_module, features, inputs, motion, rehearsal, body, motions, exercises, stage, *CUTS
LEARNING = network, training


def folder() -> Path:
    """Folder of the weights: DDAKF_CACHE, or ``ddakf`` in the user's cache folder."""
    chosen = os.environ.get("DDAKF_CACHE")
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(chosen) if chosen else Path(home, "ddakf")


def key(chosen: list[Source], settings: TrainingSettings) -> str:
    """Cache key: a hash of the code, the settings and the training data."""
    data = [[source.labels.name, source.digest] for source in chosen]
    return _hash([_code((*EXAMPLES, *LEARNING)), asdict(settings), data])


def committee(labels: RecordingLabels, settings: TrainingSettings = DEFAULT, among: Iterable[Source] | None = None) -> Committee:
    """The networks for a scored recording: from the cache, or trained, which takes minutes and shows its progress on stderr.

    Args:
        labels: of the scored recording, from which they must not have learned.
        settings: of the training.
        among: available training data, :func:`.library.sources` by default.

    Raises:
        NotApplicable: no training data is left, or training is needed and PyTorch is not installed.
    """
    chosen = library.without_scored(labels, library.sources() if among is None else among)
    if not chosen:
        raise NotApplicable(f"clothfit has nothing to learn from once {_listed(labels)} is left out")
    path = folder() / f"clothfit-{key(chosen, settings)}.npz"
    if (arrays := _cached(path)) is None:
        torch()  # refuses before any work
        with _training_lock():
            if (arrays := _cached(path)) is None:
                arrays = _train_with_bar(chosen, settings, _listed(labels)).arrays()
                _save(path, arrays)
                drop_unused(folder().glob("clothfit-*"))
    return _checked(path, arrays)


def _checked(path: Path, arrays: dict[str, np.ndarray]) -> Committee:
    trained = Committee.from_arrays(arrays)
    for member in trained.members:
        sizes = len(member.mean), member.layers[-1][0].shape[1]
        if sizes != (INPUTS, OUTPUTS):
            raise InvalidFile(str(path), f"weights of {INPUTS} inputs and {OUTPUTS} outputs", str(sizes))
    return trained


def train(chosen: list[Source], settings: TrainingSettings, progress: Progress) -> Committee:
    """Networks trained on recordings."""
    found = _examples(chosen, settings, progress)
    own, external = ([found[source.labels.name] for source in chosen if source.external == kind] for kind in (False, True))
    return training.committee(own, external, settings, progress)


def _examples(chosen: list[Source], settings: TrainingSettings, progress: Progress) -> dict[str, Examples]:
    """Examples by the name of their source. The cache holds them, at most 2 MB of a rehearsal and 9 MB of a recording, since
    networks that exclude other recordings need most of them again."""
    paths = {source: _place(source, settings) for source in chosen}
    progress(0, 1, "reading")
    found = {source: Examples(**arrays) for source, path in paths.items() if (arrays := _cached(path)) is not None}
    for source, sequence in _sequences([source for source in chosen if source not in found], progress):
        cut = settings.rehearsed if isinstance(source.origin, Rehearsal) else settings.cut
        found[source] = examples(sequence, cut, settings.seed)
        _save(paths[source], found[source]._asdict())
    return {source.labels.name: found[source] for source in chosen}


def _sequences(missing: list[Source], progress: Progress) -> Iterator[tuple[Source, Sequence]]:
    """The missing sources with their sequences: files are read one by one, rehearsals simulated in batches."""
    for done, source in enumerate(read := [source for source in missing if isinstance(source.origin, Path)]):
        progress(done, len(read), f"following {source.labels.name}")
        yield source, load_sequence(source.origin)
    rehearsed = [source for source in missing if isinstance(source.origin, Rehearsal)]
    for first in range(0, len(rehearsed), BATCH):
        some = rehearsed[first : first + BATCH]

        def frames(done: int, total: int, before: int = first, now: int = len(some)) -> None:
            progress(before * total + now * done, len(rehearsed) * total, "rehearsing")

        yield from zip(some, rehearse([source.origin for source in some], frames), strict=True)


def _place(source: Source, settings: TrainingSettings) -> Path:
    made_from = [_code(EXAMPLES), asdict(settings.cut), asdict(settings.rehearsed), settings.seed, source.digest]
    return folder() / f"clothfit-examples-{_hash(made_from)}.npz"


def _code(modules: tuple[ModuleType, ...]) -> list[str]:
    return [hashlib.sha256(Path(module.__file__).read_bytes()).hexdigest() for module in modules]


def _hash(values: list) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:16]


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Writes atomically: a concurrent reader finds the whole file or none."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix="clothfit-", suffix=".part", delete=False) as file:
        np.savez(file, **arrays)
    os.replace(file.name, path)


def _cached(path: Path) -> dict[str, np.ndarray] | None:
    """The saved arrays, or None. Reading marks the file as used; another process may delete it while it is open."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return None
    with file, np.load(file, allow_pickle=False) as archive:
        used(file.fileno() if os.utime in os.supports_fd else path)
        return {name: archive[name] for name in archive.files}


@contextmanager
def _training_lock() -> Iterator[None]:
    """Lock against concurrent training, where the system has file locks. Processes would repeat most of the work, each with a
    gigabyte of memory."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    folder().mkdir(parents=True, exist_ok=True)
    with (folder() / "clothfit.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _listed(labels: RecordingLabels) -> str:
    return ", ".join(filter(None, labels)) or "nothing"


def _train_with_bar(chosen: list[Source], settings: TrainingSettings, without: str) -> Committee:
    """Trains with a progress bar."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("time left"), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("clothfit", total=None)

        def progress(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total, description=f"clothfit, without {without}: {what}")

        return train(chosen, settings, progress)
