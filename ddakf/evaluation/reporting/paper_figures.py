"""Figures of the report, drawn with matplotlib (extra ``evaluation``): the paper's, the ablation, the calibration."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ddakf.evaluation import statistics
from ddakf.evaluation.drawing import pictures
from ddakf.evaluation.drawing.diagrams import COLOURS, STYLES, figure
from ddakf.evaluation.metrics.calibration import NOMINAL_PROBABILITIES
from ddakf.evaluation.paper_scope import TITLES, ordered
from ddakf.evaluation.reporting.result_files import Result
from ddakf.evaluation.sensors.camera import Camera, Intrinsics
from ddakf.evaluation.studies.frame_estimates import FrameEstimates
from ddakf.kernels import zbuffer
from ddakf.mesh import vertex_normals

PANEL = 340  # pixels, of a panel's height
FOCAL = 1.6  # panel heights
INK = "#23262e"
COLOUR = {
    "kf": "#999999", "icp": "#e69f00", "icp-rigid": "#f0e442", "pf": "#56b4e9", "clothfit": "#cc79a7", "opt-ed": "#009e73",
    "nicp": "#0072b2", "paper": "#7a5230", "ddakf": "#d55e00",
}  # fmt: skip
WITHOUT = {
    "no-planes": "point-to-point", "one-association": "one association per frame", "no-visibility": "without visibility",
    "no-correlation": "without motion's correlation", "no-carrying": "without carrying by the body",
    "no-softening": "without softening", "no-levels": "without coarse levels", "no-hems": "without hems",
    "no-holding": "without holding to the body",
}  # fmt: skip  # the variants of methods.ablations and methods.refinements


def error_maps(path: Path, frame: FrameEstimates, title: str) -> None:
    """The estimates of all systems for one frame, coloured by the distance of each vertex from the truth, on one scale.

    Args:
        path: of the picture.
        frame: the estimates, and the truth.
        title: above it.
    """
    methods = ordered(frame.estimates)
    errors = {m: 1e3 * np.linalg.norm(frame.estimates[m] - frame.truth, axis=1) for m in methods}
    rmse = {m: float(np.sqrt(np.mean(errors[m] ** 2))) for m in methods}
    following = [errors[m] for m in methods if not statistics.lost([rmse[m]])[0]] or list(errors.values())
    top = pictures.round_up(float(np.percentile(np.concatenate(following), 97)))  # lost estimates exceed any scale
    camera = _camera(frame)
    columns = min(len(methods) + 1, 5)
    rows = -(-(len(methods) + 1) // columns)
    drawn = figure(1.9 * columns + 0.9, 2.7 * rows + 0.4)
    axes = drawn.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    axes[0].imshow(_painted(frame.truth, frame.faces, None, top, camera))
    axes[0].set_title("the truth\n", fontsize=9)
    for axis, method in zip(axes[1:], methods, strict=False):
        axis.imshow(_painted(frame.estimates[method], frame.faces, errors[method], top, camera))
        axis.set_title(f"{TITLES.get(method, method)}\nRMSE {rmse[method]:.1f} mm", fontsize=9)
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    scale = LinearSegmentedColormap.from_list("error", pictures.COLOURS / 255)
    bar = drawn.colorbar(ScalarMappable(Normalize(0, top), scale), ax=list(axes), shrink=0.7, extend="max")
    bar.set_label("distance from the true vertex, mm")
    drawn.suptitle(title, fontsize=10)
    _save(drawn, path)


def over_time(path: Path, result: Result, sequence: str, view: str) -> None:
    """RMSE of all systems and DD-AKF's reliability, frame by frame, means over the runs; the occlusion is shaded."""
    drawn = figure(8.0, 5.2)
    above, below = drawn.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    for method in ordered(result.methods):
        runs = [r for c in result.cells_of(method, lambda c: (c["sequence"], c["view"]) == (sequence, view)) for r in c["runs"]]
        if not runs:
            continue
        number = np.array(runs[0]["per_frame"]["number"])
        rmse = np.mean([run["per_frame"]["rmse_mm"] for run in runs], axis=0)
        ours = method == "ddakf"
        above.plot(number, rmse, label=TITLES.get(method, method), color=COLOUR.get(method), linewidth=2.2 if ours else 1.1)
        if ours:
            for name, style in (("reliability", "-"), ("paper_score", ":")):
                values = np.mean([run["per_frame"][name] for run in runs], axis=0)
                label = "reliability" if name == "reliability" else "s_k of the paper"
                below.plot(number, values, style, color=COLOUR["ddakf"], label=label)
    above.set(ylabel="RMSE, mm", yscale="log")
    below.set(ylabel="DD-AKF's score", xlabel="frame", ylim=(0, 1.02))
    first, end = result.meta["conditions"]["occlude"]
    for axis in (above, below):
        axis.axvspan(first - 0.5, end - 0.5, color="0.88", zorder=0)
        axis.spines[["top", "right"]].set_visible(False)
    below.legend(frameon=False, fontsize=8, loc="lower left")
    above.legend(frameon=False, fontsize=8, loc="upper left", bbox_to_anchor=(1.0, 1.0))
    above.set_title(f"{sequence}, {view}: a side of the garment is hidden in the shaded frames", fontsize=10, loc="left")
    _save(drawn, path)


