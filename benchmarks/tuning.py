"""Tuning of the baselines' settings: ``python benchmarks/tuning.py [--only NAME ...]``, about a quarter of an hour.

Every baseline but the learned one, which has clips of its own, is tuned on the same clips by its error alone: training recordings
of the collection, in all conditions. A coordinate search starts with the first value of
each axis, and chooses the best value of one axis after another. A best value at the end of an axis widens it, by the ratio of
the last two values, until the error rises or a limit is reached. All tries go into ``benchmarks/results/tuning.json``, which a
later call with ``--only`` completes. The defaults of the settings are the ones chosen there, and a test compares them. The score
is the geometric mean over the clips of the RMSE, so that every clip has the same weight. DD-AKF runs beside them with its
defaults.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from committed import parsed
from threadpoolctl import threadpool_limits

from ddakf import data
from ddakf.commands import warmup
from ddakf.errors import NotApplicable
from ddakf.evaluation import machine, metrics
from ddakf.evaluation.baselines.baseline import Baseline
from ddakf.evaluation.baselines.clothfit import library, weights
from ddakf.evaluation.baselines.clothfit.method import ClothFit
from ddakf.evaluation.baselines.clothfit.settings import AnswerSettings
from ddakf.evaluation.baselines.clothfit.settings import TrainingSettings as Training
from ddakf.evaluation.baselines.embedded_deformation import EmbeddedDeformation, EmbeddedSettings
from ddakf.evaluation.baselines.filters.as_printed import AsPrinted, PrintedSettings
from ddakf.evaluation.baselines.filters.kalman_filter import KalmanFilter, KalmanSettings
from ddakf.evaluation.baselines.filters.particle_filter import ParticleFilter, ParticleSettings
from ddakf.evaluation.baselines.icp import IcpSettings, NonRigidPointToPlane, RigidPointToPlane, RigidSettings
from ddakf.evaluation.baselines.nicp import NicpSettings, NonRigidIcp
from ddakf.evaluation.sensors import CapturedFrame, Sensor
from ddakf.evaluation.splits import RecordingLabels, labels_of
from ddakf.evaluation.trials.estimates import MethodFactory
from ddakf.evaluation.trials.methods import method_factory, start_baseline
from ddakf.evaluation.trials.recordings import find_recording
from ddakf.mesh import Mesh

RESULT = Path(__file__).parent / "results/tuning.json"
CLIPS = (
    ("long-shirt_run_loose_45", "full"), ("skirt_squat_loose_53", "front"), ("tshirt_dance_loose_63", "front+body"),
    ("trousers_dance_loose_11", "front+body"),
)  # fmt: skip
FIRST = 30  # frame of the start, as in the study
FRAMES, SEED, SENSOR = 30, 1, Sensor(points=10_000, noise=0.003)  # tracked
LEARNED_FRAMES = 44
WIDENINGS = 4  # of an axis at most
LIMITS = {  # of axes: beyond them a value has no further effect, or no meaning (a node for nearly every vertex)
    "hold": (0.001, 1.0), "momentum": (0.0, 1.0), "harmonics": (1, 96), "nodes": (20, 675), "normal_cosine": (-1.0, 1.0),
    "proposal_steps": (1, 24), "tangential_sd": (0.001, 3.0), "alpha": (0.0, 0.99),
    "lowest_sd": (1e-5, 0.05),
}  # fmt: skip

LEARNED_STEPS = 300  # of the learned method's training, for every try alike; in use there are more


class Clip(NamedTuple):
    """The first frames of a recording, seen by a sensor."""

    name: str
    labels: RecordingLabels
    garment: Mesh
    start: np.ndarray  # (V, 3) m
    body: Mesh | None
    frames: list[CapturedFrame]  # with their truth


def clips(frames: int) -> Iterator[Clip]:
    """Clips on which all methods but the learned one are tuned."""
    for name, view in CLIPS:
        yield _clip(name, view, frames)


def wider(axis: str, values: Iterable[float], best: float) -> float | None:
    """The value beyond ``best`` at the end of an axis, in the ratio of the last two, at most the axis's limit; None inside, or
    where the axis is no scale of numbers."""
    known = sorted(set(values))
    if len(known) < 2 or any(isinstance(value, bool) or value <= 0 for value in known) or known[0] < best < known[-1]:
        return None
    new = best * best / (known[1] if best == known[0] else known[-2])
    new = round(new) if isinstance(best, int) else float(f"{new:.2g}")
    low, high = LIMITS.get(axis, (new, new))
    return min(max(new, low), high)


def learned_clips(frames: int) -> Iterator[Clip]:
    """Clips on which the learned method is tuned: the training recordings that ship; bodies without clouds."""
    for path in sorted(data.TRAINING.glob("*.npz")):
        yield _learned_clip(path.stem, min(frames, LEARNED_FRAMES))


class Search(NamedTuple):
    """What is tried of a baseline: its settings, made into a method for what will be scored; per axis the values, the first one
    to begin with; and on what."""

    make: Callable[[Any, RecordingLabels], Baseline]
    settings: type
    axes: dict[str, tuple]
    clips: Callable[[int], Iterator[Clip]] = clips


def without_labels(method: type) -> Callable[[Any, RecordingLabels], Baseline]:
    """The factory of a method that ignores the labels of the scored recording."""
    return lambda settings, scored: method(settings)


def clothfit(settings: AnswerSettings, scored: RecordingLabels) -> ClothFit:
    """Learned from what ships for learning alone, without the clip, its garment and its motion; from nothing that the study
    scores, neither the sample nor what DDAKF_DATA names."""
    among = [source for source in library.sources() if not source.external and source.origin != data.SAMPLE]
    return ClothFit(partial(weights.committee, scored, Training(gate=settings.gate, steps=LEARNED_STEPS), among), settings)


SEARCHES = {
    "kf": Search(without_labels(KalmanFilter), KalmanSettings, {
        "tangential_sd": (0.3, 0.1, 1.0), "measurement_sd": (0.03, 0.01, 0.1), "acceleration_density": (1.0, 0.3, 3.0),
        "damping": (4.0, 2.0, 8.0), "gate": (0.1, 0.05, 0.2), "held_sd": (0.02, 0.01, 0.04),
    }),
    "pf": Search(without_labels(ParticleFilter), ParticleSettings, {
        "harmonics": (24, 12, 48), "elasticity": (30.0, 10.0, 90.0), "proposal_steps": (6, 3, 12), "hold": (0.1, 0.03, 0.3),
        "amplitude_sd": (0.001, 0.0005, 0.002),
    }),
    "icp": Search(without_labels(NonRigidPointToPlane), IcpSettings, {
        "stiffness": (2.0, 1.0, 4.0), "gate": (0.1, 0.05, 0.2), "hold": (0.1, 0.03, 0.3),
    }),
    "nicp": Search(without_labels(NonRigidIcp), NicpSettings, {
        "stiffness": (24.0, 12.0, 48.0), "gate": (0.1, 0.07, 0.14), "hold": (0.1, 0.03, 0.3),
    }),
    "opt-ed": Search(without_labels(EmbeddedDeformation), EmbeddedSettings, {
        "smoothness": (3.0, 1.0, 9.0), "nodes": (300, 200, 450), "gate": (0.1, 0.05, 0.2), "hold": (0.1, 0.03, 0.3),
    }),
    "printed": Search(without_labels(AsPrinted), PrintedSettings, {
        "velocity_rows": (True, False), "acceleration": (12.0, 6.0, 24.0), "lowest_sd": (0.001, 0.003, 0.01),
        "speed_sd": (0.5, 0.25, 1.0), "alpha": (0.9, 0.8), "gate": (0.1, 0.05, 0.2), "stiffness": (1.0, 0.3, 3.0),
        "longest_correction": (0.02, 0.01, 0.04),
    }),
    "icp-rigid": Search(without_labels(RigidPointToPlane), RigidSettings, {
        "gate": (0.15, 0.1, 0.22), "robust_scale": (0.3, 0.1, 0.9),
    }),
    "clothfit": Search(clothfit, AnswerSettings, {
        "gate": (1.0, 0.0), "caution": (2.0, 0.0, 0.5, 1.0, 4.0, 8.0), "smoothing": (2, 0, 4),
    }, learned_clips),
}  # fmt: skip
UNTUNED = {
    "ddakf": (lambda clip: method_factory("default"), clips),
    "carried": (lambda clip: method_factory("carried"), learned_clips),
}
NAMES = *UNTUNED, *SEARCHES


def main(argv: list[str] | None = None) -> int:
    """Searches the settings of the wanted methods; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=NAMES, default=NAMES, metavar="NAME")
    parser.add_argument("--frames", type=int, default=FRAMES, help=f"per clip (default {FRAMES})")
    parser.add_argument("--table", action="store_true", help="print --out in Markdown, and run nothing")
    parser.add_argument("--out", type=Path, default=RESULT, help=f"file of the result (default {RESULT})")
    arguments = parsed(parser, argv)
    if arguments.table:
        report = json.loads(arguments.out.read_text())
        print(table(report), chosen_settings(report), learned_tries(report), sep="\n\n")
        return 0
    threadpool_limits(1)
    warmup.warm()
    report = json.loads(arguments.out.read_text()) if arguments.out.is_file() else {"methods": {}}
    for name in arguments.only:
        found = untuned(name, arguments.frames) if name in UNTUNED else search(name, arguments.frames)
        how = {"commit": machine.commit(), "date": time.strftime("%Y-%m-%d"), "machine": machine.describe()}
        report["methods"][name] = how | found
        report["meta"] = meta(arguments.frames)
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(readable(report))
    return 0


