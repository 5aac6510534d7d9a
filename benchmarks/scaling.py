"""Scaling: ``python benchmarks/scaling.py [--measure] [--overhead] [--sessions 10000] [--rate 30] ...``.

``--measure`` measures what a session costs on this machine: processor time of a frame in its worker and in the network process,
memory, bytes on the wire and of a checkpoint, and the time until each of n sessions is back when their worker is killed.
``--overhead`` compares workers on a Ray cluster with local ones: the time of a frame beyond its own processor time, where 1, 8
and 32 sessions of one worker stream at the same time, each with one frame under way. Two services run beside each other and take
turns of a few frames, so that other programs hold up both alike. Both options write benchmarks/results/scaling.json and the
tables of docs/scaling.md; without them its figures are used.

Then it prints the plan for ``--sessions`` and simulates the placement of that many sessions, and the loss of a node and of a
gateway. The simulation is run at the measured sizes too, beside the measurement; the exit status is 1 where they disagree.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import heapq
import itertools
import json
import math
import os
import signal
import sys
import time
import urllib.request
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path

import fleet_tables
import grpc
import numpy as np
import traffic
from ddakf_api import API_VERSION
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from ddakf_service.commands.service_process import ServiceProcess
from ddakf_service.sessions.recovery.durability import _MAX_RESTORES as RESTORES_AT_A_TIME
from ddakf_service.store.tables.heartbeat import _BEATS as BEATS_PER_LEASE
from ddakf_service.workers.fair_shares import _PLANNED as PLANNED_SHARE

from ddakf.evaluation import machine

RESULT = Path(__file__).parent / "results" / "scaling.json"
VERTICES, POINTS = 2500, 10_000
BUSY = 0.7  # share of a core that a gateway's event loop may be busy, so that answers do not queue
LEASE = 5.0  # seconds
RESERVE, NODE_CORES = 1.1, 64  # of the simulated fleet: workers as a multiple of those that are needed; workers of a node
SIZES = (1, 8, 32)  # sessions, where kinds of workers are compared
PAIRED_FRAMES, PAIRED_TURNS = 800, 25  # of each kind of workers, at least
TURN_FRAMES = 4  # of each session, before the other kind of workers has its turn
TOLERANCE = 0.2  # of a measured time, between it and the simulated one
ROWS = 2  # of the database, per session and second with frames: history, registry
_TICKS = os.sysconf("SC_CLK_TCK")


@dataclass(frozen=True)
class Figures:
    """What a session of 2,500 vertices and 10,000 points costs. Seconds and bytes.

    Attributes:
        frame_cpu, network_cpu: processor time of a frame, in its worker and in the network process.
        frame_bytes, result_bytes: on the wire.
        checkpoint_bytes: of one checkpoint.
        worker_bytes, network_bytes: memory of a session beside that of the process.
        restore_first, restore_next: until the first session of a killed worker is back, and until each further one.
    """

    frame_cpu: float
    network_cpu: float
    frame_bytes: float
    result_bytes: float
    checkpoint_bytes: float
    worker_bytes: float
    network_bytes: float
    restore_first: float
    restore_next: float


def main(argv: list[str] | None = None) -> int:
    """Returns the exit status."""
    a = _parser().parse_args(argv)
    report = json.loads(a.out.read_text()) if a.out.exists() else {"name": "scaling"}
    if a.measure or a.overhead:
        place = {"commit": machine.commit(), "machine": machine.describe(), "date": time.strftime("%Y-%m-%d")}
        script = traffic.Script(VERTICES, POINTS)
        if a.measure:
            figures, restores = measured(script)
            report |= place | {"figures": asdict(figures), "restores": restores}
        if a.overhead:
            report["overhead"] = place | {"rows": overheads(script)}
        a.out.write_text(json.dumps(report, indent=1) + "\n")
        fleet_tables.write(a.out)
    figures = Figures(**report["figures"])
    _print("plan", plan(figures, a.sessions, a.rate))
    losses = simulated(figures, a.sessions, a.rate, reserve=a.reserve, node_cores=a.node_cores, seed=a.seed)
    _print("simulation", losses)
    print("\n".join(fleet_tables.restore_table(report)))
    if "overhead" in report:
        print("\n".join(fleet_tables.overhead_table(report)))
    found = disagreements(report)
    for row in found:
        print(f"killed worker of {row['sessions']} sessions: simulation and measurement differ by more than {TOLERANCE:.0%}")
    return 1 if found else 0


# Plan ---------------------------------------------------------------------------------------------------------------


def plan(f: Figures, sessions: int, rate: float) -> dict[str, float]:
    """What so many sessions of ``rate`` frames per second need."""
    frames = sessions * rate
    gateways = math.ceil(frames * f.network_cpu / BUSY)
    return {
        "sessions": sessions,
        "frames_per_second": frames,
        "sessions_per_core": PLANNED_SHARE / (rate * f.frame_cpu),
        "sessions_per_gigabyte": 2**30 / f.worker_bytes,
        "worker_cores": math.ceil(frames * f.frame_cpu / PLANNED_SHARE),
        "worker_gigabytes": math.ceil(sessions * f.worker_bytes / 2**30),
        "gateways": gateways,
        "gateway_gigabytes": math.ceil(sessions * f.network_bytes / 2**30),
        "gigabits_per_second_in": round(8e-9 * frames * f.frame_bytes, 1),
        "gigabits_per_second_out": round(8e-9 * frames * f.result_bytes, 1),
        "checkpoint_megabytes_per_second": round(1e-6 * frames / 30 * f.checkpoint_bytes),
        "checkpoints_per_second": round(frames / 30),
        "database_rows_per_second": ROWS * sessions,
        "heartbeats_per_second": round(gateways * BEATS_PER_LEASE / LEASE),
    }


def _print(title: str, values: dict[str, float]) -> None:
    print(title)
    for name, value in values.items():
        print(f"  {name.replace('_', ' '):34} {value:,.4g}" if value < 1e4 else f"  {name.replace('_', ' '):34} {value:,.0f}")


# Simulation ---------------------------------------------------------------------------------------------------------


def placed(sessions: int, gateways: int, workers: int, rng: np.random.Generator) -> list[Counter[int]]:
    """Sessions of each worker, by gateway: clients choose a gateway at random, and it the worker with the fewest sessions."""
    fleet = []
    for count in rng.multinomial(sessions, [1 / gateways] * gateways):
        load = [(0, worker) for worker in range(workers)]
        for _ in range(count):
            n, worker = load[0]
            heapq.heapreplace(load, (n + 1, worker))
        fleet.append(Counter({worker: n for n, worker in load}))
    return fleet


def back_after(groups: list[int], f: Figures) -> list[float]:
    """Seconds until each session is back; each group is restored by one worker, one after the other, eight begun at a time."""
    times = []
    for count in groups:
        lanes = [f.restore_first - f.restore_next] * min(RESTORES_AT_A_TIME, max(count, 1))
        worker = f.restore_first - f.restore_next  # a worker builds one model at a time
        for _ in range(count):
            begun = heapq.heappop(lanes)
            worker = max(worker, begun) + f.restore_next
            heapq.heappush(lanes, worker)
            times.append(worker)
    return times


def disagreements(report: dict) -> list[dict]:
    """The rows of killed workers whose simulated time is not the measured one."""
    f = Figures(**report["figures"])
    return [row for row in report["restores"] if abs(max(back_after([row["sessions"]], f)) / row["longest_s"] - 1) > TOLERANCE]


def simulated(f: Figures, sessions: int, rate: float, *, reserve: float, node_cores: int, seed: int) -> dict[str, float]:
    """The placement of so many sessions on the planned fleet, and the loss of a node and of a gateway.

    Args:
        reserve: workers, as a multiple of those that are needed.
        node_cores: workers of a node.
    """
    needs, rng = plan(f, sessions, rate), np.random.default_rng(seed)
    gateways = needs["gateways"] + 1
    workers = math.ceil(needs["worker_cores"] * reserve / gateways)  # of each gateway
    fleet = placed(sessions, gateways, workers, rng)
    # A node has the workers of several gateways, spread by Ray; each gateway's spares take their places.
    cores = list(itertools.product(range(gateways), range(workers)))
    rng.shuffle(cores)
    on_node = [fleet[gateway][worker] for gateway, worker in cores[:node_cores]]
    node_back = back_after(on_node, f)
    # The sessions of a lost gateway come to the others when its leases have expired, and join the workers there.
    on_gateway = sum(fleet[0].values())
    arrivals = rng.multinomial(on_gateway, [1 / (gateways - 1)] * (gateways - 1))
    groups = [math.ceil(n / workers) for n in arrivals for _ in range(workers)]
    return {
        "workers": gateways * workers,
        "sessions_of_fullest_worker": max(max(load.values()) for load in fleet),
        "sessions_of_lost_node": sum(on_node),
        "median_seconds_after_node": float(np.median(node_back)),
        "longest_seconds_after_node": max(node_back),
        "spares_of_gateway_for_node": math.ceil(node_cores / gateways),
        "sessions_of_lost_gateway": on_gateway,
        "longest_seconds_after_gateway": LEASE + max(back_after(groups, f)),
        "sessions_per_worker_after_gateway": max(
            (sum(load.values()) + n) / workers for load, n in zip(fleet[1:], arrivals, strict=True)
        ),
    }


# Measurement --------------------------------------------------------------------------------------------------------


def measured(script: traffic.Script) -> tuple[Figures, list[dict]]:
    """The figures, and the rows of killed workers that they come from."""
    with traffic.service(["--workers", "1"]) as process:
        first = asyncio.run(_streamed(process, script, 1, 15.0, 10.0))
        before = _memory(process)  # with the pages of the template that any session copies
        many = asyncio.run(_streamed(process, script, 8, 20.0, 2.0, keep=True))
        after = _memory(process)
        written = _metrics(process)
    restores = [_killed(script, n) for n in (1, 4, 8)]
    low, high = restores[0]["longest_s"], restores[-1]["longest_s"]
    per_session = max((high - low) / (restores[-1]["sessions"] - restores[0]["sessions"]), 1e-3)
    return Figures(
        frame_cpu=first["used"],
        network_cpu=many["network"],
        frame_bytes=script.bytes,
        result_bytes=first["bytes"],
        checkpoint_bytes=written["ddakf_checkpoint_bytes_total"] / max(written["ddakf_checkpoint_seconds_count"], 1),
        worker_bytes=(after[1] - before[1]) / 8,
        network_bytes=(after[0] - before[0]) / 8,
        restore_first=low,
        restore_next=per_session,
    ), restores


async def _streamed(
    process: ServiceProcess, script: traffic.Script, n: int, seconds: float, rate: float, *, keep: bool = False
) -> dict:
    """Processor times of a frame, and bytes of its result, of n lossless streams. ``keep``: the sessions stay."""
    async with traffic.channel_to(process.grpc) as channel:
        stub = TrackingServiceStub(channel)
        names = [await traffic.created(stub, script) for _ in range(n)]
        used = _cpu(process.pid)
        logs, delays = [traffic.StreamLog() for _ in names], traffic.spread(n, rate)
        plays = [
            traffic.play(stub, name, script, rate, seconds, record, flow=pb.FLOW_MODE_LOSSLESS, delay=delay)
            for name, record, delay in zip(names, logs, delays, strict=False)
        ]
        await asyncio.gather(*plays)
        used = (_cpu(process.pid) - used) / sum(record.answered for record in logs)
        result = pb.TrackResponse(result=pb.Result(vertices=pb.PackedArray(data=bytes(20 * script.vertices)))).ByteSize()
        for name in [] if keep else names:
            await stub.DeleteSession(pb.DeleteSessionRequest(name=name))
    mean = float(np.mean([seconds for log in logs for seconds in log.used]))
    return {"used": mean, "network": used, "bytes": result}


def _killed(script: traffic.Script, n: int) -> dict:
    """The longest stand-still of n sessions whose worker is killed."""

    async def kill() -> list[float]:
        async with traffic.channel_to(process.grpc) as channel:
            stub, logs = TrackingServiceStub(channel), [traffic.StreamLog() for _ in range(n)]
            names = [await traffic.created(stub, script) for _ in logs]
            plays = [
                asyncio.create_task(traffic.play(stub, name, script, 2.0, 12.0, record, flow=pb.FLOW_MODE_LOSSLESS, delay=0.0))
                for name, record in zip(names, logs, strict=True)
            ]
            await asyncio.sleep(4.0)
            os.kill(traffic.workers(process.pid)[0], signal.SIGKILL)
            killed = time.monotonic()
            await asyncio.gather(*plays)
        return [record.resumed[0][0] - killed for record in logs]

    with traffic.service(["--workers", "1", "--checkpoint-every", "2"]) as process:
        stood = asyncio.run(kill())
    return {"sessions": n, "longest_s": round(max(stood), 3)}


def overheads(script: traffic.Script) -> list[dict]:
    """Milliseconds of a frame beyond its processor time, with local workers and with actors of a cluster; a row per size.

    Those of the sessions' frames include the wait for one another. ``more_ms`` does not: it is what a frame takes of the time of
    all of them, less the processor time of all of them.
    """
    import cluster

    rays = cluster._ray_cluster()
    try:
        with (
            traffic.service(["--workers", "1"]) as local,
            traffic.service(["--workers", "1", "--worker-kind", "ray", "--ray-address", rays.address]) as ray,
        ):
            return [asyncio.run(_compared(script, {"local": local, "ray": ray}, n)) for n in SIZES]
    finally:
        rays.shutdown()


async def _compared(script: traffic.Script, services: dict[str, ServiceProcess], n: int) -> dict:
    """Times of n sessions of each service, which all stream at the same time; the services take turns."""
    async with contextlib.AsyncExitStack() as stack:
        streams, stubs = {}, {}
        for kind, service in services.items():
            stubs[kind] = TrackingServiceStub(await stack.enter_async_context(traffic.channel_to(service.grpc)))
            streams[kind] = [await Stream.opened(stubs[kind], script) for _ in range(n)]
        beyond, shares = ({kind: [] for kind in services} for _ in range(2))
        for turn in range(1 + max(math.ceil(PAIRED_FRAMES / (TURN_FRAMES * n)), PAIRED_TURNS)):
            for kind in sorted(services, reverse=turn % 2 == 1):
                began = time.perf_counter()
                parts = await asyncio.gather(*(stream.turn(script, turn) for stream in streams[kind]))
                elapsed, frames = time.perf_counter() - began, [frame for part in parts for frame in part]
                if turn > 0:  # the first one is of trackers that are new
                    beyond[kind] += [seconds - used for seconds, used in frames]
                    shares[kind].append((elapsed - sum(used for _, used in frames)) / len(frames))
        for kind, stub in stubs.items():
            for stream in streams[kind]:
                await stream.call.done_writing()
                await stub.DeleteSession(pb.DeleteSessionRequest(name=stream.name))
    more = np.median(np.subtract(shares["ray"], shares["local"]))
    return {"sessions": n, **{kind: _percentiles(times) for kind, times in beyond.items()}, "more_ms": round(1000 * more, 2)}


class Stream:
    """A stream that has one frame under way."""

    def __init__(self, name: str, call: grpc.aio.StreamStreamCall):
        self.name, self.call = name, call

    @classmethod
    async def opened(cls, stub: TrackingServiceStub, script: traffic.Script) -> Stream:
        """The stream of a new session."""
        stream = cls(await traffic.created(stub, script), stub.Track())
        start = pb.Start(name=stream.name, api_version=API_VERSION, flow_mode=pb.FLOW_MODE_LOSSLESS)
        await stream.call.write(pb.TrackRequest(start=start))
        return stream

    async def turn(self, script: traffic.Script, turn: int) -> list[tuple[float, float]]:
        """Sends the frames of a turn, each when the one before is answered; of each the seconds until its answer, and the
        processor seconds of its tracker."""
        found = []
        for number in range(turn * TURN_FRAMES, (turn + 1) * TURN_FRAMES):
            frame, began = script.frame(number + 1, 30.0), time.perf_counter()
            await self.call.write(frame)
            while (response := await self.call.read()).WhichOneof("message") != "result":
                pass  # the start, or a notice
            found.append((time.perf_counter() - began, response.result.usage.processor_seconds))
        return found


def _percentiles(seconds: list[float]) -> dict:
    p50, p99 = 1000 * np.percentile(seconds, (50, 99))
    return {"frames": len(seconds), "p50_ms": round(p50, 2), "p99_ms": round(p99, 2)}


def _cpu(pid: int) -> float:
    """Processor seconds of one process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def _memory(process: ServiceProcess) -> tuple[int, int]:
    """Allocated bytes of the network process and of the worker."""
    sizes = traffic.Usage(process.pid).memory()
    return sizes[process.pid], sizes[traffic.workers(process.pid)[0]]


def _metrics(process: ServiceProcess) -> dict[str, float]:
    with urllib.request.urlopen(f"{process.http}/metrics", timeout=30) as answer:
        lines = answer.read().decode().splitlines()
    return {line.rpartition(" ")[0]: float(line.rpartition(" ")[2]) for line in lines if not line.startswith("#")}


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", action="store_true")
    parser.add_argument("--overhead", action="store_true")
    parser.add_argument("--sessions", type=int, default=10_000)
    parser.add_argument("--rate", type=float, default=30.0, help="frames per second of a session")
    parser.add_argument("--reserve", type=float, default=RESERVE, help="workers, as a multiple of those that are needed")
    parser.add_argument("--node-cores", type=int, default=NODE_CORES)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, default=RESULT)
    return parser


if __name__ == "__main__":
    sys.exit(main())
