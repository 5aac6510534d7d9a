"""Relocalization rates: wrong starts, and garments displaced while out of sight.

    python benchmarks/recovery.py [starts] [losses] [--cases 100] [--json benchmarks/results/recovery.json]
    python benchmarks/recovery.py losses --held-out --cloud "coloured person"

**Starts.** The template in its rest shape, laid on the garment of the first frame, moved by 10 cm and turned by 20 degrees
about the vertical (ddakf.evaluation.trials.runs.displaced_template). Converged: within 15 frames the normal RMSE is at most 1.2
times that of the run started at the truth on the same clouds, for three frames; for garments with sleeves or legs also the
vertex RMSE.

**Losses.** A garment is tracked for 10 frames from a random one, disappears for 0.3 to 2.5 seconds (empty clouds, while it
goes on moving), and reappears displaced by up to 1 m horizontally and turned by up to 45 degrees about the vertical. Found:
after 15 frames (mean of frames 13 to 17) the state is not lost and the RMSE is at most twice that of a run that is started
at the truth where the garment reappears, or 15 mm where that is more; the vertex RMSE where the garment has sleeves or
legs, the normal RMSE where it looks alike from several sides, so that it is found by its shape, but not its heading. Beside
it, and stricter, normal and vertex RMSE of all garments within twice, without the 15 mm. And what it costs: CPU time of the
first frame after the loss, and this and the mean of the four after it in units of the median frame of the run from the truth.
The cloud is of the garment alone, or of the whole person, with or without colours.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import sys
import time
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
from committed import parsed
from inputs import TEXTURES, sequences
from scipy.spatial.transform import Rotation

import ddakf
from ddakf.commands import warmup
from ddakf.errors import InvalidFrame
from ddakf.evaluation import machine
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.metrics import normal_rmse_mm, rmse_mm
from ddakf.evaluation.sensors import Sensor
from ddakf.evaluation.splits import turns_unseen
from ddakf.evaluation.trials.recordings import find_recording
from ddakf.evaluation.trials.runs import START_FRAMES, run_trial
from ddakf.evaluation.trials.trial import Trial
from ddakf.files.sequence import Sequence

COSTS = ("ms_searched", "times_searched", "times_settling")
FAR, FAR_TURN = 1.0, np.radians(45.0)  # m, rad: largest displacement of a garment that reappears
AWAY = (0.3, 2.5)  # s
LEAD_IN = 10  # frames tracked before a loss
GOOD = 15.0  # mm: an error below it counts as found
FACTOR = 2.0  # times the error of the run from the truth
WITHIN = 15  # frames that a start may take
JUDGED = range(12, 17)  # frames after the reappearance whose mean is judged
NOTHING = np.empty((0, 3), np.float32)


def turned(vertices: np.ndarray, centre: np.ndarray, angle: float, shift: np.ndarray) -> np.ndarray:
    """(..., 3) vertices turned by ``angle`` about the vertical through ``centre``, then moved."""
    rotation = Rotation.from_rotvec([0.0, angle, 0.0]).as_matrix()
    return ((vertices - centre) @ rotation.T + centre + shift).astype(np.float32)


def displaced(sequence: Sequence, frames: range, rng: np.random.Generator) -> Sequence:
    """The sequence with garment and body of these frames turned and moved as one."""
    centre = sequence.garment_vertices[frames[0]].mean(axis=0, dtype=np.float64)
    away, direction, angle = FAR * np.sqrt(rng.random()), rng.uniform(0, 2 * np.pi), rng.uniform(-FAR_TURN, FAR_TURN)
    shift = away * np.array([np.cos(direction), 0.0, np.sin(direction)])

    def moved(vertices):
        vertices = vertices.copy()
        vertices[frames] = turned(vertices[frames], centre, angle, shift)
        return vertices

    body = None if sequence.body_vertices is None else moved(sequence.body_vertices)
    return replace(sequence, garment_vertices=moved(sequence.garment_vertices), body_vertices=body)


class Track:
    """A tracker on the frames of one sequence as one sensor sees them, with its errors."""

    def __init__(self, sequence: Sequence, view: str, start: np.ndarray, seed: int, cloud: str = "garment"):
        self.sequence, self.seed, self.texture = sequence, seed, TEXTURES[cloud]
        self.sensor = Sensor(view, segmented=cloud == "garment")
        self.tracker = ddakf.Tracker(ddakf.Mesh(sequence.template, sequence.garment_faces))
        self.tracker.reset(start)
        self.vertex, self.normal, self.states, self.ms = [], [], [], []

    def see(self, frame: int, shown: bool = True) -> None:
        """Steps on one frame; on an empty cloud where nothing is shown."""
        s = self.sequence
        cloud = self.sensor.capture(s, frame, np.random.default_rng([self.seed, frame]), self.texture)
        begun = time.thread_time()
        try:
            colors = getattr(cloud, "colors", None)
            result = self._step(frame, *((cloud.points, cloud.sensor_origin, colors) if shown else (NOTHING, None, None)))
        except InvalidFrame:  # of a garment that has left the camera's view but for a corner
            result = self._step(frame, NOTHING, None, None)
        if shown:
            self.ms.append(1e3 * (time.thread_time() - begun))
            truth = s.garment_vertices[frame]
            self.vertex.append(rmse_mm(result.vertices, truth))
            self.normal.append(normal_rmse_mm(result.vertices, truth, s.garment_faces))
            self.states.append(result.state)

    def _step(self, frame: int, points, sensor_origin, colors) -> ddakf.FrameResult:
        timestamp = self.sequence.timestamp(frame)
        return self.tracker.step(points, timestamp=timestamp, sensor_origin=sensor_origin, colors=colors)

    def judged(self) -> tuple[float, float]:
        """Mean normal and vertex RMSE of the frames that are judged, millimetres."""
        frames = slice(JUDGED[0], JUDGED[-1] + 1)
        return float(np.mean(self.normal[frames])), float(np.mean(self.vertex[frames]))


def start_case(sequence: Sequence, view: str, seed: int, cloud: str) -> dict:
    """One wrong start, in the first frame of the garment's cloud."""
    trial = Trial(sequence.name, view, seed=seed, start=seed, frames=START_FRAMES)
    row = run_trial(trial)
    taken = {what: row[f"frames_until_{name}"] for what, name in (("normal", "normal_rmse_mm"), ("vertex", "rmse_mm"))}
    return {
        "sequence": sequence.name, "view": view, "seed": seed, "frames": taken,
        "normal_found": taken["normal"] is not None and taken["normal"] <= WITHIN,
        "vertex_found": taken["vertex"] is not None and taken["vertex"] <= WITHIN,
        "heading": not turns_unseen(sequence.name),
    }  # fmt: skip