def search(name: str, frames: int) -> dict:
    """Coordinate search of a baseline's settings: ``chosen``, ``score`` and all ``tries``."""
    make, settings, axes, shown = SEARCHES[name]
    chosen, tries = {axis: values[0] for axis, values in axes.items()}, []

    def tried(values: dict) -> dict:
        loss = score(lambda clip: partial(start_baseline, make(settings(**values), clip.labels)), shown(frames))
        row = {"settings": values} | loss
        tries.append(row)
        print(f"{name} {values}: RMSE {row['rmse_mm']} mm, normal {row['normal_rmse_mm']}", file=sys.stderr, flush=True)
        return row

    try:
        best = tried(chosen)
        for axis, values in axes.items():
            rows = [best, *(tried(best["settings"] | {axis: value}) for value in values[1:])]
            best = min(rows, key=lambda row: row["rmse_mm"])
            for _ in range(WIDENINGS):
                known = {row["settings"][axis] for row in rows}
                new = wider(axis, known, best["settings"][axis])
                if new is None or new in known:
                    break
                rows.append(tried(best["settings"] | {axis: new}))
                best = min(rows, key=lambda row: row["rmse_mm"])
    except NotApplicable as absent:
        return {"not_applicable": str(absent)}
    return {"chosen": asdict(settings(**best["settings"])), "score": best, "tries": tries}


