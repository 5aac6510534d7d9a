"""Failures of a cluster: ``python benchmarks/cluster.py [--worker-kind local] [--events "actor killed" ...] [--rounds 2] ...``.

Two gateways share their sessions through a PostgreSQL and a folder of checkpoints; their workers are actors on a Ray cluster of
three nodes, all on this machine. Lossless streams of the sample go through them, from clients that know both addresses. Then an
actor, a node and a gateway are killed, and a gateway and a node are drained. For each event: applied frames that the trackers
forgot, answers that never came, and the longest time between two answers of a stream. Exit status 1 if an answer is missing, if a
drain forgets a frame, or if a stream stands still for longer than its event's limit. Writes benchmarks/results/cluster.json, with
the load average, since other load lengthens the times, and the table of docs/operations.md.
"""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import fleet_tables
import numpy as np
from committed import parsed
from ddakf_client import Frame, connect
from ddakf_service.commands.service_process import ServiceProcess
from ports import lasting_port
from postgres import Postgres
from rich.console import Console
from service_metrics import metrics_of

from ddakf import data
from ddakf.evaluation import machine

RESULT = Path(__file__).parent / "results" / "cluster.json"
PATIENCE = 180.0  # seconds in which everything has to be as before
ANSWERS = 30  # of each stream after an event
LEASE = 5.0  # seconds, the default
NODE = {"num_cpus": 8, "object_store_memory": 100_000_000}
console = Console(stderr=True, highlight=False)


class Event(NamedTuple):
    """A kind of event.

    Attributes:
        limit: seconds that a stream may stand still.
        needs_ray: it happens to an actor or a node.
        may_forget: the trackers may forget frames.
        is_told: a stream is interrupted, and told.
    """

    strike: Callable[[Fleet], None]
    limit: float
    needs_ray: bool = False
    may_forget: bool = True
    is_told: bool = True


class Stream(threading.Thread):
    """A lossless stream of the sample until it is told to end: times of its answers, and what it was told."""

    def __init__(self, addresses: list[str], rate: float, points: int):
        super().__init__(daemon=True)
        self._addresses, self._rate, self._wanted = addresses, rate, threading.Event()
        self._wanted.set()
        self._sample = data.sample()
        n_vertices = len(self._sample.template)
        self._chosen = np.random.default_rng(0).choice(n_vertices, min(points, n_vertices), replace=False)
        self.sent, self.answers, self.answered = 0, [], set()
        self.resumed: list[tuple[float, float]] = []  # times, and forgotten frames
        self.failure: Exception | None = None

    def run(self) -> None:
        try:
            with connect(self._addresses, timeout=PATIENCE) as client:
                session = client.create_session(self._sample.template, self._sample.garment_faces, flow="lossless")
                for result in session.track(self._frames(), on_notice=self._note, resume=PATIENCE):
                    self.answers.append(time.monotonic())
                    self.answered.add(result.sequence)
                session.delete()
        except Exception as error:
            self.failure = error

    def _note(self, notice) -> None:
        if notice.kind == "resumed":
            self.resumed.append((time.monotonic(), notice.value))

    def _frames(self) -> Iterator[Frame]:
        vertices = self._sample.garment_vertices
        due = time.monotonic()
        while self._wanted.is_set():
            place = self.sent % (2 * len(vertices) - 2)  # forth and back
            self.sent += 1
            yield Frame(vertices[min(place, 2 * len(vertices) - 2 - place)][self._chosen], self.sent / self._rate)
            due = max(due + 1 / self._rate, time.monotonic())
            time.sleep(max(due - time.monotonic(), 0.0))

    def end(self) -> int:
        """Number of frames without an answer."""
        self._wanted.clear()
        self.join(PATIENCE)
        return self.sent - len(self.answered) + self.is_alive()

    def longest(self, since: float) -> float:
        """Longest time between two answers since a moment."""
        times = [since, *(moment for moment in self.answers if moment > since)]
        return max((late - early for early, late in itertools.pairwise(times)), default=0.0)


class Gateway:
    """A service of one name and one address; started again after each end."""

    def __init__(self, name: str, folder: Path, arguments: list[str]):
        self.address, self._log = f"127.0.0.1:{lasting_port()}", folder / f"{name}.log"
        port = self.address.rpartition(":")[2]
        self._arguments = [*arguments, "--server-id", name, "--data-dir", str(folder / name), "--grpc-port", port]
        self._arguments += ["--share-sessions", "--gateway-address", self.address, "--lease-seconds", str(LEASE)]
        self.start()

    def start(self) -> None:
        self.process = ServiceProcess(self._arguments, log=self._log)
        self.process.wait_until_ready()

    def end(self, number: int) -> None:
        self.process.stop(number)

    def metric(self, name: str) -> float:
        return metrics_of(self.process)[name]


