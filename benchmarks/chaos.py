"""Chaos test: sessions beside a hostile one and under injected faults. ``python benchmarks/chaos.py [--seconds 150] [--seed 1]``.

First a hostile session joins the clients: the largest garment and cloud, a fifth of the points on one spot. No client may wait
longer than 250 ms between two answers, or than twice as long as without it where the machine is too busy for that.

Then clients stream the sample through the client library and a proxy. On a schedule drawn from the seed, workers are killed,
connections are cut, readers stall, the file system of the checkpoints is filled, the database is stopped, and the whole server
is killed and started again. Afterwards every session has to be alive, its state tracking, and its error as without faults: over
the last seconds at most 1.2 times, or 1 mm above, that of the same frames without faults. Faults that the machine cannot produce
(no PostgreSQL, no root for a file system of limited size) are skipped and listed. Writes benchmarks/results/chaos.json.

Exit status 1: the service failed. 2: the test itself did, and says nothing about the service.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import itertools
import json
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from pathlib import Path

import hostile
import inputs
import numpy as np
import traffic
from committed import parsed
from ddakf_client import Frame, Notice, Result, aconnect
from ddakf_service.commands.service_process import ServiceFailed, ServiceProcess
from ports import lasting_port
from postgres import NoPostgres, Postgres, PostgresFailed
from rich.console import Console

import ddakf
from ddakf import data
from ddakf.evaluation import machine, metrics

RESULT = Path(__file__).parent / "results" / "chaos.json"
QUIET = 10.0  # seconds without faults at the end, over whose last half errors are compared
EVERY = (4.0, 8.0)  # seconds between faults
RATIO, SLACK_MM = 1.2, 1.0
ANSWERED = 0.5  # share of the frames in that time that are answered, at least
LONGEST_GAP_MS, BUSY_RATIO = 250.0, 2.0  # between two answers beside a hostile session; over that without it, if larger
UNDISTURBED = 10.0  # seconds of the clients before the hostile session begins
DISK = "24m"  # of the file system that the checkpoints are on
console = Console(stderr=True, highlight=False)


def main(argv: list[str] | None = None) -> int:
    """Returns the exit status."""
    a = parsed(_parser(), argv)
    try:
        part = _measured(a)
    except (PostgresFailed, HarnessFailed) as failure:
        print(f"THE TEST FAILED, not the service: {failure}")
        return 2
    report = {"name": "chaos", "commit": machine.commit(), "machine": machine.describe(), "date": time.strftime("%Y-%m-%d")}
    report["chaos"] = part
    a.out.parent.mkdir(parents=True, exist_ok=True)
    a.out.write_text(json.dumps(report, indent=1) + "\n")
    for row in part["sessions"]:
        print("  ".join(f"{name} {value}" for name, value in row.items()))
    if part["hostile"]:
        print("  ".join(f"{name} {part['hostile'][name]}" for name in ("longest_gap_ms", "undisturbed_gap_ms", "answers")))
    for sentence in part["failed"]:
        print(f"FAILED: {sentence}")
    print(a.out)
    return 1 if part["failed"] else 0


def _measured(a: argparse.Namespace) -> dict:
    """The results, with the sentences of what failed.

    Raises:
        PostgresFailed, HarnessFailed: the test cannot go on.
    """
    run = inputs.run_of(data.sample(), a.frames, "full", a.points)
    with contextlib.ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        disk = stack.enter_context(_small_disk(folder))
        database = stack.enter_context(_postgres())
        server = Fleet(folder, disk, database, a.workers)
        stack.callback(server.stop)
        server.start()
        return asyncio.run(_chaos(a, run, server))


class HarnessFailed(RuntimeError):
    """The test cannot go on, for a reason that is none of the service's."""


