"""Content of the report: the paper's Tables 1 to 7 and Figures 1 to 3, and tables beyond them."""

from __future__ import annotations

import os
import re
from dataclasses import replace
from pathlib import Path

from ddakf.evaluation.paper_scope import CONDITIONS, EVERY, RATE, TITLES, ordered
from ddakf.evaluation.reporting import headline, not_reproduced, paper_figures, paper_numbers, paper_tables
from ddakf.evaluation.reporting.page import Picture, page
from ddakf.evaluation.reporting.paper_tables import Table
from ddakf.evaluation.reporting.result_files import Result
from ddakf.evaluation.splits import labels_of, standing_of
from ddakf.evaluation.studies.frame_estimates import load_frame_estimates

TITLE = "DD-AKF and its baselines: the paper's tables and figures, measured"
INTRODUCTION = [
    "Columns headed 'in the paper' repeat what the paper prints. Its data, seeds, trained weights and implementations are not "
    "public, so that they stand here for orientation and are never compared with a test; every other number was measured by "
    "this project, with all systems fed the same clouds. The last sections say what is not reproduced and why, and where each "
    "number comes from: a cell that is pointed at names its file and runs.",
    "A number is the mean over sequences and views, ± the standard deviation of that mean over the runs, which differ by the "
    "seed of the sensor's noise. Views: full, points from all around; front, one depth camera; ring4, four; +body where the "
    "systems are told the body of every frame. Bold: the best system of the column, or of the row, of those that did not lose "
    "the garment (RMSE above 100 mm) in more than half of their runs. No system is best in what a frozen, rigid or torn garment "
    "would win. A dash: does not apply, or was not run.",
]
GEOMETRY = ("rmse_mm", "hausdorff_mm", "flicker", "acceleration_variance", "ms_per_frame", "fps")
CLOTH = ("rmse_mm", "iou", "stretch_percent", "bend_deg", "penetration_mm", "acceleration_variance", "flicker")
BEYOND = ("rmse_normal_mm", "rmse_tangential_mm", "hausdorff_mm", "stretch_error_percent", "bend_error_deg",
          "penetration_violating_mm", "penetration_share", "ms_per_frame", "fps", "memory_mib_per_frame")  # fmt: skip
UNTOUCHED_METRICS = ("rmse_mm", "rmse_normal_mm", "hausdorff_mm", "iou", "stretch_error_percent", "bend_error_deg",
                     "penetration_mm", "flicker", "ms_per_frame", "fps", "effective_sample_size")  # fmt: skip
DEPTH = ("held_out_share", "held_out_mm", "iou", "silhouette_covered", "silhouette_inside", "limb_mm", "moved_limb_mm",
         "drift_mm", "residual_mm", "stretch_percent", "own_flicker")  # fmt: skip
UNTOUCHED_TESTED = ("rmse_mm", "rmse_normal_mm", "penetration_mm", "flicker")
JUDGED = ("rmse_mm", "rmse_normal_mm", "hausdorff_mm", "iou", "stretch_error_percent", "bend_error_deg",
          "penetration_mm", "flicker")  # fmt: skip
TESTED = ("rmse_mm", "hausdorff_mm", "iou", "stretch_percent", "stretch_error_percent", "bend_deg", "bend_error_deg",
          "penetration_mm", "flicker", "acceleration_variance")  # fmt: skip
LESS = (
    "Of stretch, bend and variance of acceleration less is called better, as in the paper; a rigid or a frozen garment would win "
    "them."
)
NEVER = "No run of any system came back to within 1.5 times its error before the occlusion."


def write(results: dict[str, Result], folder: Path, out: Path) -> None:
    """Renders the tables and figures for which there are results.

    Args:
        results: by name.
        folder: of the results and of the frame estimates.
        out: for index.html and the pictures.
    """
    *numbers, absent = tables_of(results, folder)
    parts = [*numbers, *_error_maps(folder, out), *_drawn(results, out), absent]
    (out / "index.html").write_text(page(TITLE, INTRODUCTION, parts, list(results.values()), os.path.relpath(folder, out)))


def tables_of(results: dict[str, Result], folder: Path, *, brief: bool = False) -> list[Table]:
    """The tables for which a folder has results; the last one lists the missing ones.

    Args:
        results: by name.
        folder: they were read from.
        brief: as a document quotes them: the tests in short and over all views, nothing that another table has.
    """
    studies = [*_untouched(results), *_faust(results, brief), *_cloth(results, brief), *_depth(results)]
    parts = [*studies, *_sweeps(results), *_occlusion(results, brief), *_reliability(results)]
    for table in parts:
        for source in table.sources:
            table.notes += [note for note in (source.constants, source.mixed_runs, source.untraceable) if note]
    return [*parts, not_reproduced.table(results, [path.stem for path in folder.glob("*.npz")])]