def loss_case(sequence: Sequence, view: str, seed: int, cloud: str) -> dict:
    """One garment that reappears elsewhere."""
    rng = np.random.default_rng([seed, 2, 1])  # clouds have [seed, frame]
    away = round(rng.uniform(*AWAY) * sequence.fps)
    shown = JUDGED[-1] + 1
    first = int(rng.integers(len(sequence) - LEAD_IN - away - shown))
    back = first + LEAD_IN + away
    frames = range(back, back + shown)
    sequence = displaced(sequence, frames, rng)
    lost = Track(sequence, view, sequence.garment_vertices[first], seed, cloud)
    for frame in range(first + 1, back):
        lost.see(frame, shown=frame < first + LEAD_IN)
    before = len(lost.normal)
    sure = Track(sequence, view, sequence.garment_vertices[back], seed, cloud)
    for frame in frames:
        lost.see(frame)
        sure.see(frame)
    for values in (lost.vertex, lost.normal, lost.states, lost.ms):
        del values[:before]
    return compared(sequence.name, view, seed, sure, lost) | cost(sure, lost)


def cost(sure: Track, lost: Track) -> dict[str, float]:
    """CPU time of the frame that is searched, milliseconds, and over the median frame from the truth its and the next ones'."""
    usual = np.median(sure.ms)
    settling = ddakf.Config().relocalization.settling_frames
    costs = lost.ms[0], lost.ms[0] / usual, np.mean(lost.ms[1 : 1 + settling]) / usual
    return {what: round(float(value), 2) for what, value in zip(COSTS, costs, strict=True)}


def compared(name: str, view: str, seed: int, sure: Track, other: Track) -> dict:
    """The judgement of a loss: True if the track has at most twice the error of the one started at the truth."""
    (normal_0, vertex_0), (normal, vertex) = sure.judged(), other.judged()
    error, least = (normal, normal_0) if turns_unseen(name) else (vertex, vertex_0)
    return {
        "sequence": name, "view": view, "seed": seed, "state": other.states[JUDGED[-1]],
        "normal_mm": round(normal, 2), "vertex_mm": round(vertex, 2),
        "normal_from_truth_mm": round(normal_0, 2), "vertex_from_truth_mm": round(vertex_0, 2),
        "found": bool(error <= max(FACTOR * least, GOOD) and other.states[JUDGED[-1]] != "lost"),
        "normal_found": bool(normal <= FACTOR * normal_0 and other.states[JUDGED[-1]] != "lost"),
        "vertex_found": bool(vertex <= FACTOR * vertex_0 and other.states[JUDGED[-1]] != "lost"),
        "heading": not turns_unseen(name),
    }  # fmt: skip