def untuned(name: str, frames: int) -> dict:
    """DD-AKF's default, and the garment that goes with the body, on the clips of those that they are compared with."""
    make, shown = UNTUNED[name]
    return {"score": score(make, shown(frames))}


def score(make: Callable[[Clip], MethodFactory], shown: Iterable[Clip]) -> dict:
    """A method on clips: geometric means of the errors, and the median time per frame; all of them per clip too."""
    rows = {}
    for clip in shown:
        step, errors, normal, times = make(clip)(clip.garment, clip.start, clip.body), [], [], []
        for frame in clip.frames:
            begun = time.thread_time()
            vertices = step(frame).vertices
            times.append(1e3 * (time.thread_time() - begun))
            errors.append(metrics.rmse_mm(vertices, frame.truth))
            normal.append(metrics.normal_rmse_mm(vertices, frame.truth, clip.garment.faces))
        row = {"rmse_mm": np.mean(errors), "normal_rmse_mm": np.mean(normal), "cpu_ms_p50": np.median(times)}
        rows[clip.name] = {key: round(float(value), 2) for key, value in row.items()}
    means = {key: round(geometric_mean([row[key] for row in rows.values()]), 3) for key in ("rmse_mm", "normal_rmse_mm")}
    return means | {"clips": rows}


def geometric_mean(values: list[float]) -> float:
    return float(np.exp(np.mean(np.log(values))))


@lru_cache(maxsize=len(CLIPS))
def _clip(name: str, view: str, frames: int) -> Clip:
    side, _, told = view.partition("+")
    sequence, sensor = find_recording(name), Sensor(side, SENSOR.points, SENSOR.noise)
    seen = []
    for k in range(FIRST + 1, min(FIRST + frames, len(sequence) - 1) + 1):
        cloud = sensor.capture(sequence, k, np.random.default_rng([SEED, k]))
        pose = sequence.body_vertices[k] if told else None
        seen.append(CapturedFrame(k, sequence.timestamp(k), *cloud, pose, truth=sequence.garment_vertices[k]))
    garment, start = Mesh(sequence.template, sequence.garment_faces), sequence.garment_vertices[FIRST].astype(np.float64)
    body = Mesh(sequence.body_vertices[FIRST], sequence.body_faces) if told else None
    return Clip(f"{name} {view}", labels_of(sequence), garment, start, body, seen)


