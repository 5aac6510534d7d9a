"""Load generator: ``python benchmarks/load.py [--clients N ...] [--rate FPS] [--vertices V] [--points M] [--codec NAME] ...``.

Streams the bundled sample from several clients on schedule to a service of its own, or to a running one, and prints the
sustained load: frames answered, dropped, refused, curtailed by their budgets, and of lighter trackers, latency from the moment a
frame was due to its answer, CPU, and the error of the results. Generator and service share the machine. Writes
benchmarks/results/load.json unless ``--out`` says otherwise.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import sys
import time
from pathlib import Path

import grpc
import numpy as np
import traffic
from committed import parsed
from ddakf_api.codec import CODECS, DEFAULT_CODEC
from ddakf_api.errors import from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from ddakf.evaluation import machine

RESULT = Path(__file__).parent / "results" / "load.json"
FLOWS = {"realtime": pb.FLOW_MODE_REALTIME, "lossless": pb.FLOW_MODE_LOSSLESS}
WARM = 1.0  # seconds at the beginning whose latencies are left out


def main(argv: list[str] | None = None) -> int:
    """Returns the exit status: 0 if no stream ended with an error, even with dropped frames; otherwise 1."""
    a = parsed(_parser(), argv)
    script = traffic.Script(a.vertices, a.points, view=a.view, codec_name=a.codec, body=a.body)
    report = {"name": "load", "commit": machine.commit(), "machine": machine.describe(), "date": time.strftime("%Y-%m-%d")}
    rows = report["load"] = []
    a.out.parent.mkdir(parents=True, exist_ok=True)
    for clients in a.clients:
        try:
            rows.append(_run(a, script, clients))
        except grpc.RpcError as error:
            print(f"{clients} clients: {from_rpc_error(error)}", file=sys.stderr)
            break
        a.out.write_text(json.dumps(report, indent=1) + "\n")  # the next load may be refused
    if rows:
        _show(rows)
        print(a.out)
    return 1 if len(rows) < len(a.clients) or any(row["ended"] for row in rows) else 0


def _run(a: argparse.Namespace, script: traffic.Script, clients: int) -> dict:
    """One load, on a service of its own or on the one that runs."""
    with contextlib.ExitStack() as stack:
        address, pid = a.server, None
        if address is None:
            process = stack.enter_context(traffic.service(["--workers", str(a.workers), "--max-sessions", str(max(clients, 64))]))
            address, pid = process.grpc, process.pid
        return asyncio.run(_load(a, script, clients, address, traffic.Usage(pid) if pid else None))


async def _load(a: argparse.Namespace, script: traffic.Script, clients: int, address: str, usage: traffic.Usage | None) -> dict:
    records = [traffic.StreamLog() for _ in range(clients)]
    async with contextlib.AsyncExitStack() as stack:
        channels = [traffic.channel_to(address, a.api_key, a.tls_ca) for _ in records]
        stubs = [TrackingServiceStub(await stack.enter_async_context(channel)) for channel in channels]
        garments = [0 if a.one_garment else k for k in range(clients)]
        names = await asyncio.gather(*(traffic.created(stub, script, number=k) for stub, k in zip(stubs, garments, strict=True)))
        before, own, begun = usage.cpu_seconds() if usage else 0.0, time.process_time(), time.monotonic()
        delays = traffic.spread(clients, a.rate)
        plays = [
            traffic.play(stub, name, script, a.rate, a.seconds, record, flow=FLOWS[a.flow], delay=delay)
            for stub, name, record, delay in zip(stubs, names, records, delays, strict=False)
        ]
        await asyncio.gather(_progress(a.seconds), *plays)
        elapsed = time.monotonic() - begun
        cores = (usage.cpu_seconds() - before) / elapsed if usage else None
        generator = (time.process_time() - own) / elapsed
        for stub, name in zip(stubs, names, strict=True):
            await stub.DeleteSession(pb.DeleteSessionRequest(name=name))
    return _row(a, script, records, elapsed, cores) | {"generator_cores": round(generator, 2)}


async def _progress(seconds: float) -> None:
    with Progress(console=Console(stderr=True), transient=True) as bar:
        task, begun = bar.add_task("streaming", total=seconds), time.monotonic()
        while (elapsed := time.monotonic() - begun) < seconds:
            bar.update(task, completed=elapsed)
            await asyncio.sleep(0.25)


def _row(a: argparse.Namespace, script: traffic.Script, records: list[traffic.StreamLog], elapsed: float, cores) -> dict:
    skipped = round(WARM * a.rate)
    latency = 1e3 * np.concatenate([np.array(r.latency[min(skipped, len(r.latency) // 2) :]) for r in records])
    rmse = np.concatenate([np.array(r.rmse) for r in records])
    refused = {name: sum(r.errors.get(name, 0) for r in records) for name in sorted({n for r in records for n in r.errors})}
    sent, answered = sum(r.sent for r in records), sum(r.answered for r in records)
    return {
        "clients": len(records),
        "rate": a.rate,
        "vertices": script.vertices,
        "points": a.points,
        "view": a.view + (" + body" if a.body else ""),
        "garments": 1 if a.one_garment else len(records),
        "codec": a.codec,
        "flow": a.flow,
        "workers": None if a.server else a.workers,
        "bytes_per_frame": script.bytes,
        "sent": sent,
        "answered": answered,
        "dropped": sum(r.dropped for r in records),
        "refused": refused,
        "ended": [r.ended for r in records if r.ended],
        "frames_per_second": round(answered / elapsed, 2),
        "latency_ms": {f"p{p:g}": round(float(np.percentile(latency, p)), 2) for p in (50, 99, 99.9)} if len(latency) else {},
        "least_frames_per_second": round(min(r.answered for r in records) / elapsed, 2),
        "curtailed": sum(r.curtailed for r in records),
        "lighter": sum(r.lighter for r in records),
        "processor_ms": round(1e3 * float(np.mean([seconds for r in records for seconds in r.used])), 2) if answered else None,
        "cores": None if cores is None else round(cores, 2),
        "rmse_mm": round(float(rmse.mean()), 2) if len(rmse) else None,
    }


def _show(rows: list[dict]) -> None:
    table = Table("figure", box=None, header_style="bold")
    for row in rows:
        table.add_column(f"{row['clients']} clients", justify="right")
    for name in rows[0]:
        table.add_row(name, *(_text(row[name]) for row in rows))
    Console(highlight=False).print(table)


def _text(value) -> str:
    if isinstance(value, list):
        return ", ".join(value) or "none"
    if isinstance(value, dict):
        return ", ".join(f"{key} {number}" for key, number in value.items()) or "none"
    return str(value)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--clients", type=int, nargs="+", default=[4], help="of one load after another")
    parser.add_argument("--rate", type=float, default=30.0, help="frames per second of each client")
    parser.add_argument("--vertices", type=int, default=2_500)
    parser.add_argument("--points", type=int, default=10_000)
    parser.add_argument("--view", default="full", choices=("full", "front"))
    parser.add_argument("--body", action="store_true", help="the body's vertices travel with every frame")
    parser.add_argument("--one-garment", action="store_true", help="of all clients, so that their sessions share constants")
    parser.add_argument("--codec", choices=CODECS, default=DEFAULT_CODEC)
    parser.add_argument("--flow", choices=FLOWS, default="realtime")
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--workers", type=int, default=2, help="of the service that is started")
    parser.add_argument("--server", metavar="HOST:PORT", help="a service that runs, instead of one of our own")
    parser.add_argument("--api-key", default=os.environ.get("DDAKF_API_KEY"), help="of that service (default: $DDAKF_API_KEY)")
    parser.add_argument("--tls-ca", type=Path, metavar="PEM", help="certificates that its own is signed by; none: not encrypted")
    parser.add_argument("--out", type=Path, default=RESULT)
    return parser


if __name__ == "__main__":
    sys.exit(main())
