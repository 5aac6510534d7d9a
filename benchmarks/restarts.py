"""Restarts of a server: seconds and CPU seconds until it is ready, and until a client that lost it has its next answer.

Part of ``python benchmarks/kill.py``. The kernel cache is warm. The client is the Python library's, with a lossless stream; the
server gets SIGKILL and starts again at once with its data and its port, as a process manager starts it.
"""

from __future__ import annotations

import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import traffic
from ddakf_api.codec import decode
from ddakf_client import Frame, connect
from ddakf_service.commands.service_process import ServiceProcess
from ports import lasting_port

_BETWEEN = 3.0  # seconds of streaming before each kill
_PATIENCE = 120.0  # seconds in which a client looks for its server


class Server:
    """A server on one port and one folder, with the time of each of its starts."""

    def __init__(self, folder: Path):
        self._port = str(lasting_port())
        self._folder = folder
        self.ready: list[float] = []
        self.cpu: list[float] = []
        self._starting: threading.Thread | None = None
        self.start()
        self.wait()

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self._port}"

    def start(self) -> None:
        """Starts the process and returns at once."""
        begun = time.monotonic()
        arguments = ["--workers", "2", "--grpc-port", self._port, "--data-dir", str(self._folder / "state")]
        self._process = ServiceProcess(arguments, log=self._folder / f"service-{len(self.ready)}.log")
        self._starting = threading.Thread(target=self._wait_until_ready, args=(begun,))
        self._starting.start()

    def kill(self) -> None:
        self._process.stop(signal.SIGKILL)

    def stop(self) -> None:
        self._process.stop()

    def wait(self) -> None:
        """Returns when the last start is over."""
        self._starting.join()

    def _wait_until_ready(self, begun: float) -> None:
        self._process.wait_until_ready()
        self.ready.append(time.monotonic() - begun)
        self.cpu.append(traffic.Usage(self._process.pid).cpu_seconds())


def row(script: traffic.Script, kills: int, rate: float) -> dict:
    """Kills the server in mid-stream so many times. All starts but the first have the client's stand-still within them."""
    with tempfile.TemporaryDirectory() as folder:
        server = Server(Path(folder))
        try:
            stood, busy, missing = _stream(server, script, kills, rate)
        finally:
            server.stop()
    return {
        "vertices": script.vertices,
        "kills": kills,
        "load_average": round(sum(busy) / len(busy), 1),
        "ready_s": [round(seconds, 2) for seconds in server.ready],
        "ready_cpu_s": [round(seconds, 2) for seconds in server.cpu],
        "stood_s": [round(seconds, 2) for seconds in stood],
        "answers_missing": missing,
    }


def _stream(server: Server, script: traffic.Script, kills: int, rate: float) -> tuple[list[float], list[float], int]:
    """Stand-stills in seconds, load averages, and the number of frames without an answer."""
    sent, stood, busy, answered = 0, [], [], set()
    over, killed = threading.Event(), None

    def frames() -> Iterator[Frame]:
        nonlocal sent
        begun = time.monotonic()
        while not over.is_set():
            sent += 1
            time.sleep(max(0.0, begun + sent / rate - time.monotonic()))
            message = script.frame(sent, rate).frame
            points = decode(message.point_cloud, max_points=message.point_cloud.point_count)
            yield Frame(points, message.capture_time)

    with connect(server.address) as client:
        session = client.create_session(*script.mesh, flow="lossless")
        session.reset(script.begin)
        due = time.monotonic() + _BETWEEN
        for result in session.track(frames(), resume=_PATIENCE, timeout=_PATIENCE, on_notice=lambda notice: None):
            now = time.monotonic()
            answered.add(result.sequence)
            if killed is not None:
                stood.append(now - killed)
                killed, due = None, now + _BETWEEN
                server.wait()
            elif len(stood) < kills and now > due:
                busy.append(os.getloadavg()[0])
                killed = time.monotonic()
                server.kill()
                server.start()
            elif len(stood) == kills:
                over.set()
    return stood, busy, sent - len(answered)
