"""Tables of the documents about a fleet, from the results of ``scaling.py`` and ``cluster.py``, which write them."""

from __future__ import annotations

import json
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results"
RATES = (30, 15)  # frames per second
EVENTS = {"actor killed": "an actor is killed", "node lost": "a node is lost", "node drained": "a node is drained, then stopped",
          "gateway killed": "a gateway is killed", "gateway drained": "a gateway is stopped in order"}  # fmt: skip


def session_table(report: dict) -> list[str]:
    """What a session costs."""
    f, back = report["figures"], report["restores"][-1]
    rows = {
        "processor time of a frame in its worker": f"{1e3 * f['frame_cpu']:.1f} ms",
        "processor time of a frame in the gateway's network process": f"{1e3 * f['network_cpu']:.1f} ms",
        "memory in the worker; in the network process": f"{_megabytes(f['worker_bytes'])}; {_megabytes(f['network_bytes'])}",
        "on the wire: a frame; a result": f"{f['frame_bytes'] / 1e3:.0f} kB; {f['result_bytes'] / 1e3:.0f} kB",
        "a checkpoint": _megabytes(f["checkpoint_bytes"]),
        f"killed worker: first session back; all {back['sessions']}": f"{f['restore_first']:.2f} s; {back['longest_s']:.2f} s",
    }
    return ["| | |", "|---|---|", *(f"| {name} | {value} |" for name, value in rows.items()), "", _place(report)]


def rate_table(report: dict) -> list[str]:
    """How many sessions a core, a gigabyte and a gateway serve."""
    from scaling import Figures, plan

    head = ["| rate | sessions per core | sessions per gigabyte of worker memory | sessions per gateway |", "|---|---|---|---|"]
    for rate in RATES:
        needs = plan(Figures(**report["figures"]), 10_000, rate)
        sessions = f"{needs['sessions_per_core']:.1f} | {needs['sessions_per_gigabyte']:.0f} | {10_000 / needs['gateways']:.1f}"
        head.append(f"| {rate} frames per second | {sessions} |")
    return head


def overhead_table(report: dict) -> list[str]:
    """Milliseconds of a frame beyond its tracker's, with both kinds of workers."""
    found = report["overhead"]
    lines = ["| sessions | local p50 (p99) | Ray p50 (p99) | Ray less local, median of pairs |", "|---|---|---|---|"]
    for row in found["rows"]:
        times = " | ".join(f"{row[kind]['p50_ms']:.1f} ({row[kind]['p99_ms']:.1f})" for kind in ("local", "ray"))
        lines.append(f"| {row['sessions']} | {times} | {row['more_ms']:+.1f} |")
    return [*lines, "", f"{found['rows'][0]['local']['frames']} pairs of frames each. " + _place(found)]


def event_table(report: dict) -> list[str]:
    """Failures of a cluster, the worst of all rounds."""
    lines = ["| event | frames forgotten | longest gap | limit |", "|---|---|---|---|"]
    for name, words in EVENTS.items():
        rows = [row for row in report["rows"] if row["event"] == name]
        if rows:
            forgotten, gap = (max(row[key] for row in rows) for key in ("frames_forgotten", "longest_gap_s"))
            lines.append(f"| {words} | {forgotten} | {gap:.1f} s | {rows[0]['limit_s']:g} s |")
    return [*lines, "", _place(report)]


# By document: the file of results, and by name the functions of its tables.
DOCUMENTS = {
    "docs/scaling.md": ("scaling.json", {"session": session_table, "rates": rate_table, "overhead": overhead_table}),
    "docs/operations.md": ("cluster.json", {"events": event_table}),
}


def fresh(document: str) -> str:
    """A document with its tables as the results have them."""
    name, tables = DOCUMENTS[document]
    report, text = json.loads((RESULTS / name).read_text()), (ROOT / document).read_text()
    for table, lines in tables.items():
        begin, end = f"<!-- {table}: begin -->", f"<!-- {table}: end -->"
        head, found, rest = text.partition(begin)
        if not found:
            raise ValueError(f"{document} has no table {table}")
        text = "\n".join([head + begin, *lines(report), end]) + rest.partition(end)[2]
    return text


def write(results: Path) -> None:
    """Writes the tables of a file of results into the documents; nothing where it is not one of theirs."""
    for document, (name, _) in DOCUMENTS.items():
        if results.resolve() == RESULTS / name:
            (ROOT / document).write_text(fresh(document))


def _megabytes(size: float) -> str:
    return f"{size / 1e6:.1f} MB"


def _place(report: dict) -> str:
    """Where and when something was measured."""
    at = report["machine"]
    return f"{report['date']}, {at['cores']} cores, load average {at['load_average']:.1f} at the beginning."
