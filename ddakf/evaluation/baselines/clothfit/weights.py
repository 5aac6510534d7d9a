"""Trained weights, kept in the user's cache by what they were made from; made where they are not there."""

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
from ddakf.evaluation.baselines.clothfit import binding, features, library, motion, network, rehearsal, training
from ddakf.evaluation.baselines.clothfit import examples as example_module
from ddakf.evaluation.baselines.clothfit.examples import examples
from ddakf.evaluation.baselines.clothfit.inputs import Examples
from ddakf.evaluation.baselines.clothfit.library import Source
from ddakf.evaluation.baselines.clothfit.network import INPUTS, OUTPUTS, Committee
from ddakf.evaluation.baselines.clothfit.rehearsal import Part, rehearse
from ddakf.evaluation.baselines.clothfit.settings import TrainingSettings
from ddakf.evaluation.baselines.clothfit.training import Progress, torch
from ddakf.evaluation.simulation import garments, motions, remesh
from ddakf.evaluation.splits import RecordingLabels
from ddakf.files.cache import drop_unused, used
from ddakf.files.sequence import Sequence, load_sequence

DEFAULT = TrainingSettings()
TOGETHER = 7  # rehearsals simulated at once
# what examples, and beyond them weights, are made by
EXAMPLES = binding, example_module, features, motion, rehearsal, body, garments, motions, remesh
LEARNING = network, training


def folder() -> Path:
    """Where weights are kept: DDAKF_CACHE, or ``ddakf`` in the user's cache folder."""
    chosen = os.environ.get("DDAKF_CACHE")
    home = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    return Path(chosen) if chosen else Path(home, "ddakf")


def key(chosen: list[Source], settings: TrainingSettings) -> str:
    """Of the code, the settings and the data that weights are made from; what is left out is not among these."""
    data = [[source.labels.name, source.digest] for source in chosen]
    return _hash([_code((*EXAMPLES, *LEARNING)), asdict(settings), data])


def committee(scored: RecordingLabels, settings: TrainingSettings = DEFAULT, among: Iterable[Source] | None = None) -> Committee:
    """The networks for what is about to be scored: from the cache, or trained, which takes minutes and shows its progress on
    stderr.

    Args:
        scored: what they must not have learned from.
        settings: of the training.
        among: what there is to learn from, :func:`.library.sources` by default.

    Raises:
        NotApplicable: nothing is left to learn from, or they have to be trained and PyTorch is not installed.
    """
    chosen = library.allowed(scored, library.sources() if among is None else among)
    if not chosen:
        raise NotApplicable(f"clothfit has nothing to learn from once {_named(scored)} is left out")
    path = folder() / f"clothfit-{key(chosen, settings)}.npz"
    if (arrays := _kept(path)) is None:
        torch()  # refuses before any work
        with _alone():
            if (arrays := _kept(path)) is None:
                arrays = _shown(chosen, settings, _named(scored)).arrays()
                _save(path, arrays)
                drop_unused(folder().glob("clothfit-*"))
    return _checked(path, arrays)


def load(path: Path) -> Committee:
    """Reads weights.

    Raises:
        InvalidFile: they are not of these networks.
    """
    with np.load(path, allow_pickle=False) as archive:
        return _checked(path, {name: archive[name] for name in archive.files})


def _checked(path: Path, arrays: dict[str, np.ndarray]) -> Committee:
    trained = Committee.of(arrays)
    for member in trained.members:
        sizes = len(member.mean), member.layers[-1][0].shape[1]
        if sizes != (INPUTS, OUTPUTS):
            raise InvalidFile(str(path), f"weights of {INPUTS} inputs and {OUTPUTS} outputs", str(sizes))
    return trained


def train(chosen: list[Source], settings: TrainingSettings, progress: Progress) -> Committee:
    """Networks trained on recordings."""
    found = _examples(chosen, settings, progress)
    own, at_hand = ([found[source.labels.name] for source in chosen if source.at_hand == kind] for kind in (False, True))
    return training.committee(own, at_hand, settings, progress)


def _examples(chosen: list[Source], settings: TrainingSettings, progress: Progress) -> dict[str, Examples]:
    """By name. They are kept, 2 MB of a rehearsal and 9 MB of a recording at most: networks that leave out something else need
    most of them again."""
    paths = {source: _place(source, settings) for source in chosen}
    progress(0, 1, "reading")
    found = {source: Examples(**arrays) for source, path in paths.items() if (arrays := _kept(path)) is not None}
    for source, sequence in _sequences([source for source in chosen if source not in found], progress):
        cut = settings.rehearsed if isinstance(source.what, Part) else settings.cut
        found[source] = examples(sequence, cut, settings.seed)
        _save(paths[source], found[source]._asdict())
    return {source.labels.name: found[source] for source in chosen}


def _sequences(missing: list[Source], progress: Progress) -> Iterator[tuple[Source, Sequence]]:
    """What is read, one by one, and what is rehearsed, some together."""
    for done, source in enumerate(read := [source for source in missing if isinstance(source.what, Path)]):
        progress(done, len(read), f"following {source.labels.name}")
        yield source, load_sequence(source.what)
    rehearsed = [source for source in missing if isinstance(source.what, Part)]
    for first in range(0, len(rehearsed), TOGETHER):
        some = rehearsed[first : first + TOGETHER]

        def frames(done: int, total: int, before: int = first, now: int = len(some)) -> None:
            progress(before * total + now * done, len(rehearsed) * total, "rehearsing")

        yield from zip(some, rehearse([source.what for source in some], frames), strict=True)


def _place(source: Source, settings: TrainingSettings) -> Path:
    made_from = [_code(EXAMPLES), asdict(settings.cut), asdict(settings.rehearsed), settings.seed, source.digest]
    return folder() / f"clothfit-examples-{_hash(made_from)}.npz"


def _code(modules: tuple[ModuleType, ...]) -> list[str]:
    return [hashlib.sha256(Path(module.__file__).read_bytes()).hexdigest() for module in modules]


def _hash(values: list) -> str:
    return hashlib.sha256(json.dumps(values).encode()).hexdigest()[:16]


def _save(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Whoever reads meanwhile finds all or nothing."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.NamedTemporaryFile(dir=path.parent, prefix="clothfit-", suffix=".part", delete=False) as file:
        np.savez(file, **arrays)
    os.replace(file.name, path)


def _kept(path: Path) -> dict[str, np.ndarray] | None:
    """What was saved, or None; it is in use from now on, and whoever drops the file meanwhile does not hurt who has it open."""
    try:
        file = path.open("rb")
    except FileNotFoundError:
        return None
    with file, np.load(file, allow_pickle=False) as archive:
        used(file.fileno() if os.utime in os.supports_fd else path)
        return {name: archive[name] for name in archive.files}


@contextmanager
def _alone() -> Iterator[None]:
    """While no other process trains, where the system has locks: most of what they do is the same, and a gigabyte each."""
    try:
        import fcntl
    except ImportError:
        yield
        return
    folder().mkdir(parents=True, exist_ok=True)
    with (folder() / "clothfit.lock").open("w") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _named(scored: RecordingLabels) -> str:
    return ", ".join(filter(None, scored)) or "nothing"


def _shown(chosen: list[Source], settings: TrainingSettings, without: str) -> Committee:
    """Trains with a progress bar."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

    columns = TextColumn("{task.description}"), BarColumn(), TextColumn("time left"), TimeRemainingColumn()
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task("clothfit", total=None)

        def progress(done: int, total: int, what: str) -> None:
            bar.update(task, completed=done, total=total, description=f"clothfit, without {without}: {what}")

        return train(chosen, settings, progress)
