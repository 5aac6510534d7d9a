"""Studies for the paper's tables and figures, on the available data."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from ddakf.errors import DdakfError
from ddakf.evaluation import machine
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.paper_scope import (
    ALL_SYSTEMS,
    CLOUD_SYSTEMS,
    CONDITIONS,
    DROP_PERCENT,
    ERROR_MAPS,
    EVERY,
    NOISE_MM,
    OUTLIER_PERCENT,
)  # fmt: skip
from ddakf.evaluation.sensors.virtual_sensor import front_camera
from ddakf.evaluation.splits import faust_split
from ddakf.evaluation.studies.frame_estimates import FrameEstimates, load_frame_estimates
from ddakf.evaluation.studies.study_plan import StudyPlan
from ddakf.evaluation.trials.recordings import (
    AT,
    FAUST,
    SAMPLE,
    depth_recording_names,
    faust_names,
    find_recording,
    recording_names,
)
from ddakf.evaluation.trials.runs import estimate_frame
from ddakf.evaluation.trials.trial import Trial, sensor_of
from ddakf.evaluation.trials.variants import ablations, refinements

MOVING = "30:91"  # frames of the untouched recordings and of the sweeps: all are in motion by then
FASTER, MOVING_FASTER = 60, "60:181"  # frames per second, and the frames of the same two seconds
OCCLUDE, OCCLUSION_FRAMES = (38, 68), "0:101"  # of Figures 1 and 3
CAPTURES = ("samba_dress", "samba_whole")  # real captures without a body, which have a study of their own


@dataclass(frozen=True)
class Size:
    """Size of the studies.

    Attributes:
        runs: seeds.
        swept_runs: seeds of the sweeps.
        frames: of every recording in the main study, ``A:B``.
        moving: of the untouched recordings, and of those of the sweeps.
        names: default sequences; empty for all available ones.
        sweeps: True for all levels of the sweeps on untouched recordings, False for the first and the last on the main study's.
        faust: clips at most.
    """

    runs: int = 5
    swept_runs: int = 5
    frames: str = ":"
    moving: str = MOVING
    names: tuple[str, ...] = ()
    sweeps: bool = True
    faust: int = 16


FULL = Size()
QUICK = Size(runs=2, swept_runs=1, frames="0:31", moving="0:31", names=(SAMPLE, "skirt_walk"), sweeps=False, faust=0)


def studies(size: Size, names: list[str] | None = None) -> dict[str, StudyPlan]:
    """The studies by name.

    Args:
        size: :data:`FULL` or :data:`QUICK`.
        names: sequences with a body, untouched or not; None: those of the size, or the untouched recordings of the collection,
            the sample and the recordings under DDAKF_DATA.
    """
    held_out = [each.name for each in collection.listed(collection.HELD_OUT)] if size.sweeps else []
    captures = tuple(name for name in CAPTURES if name in recording_names())
    known = names or list(size.names) or [name for name in recording_names() if name not in CAPTURES]
    chosen = tuple(name for name in known if name not in held_out)
    untouched = tuple(name for name in held_out if names is None or name in names)
    common, views, plans = Trial("", surfaces=True), tuple(CONDITIONS), {}
    if untouched:
        plans["untouched"] = StudyPlan(untouched, ALL_SYSTEMS, views, size.runs, size.moving, common)
    if fresh := tuple(each.name for each in collection.listed(collection.FRESH) if size.sweeps and names is None):
        plans["fresh"] = StudyPlan(fresh, ALL_SYSTEMS, views, size.runs, size.moving, common)
    if size.faust and (clips := _clips(size.faust)):
        plans["faust"] = StudyPlan(clips, ALL_SYSTEMS, ("full",), size.runs, ":", common)
    if chosen:
        plans["main"] = StudyPlan(chosen, ALL_SYSTEMS, views, size.runs, size.frames, common)
    swept = untouched or chosen
    for name, settings in _degraded(common, size.sweeps).items():
        plans[name] = StudyPlan(swept, ALL_SYSTEMS, views[:1], size.swept_runs, size.moving, settings)
    if untouched:
        twice = tuple(f"{name}{AT}{FASTER}" for name in swept)
        plans[f"rate-{FASTER}"] = StudyPlan(twice, ALL_SYSTEMS, views[:1], size.swept_runs, MOVING_FASTER, common)
    window = OCCLUDE if size.sweeps else (12, 22)
    if long_enough := tuple(name for name in swept if len(find_recording(name)) > window[1]):  # that are seen again after it
        frames = OCCLUSION_FRAMES if size.sweeps else size.frames
        plans["occlusion"] = StudyPlan(long_enough, ALL_SYSTEMS, views[:1], size.runs, frames, replace(common, occlude=window))
    if captures and names is None and size.sweeps:
        plans["captures"] = StudyPlan(captures, CLOUD_SYSTEMS, ("full", "ring4"), size.runs, size.frames, common)
    recordings, pairs = depth_recording_names()
    if recordings and names is None and size.sweeps:
        plans["depth"] = StudyPlan(tuple(recordings), CLOUD_SYSTEMS, ("front",), 1, size.frames, common)
    if pairs and names is None and size.sweeps:
        plans["scene-flow"] = StudyPlan(tuple(pairs), CLOUD_SYSTEMS, ("front",), 1, ":", common)
    if chosen:
        systems = ("ddakf", *ablations(), *refinements(), "paper")
        plans["ablation"] = StudyPlan(chosen, systems, views, 1, size.moving, common)
    return plans


def _degraded(common: Trial, whole: bool) -> dict[str, Trial]:
    """The settings of the sweeps by name: all levels, or the first and the last."""
    def levels(values: tuple[int, ...]) -> tuple[int, ...]:
        return values if whole else (values[0], values[-1])

    return (
        {f"noise-{level}": replace(common, noise=level / 1e3) for level in levels(NOISE_MM)}
        | {f"drop-{level}": replace(common, drop=level / 100) for level in levels(DROP_PERCENT)}
        | {f"outliers-{level}": replace(common, outliers=level / 100) for level in levels(OUTLIER_PERCENT)}
        | {f"every-{level}": replace(common, every=level) for level in levels(EVERY)}
    )


def _clips(most: int) -> tuple[str, ...]:
    """At most ``most`` clips of FAUST, evenly over subjects and poses: of the test subjects, or of all if there are none."""
    names = faust_names()
    test = faust_split(name.removeprefix(FAUST) for name in names).test
    return _spread([FAUST + clip for clip in test] or names, most)


def _spread(names: list[str], most: int) -> tuple[str, ...]:
    return tuple(names[k] for k in np.unique(np.linspace(0, len(names) - 1, min(most, len(names))).round().astype(int)))


def save_error_maps(figures: list[str], size: Size, folder: Path, console, *, again: bool = False) -> None:
    """Runs the systems up to the frames of these figures, and saves their estimates. An existing file of the same frame stays;
    with ``again``, only if it is of the same commit."""
    for name in figures:
        view, noise, sequence, number = ERROR_MAPS[name]
        view, _, body = view.partition("+")
        first = int(MOVING.partition(":")[0])
        number = number if size.sweeps else first + 10
        trial = Trial(sequence, view, bool(body), noise=noise, first=first)
        path = folder / f"{name}.npz"
        if path.is_file():
            meta = load_frame_estimates(path).meta
            if Trial.from_row(meta) == trial and meta["frame"] == number and not (again and meta["commit"] != machine.commit()):
                continue
        console.print(f"[bold]{name}[/bold]: {sequence}, frame {number}")
        eye = front_camera(find_recording(sequence)).eye
        frame_estimates_of(trial, list(ALL_SYSTEMS), number, eye).save(path)


def frame_estimates_of(trial: Trial, systems: list[str], number: int, eye: np.ndarray) -> FrameEstimates:
    """Runs the systems up to one frame. Those that do not apply or fail are left out and listed in ``meta``."""
    estimates, missing = {}, {}
    for system in systems:
        try:
            estimates[system] = estimate_frame(replace(trial, variant=system), number)
        except DdakfError as error:
            missing[system] = str(error)
    sequence = find_recording(trial.sequence)
    own = {"frame": number, "missing": missing, "commit": machine.commit(), "date": time.strftime("%Y-%m-%d")}
    cloud = sensor_of(trial).capture(sequence, number, np.random.default_rng([trial.seed, number]))
    truth, faces = sequence.garment_vertices[number], sequence.garment_faces
    return FrameEstimates(asdict(trial) | own, truth, faces, estimates, eye, cloud.points)