def _untouched(results: dict[str, Result]) -> list[Table]:
    """The headline, and every number behind it."""
    if "untouched" not in results:
        return []
    result, judged = results["untouched"], [results[name] for name in ("untouched", "fresh") if name in results]
    parts = [headline.table(result), headline.calibration(judged)]
    if "fresh" in results:
        parts.append(headline.table(results["fresh"], "fresh", "Fresh recordings"))
    known = [value for value in UNTOUCHED_METRICS if any(result.pooled(method, value) for method in result.methods)]
    for view in result.views:
        title = f"Untouched recordings, {CONDITIONS.get(view, view)}"
        parts.append(paper_tables.comparison(f"untouched-{view}", title, result, known, {}, view))
        parts.append(paper_tables.significance(
            f"untouched-tests-{view}", f"{title}: every system against DD-AKF", result, UNTOUCHED_TESTED, {}, view
        ))  # fmt: skip
    parts.append(paper_tables.behind("untouched-behind", "Where DD-AKF does not win, untouched recordings", result, JUDGED))
    parts.append(paper_tables.by_sequence("untouched-by-sequence", "RMSE in mm by untouched recording", result, "rmse_mm"))
    return parts


def _faust(results: dict[str, Result], brief: bool) -> list[Table]:
    if "faust" not in results:
        return []
    result, tested = results["faust"], ("rmse_mm", "hausdorff_mm", "flicker", "acceleration_variance")
    name, title = "table-2", "Table 2: FAUST, every system against DD-AKF"
    return [
        paper_tables.comparison("table-1", "Table 1: FAUST", result, GEOMETRY, paper_numbers.FAUST),
        paper_tables.effects(name, title, result, tested) if brief
        else paper_tables.significance(name, title, result, tested, paper_numbers.FAUST_P),
    ]  # fmt: skip


def _cloth(results: dict[str, Result], brief: bool) -> list[Table]:
    if "main" not in results:
        return []
    result, parts = results["main"], []
    for view in result.views:
        heading, repeated = f"Table 3: CLOTH3D-like, {view}", brief and parts
        printed = {} if repeated else paper_numbers.CLOTH3D
        parts.append(paper_tables.comparison(f"table-3-{view}", heading, result, CLOTH, printed, view))
        heading = f"Beyond the metrics of Table 3: CLOTH3D-like, {view}"
        parts.append(paper_tables.comparison(f"beyond-{view}", heading, result, BEYOND, {}, view))
    parts += [replace(test, notes=[LESS, *test.notes]) for test in _tested(result, brief)]
    parts.append(paper_tables.behind("behind", "Where DD-AKF does not win", result, JUDGED))
    parts.append(paper_tables.by_sequence("by-sequence", "RMSE in mm by sequence", result, "rmse_mm"))
    if not brief:
        title = "Leave-garment-category-out: RMSE in mm by garment category; ClothFit has learned from no garment of it"
        parts.append(paper_tables.by_sequence("by-category", title, result, "rmse_mm", head="garment",
                                        group=lambda name: labels_of(Path(name).stem).garment))  # fmt: skip
    return parts


def _tested(result: Result, brief: bool) -> list[Table]:
    """Table 4, over all views and of each."""
    name, title = "table-4-{}", "Table 4: CLOTH3D-like, every system against DD-AKF, {}"
    if brief:
        return [paper_tables.effects(name.format("all"), title.format("all views"), result, TESTED)]
    views = {"all": "all views"} | {view: view for view in result.views if len(result.views) > 1}
    return [
        paper_tables.significance(name.format(view), title.format(words), result, TESTED, paper_numbers.CLOTH3D_P, view)
        for view, words in views.items()
    ]


def _depth(results: dict[str, Result]) -> list[Table]:
    parts = []
    if "captures" in results:
        title = "RMSE in mm on real captures without a body"
        parts.append(paper_tables.by_sequence("captures", title, results["captures"], "rmse_mm"))
    if "depth" in results:
        parts.append(paper_tables.comparison("depth", "Real depth without truth, means", results["depth"], DEPTH, {}))
    for name, title, value in (
        ("depth", "Real depth: joints more than 15 cm from their start, distance to the skeleton's, mm", "moved_limb_mm"),
        ("depth", "Real depth: share of held-out pixels whose depth is predicted within 30 mm", "held_out_share"),
        ("depth", "Real depth: mean distance of the points to the surface, mm", "residual_mm"),
        ("scene-flow", "DeepDeform: end-point error of the scene flow, mm", "end_point_error_mm"),
    ):  # fmt: skip
        if name in results and any(cell["mean"] and cell["mean"].get(value) is not None for cell in results[name].cells):
            parts.append(paper_tables.by_sequence(f"{name}-{value}", title, results[name], value))
    if "depth" in results and any(cell["runs"] for cell in results["depth"].cells_of("ddakf")):
        title = "Real depth: DD-AKF's reliability against what can be measured"
        parts.append(paper_tables.depth_reliability("depth-reliability", title, results["depth"]))
    return parts


