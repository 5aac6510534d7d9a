"""The studies that the paper's tables and figures need, on what data there is."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ddakf.evaluation import machine, methods, trials
from ddakf.evaluation.protocols import faust_split
from ddakf.evaluation.sensors import front_camera
from ddakf.evaluation.study import stills
from ddakf.evaluation.study.plan import METHODS, Plan
from ddakf.evaluation.trials import SAMPLE, Trial

NOISE_MM = (0, 1, 3, 5)  # Table 5
DROP_PERCENT = (0, 10, 20, 30, 40)  # Table 6
SWEPT = "0:61"  # frames of the sweeps
OCCLUDE, OCCLUSION_FRAMES = (38, 68), "0:101"  # of Figures 1 and 3
CAPTURES = ("samba_dress", "samba_whole")  # no body: a study of their own
ALL = (*METHODS, "icp-rigid")
CLOUD = tuple(name for name in ALL if name != "clothfit")  # what needs no body
DEPTH = 4  # recordings of a real depth camera


@dataclass(frozen=True)
class Size:
    """How much is run.

    Attributes:
        runs: seeds.
        swept_runs: seeds of the sweeps.
        frames: of every recording in the main study, ``A:B``.
        swept: of every recording in the sweeps.
        names: of the sequences, where nobody says others; none: all that there are.
        sweeps: the first and the last level alone, or all.
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


def studies(size: Size, names: list[str] | None = None) -> dict[str, Plan]:
    """The studies by name.

    Args:
        size: :data:`FULL` or :data:`QUICK`.
        names: sequences with a body; None: those of the size, or the sample and the recordings under DDAKF_DATA.
    """
    bare = tuple(name for name in CAPTURES if name in trials.names())
    known = names or list(size.names) or [name for name in trials.names() if name not in CAPTURES]
    chosen = tuple(known)
    common = Trial("", surfaces=True)
    noise = NOISE_MM if size.sweeps else (NOISE_MM[0], NOISE_MM[-1])
    drop = DROP_PERCENT if size.sweeps else (DROP_PERCENT[0], DROP_PERCENT[-1])
    views = ("full+body", "front+body")
    plans = {}
    if size.faust and (clips := _clips(size.faust)):
        plans["faust"] = Plan(clips, ALL, ("full",), size.runs, ":", common)
    plans |= {"main": Plan(chosen, ALL, views, size.runs, size.frames, common)}
    for level in noise:
        plans[f"noise-{level}"] = Plan(chosen, ALL, views[:1], size.swept_runs, size.swept, replace(common, noise=level / 1e3))
    for level in drop:
        plans[f"drop-{level}"] = Plan(chosen, ALL, views[:1], size.swept_runs, size.swept, replace(common, drop=level / 100))
    window = OCCLUDE if size.sweeps else (12, 22)
    if lasting := tuple(name for name in chosen if len(trials.recording(name)) > window[1]):  # that are seen again after it
        frames = OCCLUSION_FRAMES if size.sweeps else size.frames
        plans["occlusion"] = Plan(lasting, ALL, views[:1], size.runs, frames, replace(common, occlude=window))
    if bare and names is None and size.sweeps:
        plans["captures"] = Plan(bare, CLOUD, ("full", "ring4"), size.runs, size.frames, common)
    recordings, pairs = trials.sensed_names()
    if recordings and names is None and size.sweeps:
        plans["depth"] = Plan(_spread(recordings, DEPTH), CLOUD, ("front",), 1, size.frames, common)
    if pairs and names is None and size.sweeps:
        plans["scene-flow"] = Plan(tuple(pairs), CLOUD, ("front",), 1, ":", common)
    plans["ablation"] = Plan(
        chosen, ("ddakf", *methods.ablations(), *methods.refinements(), "paper"), views, 1, size.swept, common
    )
    return plans


def _clips(most: int) -> tuple[str, ...]:
    """So many clips of FAUST, evenly over subjects and poses: of those to be scored, or of all where none of them is at hand."""
    names = trials.faust_names()
    test = faust_split(name.removeprefix(trials.FAUST) for name in names).test
    return _spread([trials.FAUST + clip for clip in test] or names, most)


def _spread(names: list[str], most: int) -> tuple[str, ...]:
    return tuple(names[k] for k in np.unique(np.linspace(0, len(names) - 1, min(most, len(names))).round().astype(int)))


STILLS = {  # name: view, noise in metres, a recording that ships, frame
    "figure-1": ("front+body", 0.003, SAMPLE, 110),
    "figure-2": ("full+body", 0.010, "skirt_walk", 60),
}


def save_stills(size: Size, folder: Path, console, *, again: bool = False) -> None:
    """Runs the systems up to the frames that Figures 1 and 2 show; what is there of the same frame already is kept, or with
    ``again`` what is there of the same frame and commit."""
    for name, (view, noise, sequence, number) in STILLS.items():
        view, _, body = view.partition("+")
        last = len(trials.recording(sequence)) - 1
        number = min(number if size.sweeps else 30, last)
        trial = Trial(sequence, view, bool(body), noise=noise)
        path = folder / f"{name}.npz"
        if path.is_file():
            meta = stills.load(path).meta
            if Trial.of(meta) == trial and meta["frame"] == number and not (again and meta["commit"] != machine.commit()):
                continue
        console.print(f"[bold]{name}[/bold]: {sequence}, frame {number}")
        eye = front_camera(trials.recording(sequence)).eye
        stills.taken(trial, list(ALL), number, eye).save(path)