CASES = {"starts": start_case, "losses": loss_case}


@cache
def recording(name: str) -> Sequence:
    """A recording; with the first one the kernels are loaded."""
    warmup.warm()
    return find_recording(name)


def one(job: tuple[str, str, str, int, str]) -> dict:
    """A case in a process of its own."""
    kind, name, *how = job
    return CASES[kind](recording(name), *how)


def wilson(hits: int, total: int) -> tuple[float, float]:
    """95 % interval of a rate (Wilson 1927)."""
    z, p = 1.959964, hits / total
    middle, half = p + z * z / (2 * total), z * np.sqrt(p * (1 - p) / total + z * z / (4 * total**2))
    return float((middle - half) / (1 + z * z / total)), float((middle + half) / (1 + z * z / total))


def rates(cases: list[dict]) -> dict:
    """Found, of losses; normal RMSE over all cases, vertex RMSE over the garments whose heading shows, per view."""
    out = {}
    for view in sorted({case["view"] for case in cases}):
        mine = [case for case in cases if case["view"] == view]
        for what, key, chosen in (
            ("found", "found", [case for case in mine if "found" in case]),
            ("normal RMSE", "normal_found", mine),
            ("vertex RMSE", "vertex_found", [case for case in mine if case["heading"]]),
        ):
            hits = sum(case[key] for case in chosen)
            if chosen:
                out[f"{view}, {what}"] = {"found": hits, "of": len(chosen), "interval": wilson(hits, len(chosen))}
    return out


def costs(cases: list[dict]) -> dict[str, list[float]]:
    """10 %, median and 90 % of what :func:`cost` says, over the cases."""
    return {what: np.percentile([case[what] for case in cases], [10, 50, 90]).round(2).tolist() for what in COSTS}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", default=list(CASES), help="starts, losses (default both)")
    parser.add_argument("--cases", type=int, default=100, help="per view (default 100)")
    parser.add_argument("--views", nargs="+", default=["full", "front"])
    parser.add_argument("--sequences", nargs="+", help="names of recordings; default: those at hand that were tuned on")
    parser.add_argument("--held-out", action="store_true", help="the recordings that nothing was tuned on")
    parser.add_argument("--cloud", choices=list(TEXTURES), default="garment", help="what the cloud is of, in losses")
    parser.add_argument("--procs", type=int, default=1)
    parser.add_argument("--json", type=Path, help="result file")
    arguments = parsed(parser, target="json")
    held_out = [each.name for each in collection.listed(collection.HELD_OUT)] if arguments.held_out else None
    names = arguments.sequences or held_out or [sequence.name for sequence in sequences()]
    report = {"commit": machine.commit(), "machine": machine.describe(), "sequences": names}
    with multiprocessing.get_context("spawn").Pool(arguments.procs) if arguments.procs > 1 else nullcontext() as pool:
        run: Callable = pool.imap if pool else map
        for part in arguments.parts:
            cloud, count = arguments.cloud, arguments.cases
            jobs = [(part, names[k % len(names)], view, k, cloud) for view in arguments.views for k in range(count)]
            cases = []
            for case in run(one, jobs):
                cases.append(case)
                if sys.stderr.isatty() or not (case["normal_found"] and case["vertex_found"]):
                    print(part, len(cases), case, file=sys.stderr, flush=True)
            report[part] = {"rates": rates(cases), "cases": cases}
            if part == "losses":
                report[part] |= {"cloud": cloud, "costs": costs(cases)}
                for what, (low, median, high) in report[part]["costs"].items():
                    print(f"{part}: {what}: median {median}, 10 % and 90 % {low} and {high}")
            for what, rate in report[part]["rates"].items():
                low, high = rate["interval"]
                print(f"{part}: {what}: {rate['found']} of {rate['of']} ({100 * low:.0f} to {100 * high:.0f} %)")
    if arguments.json:
        arguments.json.write_text(json.dumps(report, indent=1) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
