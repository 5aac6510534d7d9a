"""Figures of the report, drawn with matplotlib (extra ``evaluation``): the paper's, the ablation, the calibration."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from ddakf.evaluation import statistics
from ddakf.evaluation.drawing import pictures
from ddakf.evaluation.drawing.diagrams import COLOURS, STYLES, figure
from ddakf.evaluation.metrics.calibration import NOMINAL_PROBABILITIES
from ddakf.evaluation.paper_scope import CONDITIONS, REFERENCES, TITLES, ordered
from ddakf.evaluation.reporting import headline
from ddakf.evaluation.reporting.result_files import Result
from ddakf.evaluation.sensors.camera import Camera, Intrinsics
from ddakf.evaluation.studies.frame_estimates import FrameEstimates
from ddakf.kernels import zbuffer
from ddakf.mesh import vertex_normals

PANEL = 340  # pixels, of a panel's height
SMALL, LARGE, DPI = 7.5, 9.0, 150  # points, of the texts in print; dots per inch
POINT = (40, 70, 120)
MOST_LINES = 5  # of Figure 3
BESIDE = ((0.98, "right", "bottom"), (0.02, "left", "top"))  # labels of the references' lines, where few systems are
MARKERS = {"kf": "v", "icp": "s", "icp-rigid": "P", "pf": "^", "opt-ed": "D", "nicp": "o", "paper": "x", "printed": "X",
           "ddakf": "*"}  # fmt: skip
INK = "#23262e"
COLOUR = {
    "kf": "#999999", "icp": "#e69f00", "icp-rigid": "#8c6d00", "pf": "#56b4e9", "clothfit": "#cc79a7", "opt-ed": "#009e73",
    "nicp": "#0072b2", "paper": "#7a5230", "printed": "#b58a5f", "ddakf": "#d55e00",
    "still": "#444444", "carried": "#888888",
}  # fmt: skip
WITHOUT = {
    "no-planes": "point-to-point", "one-association": "one association per frame", "no-visibility": "without visibility",
    "no-correlation": "without motion's correlation", "no-carrying": "without carrying by the body",
    "no-softening": "without softening", "no-clusters": "without clusters", "no-hems": "without hems",
    "no-holding": "without holding to the body",
    "no-following": "without hidden cloth that follows",
    "no-weight": "without weight of the cloth",
}  # fmt: skip  # the variants of methods.ablations and methods.refinements


def error_maps(path: Path, frame: FrameEstimates, title: str) -> None:
    """The cloud, and the estimates for one frame, coloured by the distance of each vertex from the truth, on one scale.

    Systems that lost the garment have no panel: they are named in the caption.

    Args:
        path: of the picture.
        frame: the estimates, and the truth.
        title: above it.
    """
    errors = {m: 1e3 * np.linalg.norm(frame.estimates[m] - frame.truth, axis=1) for m in ordered(frame.estimates)}
    rmse = {m: float(np.sqrt(np.mean(errors[m] ** 2))) for m in errors}
    methods = [m for m in errors if not statistics.lost([rmse[m]])[0]] or list(errors)
    top = pictures.round_up(float(np.median([np.percentile(errors[m], 80) for m in methods])))
    camera = _camera(frame, [frame.estimates[m] for m in methods])
    shown = [("input\n", _cloud_image(frame, camera))] if frame.points is not None else []
    shown.append(("truth\n", _painted(frame.truth, frame.faces, None, top, camera)))
    shown += [
        (f"{_wrapped(m)}\n{rmse[m]:.0f} mm RMSE", _painted(frame.estimates[m], frame.faces, errors[m], top, camera))
        for m in methods
    ]
    columns = min(len(shown), 5)
    rows = -(-len(shown) // columns)
    width = 1.45
    drawn = figure(width * columns + 0.8, rows * (width * camera.intrinsics.height / camera.intrinsics.width + 0.5) + 0.3)
    axes = drawn.subplots(rows, columns, squeeze=False).ravel()
    for axis in axes:
        axis.set_axis_off()
    for axis, (name, image) in zip(axes, shown, strict=False):
        axis.imshow(image)
        axis.set_title(name, fontsize=SMALL)
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import LinearSegmentedColormap, Normalize

    scale = LinearSegmentedColormap.from_list("error", pictures.COLOURS / 255)
    bar = drawn.colorbar(ScalarMappable(Normalize(0, top), scale), ax=list(axes), shrink=0.7, extend="max")
    bar.set_label("distance from the true vertex, mm", fontsize=SMALL)
    bar.ax.tick_params(labelsize=SMALL)
    drawn.suptitle(title, fontsize=LARGE)
    _save(drawn, path)


def _wrapped(method: str) -> str:
    """The title of a system in lines that a panel holds."""
    return textwrap.fill(TITLES.get(method, method), 24, break_on_hyphens=False)


def lost_in(frame: FrameEstimates) -> list[str]:
    """The systems that lost the garment by this frame."""
    rmse = {m: 1e3 * float(np.sqrt(np.square(frame.estimates[m] - frame.truth).sum(axis=1).mean())) for m in frame.estimates}
    return [m for m in ordered(rmse) if statistics.lost([rmse[m]])[0]]


def speed(path: Path, result: Result) -> None:
    """Error against time per frame, a panel per condition: geometric means over the sequences."""
    views = [view for view in CONDITIONS if view in result.views]
    drawn = figure(2.5 * len(views) + 0.2, 3.1)
    axes = drawn.subplots(1, len(views), sharex=True, sharey=True, squeeze=False).ravel()
    for axis, view in zip(axes, views, strict=True):
        for method in ordered(result.methods):
            error, ms = (headline.geometric_mean(result, method, view, value) for value in ("rmse_mm", "cpu_ms_per_frame"))
            if error is None:
                continue
            if method in REFERENCES:
                axis.axhline(error, color="0.6", linewidth=0.8, linestyle=STYLES[REFERENCES.index(method)], zorder=0)
                left, across, up = BESIDE[REFERENCES.index(method)]
                axis.annotate(TITLES[method], (left, error), xycoords=("axes fraction", "data"), fontsize=SMALL, color="0.4",
                              ha=across, va=up)  # fmt: skip
                continue
            size = 11 if method == "ddakf" else 5.5
            style = {"color": COLOUR.get(method, INK), "markersize": size, "linestyle": "", "label": TITLES.get(method, method)}
            axis.plot(ms, error, MARKERS.get(method, "o"), **style)
        axis.set(xscale="log", yscale="log", xlabel="ms of one core per frame")
        _numbers(axis.xaxis, (1.0,))
        _numbers(axis.yaxis)
        axis.margins(x=0.12, y=0.12)
        _plain(axis, CONDITIONS[view])
    axes[0].set_ylabel("RMSE, mm", fontsize=SMALL)
    shown = {label: handle for axis in axes for handle, label in zip(*axis.get_legend_handles_labels(), strict=True)}
    drawn.legend(shown.values(), shown, loc="outside upper center", ncols=4, frameon=False, fontsize=SMALL)
    _save(drawn, path)


def residuals(path: Path, result: Result, systems: Iterable[str] = ("icp-rigid", "opt-ed", "nicp", "ddakf")) -> None:
    """Mean distance of the points to the surface over time, a panel per recording of a real camera: at most four."""
    names = [result.sequences[k] for k in np.unique(np.linspace(0, len(result.sequences) - 1, 4).round().astype(int))]
    drawn = figure(7.4, 1.15 * len(names) + 0.3)
    axes = drawn.subplots(len(names), 1, sharex=False, squeeze=False).ravel()
    for axis, name in zip(axes, names, strict=True):
        for method in ordered(set(systems) & set(result.methods)):
            runs = [run for cell in result.cells_of(method, lambda c, n=name: c["sequence"] == n) for run in cell["runs"]]
            if not runs or "per_frame" not in runs[0]:
                continue
            per_frame, ours = runs[0]["per_frame"], method == "ddakf"
            axis.plot(per_frame["number"], per_frame["residual_mm"], label=TITLES.get(method, method), color=COLOUR[method],
                      linewidth=1.8 if ours else 1.0)  # fmt: skip
        axis.set_ylabel("mm", fontsize=SMALL)
        _plain(axis, Path(name).name.removesuffix("_depth.mat"))
    axes[-1].set_xlabel("frame", fontsize=SMALL)
    handles, labels = axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside upper center", ncols=4, frameon=False, fontsize=SMALL)
    _save(drawn, path)


def over_time(path: Path, result: Result, sequence: str, view: str) -> None:
    """RMSE of all systems and DD-AKF's reliability, frame by frame, means over the runs; the occlusion is shaded."""
    drawn = figure(7.4, 4.4)
    above, below = drawn.subplots(2, 1, sharex=True, height_ratios=(2, 1))
    here = {m: result.pooled(m, "rmse_mm", lambda c: (c["sequence"], c["view"]) == (sequence, view)) for m in result.methods}
    best = sorted((m for m in here if here[m] and m not in REFERENCES), key=lambda m: (m != "ddakf", here[m].mean))
    for method in ordered(best[:MOST_LINES]):
        runs = [r for c in result.cells_of(method, lambda c: (c["sequence"], c["view"]) == (sequence, view)) for r in c["runs"]]
        if not runs:
            continue
        number = np.array(runs[0]["per_frame"]["number"])
        rmse = np.mean([run["per_frame"]["rmse_mm"] for run in runs], axis=0)
        ours = method == "ddakf"
        every = np.array([run["per_frame"]["rmse_mm"] for run in runs])
        above.plot(number, rmse, label=TITLES.get(method, method), color=COLOUR.get(method), linewidth=2.2 if ours else 1.1)
        if len(every) > 1:
            above.fill_between(number, every.min(axis=0), every.max(axis=0), color=COLOUR.get(method), alpha=0.2, linewidth=0)
        if ours:
            for name, style in (("reliability", "-"), ("paper_score", ":")):
                values = np.mean([run["per_frame"][name] for run in runs], axis=0)
                label = "reliability" if name == "reliability" else "s_k of the paper"
                below.plot(number, values, style, color=COLOUR["ddakf"], label=label)
    above.set(ylabel="RMSE, mm", yscale="log")
    _numbers(above.yaxis)
    below.set(ylabel="DD-AKF's score", xlabel="frame", ylim=(0, 1.02))
    first, end = result.meta["conditions"]["occlude"]
    title = f"{sequence}, {CONDITIONS.get(view, view)}: a side of the garment is hidden in the shaded frames"
    for axis, name in ((above, title), (below, "")):
        axis.axvspan(first - 0.5, end - 0.5, color="0.88", zorder=0)
        _plain(axis, name)
        axis.yaxis.label.set_fontsize(SMALL)
    below.legend(frameon=False, fontsize=SMALL, loc="lower left")
    above.legend(frameon=False, fontsize=SMALL, loc="upper left", bbox_to_anchor=(1.0, 1.0))
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
        axis.set(xlabel="RMSE, mm", title=CONDITIONS.get(view, view), xscale="log")
        _numbers(axis.xaxis, (1.0, 3.0))
        axis.margins(x=0.22)
        axis.grid(axis="y", color="0.9")
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].invert_yaxis()  # that all share: the default above
    _save(drawn, path)


