"""Tables of the documents about a fleet, from the results of ``scaling.py`` and ``cluster.py``, which write them."""

from __future__ import annotations

import json
import math
from pathlib import Path

from fleet import LEASE, NODE_CORES, RESERVE, Figures, back_after, plan, simulated

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "benchmarks/results"
RATES = (30, 15)  # frames per second
FLEET = (10_000, 30.0)  # sessions, frames per second
GATEWAYS_OF_NODE = 16
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
    head = ["| rate | sessions per core | sessions per gigabyte of worker memory | sessions per gateway |", "|---|---|---|---|"]
    for rate in RATES:
        needs = plan(Figures(**report["figures"]), 10_000, rate)
        sessions = f"{needs['sessions_per_core']:.1f} | {needs['sessions_per_gigabyte']:.0f} | {10_000 / needs['gateways']:.1f}"
        head.append(f"| {rate} frames per second | {sessions} |")
    return head


def need_table(report: dict) -> list[str]:
    """What the fleet needs."""
    n = plan(Figures(**report["figures"]), *FLEET)
    nodes, places = math.ceil(n["worker_cores"] / NODE_CORES), math.ceil(n["gateways"] / GATEWAYS_OF_NODE)
    rows = [
        ("worker cores", f"{n['worker_cores']:,}", f"{nodes} nodes of {NODE_CORES} cores"),
        ("worker memory", f"{n['worker_gigabytes']} GB", "and 0.25 GB per fork server or actor"),
        ("gateways", f"{n['gateways']:,}", f"processes of one core each, {GATEWAYS_OF_NODE} to a node: {places} nodes"),
        ("gateway memory", f"{n['gateway_gigabytes']} GB", "and about 0.2 GB per process"),
        ("network in; out", f"{n['gigabits_per_second_in']:.0f} Gbit/s; {n['gigabits_per_second_out']:.0f} Gbit/s",
         "twice, as frames also go from gateway to worker"),
        ("checkpoints", f"{n['checkpoints_per_second']:,} per second, {n['checkpoint_megabytes_per_second'] / 1e3:.0f} GB/s",
         "at the default `checkpoint_every` of 30"),
        ("database", f"{n['database_rows_per_second']:,} rows per second",
         f"history and registry, in batches; heartbeats: {n['heartbeats_per_second']:,} per second"),
    ]  # fmt: skip
    return ["| | needed | remarks |", "|---|---|---|", *(f"| {' | '.join(row)} |" for row in rows)]


def loss_table(report: dict) -> list[str]:
    """What a loss does to the simulated fleet."""
    figures = Figures(**report["figures"])
    f = simulated(figures, *FLEET, reserve=RESERVE, node_cores=NODE_CORES, seed=1)
    fit = plan(figures, *FLEET)["sessions_per_core"]
    after = f"{f['median_seconds_after_node']:.2f} s (median) to {f['longest_seconds_after_node']:.2f} s after it is noticed"
    rows = {
        "clients choose gateways at random": f"the fullest of {f['workers']:,} workers has {f['sessions_of_fullest_worker']} "
        f"sessions where {fit:.1f} fit",
        f"a node of {NODE_CORES} cores is lost": f"{f['sessions_of_lost_node']} sessions stand still for {after}; "
        f"spares that each gateway needs for it: {f['spares_of_gateway_for_node']}",
        "a gateway is lost": f"{f['sessions_of_lost_gateway']} sessions stand still for up to "
        f"{f['longest_seconds_after_gateway']:.1f} s, {LEASE:g} s of them until its leases expire",
    }
    return ["| event | consequence |", "|---|---|", *(f"| {event} | {consequence} |" for event, consequence in rows.items())]


def restore_table(report: dict) -> list[str]:
    """Killed workers of the real service beside the simulation."""
    lines = ["| sessions of a killed worker | all back, measured | simulated |", "|---|---|---|"]
    for row in report["restores"]:
        longest = max(back_after([row["sessions"]], Figures(**report["figures"])))
        lines.append(f"| {row['sessions']} | {row['longest_s']:.2f} s | {longest:.2f} s |")
    return lines


def overhead_table(report: dict) -> list[str]:
    """Milliseconds of a frame beyond its tracker's, with both kinds of workers."""
    found = report["overhead"]
    lines = ["| sessions | local p50 (p99) | Ray p50 (p99) | Ray less local, median of pairs |", "|---|---|---|---|"]
    for row in found["rows"]:
        times = " | ".join(f"{row[kind]['p50_ms']:.1f} ({row[kind]['p99_ms']:.1f})" for kind in ("local", "ray"))
        lines.append(f"| {row['sessions']} | {times} | {row['more_ms']:+.1f} |")
    return [*lines, "", f"At least {found['rows'][0]['local']['frames']} pairs of frames each. " + _place(found)]


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
    "docs/scaling.md": (
        "scaling.json",
        {"session": session_table, "rates": rate_table, "needs": need_table, "losses": loss_table, "restores": restore_table,
         "overhead": overhead_table},
    ),
    "docs/operations.md": ("cluster.json", {"events": event_table}),
}  # fmt: skip


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
