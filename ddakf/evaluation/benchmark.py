"""Benchmark: a named, versioned set of untouched recordings, with the protocol on which trackers are compared."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ddakf import data
from ddakf.errors import InvalidArgument
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.simulation import quality, simulated_recording
from ddakf.evaluation.simulation.collection_plan import Entry, entries
from ddakf.evaluation.studies.study_plan import StudyPlan
from ddakf.evaluation.trials.trial import Trial

VERSION = 1
QUANTUM = 2.0**-12  # m of the stored coordinates


@dataclass(frozen=True)
class Published:
    """A recording of the benchmark."""

    name: str
    seed: int
    sha256: str


@dataclass(frozen=True)
class Benchmark:
    """A version of the benchmark.

    Attributes:
        name, version: together they name it.
        recordings: with the seeds that they were simulated with.
        frames: ``A:B`` that are tracked; the garment is known in frame A.
        views: conditions, see :class:`ddakf.evaluation.studies.study_plan.StudyPlan`.
        runs: seeds of the sensor's noise.
        points, noise: of each cloud at most, and metres.
    """

    name: str
    version: int
    recordings: tuple[Published, ...]
    frames: str
    views: tuple[str, ...]
    runs: int
    points: int
    noise: float

    def plan(self, systems: Iterable[str], folder: Path, names: Iterable[str] = (), runs: int | None = None) -> StudyPlan:
        """The study of these systems.

        Args:
            systems: names of methods, or ``MODULE:CLASS``.
            folder: of the recordings.
            names: of a part of the recordings; none: all.
            runs: fewer seeds.

        Raises:
            InvalidArgument: a name that the benchmark does not have.
        """
        known = [each.name for each in self.recordings]
        if unknown := [name for name in names if name not in known]:
            raise InvalidArgument("recordings", f"some of the {len(known)} of {self.title}", unknown[0])
        chosen = [name for name in known if name in names] if names else known
        ours = collection.folder().resolve() == folder.resolve()
        places = tuple(name if ours else str(folder / f"{name}.npz") for name in chosen)
        settings = Trial("", points=self.points, noise=self.noise, surfaces=True)
        return StudyPlan(places, tuple(systems), self.views, runs or self.runs, self.frames, settings)

    @property
    def title(self) -> str:
        """``ddakf-simulated-1``."""
        return f"{self.name}-{self.version}"


def load(version: int = VERSION) -> Benchmark:
    """A version of the benchmark.

    Raises:
        InvalidArgument: no such version.
    """
    path = data.SAMPLE.with_name(f"benchmark-{version}.json")
    if not path.is_file():
        raise InvalidArgument("version", "1", str(version))
    content = json.loads(path.read_text())
    rows = tuple(Published(row["name"], row["seed"], row["sha256"]) for row in content["recordings"])
    values = {name: content[name] for name in ("name", "version", "frames", "runs", "points", "noise")}
    return Benchmark(recordings=rows, views=tuple(content["views"]), **values)


def differing(benchmark: Benchmark, folder: Path) -> list[str]:
    """The recordings whose files are absent or not the published ones, a sentence each."""
    found = []
    for each in benchmark.recordings:
        path = folder / f"{each.name}.npz"
        if not path.is_file():
            found.append(f"{each.name}: absent, ddakf benchmark make writes it")
        elif (checksum := collection.checksum(path)) != each.sha256:
            found.append(f"{each.name}: SHA-256 {checksum[:12]}, published {each.sha256[:12]}")
    return found


def make(benchmark: Benchmark, folder: Path, say: Callable[[str], None], names: Iterable[str] = (), anew: bool = False) -> None:
    """Brings the recordings into a folder: those of this checkout are copied, others simulated with their published seeds.

    Args:
        benchmark: whose recordings.
        folder: for the files.
        say: called with a sentence for each.
        names: of a part; none: all.
        anew: simulate also what could be copied.

    Raises:
        MissingDependency: the solver is not installed, and a recording must be simulated.
    """
    folder.mkdir(parents=True, exist_ok=True)
    chosen = [each for each in benchmark.recordings if not names or each.name in names]
    for number, each in enumerate(chosen, 1):
        target, source = folder / f"{each.name}.npz", collection.CHECKOUT / f"{each.name}.npz"
        if target.is_file() and collection.checksum(target) == each.sha256 and not anew:
            how = "is there"
        elif source.is_file() and collection.checksum(source) == each.sha256 and not anew:
            shutil.copyfile(source, target)
            how = "copied from the checkout"
        else:
            simulate(each, target)
            how = "simulated"
        same = "the published file" if collection.checksum(target) == each.sha256 else "other bytes than the published file"
        say(f"{number} of {len(chosen)}: {each.name} {how}, {same}")


def simulate(published: Published, target: Path) -> None:
    """Simulates a recording with its published seed, and writes it.

    Raises:
        MissingDependency: the solver is not installed.
        PoorQuality: what it simulated is not good enough.
    """
    planned = next(entry for entry in entries() if entry.name == published.name)
    order = replace(planned, attempt=published.seed - Entry(planned.number).seed).order
    sequence, pose = simulated_recording.record(order)
    quality.check(quality.figures(sequence))
    beside = target.with_suffix(".part.npz")
    np.savez_compressed(beside, **simulated_recording.arrays(order, sequence, pose, QUANTUM))
    beside.replace(target)
