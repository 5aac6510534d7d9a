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
import json
import math
import os
import signal
import sys
import time
from dataclasses import asdict
from pathlib import Path

import fleet_tables
import grpc
import numpy as np
import traffic
from committed import parsed
from ddakf_api import API_VERSION
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from ddakf_service.commands.service_process import ServiceProcess
from fleet import NODE_CORES, RESERVE, TOLERANCE, Figures, disagreements, plan, simulated
from service_metrics import metrics_of

from ddakf.evaluation import machine

RESULT = Path(__file__).parent / "results" / "scaling.json"
VERTICES, POINTS = 2500, 10_000
SIZES = (1, 8, 32)  # sessions, where kinds of workers are compared
PAIRED_FRAMES, PAIRED_TURNS = 800, 25  # of each kind of workers, at least
TURN_FRAMES = 4  # of each session, before the other kind of workers has its turn
_TICKS = os.sysconf("SC_CLK_TCK")


def main(argv: list[str] | None = None) -> int:
    """Returns the exit status."""
    a = parsed(_parser(), argv, writing=("measure", "overhead"))
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


def _print(title: str, values: dict[str, float]) -> None:
    print(title)
    for name, value in values.items():
        print(f"  {name.replace('_', ' '):34} {value:,.4g}" if value < 1e4 else f"  {name.replace('_', ' '):34} {value:,.0f}")


# Measurement --------------------------------------------------------------------------------------------------------


def measured(script: traffic.Script) -> tuple[Figures, list[dict]]:
    """The figures, and the rows of killed workers that they come from."""
    with traffic.service(["--workers", "1"]) as process:
        first = asyncio.run(_streamed(process, script, 1, 15.0, 10.0))
        before = _memory(process)  # with the pages of the fork server that any session copies
        many = asyncio.run(_streamed(process, script, 8, 20.0, 2.0, keep=True))
        after = _memory(process)
        written = metrics_of(process)
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
        names = [await traffic.created(stub, script, number=k) for k in range(n)]
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
            names = [await traffic.created(stub, script, number=k) for k in range(n)]
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
