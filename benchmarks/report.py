"""A result file as tables on the screen, and in the documents that quote it.

``python benchmarks/report.py``           shows benchmarks/results/bench.json
``python benchmarks/report.py --write``   writes the tables of the documents from it; ``--check`` says whether they are up to date
"""

from __future__ import annotations

import argparse
import json
import statistics
import sys
import textwrap
from pathlib import Path

from rich.console import Console
from rich.table import Table

from ddakf.evaluation.paper_scope import CONDITIONS, TITLES
from ddakf.evaluation.reporting import headline, result_files
from ddakf.evaluation.studies.study_summary import OURS

ROOT = Path(__file__).resolve().parents[1]
RESULT = ROOT / "benchmarks/results/bench.json"
UNTOUCHED, FRESH = ROOT / "results/untouched.json", ROOT / "results/fresh.json"
OTHER_TRIANGLES = ROOT / "benchmarks/results/other_triangles.json"
BUSY = 0.5  # load average when the run begins, above which the report says so
WIDTH = 120  # columns that the widest table takes


def show(report: dict) -> None:
    """Prints every part that a report holds."""
    console, machine = Console(highlight=False, markup=False, soft_wrap=True), report["machine"]
    console.width = max(console.width, WIDTH)
    packages = ", ".join(f"{name} {version}" for name, version in machine["packages"].items() if version)
    console.print(f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, {packages}")
    for part, print_part in PRINTERS.items():
        if part in report:
            print_part(console, report[part])


def _frame(console: Console, rows: list[dict]) -> None:
    table = Table("one frame", "V", "N", "ms p50 (p99)", "RMSE mm", "normal", "in 90 %", box=None, header_style="bold")
    for row in rows:
        accuracy = f"{row['rmse_mm']:.1f}", f"{row['normal_rmse_mm']:.1f}", f"{row['coverage90']:.0%}"
        table.add_row(row["name"], str(row["vertices"]), str(row["points"]), _time(row["ms"]["total"], True), *accuracy)
    console.print(table)
    stages = [stage for stage in rows[0]["ms"] if stage != "total"]
    table = Table("ms p50 (p99)", *stages, box=None, header_style="bold")
    for row in rows:
        table.add_row(row["name"], *(_time(row["ms"].get(stage), True) for stage in stages))
    console.print(table)


def _changes(console: Console, rows: list[dict]) -> None:
    table = Table("change", "sequence", "RMSE mm", "normal", "in 90 %", "ms p50", box=None, header_style="bold")
    for row in rows:
        table.add_row(row["config"], row["view"], *_change(row))
    console.print(table)


def _change(row: dict) -> list[str]:
    if "failed" in row:
        return [f"failed: {row['failed']}", "", "", ""]
    return [f"{row['rmse_mm']:.1f}", f"{row['normal_rmse_mm']:.1f}", f"{row['coverage90']:.0%}", f"{row['ms_p50']:.1f}"]


def _open3d(console: Console, part: dict) -> None:
    if "skipped" in part:
        console.print(f"not compared with Open3D: {part['skipped']}")
        return
    columns = "V", "N", "preset", "ddakf, whole frame ms", "Open3D, outliers + normals ms", "ratio", "RMSE mm", "normal"
    table = Table(*columns, box=None, header_style="bold")
    for row in part["rows"]:
        ratio = f"1/{row['open3d_over_ddakf']:.1f}"
        times = _time(row["ddakf_frame_ms"]), _time(row["open3d_ms"])
        errors = f"{row['rmse_mm']:.1f}", f"{row['normal_rmse_mm']:.1f}"
        table.add_row(str(row["vertices"]), str(row["points"]), row["config"], *times, ratio, *errors)
    console.print(table)


def _icp(console: Console, rows: list[dict]) -> None:
    columns = "method", "V", "N", "ms p50 (p99)", "times ddakf's", "times Open3D's preprocessing", "RMSE mm"
    table = Table(*columns, box=None, header_style="bold")
    for row in rows:
        sizes, beside = (str(row["vertices"]), str(row["points"])), row["over_open3d_preprocessing"]
        ratios = f"{row['over_default']:.1f}", "–" if beside is None else f"{beside:.1f}"
        table.add_row(row["method"], *sizes, _time(row["ms"], tail=True), *ratios, f"{row['rmse_mm']:.1f}")
    console.print(table)


def _scaling(console: Console, part: dict) -> None:
    table = Table("V", "N", "ms p50", "RMSE mm", "normal", "per doubling", box=None, header_style="bold")
    for row, step in zip(part["rows"], [None, *part["steps"]], strict=True):
        ratio = f"{step['ratio_per_doubling']:.2f} x" if step else ""
        errors = f"{row['rmse_mm']:.1f}", f"{row['normal_rmse_mm']:.1f}"
        table.add_row(str(row["vertices"]), str(row["points"]), f"{row['ms_p50']:.1f}", *errors, ratio)
    console.print(table)
    console.print(f"time grows as V^{part['exponent']:.2f}")


def _outliers(console: Console, part: dict) -> None:
    table = Table("outlier filter, 10 % outliers", "ms", "outliers removed", "inliers lost", box=None, header_style="bold")
    for row in part["rows"]:
        table.add_row(row["filter"], f"{row['ms_p50']:.1f}", f"{row['outliers_removed']:.1%}", f"{row['inliers_lost']:.1%}")
    console.print(table)


def _memory(console: Console, part: dict) -> None:
    console.print(
        f"a frame of {part['vertices']} vertices and {part['points']} points has {part['peak_mib_per_frame']['p50']:.1f} MiB "
        f"in use at most, and keeps {part['kept_mib_per_frame']:.2f} MiB"
    )


def _cold(console: Console, part: dict) -> None:
    console.print(
        f"fresh process, warm kernel cache: import {part['import_s']:.2f} s, first frame {part['first_frame_s']:.2f} s, "
        f"together {part['together_s']:.2f} s, {part['peak_mib']:.0f} MiB resident at most"
    )


def _growth(console: Console, part: dict) -> None:
    console.print(
        f"memory over {part['frames']} frames: {part['rss_kib_per_1000_frames']:+.0f} KiB resident and "
        f"{part['python_blocks_per_1000_frames']:+.0f} blocks per 1,000 frames",
    )


def _codecs(console: Console, rows: list[dict]) -> None:
    table = Table("codec", "N", "bytes", "encode ms", "decode ms", "largest error mm", box=None, header_style="bold")
    for row in rows:
        times = _time(row["encode_ms"]), _time(row["decode_ms"])
        table.add_row(row["codec"], str(row["points"]), str(row["bytes"]), *times, f"{row['largest_error_mm']:.3f}")
    console.print(table)


def _images(console: Console, rows: list[dict]) -> None:
    columns = "depth image", "pixels", "bytes", "mask", "encode ms", "decode ms", "unproject ms", "largest error mm"
    table = Table(*columns, box=None, header_style="bold")
    for row in rows:
        times = (_time(row[key]) for key in ("encode_ms", "decode_ms", "unproject_ms"))
        sizes = str(row["pixels"]), str(row["bytes"]), str(row["mask_bytes"])
        table.add_row(row["codec"], *sizes, *times, f"{row['largest_error_mm']:.3f}")
    console.print(table)


def _service(console: Console, part: dict) -> None:
    table = Table("service, ms p50 (p99)", "latency", "tracker", "added", "RMSE mm", box=None, header_style="bold")
    for row in part["overhead"]:
        times = (_time(row[key], True) for key in ("latency_ms", "tracker_ms", "overhead_ms"))
        table.add_row(row["codec"], *times, f"{row['rmse_mm']:.1f}")
    console.print(table)
    load = part["clients"]
    console.print(
        f"{load['clients']} clients at 30 frames per second on {load['workers']} workers: {load['frames_dropped']} of "
        f"{load['frames_sent']} frames dropped, latency {_time(load['latency_ms'], True)} ms"
    )


PRINTERS = {
    "frame": _frame,
    "changes": _changes,
    "open3d": _open3d,
    "icp": _icp,
    "scaling": _scaling,
    "outliers": _outliers,
    "memory": _memory,
    "cold": _cold,
    "growth": _growth,
    "codecs": _codecs,
    "images": _images,
    "service": _service,
}


def _time(times: dict | None, tail: bool = False) -> str:
    if times is None:
        return ""
    return f"{times['p50']:.1f} ({times['p99']:.1f})" if tail else f"{times['p50']:.1f}"


def readme_table(report: dict) -> str:
    """What the README says in numbers: errors on untouched recordings first, then times."""
    machine = report["machine"]
    around = next(row for row in report["frame"] if row["name"].startswith("sample, full"))
    added = next(row for row in report["service"]["overhead"] if row["codec"] == "morton-zstd")
    bare = report["open3d"].get("rows")
    compared = (
        f"{1 / bare[0]['open3d_over_ddakf']:.1f} times Open3D's outlier removal and normals alone"
        if bare
        else f"not compared: {report['open3d']['skipped']}"
    )
    largest = bare[0] if bare else {"vertices": around["vertices"], "points": around["points"]}
    frame_ms = bare[0]["ddakf_frame_ms"]["p50"] if bare else around["ms"]["total"]["p50"]
    rows = [
        *_untouched_rows(result_files.read_one(UNTOUCHED)),
        _fresh_row(result_files.read_one(FRESH)),
        _other_triangles_row(json.loads(OTHER_TRIANGLES.read_text())["rows"]),
        (
            "the bundled sample, on which constants were chosen, points all around",
            f"{around['rmse_mm']:.1f} mm RMSE, {around['normal_rmse_mm']:.1f} mm along the normal",
        ),
        (f"one frame, {largest['vertices']:,} vertices and {largest['points']:,} points", f"{frame_ms:.0f} ms, {compared}"),
        ("what the service adds to a frame", f"{added['overhead_ms']['p50']:.1f} ms (p50)"),
    ]
    lines = ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows)]
    place = f"{machine['cpu']}, {machine['cores']} cores, one thread used, Python {machine['python']}"
    if machine["load_average"] > BUSY:
        place += f" (other work ran beside it: load average {machine['load_average']})"
    source = (
        f"The first six rows are of untouched recordings ([results](docs/results.md)), the rest by `make bench` on {place}; "
        "`benchmarks/results/bench.json` has more. The [glossary](docs/notation.md#glossary) explains the words."
    )
    return "\n".join([*lines, "", textwrap.fill(source, 100, break_long_words=False, break_on_hyphens=False)])


