"""Collection of simulated recordings: ``python benchmarks/recordings.py [--most N] [--only NAME ...]``.

Simulates what the manifest does not list, in the order of the plan (:mod:`ddakf.evaluation.simulation.collection_plan`). Each
recording is written with the manifest as soon as it is done, so that a stopped run goes on where it was, on any machine. A
recording of poor quality is noted and tried again with its next seed. Needs the extra ``simulation``; about a minute each.

``--check`` compares every file with its checksum, its quality figures and its parameters in the manifest. ``--table`` prints
the collection in Markdown. ``--export NAME FILE.npz`` writes an ordinary sequence file, the body's vertices included.
``--again NAME`` simulates one anew and compares.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections import Counter
from dataclasses import asdict
from pathlib import Path

import numpy as np
from rich.console import Console

from ddakf.data.body import Pose
from ddakf.errors import DdakfError, PoorQuality
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.simulation import quality, simulated_recording, solver
from ddakf.evaluation.simulation.collection_plan import ATTEMPTS, Entry, entries
from ddakf.files.sequence import Sequence, load_sequence

QUANTUM = 2.0**-12  # m of the coordinates; rounded to half of it
FIGURES = ("stretch_p99", "stretch_worst_frame_p99", "inside_share_mean", "penetration_max_mm", "displacement_mean_mm",
           "displacement_max_mm")  # fmt: skip ; of quality, in the manifest
MOST_BYTES = 25_000_000  # of the collection


class Manifest:
    """What is done and what was refused, in a file with a line per recording."""

    def __init__(self, folder: Path):
        self.folder, self._path = folder, folder / collection.MANIFEST
        content = json.loads(self._path.read_text()) if self._path.is_file() else {"recordings": [], "refused": []}
        self.recordings: list[dict] = content["recordings"]
        self.refused: list[dict] = content["refused"]

    def has(self, entry: Entry) -> bool:
        """True if a recording is listed and its file is there."""
        return any(row["name"] == entry.name for row in self.recordings) and (self.folder / f"{entry.name}.npz").is_file()

    def next_attempt(self, entry: Entry) -> Entry:
        """The first attempt that has not been refused."""
        return Entry(entry.number, sum(row["name"] == entry.name for row in self.refused))

    def add(self, row: dict) -> None:
        self.recordings = sorted([*(old for old in self.recordings if old["name"] != row["name"]), row], key=_number)
        self._write()

    def refuse(self, entry: Entry, reason: str) -> None:
        self.refused.append({"name": entry.name, "seed": entry.seed, "reason": reason})
        self.refused.sort(key=_number)
        self._write()

    def _write(self) -> None:
        parts = [f' "licence": {json.dumps(simulated_recording.LICENCE)}']
        parts += [f' "{name}": [\n{_lines(getattr(self, name))}\n ]' for name in ("recordings", "refused")]
        text = "{\n" + ",\n".join(parts) + "\n}\n"
        beside = self._path.with_suffix(".part")
        beside.write_text(text)
        os.replace(beside, self._path)


def _number(row: dict) -> int:
    return int(row["name"].rpartition("_")[2])


def _lines(rows: list[dict]) -> str:
    return ",\n".join(f"  {json.dumps(row)}" for row in rows)


def generate(manifest: Manifest, wanted: list[Entry], console: Console) -> None:
    """Simulates what is not there."""
    for entry in wanted:
        if manifest.has(entry):
            continue
        attempt = manifest.next_attempt(entry)
        while attempt.attempt < ATTEMPTS and not _simulated(manifest, attempt, console):
            attempt = attempt.again()


def _simulated(manifest: Manifest, entry: Entry, console: Console) -> bool:
    """Simulates one attempt; False, and a note in the manifest, if its quality does not suffice."""
    start = time.process_time()
    try:
        sequence, pose = simulated_recording.record(entry.order)
        row = finish(manifest.folder, entry, sequence, pose)
    except PoorQuality as error:
        manifest.refuse(entry, str(error))
        console.print(f"{entry.name}: seed {entry.seed} refused: {error}", soft_wrap=True)
        return False
    manifest.add(row)
    done, seconds = f"{len(manifest.recordings)} of {len(entries())}", time.process_time() - start
    console.print(f"{done}: {entry.name}, {row['bytes'] / 1e3:.0f} kB, {seconds:.0f} s of CPU time", soft_wrap=True)
    return True


def finish(folder: Path, entry: Entry, sequence: Sequence, pose: Pose) -> dict:
    """Writes the file of a simulated recording; returns its row of the manifest.

    Raises:
        PoorQuality: a figure is beyond its limit; nothing is written.
    """
    found = quality.figures(sequence)
    quality.check(found)
    order, path = entry.order, folder / f"{entry.name}.npz"
    beside = path.with_suffix(".part.npz")
    np.savez_compressed(beside, **simulated_recording.arrays(order, sequence, pose, QUANTUM))
    os.replace(beside, path)
    error = np.abs(load_sequence(path).garment_vertices - sequence.garment_vertices).max()
    parameters = asdict(order)
    return {
        "name": entry.name,
        **{name: parameters[name] for name in ("garment", "fit", "fabric", "motion")},
        "split": entry.split,
        "seed": entry.seed,
        "sha256": collection.checksum(path),
        "bytes": path.stat().st_size,
        "vertices": found["vertices"],
        "frames": found["frames"],
        "coding_error_mm": round(1e3 * float(error), 4),
        **{name: found[name] for name in FIGURES},
        "newton": solver.version(),
    }


def problems(manifest: Manifest, every: int = 1) -> list[str]:
    """What is wrong with the collection, a sentence each. Figures are computed again of one recording in so many."""
    found, planned = [], {entry.name: entry for entry in entries()}
    for number, row in enumerate(manifest.recordings):
        entry = planned.get(row["name"])
        if entry is None:
            found.append(f"{row['name']} is not in the plan")
            continue
        attempt = Entry(entry.number, row["seed"] - entry.seed)
        parameters = asdict(attempt.order) | {"split": attempt.split}
        different = [name for name in ("garment", "fit", "fabric", "motion", "split") if row[name] != parameters[name]]
        if different or not 0 <= attempt.attempt < ATTEMPTS:
            found.append(f"{row['name']}: {', '.join(different) or 'seed'} is not as planned")
        try:
            path = collection.file_of(row["name"], manifest.folder)
            figures = None if number % every else quality.figures(load_sequence(path))
        except DdakfError as error:
            found.append(str(error))
            continue
        if figures is None:
            continue
        beyond = [name for name in FIGURES if abs(figures[name] - row[name]) > 0.02 * abs(row[name]) + 0.5]
        if beyond:
            found.append(f"{row['name']}: {', '.join(beyond)} differ from the manifest")
    return found


def table(manifest: Manifest) -> str:
    """The collection in Markdown: how many of each, and in all."""
    rows, lines = manifest.recordings, ["| | recordings |", "|---|---|"]
    for part in ("garment", "fit", "fabric", "motion", "split"):
        count = Counter(row[part] for row in rows)
        lines.append(f"| {part} | {', '.join(f'{name} {number}' for name, number in sorted(count.items()))} |")
    size = sum(row["bytes"] for row in rows) / 1e6
    worst = max((row["coding_error_mm"] for row in rows), default=0.0)
    lines.append(f"| in all | {len(rows)}, {size:.1f} MB, coordinates within {worst:.3f} mm; refused {len(manifest.refused)} |")
    return "\n".join(lines)


def export(name: str, target: Path, folder: Path) -> None:
    """Writes a recording as an ordinary sequence file."""
    sequence = collection.load(name, folder)
    np.savez_compressed(
        target,
        garment_V=sequence.garment_vertices,
        garment_F=sequence.garment_faces,
        garment_rest=sequence.garment_rest,
        body_V=sequence.body_vertices,
        body_F=sequence.body_faces,
        fps=sequence.fps,
        garment=sequence.garment,
        motion=sequence.motion,
    )


def again(name: str, manifest: Manifest) -> float:
    """Simulates a listed recording anew; returns the largest difference of a coordinate, metres."""
    row = next(row for row in manifest.recordings if row["name"] == name)
    entry = next(entry for entry in entries() if entry.name == name)
    sequence, _ = simulated_recording.record(Entry(entry.number, row["seed"] - entry.seed).order)
    listed = collection.load(name, manifest.folder)
    return float(np.abs(listed.garment_vertices - sequence.garment_vertices).max())


def main(words: list[str] | None = None) -> int:
    """Does what the command line asks for; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--folder", type=Path, default=collection.folder())
    parser.add_argument("--most", type=int, help="only so many of the plan")
    parser.add_argument("--only", nargs="+", metavar="NAME", help="only these")
    parser.add_argument("--check", action="store_true")
    parser.add_argument("--table", action="store_true")
    parser.add_argument("--export", nargs=2, metavar=("NAME", "FILE.npz"))
    parser.add_argument("--again", metavar="NAME")
    arguments = parser.parse_args(words)
    arguments.folder.mkdir(parents=True, exist_ok=True)
    manifest = Manifest(arguments.folder)
    if arguments.check:
        found = problems(manifest)
        print("\n".join(found) or f"{len(manifest.recordings)} recordings agree with the manifest")
        return bool(found)
    if arguments.table:
        print(table(manifest))
    elif arguments.export:
        export(arguments.export[0], Path(arguments.export[1]), arguments.folder)
    elif arguments.again:
        print(f"{arguments.again}: largest difference of a coordinate {1e3 * again(arguments.again, manifest):.3f} mm")
    else:
        solver.version()  # refuses before any work where Newton is missing
        wanted = [entry for entry in entries() if not arguments.only or entry.name in arguments.only]
        generate(manifest, wanted[: arguments.most], Console())
    return 0


if __name__ == "__main__":
    sys.exit(main())