class Fleet:
    """The server under test, always on the same ports, and the faults of its processes."""

    def __init__(self, folder: Path, disk: Path | None, database: Postgres | None, workers: int):
        self.grpc_port, self.http_port = lasting_port(), lasting_port()
        self.disk, self.database = disk, database
        self._folder, self._process, self._starts = folder, None, 0
        data_dir = (disk or folder) / "state"
        data_dir.mkdir()
        self._arguments = ["--workers", str(workers), "--data-dir", str(data_dir), "--checkpoint-every", "15"]
        self._arguments += ["--grpc-port", str(self.grpc_port), "--http-port", str(self.http_port)]
        if database:
            self._arguments += ["--database-url", database.url]

    @property
    def pid(self) -> int:
        return self._process.pid

    def start(self) -> None:
        self._starts += 1
        self._process = ServiceProcess(self._arguments, log=self._folder / f"service-{self._starts}.log")
        self._process.wait_until_ready()

    def stop(self) -> None:
        if self._process is not None:
            self._process.stop()

    def workers(self) -> list[int]:
        """Process ids of those that compute."""
        return traffic.workers(self.pid)

    def logs(self) -> str:
        return "".join(path.read_text(errors="replace") for path in sorted(self._folder.glob("service-*.log")))


class Proxy:
    """Carries bytes between clients and the server, unless told otherwise."""

    def __init__(self, port: int):
        self._port = port
        self._pairs: set[tuple[asyncio.StreamWriter, asyncio.StreamWriter]] = set()
        self._flowing = asyncio.Event()
        self._flowing.set()

    async def start(self) -> str:
        self._server = await asyncio.start_server(self._carry, "127.0.0.1", 0)
        host, port = self._server.sockets[0].getsockname()
        return f"{host}:{port}"

    def cut(self) -> None:
        """Closes every connection at once without a message."""
        for pair in list(self._pairs):
            for writer in pair:
                writer.transport.abort()

    async def stall(self, seconds: float) -> None:
        """Stops forwarding the server's bytes, so that only its buffers fill up."""
        self._flowing.clear()
        await asyncio.sleep(seconds)
        self._flowing.set()

    async def stop(self) -> None:
        self._server.close()
        self.cut()
        while self._pairs:
            await asyncio.sleep(0.01)

    async def _carry(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            from_server, to_server = await asyncio.open_connection("127.0.0.1", self._port)
        except OSError:
            writer.transport.abort()
            return
        pair = (writer, to_server)
        self._pairs.add(pair)
        try:
            async with asyncio.TaskGroup() as both:
                both.create_task(self._copy(reader, to_server, None))
                both.create_task(self._copy(from_server, writer, self._flowing))
        except* (OSError, asyncio.IncompleteReadError):
            pass  # cut
        finally:
            self._pairs.discard(pair)
            for end in pair:
                end.transport.abort()

    @staticmethod
    async def _copy(reader: asyncio.StreamReader, writer: asyncio.StreamWriter, flowing: asyncio.Event | None) -> None:
        while chunk := await reader.read(1 << 16):
            if flowing is not None:
                await flowing.wait()
            writer.write(chunk)
            await writer.drain()
        raise ConnectionResetError  # one side's end is the other's


@dataclass
class ClientLog:
    """Log of one client: error in mm by frame index, times of the answers, notices, and the error that ended it."""

    error: dict[int, float] = field(default_factory=dict)
    answers: list[float] = field(default_factory=list)
    state: str = ""
    notices: list[str] = field(default_factory=list)
    gave_up: str = ""


async def _chaos(a: argparse.Namespace, run: inputs.Run, fleet: Fleet) -> dict:
    console.print("without any trouble ...")
    direct = f"127.0.0.1:{fleet.grpc_port}"
    calm = await _stream(a, run, direct, 2 * len(run.clouds) / a.rate, "calm-1")
    if calm.gave_up:
        raise SystemExit(f"the undisturbed stream ended: {calm.gave_up}")
    beside = await _beside_hostile(a, run, direct) if a.hostile_seconds else None
    proxy = Proxy(fleet.grpc_port)
    address = await proxy.start()
    log: list[str] = []
    streams = [asyncio.create_task(_stream(a, run, address, a.seconds, f"chaos-{k}")) for k in range(a.clients)]
    failed = [*beside["failed"]] if beside else []
    try:
        await _faults(a, fleet, proxy, log)
        seen = await asyncio.gather(*streams)
    except ServiceFailed as error:
        failed.append(f"the killed server did not start again: {error}")
        seen = []
    finally:
        for stream in streams:
            stream.cancel()
        await proxy.stop()
    rows = [_judged(a, k, 2 * len(run.clouds), calm, one) for k, one in enumerate(seen)]
    failed += [f"session {row['session']}: {row['verdict']}" for row in rows if row["verdict"] != "as undisturbed"]
    left_out = [name for name, part in (("PostgreSQL", fleet.database), ("a small disk", fleet.disk)) if part is None]
    part = {"seconds": a.seconds, "seed": a.seed, "troubles": log, "left_out": left_out, "sessions": rows}
    return part | {"hostile": beside, "failed": failed}


async def _beside_hostile(a: argparse.Namespace, run: inputs.Run, address: str) -> dict:
    """Longest times between two answers of the clients, in ms: undisturbed, and from the creation of a hostile session on."""
    console.print("beside a hostile session ...")
    over = asyncio.Event()
    neighbours = (_stream(a, run, address, UNDISTURBED + 600.0, f"beside-{k}", over) for k in range(a.clients))
    streams = [asyncio.create_task(stream) for stream in neighbours]
    await asyncio.sleep(UNDISTURBED)
    begun = time.monotonic()
    attacker = await hostile.started(address, a.hostile_seconds)
    output, _ = await attacker.communicate()
    ended = time.monotonic()
    over.set()
    seen = await asyncio.gather(*streams)
    if attacker.returncode:
        raise HarnessFailed(f"the hostile client ended with status {attacker.returncode}")
    undisturbed = max(_longest_gap_ms(one.answers, begun - UNDISTURBED / 2, begun) for one in seen)
    disturbed = [_longest_gap_ms(one.answers, begun, ended) for one in seen]
    part = {"seconds": round(ended - begun, 1), "answers": json.loads(output), "longest_gap_ms": disturbed}
    part |= {"undisturbed_gap_ms": undisturbed, "limit_ms": max(LONGEST_GAP_MS, BUSY_RATIO * undisturbed)}
    part["failed"] = [f"a neighbour of the hostile session ended: {one.gave_up}" for one in seen if one.gave_up]
    if max(disturbed) > part["limit_ms"]:
        part["failed"].append(f"a neighbour of the hostile session waited for {max(disturbed):g} ms")
    return part


def _longest_gap_ms(answers: list[float], begin: float, end: float) -> float:
    """Between two answers, or an answer and the end of the span."""
    inside = [begin, *(moment for moment in answers if begin <= moment <= end), end]
    return round(1e3 * max(after - before for before, after in itertools.pairwise(inside)), 1)


async def _stream(
    a: argparse.Namespace, run: inputs.Run, address: str, seconds: float, session_id: str, over: asyncio.Event | None = None
) -> ClientLog:
    """One client, at its frames' pace, for so many seconds or until it is over."""
    seen, sequence = ClientLog(), run.sequence
    begun = time.monotonic()

    async def frames() -> AsyncIterator[Frame]:
        for k in range(round(seconds * a.rate)):
            if over is not None and over.is_set():
                return
            await asyncio.sleep(max(0.0, begun + k / a.rate - time.monotonic()))
            cloud = run.clouds[_place(k, len(run.clouds))]
            yield Frame(cloud.points, k / a.rate + 1.0, cloud.sensor_origin)

    def notice(notice: Notice) -> None:
        seen.notices.append(notice.kind)

    try:
        async with aconnect(address, timeout=60.0) as client:
            session = await client.create_session(ddakf.Mesh(sequence.template, sequence.garment_faces), session_id=session_id)
            await session.reset(sequence.garment_vertices[0])
            async for result in session.track(frames(), on_error="yield", on_notice=notice):
                if isinstance(result, Result):
                    seen.answers.append(time.monotonic())
                    k = round((result.timestamp - 1.0) * a.rate)
                    truth = sequence.garment_vertices[1 + _place(k, len(run.clouds))]
                    seen.error[k] = metrics.rmse_mm(result.vertices, truth)
                    seen.state = result.state
    except Exception as error:  # any error ends this client, and the verdict reports it
        seen.gave_up = f"{type(error).__name__}: {error}"
    return seen


def _place(k: int, n: int) -> int:
    """There and back through n frames."""
    place = k % (2 * n)
    return min(place, 2 * n - 1 - place)


async def _faults(a: argparse.Namespace, fleet: Fleet, proxy: Proxy, log: list[str]) -> None:
    """The schedule."""
    random_ = random.Random(a.seed)
    kinds: dict[str, Callable] = {
        "a worker is killed": lambda: _kill_worker(fleet, random_),
        "connections are cut": lambda: _cut(proxy),
        "readers stall": lambda: proxy.stall(3.0),
        "the server is killed": lambda: _kill_server(fleet),
    }
    if fleet.disk is not None:
        kinds["the disk is full"] = lambda: _fill(fleet.disk)
    if fleet.database is not None:
        kinds["the database is stopped"] = lambda: _stop_database(fleet.database)
    begun, waiting = time.monotonic(), list(kinds)
    random_.shuffle(waiting)
    while True:
        await asyncio.sleep(random_.uniform(*EVERY))
        elapsed = time.monotonic() - begun
        if elapsed > a.seconds - QUIET - 5.0:
            return
        # each kind once before any comes twice
        name = waiting.pop() if waiting else random_.choice(list(kinds))
        console.print(f"{elapsed:6.1f} s  {name}")
        log.append(f"{elapsed:.1f} s: {name}")
        await kinds[name]()


async def _cut(proxy: Proxy) -> None:
    proxy.cut()


async def _kill_worker(fleet: Fleet, random_: random.Random) -> None:
    if workers := fleet.workers():
        with contextlib.suppress(ProcessLookupError):
            os.kill(random_.choice(workers), signal.SIGKILL)


async def _kill_server(fleet: Fleet) -> None:
    os.kill(fleet.pid, signal.SIGKILL)
    await asyncio.to_thread(fleet.stop)
    await asyncio.to_thread(fleet.start)


async def _fill(disk: Path) -> None:
    """Fills the file system for a few seconds, so that writes fail."""
    ballast = disk / "ballast"
    with contextlib.suppress(OSError), ballast.open("wb") as file:
        while True:
            file.write(bytes(1 << 16))
            file.flush()
    await asyncio.sleep(4.0)
    ballast.unlink()


async def _stop_database(database: Postgres) -> None:
    await asyncio.to_thread(database.stop)
    await asyncio.sleep(4.0)
    await asyncio.to_thread(database.start)


def _judged(a: argparse.Namespace, number: int, period: int, calm: ClientLog, seen: ClientLog) -> dict:
    """The errors of the last seconds against those of the same frames without faults, for frames played forth and back."""
    first = round((a.seconds - QUIET / 2) * a.rate)
    pairs = [(error, calm.error[k % period]) for k, error in seen.error.items() if k >= first and k % period in calm.error]
    row = {"session": number, "frames": len(seen.error), "state": seen.state, "notices": _counted(seen.notices)}
    if seen.gave_up or not pairs:
        return row | {"verdict": seen.gave_up or "no results at the end"}
    if len(pairs) < ANSWERED * QUIET / 2 * a.rate:
        return row | {"verdict": f"{len(pairs)} answers in the last {QUIET / 2:g} s"}
    disturbed, undisturbed = np.mean(pairs, axis=0)
    row |= {"rmse_mm": round(float(disturbed), 2), "undisturbed_mm": round(float(undisturbed), 2)}
    good = seen.state == "tracking" and disturbed <= max(RATIO * undisturbed, undisturbed + SLACK_MM)
    return row | {"verdict": "as undisturbed" if good else "worse than undisturbed"}


def _counted(notices: list[str]) -> str:
    return ", ".join(f"{kind} {notices.count(kind)}" for kind in sorted(set(notices))) or "none"


@contextlib.contextmanager
def _postgres():
    """A PostgreSQL, or None if the machine cannot run one."""
    try:
        database = Postgres()
    except NoPostgres as error:
        console.print(f"no database is stopped: {error}")
        yield None
        return
    try:
        database.start()
        yield database
    finally:
        database.remove()


@contextlib.contextmanager
def _small_disk(folder: Path):
    """A file system that can be filled without harm; None if none can be mounted."""
    place = folder / "disk"
    place.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", str(place)]
    mounted = subprocess.run(command, capture_output=True, check=False)
    if mounted.returncode != 0:
        yield None
        return
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", str(place)], check=False)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=150.0)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--clients", type=int, default=2)
    parser.add_argument("--rate", type=float, default=10.0, help="frames per second of each client")
    parser.add_argument("--hostile-seconds", type=float, default=20.0, help="of frames of the hostile session; 0: none")
    parser.add_argument("--points", type=int, default=3_000)
    parser.add_argument("--frames", type=int, default=149, help="of the sample, which are played there and back")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--out", type=Path, default=RESULT)
    return parser


if __name__ == "__main__":
    sys.exit(main())