def _untouched_rows(result: result_files.Result) -> list[tuple[str, str]]:
    """Error in each condition beside that of the best baseline, and the calibration."""
    rows, inside = [], []
    for view, title in CONDITIONS.items():
        ours, (name, _) = headline.geometric_mean(result, OURS, view, "rmse_mm"), headline.best_baseline(result, view, "rmse_mm")
        theirs = headline.geometric_mean(result, name, view, "rmse_mm")
        where = f"{len(result.sequences)} untouched recordings, {title}" if not rows else f"the same, {title}"
        rows.append((where, f"{ours:.1f} mm RMSE; the best baseline, {TITLES[name]}, {theirs:.1f} mm"))
        inside.append(f"{headline.arithmetic_mean(result, OURS, view, 'coverage90'):.0%}")
    return [*rows, ("truth inside the 90 % ellipsoids, in these conditions", ", ".join(inside))]


def _fresh_row(result: result_files.Result) -> tuple[str, str]:
    """Errors in all conditions, and those of the best baselines."""
    ours = [headline.geometric_mean(result, OURS, view, "rmse_mm") for view in CONDITIONS]
    best = [headline.best_baseline(result, view, "rmse_mm")[0] for view in CONDITIONS]
    theirs = [headline.geometric_mean(result, name, view, "rmse_mm") for name, view in zip(best, CONDITIONS, strict=True)]
    mine, others = (", ".join(f"{value:.1f}" for value in values) for values in (ours, theirs))
    again = "[scored again after later changes](docs/evaluation.md#what-the-held-out-recordings-decided)"
    name = f"{len(result.sequences)} fresh recordings, simulated after the constants were fixed and {again}, in these conditions"
    return name, f"{mine} mm; the best baselines {others} mm"


