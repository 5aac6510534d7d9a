"""Ray clusters for tests: each node is a process of its own, as operators start them, with ports and a folder of its own.

Ray forks its processes in Python. The process of the tests must not be the one that does it: a copy of it has the locks that
threads of gRPC held, which nobody releases, and hangs before it begins.
"""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

from ports import lasting_port

from ..conftest import children, eventually, is_running

_PATIENCE = 120.0  # seconds for a start or an end
_STORE = 100_000_000  # bytes
_PARENT = "/tmp"  # a socket below it has a path of at most 107 characters


class RayNode:
    """A node that runs, ready for actors.

    Args:
        join: address of its cluster; empty: it is the head of another one.

    Attributes:
        address: of the cluster. raylet: process id of the parent of its actors. node_id: Ray's, in hexadecimal.
    """

    def __init__(self, processors: int, join: str = ""):
        self._folder = Path(tempfile.mkdtemp(prefix="ray-", dir=_PARENT))
        head = ["--head", "--port=0", f"--ray-client-server-port={lasting_port()}", "--include-dashboard=false"]
        place = [f"--address={join}"] if join else head
        ports = ["--min-worker-port=0", "--max-worker-port=0", "--dashboard-agent-listen-port=0"]  # any free ones
        options = [f"--temp-dir={self._folder}", *ports, "--include-log-monitor=false", "--disable-usage-stats"]
        size = [f"--num-cpus={processors}", f"--object-store-memory={_STORE}"]
        command = [sys.executable, "-m", "ray.scripts.scripts", "start", *place, *options, *size, "--block"]
        environment = {**os.environ, "RAY_worker_niceness": "0"}  # as the documents have it
        with (self._folder / "log").open("wb") as log:
            self._process = subprocess.Popen(command, env=environment, stdin=subprocess.DEVNULL, stdout=log, stderr=log)
        try:
            eventually(self._is_ready, _PATIENCE)
            self.address = join or self._address_file.read_text().strip()
            self.raylet, line = next((pid, line) for pid in children(self._process.pid) if "/raylet" in (line := _line(pid))[0])
            self.node_id = next(part.partition("=")[2] for part in line if part.startswith("--node_id="))
        except BaseException:
            self.end()
            raise

    def end(self) -> None:
        """Ends it in order. None of its processes and files are left."""
        family = self._family()
        self._process.terminate()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_PATIENCE)
        self._kill(family)

    def lose(self) -> None:
        """Ends all of its processes at once."""
        self._kill(self._family())

    def _family(self) -> list[int]:
        return [self._process.pid, *_descendants(self._process.pid)]

    def _kill(self, family: list[int]) -> None:
        for pid in filter(is_running, family):
            with contextlib.suppress(ProcessLookupError):
                os.kill(pid, signal.SIGKILL)
        self._process.wait(_PATIENCE)
        eventually(lambda: not any(map(is_running, family)) and self._is_removed(), _PATIENCE)

    def _is_removed(self) -> bool:
        """Whether its folder is gone; an actor that has just been started may still write there."""
        shutil.rmtree(self._folder, ignore_errors=True)
        return not self._folder.exists()

    @property
    def _address_file(self) -> Path:
        """It is written when the node is ready."""
        return self._folder / "ray_current_cluster"

    def _is_ready(self) -> bool:
        assert self._process.poll() is None, (self._folder / "log").read_text(errors="replace")
        return self._address_file.exists() and bool(self._address_file.read_text())


class RayCluster:
    """A head, and nodes that join it.

    Attributes:
        joined: nodes that run; who ends one removes it.
    """

    def __init__(self, processors: int):
        self._head = RayNode(processors)
        self.address, self.joined = self._head.address, []

    def add_node(self, processors: int) -> None:
        self.joined.append(RayNode(processors, self.address))

    def end(self) -> None:
        for node in [*self.joined, self._head]:
            node.end()


def _descendants(pid: int) -> list[int]:
    return [found for child in children(pid) for found in (child, *_descendants(child))]


def _line(pid: int) -> list[str]:
    return Path(f"/proc/{pid}/cmdline").read_text().split("\0")