def calibration(path: Path, result: Result) -> None:
    """Probability of the claimed ellipsoids against the share of vertices inside, of the default and as printed."""
    drawn = figure(3.4, 4.0)
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
    _plain(axes, "")
    axes.yaxis.label.set_fontsize(SMALL)
    drawn.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=SMALL)
    _save(drawn, path)


def _numbers(axis, steps: tuple[float, ...] = (1.0, 2.0, 5.0)) -> None:
    """Plain numbers at the ticks of a logarithmic axis, at these multiples of the powers of ten."""
    from matplotlib.ticker import LogLocator, NullFormatter, ScalarFormatter

    axis.set_major_locator(LogLocator(subs=steps))
    axis.set_major_formatter(ScalarFormatter())
    axis.set_minor_formatter(NullFormatter())


def _plain(axis, title: str) -> None:
    """The style of all diagrams: two axes, small numbers, a title at the left."""
    axis.set_title(title, fontsize=LARGE, loc="left")
    axis.tick_params(labelsize=SMALL)
    axis.xaxis.label.set_fontsize(SMALL)
    axis.spines[["top", "right"]].set_visible(False)


def _cloud_image(frame: FrameEstimates, camera: Camera) -> np.ndarray:
    """(H, W, 3) uint8: the points in front of white."""
    image = np.full((camera.intrinsics.height, camera.intrinsics.width, 3), 255, np.uint8)
    spot = np.round(camera.project(np.asarray(frame.points, np.float64))).astype(int)
    inside = ((spot >= 0) & (spot < [camera.intrinsics.width - 1, camera.intrinsics.height - 1])).all(axis=1)
    for shift in ((0, 0), (0, 1), (1, 0), (1, 1)):
        image[spot[inside, 1] + shift[1], spot[inside, 0] + shift[0]] = POINT
    return image


def _camera(frame: FrameEstimates, others: Iterable[np.ndarray] = ()) -> Camera:
    """The camera at the figure's eye whose panel holds the truth and the ``others`` (V, 3)."""
    centre = (frame.truth.min(axis=0) + frame.truth.max(axis=0)).astype(np.float64) / 2
    unit = Camera.looking_at(Intrinsics(1, 1, 1.0, 1.0, 0.0, 0.0), np.asarray(frame.eye, np.float64), centre)
    spot = np.concatenate([unit.project(np.asarray(vertices, np.float64)) for vertices in (frame.truth, *others)])
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
    drawn.savefig(path, dpi=DPI)