def _other_triangles_row(rows: list[dict]) -> tuple[str, str]:
    """Errors and calibration with templates whose edges are halved, in all conditions."""
    errors, inside = [], []
    for view in CONDITIONS:
        mine = [row for row in rows if (row["view"], row["template"]) == (view, "halved edges")]
        errors.append(f"{statistics.geometric_mean(row['rmse_mm'] for row in mine):.1f}")
        inside.append(f"{statistics.fmean(row['coverage'] for row in mine):.0%}")
    name = "untouched recordings, templates of [other triangles](docs/evaluation.md#triangles) than the cloud's, as from a camera"
    return name, f"{', '.join(errors)} mm; {', '.join(inside)} inside"


def payload_table(report: dict) -> str:
    """Sizes, times and errors of the payloads of a frame."""
    clouds, images = report["codecs"], report["images"]
    lines = [
        f"| {clouds[0]['points']:,} points | bytes | per point | encode ms | decode ms | largest error mm |",
        "|---|---|---|---|---|---|",
    ]
    for row in clouds:
        times = f"{_time(row['encode_ms'])} | {_time(row['decode_ms'])}"
        share = f"{row['bytes'] / row['points']:.1f}"
        lines.append(f"| `{row['codec']}` | {row['bytes']:,} | {share} | {times} | {row['largest_error_mm']:.3f} |")
    lines += [
        "",
        f"| depth image, {images[0]['pixels']:,} pixels | bytes | mask | encode ms | decode ms | unproject ms | error mm |",
        "|---|---|---|---|---|---|---|",
    ]
    for row in images:
        times = " | ".join(_time(row[key]) for key in ("encode_ms", "decode_ms", "unproject_ms"))
        sizes = f"{row['bytes']:,} | {row['mask_bytes']:,}"
        lines.append(f"| {row['codec']} | {sizes} | {times} | {row['largest_error_mm']:.3f} |")
    machine = report["machine"]
    place = f"{machine['cpu']}, {machine['cores']} cores, Python {machine['python']}, load average {machine['load_average']}"
    return "\n".join([*lines, "", f"Milliseconds are medians on {place}."])


# By document: the name of its table, its function, and the parts that it needs.
TABLES = {
    "README.md": ("numbers", readme_table, ("frame", "open3d", "service")),
    "docs/protocol.md": ("payloads", payload_table, ("codecs", "images")),
}


def fresh(document: str, report: dict) -> str:
    """A document with its table as the report has it."""
    name, table, _ = TABLES[document]
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    head, _, rest = (ROOT / document).read_text().partition(begin)
    return f"{head}{begin}\n{table(report)}\n{end}{rest.partition(end)[2]}"


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("path", type=Path, nargs="?", default=RESULT)
    parser.add_argument("--write", action="store_true", help="write the tables of the documents whose parts it has")
    parser.add_argument("--check", action="store_true", help="fail if the tables are not those of this result")
    arguments = parser.parse_args()
    report = json.loads(arguments.path.read_text())
    documents = [name for name, (_, _, parts) in TABLES.items() if all(part in report for part in parts)]
    if arguments.write:
        for document in documents:
            (ROOT / document).write_text(fresh(document, report))
    elif arguments.check:
        return int(any(fresh(document, report) != (ROOT / document).read_text() for document in documents))
    else:
        show(report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
