"""Studies for the paper's tables and figures, on the available data."""

from __future__ import annotations

import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np

from ddakf.errors import DdakfError
from ddakf.evaluation import machine
from ddakf.evaluation.paper_scope import ALL_SYSTEMS, CLOUD_SYSTEMS, DROP_PERCENT, ERROR_MAPS, NOISE_MM
from ddakf.evaluation.sensors.virtual_sensor import front_camera
from ddakf.evaluation.splits import faust_split
from ddakf.evaluation.studies.frame_estimates import FrameEstimates, load_frame_estimates
from ddakf.evaluation.studies.study_plan import StudyPlan
from ddakf.evaluation.trials.recordings import FAUST, SAMPLE, depth_recording_names, faust_names, find_recording, recording_names
from ddakf.evaluation.trials.runs import estimate_frame
from ddakf.evaluation.trials.trial import Trial
from ddakf.evaluation.trials.variants import ablations, refinements

SWEPT = "0:61"  # frames of the sweeps
OCCLUDE, OCCLUSION_FRAMES = (38, 68), "0:101"  # of Figures 1 and 3
CAPTURES = ("samba_dress", "samba_whole")  # real captures without a body, which have a study of their own
DEPTH = 4  # number of recordings of a real depth camera


@dataclass(frozen=True)
class Size:
    """Size of the studies.

    Attributes:
        runs: seeds.
        swept_runs: seeds of the sweeps.
        frames: of every recording in the main study, ``A:B``.
        swept: of every recording in the sweeps.
        names: default sequences; empty for all available ones.
        sweeps: True for all levels of the sweeps, False for the first and the last.
        faust: clips at most.
    """

    runs: int = 5
    swept_runs: int = 5
    frames: str = ":"
    swept: str = SWEPT
    names: tuple[str, ...] = ()
    sweeps: bool = True
    faust: int = 16


FULL = Size()
QUICK = Size(runs=2, swept_runs=1, frames="0:31", swept="0:31", names=(SAMPLE, "skirt_walk"), sweeps=False, faust=0)


def studies(size: Size, names: list[str] | None = None) -> dict[str, StudyPlan]:
    """The studies by name.

    Args:
        size: :data:`FULL` or :data:`QUICK`.
        names: sequences with a body; None: those of the size, or the sample and the recordings under DDAKF_DATA.
    """
    captures = tuple(name for name in CAPTURES if name in recording_names())
    known = names or list(size.names) or [name for name in recording_names() if name not in CAPTURES]
    chosen = tuple(known)
    common = Trial("", surfaces=True)
    noise = NOISE_MM if size.sweeps else (NOISE_MM[0], NOISE_MM[-1])
    drop = DROP_PERCENT if size.sweeps else (DROP_PERCENT[0], DROP_PERCENT[-1])
    views = ("full+body", "front+body")
    plans = {}
    if size.faust and (clips := _clips(size.faust)):
        plans["faust"] = StudyPlan(clips, ALL_SYSTEMS, ("full",), size.runs, ":", common)
    plans |= {"main": StudyPlan(chosen, ALL_SYSTEMS, views, size.runs, size.frames, common)}

    def swept(settings: Trial) -> StudyPlan:
        return StudyPlan(chosen, ALL_SYSTEMS, views[:1], size.swept_runs, size.swept, settings)

    for level in noise:
        plans[f"noise-{level}"] = swept(replace(common, noise=level / 1e3))
    for level in drop:
        plans[f"drop-{level}"] = swept(replace(common, drop=level / 100))
    window = OCCLUDE if size.sweeps else (12, 22)
    if long_enough := tuple(name for name in chosen if len(find_recording(name)) > window[1]):  # that are seen again after it
        frames = OCCLUSION_FRAMES if size.sweeps else size.frames
        plans["occlusion"] = StudyPlan(long_enough, ALL_SYSTEMS, views[:1], size.runs, frames, replace(common, occlude=window))
    if captures and names is None and size.sweeps:
        plans["captures"] = StudyPlan(captures, CLOUD_SYSTEMS, ("full", "ring4"), size.runs, size.frames, common)
    recordings, pairs = depth_recording_names()
    if recordings and names is None and size.sweeps:
        plans["depth"] = StudyPlan(_spread(recordings, DEPTH), CLOUD_SYSTEMS, ("front",), 1, size.frames, common)
    if pairs and names is None and size.sweeps:
        plans["scene-flow"] = StudyPlan(tuple(pairs), CLOUD_SYSTEMS, ("front",), 1, ":", common)
    plans["ablation"] = StudyPlan(
        chosen, ("ddakf", *ablations(), *refinements(), "paper"), views, 1, size.swept, common
    )
    return plans


def _clips(most: int) -> tuple[str, ...]:
    """At most ``most`` clips of FAUST, evenly over subjects and poses: of the test subjects, or of all if there are none."""
    names = faust_names()
    test = faust_split(name.removeprefix(FAUST) for name in names).test
    return _spread([FAUST + clip for clip in test] or names, most)


def _spread(names: list[str], most: int) -> tuple[str, ...]:
    return tuple(names[k] for k in np.unique(np.linspace(0, len(names) - 1, min(most, len(names))).round().astype(int)))


def save_error_maps(size: Size, folder: Path, console, *, again: bool = False) -> None:
    """Runs the systems up to the frames of Figures 1 and 2, and saves their estimates. An existing file of the same frame stays;
    with ``again``, only if it is of the same commit."""
    for name, (view, noise, sequence, number) in ERROR_MAPS.items():
        view, _, body = view.partition("+")
        last = len(find_recording(sequence)) - 1
        number = min(number if size.sweeps else 30, last)
        trial = Trial(sequence, view, bool(body), noise=noise)
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
    return FrameEstimates(asdict(trial) | own, sequence.garment_vertices[number], sequence.garment_faces, estimates, eye)
