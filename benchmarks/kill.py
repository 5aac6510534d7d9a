"""Session interruption by a killed worker, and a killed server: ``python benchmarks/kill.py [--kills 5] [--restarts 3] ...``.

A client streams the sample. Whenever a spare worker is warm, the worker of its session is killed with SIGKILL, and the time is
taken until the first answer to a frame that the next worker has tracked. Then a server is killed and started again, see
:mod:`restarts`. Exit status 1 if a client stands still for more than 2 s (worker) or 6 s (server), if no start takes 3 s or less,
if an answer is missing, or if the stream ends. Writes benchmarks/results/kill.json, with the load average of each part, since
other load lengthens the times.
"""

from __future__ import annotations

import argparse
import asyncio
import bisect
import json
import os
import random
import signal
import sys
import time
from pathlib import Path

import numpy as np
import restarts
import traffic
from committed import parsed
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from ddakf_service.commands.service_process import ServiceProcess
from rich.console import Console

from ddakf.evaluation import machine

RESULT = Path(__file__).parent / "results" / "kill.json"
LIMIT, SERVER_LIMIT = 2.0, 6.0  # seconds that a session may stand still without its worker, without its server
READY_LIMIT = 3.0  # seconds of a start with a warm cache
# Seconds between two kills, so that one comes at any moment of a frame; four within a minute would end the session.
PAUSE = (20.5, 22.0)
PATIENCE = 300.0  # seconds in which a spare has to be warm, and a session back
console = Console(stderr=True, highlight=False)


def main(argv: list[str] | None = None) -> int:
    """Returns the exit status."""
    a = parsed(_parser(), argv)
    report = {"name": "kill", "commit": machine.commit(), "machine": machine.describe(), "date": time.strftime("%Y-%m-%d")}
    limits = {"limit_s": LIMIT, "server_limit_s": SERVER_LIMIT, "ready_limit_s": READY_LIMIT}
    part = {"rate": a.rate, "points": a.points, "body": a.body, **limits, "rows": [], "failed": []}
    report["kill"] = part
    for vertices in a.vertices:
        script = traffic.Script(vertices, a.points, body=a.body)
        with traffic.service(["--workers", "1"]) as process:
            row = asyncio.run(_row(a, script, process))
        part["rows"].append(row)
        part["failed"] += [f"V = {row['vertices']}: {sentence}" for sentence in _failures(row)]
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    if a.restarts:
        part["restart"] = row = restarts.row(traffic.Script(a.vertices[0], a.points), a.restarts, a.rate)
        part["failed"] += [f"restart: {sentence}" for sentence in _failures_of_restart(row)]
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    a.out.parent.mkdir(parents=True, exist_ok=True)
    a.out.write_text(json.dumps(report, indent=1) + "\n")
    for sentence in part["failed"]:
        print(f"FAILED: {sentence}")
    print(a.out)
    return 1 if part["failed"] else 0


async def _row(a: argparse.Namespace, script: traffic.Script, process: ServiceProcess) -> dict:
    record, random_, killed = traffic.StreamLog(), random.Random(a.seed), []
    async with traffic.channel_to(process.grpc) as channel:
        stub = TrackingServiceStub(channel)
        name = await traffic.created(stub, script)
        playing = asyncio.create_task(traffic.play(stub, name, script, a.rate, 3600.0, record))
        busy = []
        while len(killed) < a.kills and not playing.done():
            await _until(lambda: traffic.spare_workers(process) > 0, playing)
            due = killed[-1] + random_.uniform(*PAUSE) if killed else 0.0
            await asyncio.sleep(max(random_.random(), due - time.monotonic()))
            busy.append(os.getloadavg()[0])
            console.print(f"V = {script.vertices}: kill {len(killed) + 1} of {a.kills}")
            killed.append(time.monotonic())
            os.kill(traffic.workers(process.pid)[0], signal.SIGKILL)  # the spare one is younger
            back = len(killed)
            await _until(lambda: len(_stood(record, killed)) == back, playing)  # noqa: B023
        playing.cancel()
        await asyncio.gather(playing, return_exceptions=True)
    stood = _stood(record, killed)
    return {
        "vertices": script.vertices,
        "kills": len(killed),
        "load_average": round(float(np.mean(busy)), 1),
        "stood_s": [round(seconds, 2) for seconds in stood],
        "median_s": round(float(np.median(stood)), 2) if stood else None,
        "longest_s": round(max(stood), 2) if stood else None,
        "frames_forgotten": [round(forgotten) for _, forgotten in record.resumed],
        "ended": record.ended,
    }


async def _until(condition, playing: asyncio.Task) -> None:
    """Returns when the condition holds, or when the stream has ended."""
    async with asyncio.timeout(PATIENCE):
        while not (playing.done() or await asyncio.to_thread(condition)):
            await asyncio.sleep(0.05)


def _stood(record: traffic.StreamLog, killed: list[float]) -> list[float]:
    """Seconds from each kill to the first answer behind the notice that the session goes on."""
    stood = []
    for kill, (resumed, _) in zip(killed, record.resumed, strict=False):
        after = bisect.bisect_left(record.answers, resumed)
        if after < len(record.answers):
            stood.append(record.answers[after] - kill)
    return stood


def _failures(row: dict) -> list[str]:
    slow = [seconds for seconds in row["stood_s"] if seconds > LIMIT]
    found = [f"stood still for more than {LIMIT:g} s in {len(slow)} of {row['kills']} kills"] if slow else []
    if row["ended"] or len(row["stood_s"]) < row["kills"]:
        found.append(f"the stream did not go on: {row['ended'] or 'no answer'}")
    return found


def _failures_of_restart(row: dict) -> list[str]:
    found = []
    if (longest := max(row["stood_s"])) > SERVER_LIMIT:
        found.append(f"a client stood still for {longest:g} s, more than {SERVER_LIMIT:g} s")
    if (shortest := min(row["ready_s"])) > READY_LIMIT:
        found.append(f"every start took more than {READY_LIMIT:g} s, the shortest one {shortest:g} s")
    if row["answers_missing"]:
        found.append(f"{row['answers_missing']} answers are missing")
    return found


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=5, help="of each size")
    parser.add_argument("--restarts", type=int, default=3, help="kills of the server; 0: none")
    parser.add_argument("--vertices", type=int, nargs="+", default=[2_500, 20_000])
    parser.add_argument("--points", type=int, default=10_000)
    parser.add_argument("--body", action="store_true", help="the body's vertices travel with every frame")
    parser.add_argument("--rate", type=float, default=10.0, help="frames per second")
    parser.add_argument("--seed", type=int, default=1, help="of the moments of the kills")
    parser.add_argument("--out", type=Path, default=RESULT)
    return parser


if __name__ == "__main__":
    sys.exit(main())
