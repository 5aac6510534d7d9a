"""A service whose workers are actors of a Ray cluster with two nodes: streams outlive an actor and a node."""

from __future__ import annotations

import contextlib
import itertools
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import httpx
import pytest
from ddakf_api.errors import ServiceError
from ddakf_client import Frame, connect

from ..conftest import TIMEOUT, eventually, make_sheet, running
from ..lossless_stream import RATE, LosslessStream
from .ray_cluster import RayCluster

pytestmark = pytest.mark.slow

SHEET = make_sheet()
PROCESSORS = 0  # of the head
PATIENCE = 120.0  # seconds for the next answer


@pytest.fixture(scope="module")
def cluster(cluster) -> RayCluster:
    """A node without processors, where the service is, and two nodes for actors."""
    for _ in range(2):
        cluster.add_node(4)
    return cluster


@pytest.fixture(scope="module")
def service(cluster, tmp_path_factory):
    arguments = ["--worker-kind", "ray", "--ray-address", cluster.address, "--workers", "1", "--spare-workers", "1"]
    with running([*arguments, "--checkpoint-every", "5"], tmp_path_factory.mktemp("ray")) as service:
        yield service


@pytest.fixture
def stream(service):
    """A stream with its first answers; every frame has an answer at its end."""
    stream = LosslessStream(service.grpc, patience=PATIENCE)
    stream.start()
    try:
        eventually(lambda: len(stream.answered) >= 10, PATIENCE)
        yield stream
    finally:
        stream.end()
    assert stream.answered == list(range(1, stream.sent + 1))


def actors(cluster) -> dict[int, int]:
    """Of the actors of this cluster, which run on this machine: the process id, and that of the node."""
    found, nodes = {}, {node.raylet for node in cluster.joined}
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError):  # it has ended meanwhile
            if (entry / "cmdline").read_text().startswith("ray::Actor"):
                found[int(entry.name)] = int(_fields(int(entry.name))[_PARENT])
    return {actor: node for actor, node in found.items() if node in nodes}


def busy_actor(cluster) -> tuple[int, int]:
    """Process id and node of the actor that tracks the stream: the one that uses the processor most, as the spare one waits."""
    nodes = actors(cluster)
    before = {actor: _used(actor) for actor in nodes}
    time.sleep(2.0)
    return max(nodes.items(), key=lambda found: _used(found[0]) - before[found[0]])


_PARENT, _USER, _SYSTEM = 1, 11, 12  # fields of /proc/PID/stat, from the state on


def _fields(process: int) -> list[str]:
    return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()


def _used(process: int) -> int:
    """Clock ticks."""
    fields = _fields(process)
    return int(fields[_USER]) + int(fields[_SYSTEM])


def is_warm(service) -> bool:
    """Whether a spare actor waits."""
    return "ddakf_workers_spare 1.0" in httpx.get(f"{service.http}/metrics", timeout=TIMEOUT).text


def test_the_actors_of_a_service_are_on_different_nodes(service, cluster):
    eventually(lambda: is_warm(service), PATIENCE)
    assert sorted(actors(cluster).values()) == sorted(node.raylet for node in cluster.joined)


def test_a_node_that_drains_gives_its_sessions_away(service, stream, cluster):
    """They move between two frames: nothing is forgotten, no actor is left there, and the stream has nothing to be told."""
    eventually(lambda: is_warm(service), PATIENCE)
    before, (_, raylet) = len(stream.answered), busy_actor(cluster)
    (node,) = [n for n in cluster.joined if n.raylet == raylet]
    why = ["--reason", "DRAIN_NODE_REASON_PREEMPTION", "--reason-message", "test", "--deadline-remaining-seconds", "3600"]
    command = [sys.executable, "-m", "ray.scripts.scripts", "drain-node", "--address", cluster.address, "--node-id", node.node_id]
    subprocess.run([*command, *why], check=True, capture_output=True, timeout=TIMEOUT)
    eventually(lambda: raylet not in actors(cluster).values(), PATIENCE)
    eventually(lambda: len(stream.answered) >= before + 20, PATIENCE)
    assert stream.notices == []
    cluster.joined.remove(node)
    node.end()
    cluster.add_node(4)
    print(f"node drained: {stream.longest:.2f} s without an answer")


def test_a_stream_outlives_its_actor(service, stream, cluster):
    eventually(lambda: is_warm(service), PATIENCE)
    before = len(stream.answered)
    os.kill(busy_actor(cluster)[0], signal.SIGKILL)
    eventually(lambda: "resumed" in stream.notices, PATIENCE)
    eventually(lambda: len(stream.answered) >= before + 20, PATIENCE)
    print(f"actor killed: {stream.longest:.2f} s without an answer")


def test_a_stream_outlives_the_node_of_its_actor(service, stream, cluster):
    eventually(lambda: is_warm(service), PATIENCE)
    before, (_, raylet) = len(stream.answered), busy_actor(cluster)
    (node,) = [n for n in cluster.joined if n.raylet == raylet]
    cluster.joined.remove(node)
    node.lose()
    eventually(lambda: "resumed" in stream.notices, PATIENCE)
    eventually(lambda: len(stream.answered) >= before + 20, PATIENCE)
    print(f"node lost: {stream.longest:.2f} s without an answer")


def test_a_stop_gives_the_clients_their_grace(cluster, tmp_path):
    """Also when that is longer than the three seconds after which Ray would abort the process; ``running`` wants the status 0."""
    arguments = ["--worker-kind", "ray", "--ray-address", cluster.address, "--workers", "1", "--spare-workers", "0"]
    with running([*arguments, "--drain-grace", "4"], tmp_path) as service, connect(service.grpc, timeout=PATIENCE) as client:
        session = client.create_session(*SHEET, flow="lossless")
        frames = (Frame(SHEET.vertices, number / RATE) for number in itertools.count(1) if not time.sleep(1 / RATE))
        answers = session.track(frames, resume=0)
        next(answers)
        before = time.monotonic()
        assert service.stop() == 0
        assert time.monotonic() - before > 3.5
        with contextlib.suppress(ServiceError):
            answers.close()


def test_a_cluster_that_is_not_there_is_one_sentence(tmp_path):
    pytest.importorskip("ray", reason="ray is not installed: pip install 'ddakf[ray]'")
    arguments = ["--worker-kind", "ray", "--ray-address", "127.0.0.1:1", "--data-dir", str(tmp_path / "data")]
    command = [sys.executable, "-m", "ddakf_service", "--grpc-port", "0", "--http-port", "0", *arguments]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode == 1
    assert "ddakf serve: the Ray cluster '127.0.0.1:1' cannot be reached" in ended.stderr.splitlines()[-1]
