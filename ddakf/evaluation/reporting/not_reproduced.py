"""Table of the paper's results that the report does not reproduce, with the reasons."""

from __future__ import annotations

import re
from collections.abc import Collection

from ddakf.evaluation.paper_scope import DROP_PERCENT, ERROR_MAPS, NOISE_MM, RUNS, SYSTEMS, TITLES
from ddakf.evaluation.reporting.paper_tables import Cell, Table
from ddakf.evaluation.reporting.result_files import Result
from ddakf.evaluation.splits import FAUST_TRAINING_SUBJECTS

TITLE = "What is not reproduced, and why"
ALWAYS = {
    "the paper's numbers": "seeds, weights, implementations and the scored recordings are not public",
    "FAUST as sequences": "FAUST is static and the paper does not say how it moves; here each pose is reached from the subject's "
    "neutral pose by interpolation within a second",
    "CLOTH3D": "not available; Tables 3 to 6 use simulated garments and, where present, the PERGAMO reconstruction, called "
    "CLOTH3D-like",
    "temporal flicker (TF)": "printed without formula or unit; the variance of acceleration is measured after a smoothing of "
    "ours, and a frozen mesh would win it: read the flicker of the error",
    "penetration": "no formula; here the mean over all vertices, 0 for those outside; beyond Table 3 the mean over those inside",
    "the paper's ClothFit": "network and weights are not public; this project's network has not seen the scored recording, its "
    "garment category or its motion",
    "the paper's frame rates": "it names no machine; times here are of the machine that each result names, under its load",
}
STUDIES = {
    "untouched": "the headline, on untouched recordings",
    "fresh": "the check on fresh recordings",
    "faust": "Tables 1 and 2", "main": "Tables 3, 4 and 7, and the calibration", "occlusion": "Figure 3 and the recovery",
    "captures": "captures without a body", "depth": "real depth", "scene-flow": "scene flow", "ablation": "the ablation",
} | {f"noise-{level}": f"Table 5, {level} mm" for level in NOISE_MM} | {
    f"drop-{level}": f"Table 6, {level} %" for level in DROP_PERCENT
}  # fmt: skip
WITHOUT_BODY = ("captures", "depth", "scene-flow", "ablation")  # not of all systems


def table(results: dict[str, Result], error_maps: Collection[str]) -> Table:
    """The table of missing results and their reasons.

    Args:
        results: by name.
        error_maps: names of the existing ones.
    """
    missing = [*_faust(results.get("faust")), *_not_run(results, error_maps), *_systems(results), *_few_runs(results)]
    pairs = [*ALWAYS.items(), *missing]
    return Table("missing", TITLE, ["what", "why"], [[Cell(what), Cell(why, kind="text")] for what, why in pairs])


def _faust(result: Result | None) -> list[tuple[str, str]]:
    """The row on the scored subjects, where they are not the paper's."""
    clips = [] if result is None else [re.search(r"s(\d+)_p\d+$", name) for name in result.sequences]
    subjects = sorted({int(clip[1]) for clip in clips if clip})
    if not FAUST_TRAINING_SUBJECTS & set(subjects):
        return []
    scored = f"the {len(clips)} clips of Table 1 are of subjects {', '.join(map(str, subjects))}"
    return [("FAUST's subjects 8 and 9, on which the paper tests", f"{scored}; no system here has learned from FAUST")]


def _not_run(results: dict[str, Result], error_maps: Collection[str]) -> list[tuple[str, str]]:
    missing = [
        (what, f"not run, or no data for it: ddakf evaluate --paper --only {name}")
        for name, what in STUDIES.items()
        if name not in results
    ]
    missing_maps = [name for name in ERROR_MAPS if name not in error_maps]
    return missing + [(name.replace("figure-", "Figure "), "not run: ddakf evaluate --paper") for name in missing_maps]


def _systems(results: dict[str, Result]) -> list[tuple[str, str]]:
    """Systems of the paper that a study was run without."""
    return [
        (f"{TITLES[method]}, {STUDIES[name]}", f"not among the systems that {name}.json was run with")
        for name, result in results.items()
        for method in SYSTEMS
        if name in STUDIES and name not in WITHOUT_BODY and method not in result.methods
    ]


def _few_runs(results: dict[str, Result]) -> list[tuple[str, str]]:
    counts: dict[int, list[str]] = {}
    for name, result in results.items():
        if name not in WITHOUT_BODY and len(result.meta["seeds"]) < RUNS:
            counts.setdefault(len(result.meta["seeds"]), []).append(f"{name}.json")
    return [(f"{RUNS} runs of each", f"{', '.join(files)}: {count} per cell") for count, files in sorted(counts.items())]
