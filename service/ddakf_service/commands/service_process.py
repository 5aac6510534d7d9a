"""Service process: the service as a child process on free loopback ports, ended with its parent."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from ..workers.pool import Progress

_STOP_PATIENCE = 20.0  # seconds for an orderly shutdown, drain included


class ServiceFailed(RuntimeError):
    """The service ended before it was ready; the message is the last line of its log."""


@contextmanager
def running_service(arguments: Sequence[str] = ()) -> Iterator[ServiceProcess]:
    """A service that is ready and ends with the block, with a temporary log; kernels that it loads are told on standard error.

    Args:
        arguments: of ``ddakf serve``, as for :class:`ServiceProcess`.

    Raises:
        ServiceFailed: the service ended before it was ready.
    """
    with tempfile.TemporaryDirectory(prefix="ddakf-log-") as folder:
        process = ServiceProcess(arguments, log=Path(folder) / "service.log")
        try:
            process.wait_until_ready(_told)
            yield process
        finally:
            process.stop()


def _told(activity: str, done: int, total: int, name: str) -> None:
    print(f"{activity} kernels: {done} of {total}", file=sys.stderr)


class ServiceProcess:
    """A service as a child process.

    Args:
        arguments: of ``ddakf serve``, in addition to the ports. Without ``--data-dir`` the service uses a temporary folder,
            or with ``keep`` none.
        log: log file.
        keep: the service outlives this process.

    Attributes:
        grpc: "host:port". http: "http://host:port", or https with TLS. :meth:`wait_until_ready` sets both.
    """

    def __init__(self, arguments: Sequence[str] = (), *, log: Path, keep: bool = False):
        self._log, self._keep = log, keep
        self.grpc = self.http = ""
        self._folder: tempfile.TemporaryDirectory | None = None
        if "--data-dir" not in arguments:
            self._folder = None if keep else tempfile.TemporaryDirectory(prefix="ddakf-")
            arguments = [*arguments, "--data-dir", self._folder.name if self._folder else "none"]
        command = [sys.executable, "-m", "ddakf_service", "--json", "--grpc-port", "0", "--http-port", "0", *arguments]
        with log.open("wb") as log_file:
            self._process = subprocess.Popen(
                # The pipe to its standard input closes at any end of this process, also a kill.
                command if keep else [*command, "--with-parent"],
                stdin=subprocess.DEVNULL if keep else subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log_file,
                # Ctrl-C must not reach the service before its clients have left.
                start_new_session=True,
            )

    @property
    def pid(self) -> int:
        return self._process.pid

    def wait_until_ready(self, progress: Progress = lambda activity, done, total, name: None) -> None:
        """Returns when the service accepts sessions.

        Raises:
            ServiceFailed: the service ended.
        """
        with self._process.stdout as lines:
            for line in lines:
                event = json.loads(line)
                if event["event"] == "ready":
                    self.grpc, self.http = event["grpc"], event["http"]
                    return
                progress(event["event"], event["done"], event["total"], event["name"])
        raise ServiceFailed(f"the service ended with status {self._process.wait()}: {self._last_log_line()}")

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Ends the service with its workers and returns the exit status."""
        if self._process.poll() is None:
            self._process.send_signal(number)
        return self.wait()

    def wait(self) -> int:
        """Waits for the end and returns the exit status; kills the process group after 20 seconds."""
        try:
            return self._process.wait(_STOP_PATIENCE)
        except subprocess.TimeoutExpired:
            os.killpg(self._process.pid, signal.SIGKILL)
            return self._process.wait()
        finally:
            if self._process.stdin:
                self._process.stdin.close()
            if self._folder:
                self._folder.cleanup()

    def _last_log_line(self) -> str:
        lines = self._log.read_text(errors="replace").strip().splitlines()
        return lines[-1] if lines else "its log is empty"
