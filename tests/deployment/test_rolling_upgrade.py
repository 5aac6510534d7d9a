"""Rolling upgrade: two servers on one PostgreSQL are replaced in turn, and their streams lose no frame."""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Iterator
from pathlib import Path

import pytest
from ddakf_client import Frame, connect
from ddakf_service.commands.service_process import ServiceProcess
from ports import lasting_port

from ..service.conftest import TIMEOUT, eventually, make_sheet, postgres  # noqa: F401

pytestmark = pytest.mark.slow

SHEET = make_sheet()
RATE, STEP = 20, 0.001  # frames per second, metres per frame
PATIENCE = 120.0  # seconds for a server to be replaced


class Gateway:
    """A server of one name, and the address of the next server of this name."""

    def __init__(self, name: str, folder: Path, shared: list[str], grpc: int, successor: int):
        arguments = ["--workers", "1", "--server-id", name, "--data-dir", str(folder / f"{name}-{grpc}"), *shared]
        arguments += ["--grpc-port", str(grpc), "--successor", f"127.0.0.1:{successor}", "--drain-grace", "1"]
        self.address = f"127.0.0.1:{grpc}"
        self._process = ServiceProcess(arguments, log=folder / f"{name}-{grpc}.log")
        self._process.wait_until_ready()

    def stop(self) -> int:
        return self._process.stop()


class Stream(threading.Thread):
    """A lossless stream until it is told to end; the numbers of its answers."""

    def __init__(self, address: str):
        super().__init__()
        self._address, self._wanted = address, threading.Event()
        self._wanted.set()
        self.answered: list[int] = []
        self.sent = 0
        self.notices: set[str] = set()
        self.states: set[str] = set()

    def run(self) -> None:
        with connect(self._address, timeout=TIMEOUT) as client:
            session = client.create_session(*SHEET, flow="lossless")
            for result in session.track(self._frames(), on_notice=lambda n: self.notices.add(n.kind), resume=PATIENCE):
                self.answered.append(result.sequence)
                self.states.add(result.state)
            session.delete()

    def end(self) -> None:
        self._wanted.clear()
        self.join(PATIENCE)
        assert not self.is_alive()

    def _frames(self) -> Iterator[Frame]:
        while self._wanted.is_set():
            self.sent += 1
            yield Frame(SHEET.vertices + [STEP * self.sent, 0, 0], self.sent / RATE)
            time.sleep(1 / RATE)


def test_streams_outlive_the_replacement_of_their_servers(postgres, tmp_path):  # noqa: F811
    url = postgres.new_database(f"rolling-{uuid.uuid4()}")
    shared = ["--database-url", url, "--checkpoint-url", f"file://{tmp_path}/checkpoints", "--departure-timeout", "120"]
    ports = {name: (lasting_port(), lasting_port()) for name in ("one", "two")}
    running = {name: Gateway(name, tmp_path, shared, *ports[name]) for name in ports}
    streams = {name: Stream(gateway.address) for name, gateway in running.items()}
    try:
        for stream in streams.values():
            stream.start()
        for name, (old, new) in ports.items():
            eventually(lambda: all(len(stream.answered) >= 10 for stream in streams.values()))
            assert running[name].stop() == 0
            running[name] = Gateway(name, tmp_path, shared, new, old)
            before = len(streams[name].answered)
            eventually(lambda: len(streams[name].answered) >= before + 10, PATIENCE)  # noqa: B023
    finally:
        for stream in streams.values():
            stream.end()
        statuses = {gateway.stop() for gateway in running.values()}
    assert statuses == {0}
    for stream in streams.values():
        assert sorted(set(stream.answered)) == list(range(1, stream.sent + 1))
        assert {"draining", "reconnect"} <= stream.notices
        assert stream.states == {"tracking"}