class Fleet:
    """Two gateways, their database, and with Ray the cluster of their workers."""

    def __init__(self, folder: Path, ray: bool):
        self.cluster, self.gateways = _ray_cluster() if ray else None, []
        self.postgres = Postgres()
        try:
            self._start(folder)
        except BaseException:
            self.close()
            raise

    def _start(self, folder: Path) -> None:
        self.postgres.start()
        arguments = ["--workers", "1", "--spare-workers", "1", "--drain-grace", "0.5", "--departure-timeout", "120"]
        arguments += ["--database-url", self.postgres.new_database("cluster"), "--checkpoint-url", f"file://{folder}/checkpoints"]
        if self.cluster is not None:
            arguments += ["--worker-kind", "ray", "--ray-address", self.cluster.address]
        for name in ("one", "two"):
            self.gateways.append(Gateway(name, folder, arguments))

    def heal(self) -> None:
        """Returns when all gateways and nodes are there, each gateway with a warm spare."""
        for gateway in self.gateways:
            if gateway.process._process.poll() is not None:
                gateway.start()
        while self.cluster is not None and len(self.cluster.worker_nodes) < 2:
            self.cluster.add_node(**NODE)
        until(lambda: all(gateway.metric("ddakf_workers_spare") == 1 for gateway in self.gateways), "a spare worker")

    def workers(self) -> list[tuple[int, int]]:
        """Process id and parent of the workers; the busiest of the last second first."""
        parents = {gateway.process.pid for gateway in self.gateways}
        if self.cluster is not None:
            parents = {_raylet(node) for node in self.cluster.worker_nodes}
        before = _ticks(parents)
        time.sleep(1.0)
        used = {key: ticks - before.get(key, 0) for key, ticks in _ticks(parents).items()}
        return sorted(used, key=used.get, reverse=True)

    def close(self) -> None:
        for gateway in self.gateways:
            gateway.end(signal.SIGTERM)
        self.postgres.remove()
        if self.cluster is not None:
            self.cluster.shutdown()


def kill_actor(fleet: Fleet) -> None:
    os.kill(fleet.workers()[0][0], signal.SIGKILL)


def kill_node(fleet: Fleet) -> None:
    fleet.cluster.remove_node(_busiest_node(fleet), allow_graceful=False)


def drain_node(fleet: Fleet) -> None:
    """Returns when the node has no workers, and stops it then."""
    node = _busiest_node(fleet)
    why = ["--reason", "DRAIN_NODE_REASON_PREEMPTION", "--reason-message", "test", "--deadline-remaining-seconds", "3600"]
    command = [sys.executable, "-m", "ray.scripts.scripts", "drain-node", "--address", fleet.cluster.address]
    subprocess.run([*command, "--node-id", node.node_id, *why], check=True, capture_output=True)
    until(lambda: not _ticks({_raylet(node)}), "workers elsewhere")
    fleet.cluster.remove_node(node)


def kill_gateway(fleet: Fleet) -> None:
    _busiest_gateway(fleet).end(signal.SIGKILL)


def drain_gateway(fleet: Fleet) -> None:
    _busiest_gateway(fleet).end(signal.SIGTERM)


EVENTS = {
    "actor killed": Event(kill_actor, 3.0),
    "node lost": Event(kill_node, 25.0, needs_ray=True),
    "node drained": Event(drain_node, 5.0, needs_ray=True, may_forget=False, is_told=False),
    "gateway killed": Event(kill_gateway, 3 * LEASE),
    "gateway drained": Event(drain_gateway, 5.0, may_forget=False),
}


def main(argv: list[str] | None = None) -> int:
    """Returns the exit status."""
    a = parsed(_parser(), argv)
    with_ray = a.worker_kind == "ray"
    report = {"name": "cluster", "commit": machine.commit(), "machine": machine.describe(), "date": time.strftime("%Y-%m-%d")}
    report |= {"worker_kind": a.worker_kind, "streams": a.streams, "rate": a.rate, "points": a.points, "lease_s": LEASE}
    folder = Path(tempfile.mkdtemp(prefix="ddakf-cluster-"))
    console.print(f"starting two gateways, PostgreSQL{' and a Ray cluster' if with_ray else ''}; logs in {folder}")
    fleet = Fleet(folder, with_ray)
    try:
        rows, missing = _rows(a, fleet, [name for name in a.events if with_ray or not EVENTS[name].needs_ray])
    finally:
        fleet.close()
    report |= {"rows": rows, "answers_missing": missing, "failed": _failures(rows, missing)}
    _print(rows)
    a.out.parent.mkdir(parents=True, exist_ok=True)
    a.out.write_text(json.dumps(report, indent=1) + "\n")
    fleet_tables.write(a.out)
    for sentence in report["failed"]:
        print(f"FAILED: {sentence}")
    print(a.out)
    if not report["failed"]:
        shutil.rmtree(folder)
    return 1 if report["failed"] else 0


def _rows(a: argparse.Namespace, fleet: Fleet, names: list[str]) -> tuple[list[dict], int]:
    """A row per event, and the number of frames without an answer at the end."""
    addresses = [gateway.address for gateway in fleet.gateways]
    streams = [Stream(addresses[i % 2 :] + addresses[: i % 2], a.rate, a.points) for i in range(a.streams)]
    for stream in streams:
        stream.start()
    rows = []
    try:
        for name in [name for _ in range(a.rounds) for name in names]:
            fleet.heal()
            _go_on(streams)
            console.print(f"{name} ...")
            rows.append(_row(name, fleet, streams))
    finally:
        missing = sum(stream.end() for stream in streams)
    for stream in streams:
        if stream.failure is not None:
            raise stream.failure
    return rows, missing


