"""Alerts: each fires in a running Prometheus when a service has the trouble, and not before."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import sqlite3
import subprocess
import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from ddakf_client import Client, Frame, Limits, connect
from ddakf_service.commands.service_process import ServiceProcess

from ddakf.commands import cli

from ..service.conftest import TIMEOUT, eventually, fork_server, held, make_sheet, postgres, running, workers  # noqa: F401
from ..service.store.conftest import fill
from .conftest import COMPOSE, Prometheus, program, prometheus

pytestmark = pytest.mark.slow

SHEET = make_sheet()
PATIENCE = 120.0  # seconds for an alert to fire
DISK, FREE = "24m", "8e6"  # size of the data folder's disk, and bytes below which the alert fires here


class Deployment(NamedTuple):
    """A service with keys on a small disk, its client and Prometheus."""

    service: ServiceProcess
    client: Client
    prometheus: Prometheus
    disk: Path

    def awaits(self, alert: str) -> None:
        """Returns when the alert fires."""
        eventually(lambda: alert in self.prometheus.alerts(), PATIENCE)


@pytest.fixture(scope="module")
def disk(tmp_path_factory) -> Iterator[Path]:
    folder = tmp_path_factory.mktemp("disk")
    mount = ["mount", "-t", "tmpfs", "-o", f"size={DISK}", "tmpfs", folder]
    if os.geteuid() or subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("only root can make a small file system here")
    yield folder
    subprocess.run(["umount", folder], check=True)


@pytest.fixture(scope="module")
def deployment(disk, tmp_path_factory) -> Iterator[Deployment]:
    program("prometheus", "prometheus")
    folder, data = tmp_path_factory.mktemp("deployment"), disk / "state"
    arguments = ["--workers", "1", "--require-keys", "--data-dir", str(data), "--checkpoint-every", "1"]
    with running(arguments, folder) as service:
        key, stream = folder / "metrics.key", folder / "stream.key"
        command = [part.replace("/run/ddakf/metrics.key", str(key)) for part in COMPOSE["services"]["metrics-key"]["command"]]
        place = ["--data-dir", str(data)]
        assert cli.main([*command[1:], *place]) == 0
        assert cli.main(["keys", "create", "test", "--scope", "stream", "--file", str(stream), *place]) == 0
        target = service.http.removeprefix("http://")
        with (
            connect(service.grpc, api_key=stream.read_text().strip(), timeout=TIMEOUT) as client,
            prometheus(folder, target, key, FREE) as monitoring,
        ):
            eventually(lambda: monitoring.values("ddakf_workers_ready") == [1.0])
            yield Deployment(service, client, monitoring, disk)


def frames(points: np.ndarray, wanted: threading.Event) -> Iterator[Frame]:
    """The same cloud at 20 frames per second, as long as it is wanted."""
    number = 0
    while wanted.is_set():
        number += 1
        yield Frame(points, number / 20)
        time.sleep(0.05)


def fires(deployment: Deployment, alert: str, points: np.ndarray, during=lambda: None, **options) -> None:
    """Streams a cloud and repeats an action until the alert fires, once an earlier one has ended."""
    eventually(lambda: alert not in deployment.prometheus.alerts(), PATIENCE)
    wanted = threading.Event()
    wanted.set()
    session = deployment.client.create_session(*SHEET, **options)

    def stream() -> None:
        for _ in session.track(frames(points, wanted), on_error="yield"):
            pass

    streaming = threading.Thread(target=stream)
    streaming.start()
    try:

        def happened() -> bool:
            during()
            return alert in deployment.prometheus.alerts()

        eventually(happened, PATIENCE)
    finally:
        wanted.clear()
        streaming.join(TIMEOUT)
        session.delete()
    assert not streaming.is_alive()


def test_an_idle_service_raises_no_alert(deployment):
    scrapes = "count_over_time(up[1m])"
    before = deployment.prometheus.values(scrapes)[0]
    eventually(lambda: deployment.prometheus.values(scrapes)[0] > before + 4)
    assert deployment.prometheus.alerts() == set()


def test_a_high_latency(deployment):
    def hold() -> None:
        with held(workers(deployment.service.pid)):
            time.sleep(0.4)
        time.sleep(0.1)

    fires(deployment, "DdakfLatencyHigh", SHEET.vertices, hold)


def test_dropped_frames(deployment):
    fires(deployment, "DdakfFramesDropped", SHEET.vertices, flow="realtime", limits=Limits(max_frame_rate=2.0))


def test_a_low_reliability(deployment):
    elsewhere = np.random.default_rng(1).uniform(-0.5, 0.5, (400, 3))
    fires(deployment, "DdakfReliabilityLow", elsewhere, lambda: time.sleep(0.2), flow="lossless")


def test_a_lost_worker(deployment):
    assert "DdakfWorkerLost" not in deployment.prometheus.alerts()
    eventually(lambda: deployment.prometheus.values("ddakf_workers_spare") == [1.0])
    os.kill(workers(deployment.service.pid)[0], signal.SIGKILL)
    deployment.awaits("DdakfWorkerLost")


def test_no_worker(deployment):
    assert "DdakfNoWorker" not in deployment.prometheus.alerts()
    eventually(lambda: deployment.prometheus.values("ddakf_workers_spare") == [1.0])
    with held([pid for pid in [fork_server(deployment.service.pid)] if pid]):
        for pid in workers(deployment.service.pid):
            os.kill(pid, signal.SIGKILL)
        deployment.awaits("DdakfNoWorker")
    eventually(lambda: deployment.prometheus.values("ddakf_workers_ready") == [1.0])


def test_a_full_disk(deployment):
    assert not {"DdakfDiskFilling", "DdakfStorageFailing"} & deployment.prometheus.alerts()
    fill(deployment.disk)
    fires(deployment, "DdakfStorageFailing", SHEET.vertices, lambda: time.sleep(0.2))
    deployment.awaits("DdakfDiskFilling")
    (deployment.disk / "ballast").unlink()
    eventually(lambda: not {"DdakfDiskFilling", "DdakfStorageFailing"} & deployment.prometheus.alerts(), PATIENCE)


def test_failed_frames(deployment):
    """Those of a worker that gets no more memory; it outlives them."""
    eventually(lambda: deployment.prometheus.values("ddakf_workers_spare") == [1.0])
    pids = workers(deployment.service.pid)
    limits = [resource.prlimit(pid, resource.RLIMIT_DATA) for pid in pids]

    def starve() -> None:
        for pid, (_, most) in zip(pids, limits, strict=True):
            resource.prlimit(pid, resource.RLIMIT_DATA, (1, most))
        time.sleep(0.2)

    large = np.resize(SHEET.vertices, (100_000, 3))
    try:
        fires(deployment, "DdakfFramesFailed", large, starve, flow="lossless")
    finally:
        for pid, limit in zip(pids, limits, strict=True):
            resource.prlimit(pid, resource.RLIMIT_DATA, limit)
    assert workers(deployment.service.pid) == pids


def test_rows_that_the_database_refuses(deployment):
    with contextlib.closing(sqlite3.connect(deployment.disk / "state/ddakf.sqlite", timeout=TIMEOUT)) as database:
        database.execute("CREATE TRIGGER refuse BEFORE INSERT ON history BEGIN SELECT RAISE(ABORT, 'refused'); END")
        try:
            fires(deployment, "DdakfHistoryLost", SHEET.vertices, lambda: time.sleep(0.2))
        finally:
            database.execute("DROP TRIGGER refuse")


def test_leases_that_cannot_be_renewed(postgres, tmp_path):  # noqa: F811
    program("prometheus", "prometheus")
    place = ["--database-url", postgres.new_database(f"alerts-{uuid.uuid4()}"), "--data-dir", str(tmp_path / "state")]
    key = tmp_path / "metrics.key"
    assert cli.main(["keys", "create", "test", "--scope", "read", "--file", str(key), *place]) == 0
    shared = ["--share-sessions", "--server-id", "one", "--checkpoint-url", (tmp_path / "checkpoints").as_uri()]
    with (
        running(["--workers", "1", "--require-keys", "--lease-seconds", "1", *shared, *place], tmp_path) as service,
        prometheus(tmp_path, service.http.removeprefix("http://"), key) as monitoring,
    ):
        eventually(lambda: monitoring.values("ddakf_lease_held") == [1.0])
        assert "DdakfLeaseLost" not in monitoring.alerts()
        postgres.stop()
        try:
            eventually(lambda: "DdakfLeaseLost" in monitoring.alerts(), PATIENCE)
        finally:
            postgres.start()
        eventually(lambda: "DdakfLeaseLost" not in monitoring.alerts(), PATIENCE)


def test_a_service_that_does_not_answer(deployment):
    assert "DdakfDown" not in deployment.prometheus.alerts()
    with held([deployment.service.pid]):
        deployment.awaits("DdakfDown")