def _learned_clip(name: str, frames: int) -> Clip:
    s, nothing = find_recording(name), np.zeros((0, 3), np.float32)
    seen = [
        CapturedFrame(k, s.timestamp(k), nothing, None, s.body_vertices[k], s.garment_vertices[k]) for k in range(1, frames + 1)
    ]
    garment, body = Mesh(s.template, s.garment_faces), Mesh(s.body_vertices[0], s.body_faces)
    return Clip(name, labels_of(s), garment, s.garment_vertices[0].astype(np.float64), body, seen)


def meta(frames: int) -> dict:
    return {
        "command": "python benchmarks/tuning.py",
        "clips": [" ".join(clip) for clip in CLIPS],
        "learned_clips": sorted(path.stem for path in data.TRAINING.glob("*.npz")),
        "learned_steps": LEARNED_STEPS,
        "frames": frames,
        "points": SENSOR.points,
        "noise_mm": 1e3 * SENSOR.noise,
        "seed": SEED,
        "score": "geometric mean over the clips of the mean RMSE",
    }


def table(report: dict) -> str:
    """What every system reached with the chosen settings, best first, in Markdown."""
    names = report["meta"]["clips"]
    lines = [f"| | {' | '.join(names)} | geometric mean | ms per frame |", "|---" * (len(names) + 3) + "|"]
    reached = {name: method["score"] for name, method in report["methods"].items() if "score" in method}
    reached = {name: row for name, row in reached.items() if set(row["clips"]) == set(names)}
    for name, row in sorted(reached.items(), key=lambda item: item[1]["rmse_mm"]):
        cells = [f"{row['clips'][clip]['rmse_mm']:.1f} / {row['clips'][clip]['normal_rmse_mm']:.1f}" for clip in names]
        times = [row["clips"][clip]["cpu_ms_p50"] for clip in names]
        mean = f"{row['rmse_mm']:.1f} / {row['normal_rmse_mm']:.1f}"
        lines.append(f"| `{name}` | {' | '.join(cells)} | {mean} | {min(times):.0f}-{max(times):.0f} |")
    return "\n".join(lines)


def learned_tries(report: dict) -> str:
    """Every try of the learned method, and the garment that goes with the body, in Markdown."""
    carried, tries = report["methods"]["carried"]["score"], report["methods"]["clothfit"]["tries"]
    names = list(tries[0]["settings"])
    lines = [f"| {' | '.join(names)} | RMSE / normal RMSE in mm |", "|---" * (len(names) + 1) + "|"]
    lines.append(f"| `carried` {'| ' * (len(names) - 1)}| {carried['rmse_mm']:.2f} / {carried['normal_rmse_mm']:.2f} |")
    for row in tries:
        values = " | ".join(str(row["settings"][name]) for name in names)
        lines.append(f"| {values} | {row['rmse_mm']:.2f} / {row['normal_rmse_mm']:.2f} |")
    return "\n".join(lines)


def chosen_settings(report: dict) -> str:
    """What was chosen of every baseline, in Markdown; the values of axes that were searched come first."""
    lines = []
    for name, method in report["methods"].items():
        if "chosen" in method:
            searched = method["score"]["settings"]
            others = {key: value for key, value in method["chosen"].items() if key not in searched}
            texts = [", ".join(f"{key} {value}" for key, value in part.items()) for part in (searched, others)]
            lines.append(f"- `{name}`, {len(method['tries'])} tries: {texts[0]}" + (f"; as set: {texts[1]}" if others else ""))
    return "\n".join(lines)


def readable(report: dict) -> str:
    """JSON with a line per try."""
    methods = []
    for name, method in report["methods"].items():
        texts = {key: _lines(value) if key == "tries" else json.dumps(value) for key, value in method.items()}
        entries = [f"   {json.dumps(key)}: {text}" for key, text in texts.items()]
        methods.append(f"  {json.dumps(name)}: {{\n" + ",\n".join(entries) + "\n  }")
    return f'{{\n "meta": {json.dumps(report["meta"])},\n "methods": {{\n' + ",\n".join(methods) + "\n }\n}\n"


def _lines(rows: list[dict]) -> str:
    return "[\n    " + ",\n    ".join(map(json.dumps, rows)) + "\n   ]"


if __name__ == "__main__":
    sys.exit(main())