def _row(name: str, fleet: Fleet, streams: list[Stream]) -> dict:
    told, began = [len(stream.resumed) for stream in streams], time.monotonic()
    EVENTS[name].strike(fleet)
    if EVENTS[name].is_told:
        until(lambda: any(len(stream.resumed) > n for stream, n in zip(streams, told, strict=True)), "a stream that is told")
    _go_on(streams)
    news = [stream.resumed[n:] for stream, n in zip(streams, told, strict=True)]
    return {
        "event": name,
        "load_average": round(os.getloadavg()[0], 1),
        "streams_interrupted": sum(bool(new) for new in news),
        "frames_forgotten": round(sum(forgotten for new in news for _, forgotten in new)),
        "longest_gap_s": round(max(stream.longest(began) for stream in streams), 2),
        "limit_s": EVENTS[name].limit,
    }


def _go_on(streams: list[Stream]) -> None:
    """Returns when each stream has some more answers."""
    before = [len(stream.answers) for stream in streams]
    enough = lambda: all(len(s.answers) >= n + ANSWERS or s.failure for s, n in zip(streams, before, strict=True))  # noqa: E731
    until(enough, "answers of every stream")
    for stream in streams:
        if stream.failure is not None:
            raise stream.failure


def _failures(rows: list[dict], missing: int) -> list[str]:
    failed = [f"{missing} answers are missing"] if missing else []
    for row in rows:
        if row["longest_gap_s"] > row["limit_s"]:
            failed.append(f"{row['event']}: {row['longest_gap_s']:g} s without an answer, more than {row['limit_s']:g} s")
        if row["frames_forgotten"] and not EVENTS[row["event"]].may_forget:
            failed.append(f"{row['event']}: {row['frames_forgotten']} frames were forgotten")
    return failed


def _print(rows: list[dict]) -> None:
    print(f"{'event':18} {'streams':>8} {'frames forgotten':>17} {'longest gap':>12} {'limit':>8}")
    for row in rows:
        gap, limit = f"{row['longest_gap_s']:.2f} s", f"{row['limit_s']:g} s"
        print(f"{row['event']:18} {row['streams_interrupted']:8} {row['frames_forgotten']:17} {gap:>12} {limit:>8}")


def until(condition: Callable[[], bool], what: str) -> None:
    """Returns when a condition holds; raises TimeoutError after PATIENCE."""
    deadline = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > deadline:
            raise TimeoutError(f"{what}: not within {PATIENCE:g} s")
        time.sleep(0.05)


def _ray_cluster():
    """A node without processors for the gateways, and two for actors."""
    from ray.cluster_utils import Cluster

    os.environ["RAY_worker_niceness"] = "0"  # noqa: SIM112 (the name that Ray reads)
    head = {"num_cpus": 0, "include_dashboard": False, "object_store_memory": NODE["object_store_memory"]}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    for _ in range(2):
        cluster.add_node(**NODE)
    return cluster


def _raylet(node) -> int:
    return node.all_processes["raylet"][0].process.pid


def _busiest_node(fleet: Fleet):
    parent = fleet.workers()[0][1]
    return next(node for node in fleet.cluster.worker_nodes if _raylet(node) == parent)


def _busiest_gateway(fleet: Fleet) -> Gateway:
    return max(fleet.gateways, key=lambda gateway: gateway.metric("ddakf_streams"))


def _ticks(parents) -> dict[tuple[int, int], int]:
    """Processor time of the workers among the children of some processes, by process id and parent."""
    found = {}
    for status in Path("/proc").glob("[0-9]*/stat"):
        try:
            fields = status.read_text().rpartition(")")[2].split()
            is_worker = int(fields[1]) in parents and _is_worker(status.parent)
        except OSError:
            continue  # it has ended meanwhile
        if is_worker:
            found[int(status.parent.name), int(fields[1])] = int(fields[11]) + int(fields[12])
    return found


def _is_worker(process: Path) -> bool:
    """Whether a folder of /proc is that of a worker process or of an actor."""
    return "ddakf-worker" in (process / "comm").read_text() or (process / "cmdline").read_text().startswith("ray::Actor")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--events", nargs="+", choices=EVENTS, default=list(EVENTS), metavar="EVENT", help=", ".join(EVENTS))
    parser.add_argument("--worker-kind", choices=("ray", "local"), default="ray")
    parser.add_argument("--streams", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=1, help="of all events")
    parser.add_argument("--rate", type=float, default=10.0, help="frames per second of a stream")
    parser.add_argument("--points", type=int, default=2000)
    parser.add_argument("--out", type=Path, default=RESULT)
    return parser


if __name__ == "__main__":
    sys.exit(main())
