"""Soak test: ``python benchmarks/soak.py [--seconds 600] [--cycles 1000] [--clients 2]``.

A few clients stream without a pause. Others connect, create a session, track a few frames, and leave: in order, by half closing,
by cancelling, or by closing the socket. Memory (anonymous pages) and open descriptors of the server and of
each worker, including the spare one, are read throughout, from the end of the warm-up. Exit status 1 if the memory at the end is
more than 3 % above that after the warm-up, if a descriptor or a session is left over, if a process started or ended, or if a
stream ended with an error. Writes benchmarks/results/soak.json.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import sys
import time
from pathlib import Path

import grpc
import numpy as np
import traffic
from committed import parsed
from ddakf_api import API_VERSION
from ddakf_api.errors import ServiceError, from_detail, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from ddakf.evaluation import machine

RESULT = Path(__file__).parent / "results" / "soak.json"
GROWTH = 0.03  # share by which memory may grow between the warm-up's end and the end
SLACK = 2 << 20  # bytes that do not count as growth: one more arena of malloc
WARM = 0.3  # share of the run after which the first readings are taken
WAYS = ("in order", "half closed", "cancelled", "gone")  # to leave
DEPARTURE = 3.0  # seconds after which the session of a client that is gone expires
POOLED = 5  # descriptors that a process may open at any time and keep: connections to the database
ANSWERED = 0.5  # share of the frames of the clients that stream all the time, at least
FRAMES = 3  # of a client that comes and leaves


def main(argv: list[str] | None = None) -> int:
    """Returns the exit status."""
    a = parsed(_parser(), argv)
    script = traffic.Script(a.vertices, a.points, frames=40)
    with traffic.service(["--workers", str(a.workers), "--max-sessions", "256"]) as process:
        part = asyncio.run(_soak(a, script, process.grpc, traffic.Usage(process.pid)))
    report = {"name": "soak", "commit": machine.commit(), "machine": machine.describe(), "date": time.strftime("%Y-%m-%d")}
    report["soak"] = part
    a.out.parent.mkdir(parents=True, exist_ok=True)
    a.out.write_text(json.dumps(report, indent=1) + "\n")
    for name in ("seconds", "cycles", "frames", "memory_growth", "descriptors", "sessions_left", "errors"):
        print(f"{name:16} {part[name]}")
    for sentence in part["failed"]:
        print(f"FAILED: {sentence}")
    print(a.out)
    return 1 if part["failed"] else 0


async def _soak(a: argparse.Namespace, script: traffic.Script, address: str, usage: traffic.Usage) -> dict:
    records = [traffic.StreamLog() for _ in range(a.clients)]
    cycles, readings = traffic.StreamLog(), []
    async with contextlib.AsyncExitStack() as stack:
        stubs = [TrackingServiceStub(await stack.enter_async_context(traffic.channel_to(address))) for _ in records]
        names = [await traffic.created(stub, script) for stub in stubs]
        idle_descriptors = usage.descriptors()
        steady = [
            traffic.play(stub, name, script, a.rate, a.seconds, record)
            for stub, name, record in zip(stubs, names, records, strict=True)
        ]
        done = [0]
        await asyncio.gather(
            *steady, _short_clients(a, script, address, cycles, done), _read(a.seconds, usage, readings, done, a.cycles)
        )
        await asyncio.sleep(2 * DEPARTURE + 2.0)  # the sessions of those whose socket went expire
        descriptors = usage.descriptors()
        left = (await stubs[0].ListSessions(pb.ListSessionsRequest(page_size=1000))).sessions
    return _judged(a, records, cycles, done[0], readings, idle_descriptors, descriptors, len(left) - a.clients)


async def _short_clients(a: argparse.Namespace, script, address: str, record: traffic.StreamLog, done: list[int]) -> None:
    """All cycles, evenly over the time."""
    begun = time.monotonic()
    for k in range(a.cycles):
        await asyncio.sleep(max(0.0, begun + k * a.seconds / a.cycles - time.monotonic()))
        try:
            async with traffic.channel_to(address) as channel:
                await _visit(TrackingServiceStub(channel), script, WAYS[k % len(WAYS)])
        except grpc.RpcError as error:
            record.failed(from_rpc_error(error))
        except ServiceError as error:
            record.failed(error)
        done[0] += 1


async def _visit(stub: TrackingServiceStub, script: traffic.Script, way: str) -> None:
    name = await traffic.created(stub, script, pb.SessionLimits(idle_timeout=DEPARTURE))
    call = stub.Track()
    await call.write(pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION, flow_mode=pb.FLOW_MODE_LOSSLESS)))
    for number in range(1, FRAMES + 1):
        await call.write(script.frame(number, 30.0))
    await _first_result(call)
    if way == "gone":
        return  # the channel is closed above the stream's head; nobody deletes the session
    if way == "cancelled":
        call.cancel()
    elif way == "half closed":
        await call.done_writing()
        while await call.read() is not grpc.aio.EOF:
            pass
    await stub.DeleteSession(pb.DeleteSessionRequest(name=name))


async def _first_result(call: grpc.aio.StreamStreamCall) -> None:
    """Reads until a frame has its result; raises the error of one that was refused."""
    while (response := await call.read()) is not grpc.aio.EOF:
        if response.HasField("result"):
            return
        if response.HasField("frame_error"):
            raise from_detail(response.frame_error.error)
    raise ServiceError("the stream ended without a result")


async def _read(seconds: float, usage: traffic.Usage, readings: list, done: list[int], cycles: int) -> None:
    """Memory and descriptors every second or so, with a progress bar."""
    columns = (TextColumn("{task.description}"), BarColumn(), TextColumn("{task.fields[state]}"), TimeRemainingColumn())
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task, begun = bar.add_task("soaking", total=seconds, state=""), time.monotonic()
        while (elapsed := time.monotonic() - begun) < seconds:
            memory, descriptors = await asyncio.to_thread(lambda: (usage.memory(), usage.descriptors()))
            readings.append((elapsed, memory, descriptors))
            state = f"{done[0]} of {cycles} cycles, {sum(memory.values()) / 2**20:.0f} MiB, {sum(descriptors.values())} files"
            bar.update(task, completed=elapsed, state=state)
            await asyncio.sleep(max(0.25, seconds / 600))


def _judged(a, records, cycles, done: int, readings, idle: dict[int, int], descriptors: dict[int, int], left: int) -> dict:
    errors: dict[str, int] = {}
    for record in (*records, cycles):
        for name, count in record.errors.items():
            errors[name] = errors.get(name, 0) + count
    growth, failed = _growth(a.seconds, readings), []
    for pid, (before, after) in growth.items():
        if after - before > max(GROWTH * before, SLACK):
            failed.append(f"process {pid} grew from {before / 2**20:.1f} to {after / 2**20:.1f} MiB")
    surplus = {pid: descriptors[pid] - idle[pid] for pid in descriptors if pid in idle and descriptors[pid] > idle[pid] + POOLED}
    if surplus:
        failed.append(f"descriptors were left over: {surplus}")
    if descriptors.keys() != idle.keys():
        failed.append(f"processes came or went: {sorted(idle)} at the start, {sorted(descriptors)} at the end")
    if left:
        failed.append(f"{left} sessions were left over")
    if errors:
        failed.append(f"errors: {errors}")
    sent, answered = sum(r.sent for r in records), sum(r.answered for r in records)
    if answered < ANSWERED * sent:
        failed.append(f"the clients that stream all the time got {answered} results of {sent} frames")
    return {
        "seconds": a.seconds,
        "cycles": done,
        "frames": answered,
        "dropped": sum(r.dropped for r in records),
        "memory_growth": [round(after / before - 1, 4) for before, after in growth.values()],
        "memory_mib": [round(after / 2**20, 1) for _, after in growth.values()],
        "descriptors": sum(descriptors.values()),
        "descriptors_at_start": sum(idle.values()),
        "sessions_left": left,
        "errors": errors,
        "failed": failed,
        "readings": [_reading(at, memory) for at, memory, _ in readings[:: max(1, len(readings) // 60)]],
    }


def _reading(at: float, memory: dict[int, int]) -> list[float]:
    """Second and MiB of each process."""
    return [round(at, 1), *(round(size / 2**20, 1) for size in memory.values())]


def _growth(seconds: float, readings) -> dict[int, tuple[float, float]]:
    """Median memory of each process in a tenth of the run after the warm-up, and in its last tenth."""
    first = [memory for at, memory, _ in readings if WARM * seconds <= at < (WARM + 0.1) * seconds]
    last = [memory for at, memory, _ in readings if at >= 0.9 * seconds]
    pids = first[0].keys() & last[-1].keys()
    return {
        pid: tuple(float(np.median([m[pid] for m in part if pid in m])) for part in (first, last)) for pid in sorted(pids)
    }


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--cycles", type=int, default=1_000, help="clients that connect and leave")
    parser.add_argument("--clients", type=int, default=2, help="that stream all the time")
    parser.add_argument("--rate", type=float, default=15.0, help="frames per second of these")
    parser.add_argument("--vertices", type=int, default=1_000)
    parser.add_argument("--points", type=int, default=3_000)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULT)
    return parser


if __name__ == "__main__":
    sys.exit(main())