def _occlusion(results: dict[str, Result], brief: bool) -> list[Table]:
    if "occlusion" not in results:
        return []
    result = results["occlusion"]
    never = "Frames after the occlusion until the error is within 1.5 times that before it; runs that never are do not count"
    recovery = paper_tables.by_sequence("recovery", never, result, "recovery_frames")
    counts = []
    for method in ordered(result.methods):
        runs = [run["recovery_frames"] for cell in result.cells_of(method) for run in cell["runs"]]
        counts.append(f"{TITLES.get(method, method)} {len(runs) - runs.count(None)} of {len(runs)}")
    recovery.notes.append(f"Runs that came back: {', '.join(counts)}.")
    if not any(result.pooled(method, "recovery_ratio") for method in result.methods):
        return [recovery]
    title = "Error of the last ten frames after the occlusion, in multiples of that of the ten before it"
    ratio = paper_tables.by_sequence("recovery-ratio", title, result, "recovery_ratio")
    if brief and not any(result.pooled(method, "recovery_frames") for method in result.methods):
        return [replace(ratio, notes=[*ratio.notes, NEVER])]
    return [recovery, ratio]


def _sweeps(results: dict[str, Result]) -> list[Table]:
    parts = []
    for kind, title, value, paper, unit in (
        ("noise", "Table 5: RMSE in mm with noise", "rmse_mm", paper_numbers.NOISE, "noise, mm"),
        ("drop", "Table 6: penetration in mm with missing points", "penetration_mm", paper_numbers.DROP, "missing, %"),
        ("outliers", "RMSE in mm with outliers", "rmse_mm", {}, "outliers, %"),
        ("rate", "RMSE in mm at other frame rates", "rmse_mm", {}, "frames per second"),
    ):
        levels = {int(m[1]): r for name, r in results.items() if (m := re.fullmatch(rf"{kind}-(\d+)", name))}
        if kind == "rate":
            levels |= {RATE // n: results[f"every-{n}"] for n in EVERY if f"every-{n}" in results}
        if levels:
            parts.append(paper_tables.sweep(f"table-{kind}", title, levels, value, paper, unit))
    return parts


def _reliability(results: dict[str, Result]) -> list[Table]:
    wanted = [results[name] for name in ("main", "occlusion") if name in results]
    title = "Table 7: rank correlation of the scores with the error, mean over runs of that within each"
    return [paper_tables.reliability("table-7", title, wanted)] if wanted else []


def _error_maps(folder: Path, out: Path) -> list[Picture]:
    parts = []
    for name, title in (
        ("figure-1", "Figure 1: error under self-occlusion"), ("figure-2", "Figure 2: error under high noise"),
    ):  # fmt: skip
        path = folder / f"{name}.npz"
        if path.is_file():
            frame = load_frame_estimates(path)
            meta = frame.meta
            view = meta["view"] + ("+body" if meta["body"] else "")
            caption = f"{meta['sequence']}, {view}, frame {meta['frame']}, noise {1e3 * meta['noise']:g} mm, seed {meta['seed']}."
            if lost := paper_figures.lost_in(frame):
                caption += f" Lost the garment, and have no panel: {', '.join(TITLES.get(m, m) for m in lost)}."
            for system, why in meta["missing"].items():
                caption += f" {TITLES.get(system, system)} is missing: {why}."
            words = f"{meta['sequence']} ({standing_of(meta['sequence'])}), {CONDITIONS.get(view, view)}, frame {meta['frame']}"
            paper_figures.error_maps(out / f"{name}.png", frame, words)
            parts.append(Picture(f"{name}.png", title, caption, f"{name}.npz, commit {meta['commit']}, {meta['date']}"))
    return parts


def _drawn(results: dict[str, Result], out: Path) -> list[Picture]:
    parts = []
    if "occlusion" in results:
        result = results["occlusion"]
        sequence, view = result.sequences[0], result.views[0]
        paper_figures.over_time(out / "figure-3.png", result, sequence, view)
        title = "Figure 3: error and reliability over time"
        parts.append(Picture("figure-3.png", title, "Means over the runs.", "occlusion.json"))
    if "ablation" in results:
        paper_figures.ablation(out / "ablation.png", results["ablation"])
        caption = "The default, the default without one of its parts each, and the method as printed; means over the sequences."
        parts.append(Picture("ablation.png", "Ablation", caption, "ablation.json"))
    if "untouched" in results:
        paper_figures.speed(out / "speed.png", results["untouched"])
        caption = "Geometric means over untouched recordings; lines: systems that use no cloud."
        parts.append(Picture("speed.png", "Error against time", caption, "untouched.json"))
    if "depth" in results and any("per_frame" in run for cell in results["depth"].cells for run in cell["runs"]):
        paper_figures.residuals(out / "depth.png", results["depth"])
        caption = "Mean distance of the points to the surface."
        parts.append(Picture("depth.png", "Real depth: residual over time", caption, "depth.json"))
    for name in ("untouched", "main"):
        if name in results and results[name].cells_of("ddakf"):
            paper_figures.calibration(out / "calibration.png", results[name])
            caption = "Pooled over vertices, frames, sequences, views and runs."
            parts.append(Picture("calibration.png", "Calibration of the claimed uncertainty", caption, f"{name}.json"))
            break
    return parts