def ablation(path: Path, result: Result) -> None:
    """RMSE of the default and of it without each of its parts, in each view."""
    methods = result.methods
    drawn = figure(9.0, 0.32 * len(methods) + 1.0)
    axes = drawn.subplots(1, len(result.views), sharey=True, squeeze=False).ravel()
    for axis, view in zip(axes, result.views, strict=True):
        pools = [result.pooled(m, "rmse_mm", lambda c, view=view: c["view"] == view) for m in methods]
        values = [np.nan if pool is None else pool.mean for pool in pools]
        names = [WITHOUT.get(m, TITLES.get(m, m)) for m in methods]
        axis.scatter(values, names, color=[COLOUR["ddakf"] if m == "ddakf" else INK for m in methods], zorder=2)
        for k, value in enumerate(values):
            axis.text(value, k, f"   {value:.1f}", va="center", fontsize=8, color=INK)
        axis.set(xlabel="RMSE, mm", title=view, xscale="log")
        axis.margins(x=0.18)
        axis.grid(axis="y", color="0.9")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].invert_yaxis()  # that all share: the default above
    _save(drawn, path)


def calibration(path: Path, result: Result) -> None:
    """Probability of the claimed ellipsoids against the share of vertices inside, of the default and as printed."""
    drawn = figure(5.0, 5.4)
    axes = drawn.subplots()
    axes.plot([0, 1], [0, 1], color="0.6", linewidth=1, label="calibrated")
    number = 0
    for method in ("ddakf", "paper"):
        runs = [run for cell in result.cells_of(method) for run in cell["runs"]]
        for group in ("observed", "hidden"):
            parts = [run["calibration"][group] for run in runs if group in run["calibration"]]
            if not parts:
                continue
            weight = np.array([part["n"] for part in parts], float)
            inside = np.average([part["inside"] for part in parts], axis=0, weights=weight)
            label = f"{TITLES[method]}, {group}"
            style = {"color": COLOURS[number % len(COLOURS)], "linestyle": STYLES[number % len(STYLES)]}
            axes.plot([0, *NOMINAL_PROBABILITIES], [0, *inside], marker=".", markersize=4, label=label, **style)
            number += 1
    axes.set(xlim=(0, 1), ylim=(0, 1), aspect="equal")
    axes.set(xlabel="probability of the claimed ellipsoid", ylabel="share of vertices inside it")
    drawn.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=8)
    _save(drawn, path)


def _camera(frame: FrameEstimates) -> Camera:
    """The camera at the figure's eye whose panel the truth fills."""
    centre = (frame.truth.min(axis=0) + frame.truth.max(axis=0)).astype(np.float64) / 2
    unit = Camera.looking_at(Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0), np.asarray(frame.eye, np.float64), centre)
    spot = unit.project(frame.truth)
    low, high = spot.min(axis=0), spot.max(axis=0)
    margin = 0.08 * (high - low).max()
    size = high - low + 2 * margin
    focal = PANEL / size[1]
    width = round(float(focal * size[0]))
    cx, cy = np.array([width, PANEL]) / 2 - focal * (low + high) / 2
    return Camera(Intrinsics(width, PANEL, focal, focal, cx, cy), unit.eye, unit.axes)


def _painted(vertices: np.ndarray, faces: np.ndarray, values: np.ndarray | None, top: float, camera: Camera) -> np.ndarray:
    """(H, W, 3) uint8: a surface coloured by values (V,), grey without them, shaded by a light at the camera."""
    vertices, faces = np.asarray(vertices, np.float64), np.ascontiguousarray(faces, np.int64)
    depth, face = camera.render([(vertices, faces)])
    image = np.full((*depth.shape, 3), 255.0)
    ray = camera.eye - vertices
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    shade = 0.6 + 0.4 * np.abs((vertex_normals(vertices, faces) * ray).sum(axis=1, keepdims=True))
    colour = (np.full((len(vertices), 3), 184.0) if values is None else pictures.colours(values, top)) * shade
    zbuffer.interpolate(camera.to_camera(vertices), faces, colour, camera.lens, 0, face, image)
    return np.clip(image, 0, 255).astype(np.uint8)


def _save(drawn, path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    drawn.savefig(path, dpi=130)
