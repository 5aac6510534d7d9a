"""Main program of the fork server, and of the workers that are forked from it.

Run as ``python -m ddakf_service.workers.compute.process SERVER DESCRIPTOR fork|single``; SERVER is the server's process id.
The process writes a line for each step of its warm-up to the socket of the descriptor, reads a line of settings from it, writes
"ready", and receives a pipe for each worker. A worker answers requests on its pipe until that closes.
"""

from __future__ import annotations

import ctypes
import gc
import json
import logging
import os
import signal
import socket
import sys

from ddakf_api.errors import to_detail

from ddakf.commands import warmup

from ...observability.logs import configure_logging, current_session
from ..messages import wire
from ..messages.wire import BlockingChannel, Kind, Message
from ..pool import Limits
from .lanes import Lanes
from .tracker_host import TrackerHost

log = logging.getLogger(__name__)

_PR_SET_PDEATHSIG, _PR_SET_NAME = 1, 15
# Seconds until a thread that waits for the interpreter gets it. A tracked frame waits hundreds of times while another thread
# builds a model in Python.
_SWITCH_INTERVAL = 2e-4


def main(server: int, descriptor: int, forks: bool) -> None:
    """Loads everything, then forks a worker for each pipe, or becomes the worker of the first one."""
    # Ctrl-C or a stop reaches the whole process group, but the server ends its workers by closing their pipes.
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    _attach(server, "ddakf-forkserv")
    control = socket.socket(fileno=descriptor)
    warmup.warm(lambda *step: control.sendall(json.dumps(step).encode() + b"\n"))  # before the server has read its settings
    setup = json.loads(control.makefile("rb").readline() or "null")
    if setup is None:
        return  # the server is gone, or will not serve
    configure_logging(setup["log"].get("DDAKF_LOG_LEVEL", "info"), setup["log"].get("DDAKF_LOG_FORMAT", "text"))
    host = TrackerHost(Limits.from_json(setup["limits"]))
    host.warm()
    gc.collect()
    gc.freeze()  # the collector of a worker would copy all shared pages
    control.sendall(b'"ready"\n')
    while (pipe := _received_pipe(control)) is not None:
        if not forks or _is_fork(server):
            control.close()
            _attach(server, "ddakf-worker")
            work(BlockingChannel(pipe), host)
            return
        pipe.close()


def work(channel: BlockingChannel, host: TrackerHost) -> None:
    """Reports READY with the process id, and answers requests."""
    sys.setswitchinterval(_SWITCH_INTERVAL)
    channel.send(Message(Kind.READY, content=str(os.getpid()).encode()))
    lanes = Lanes(lambda request: _answer(host, request), channel.send)
    while (request := channel.receive()) is not None:
        lanes.put(request)
    lanes.stop()  # nobody waits for the answers


def _answer(host: TrackerHost, request: Message) -> Message:
    current_session.set(request.session_id)
    used_before = host.processor_seconds()
    try:
        content = host.handle(request)
        return Message(Kind.RESULT, request.number, content=content)
    except Exception as error:
        detail = to_detail(error)
        if detail.name == "Internal":
            log.exception("a request failed")
        used, is_frame = host.processor_seconds() - used_before, request.kind in (Kind.FRAME, Kind.HEAVY_FRAME)
        busy = host.busy.taken() if is_frame else 0.0  # which the next frame tells
        return Message(Kind.ERROR, request.number, content=wire.pack_error(detail.SerializeToString(), used, busy))


def _received_pipe(control: socket.socket) -> socket.socket | None:
    """The pipe of the next worker; None when the server has closed the socket."""
    _, descriptors, _, _ = socket.recv_fds(control, 1, 1)
    return socket.socket(fileno=descriptors[0]) if descriptors else None


def _is_fork(server: int) -> bool:
    """Forks a process that the server adopts. True in the new process, once it is the server's child.

    A process between this one and the new one ends at once: the kernel gives the orphan to the server, which asked for orphans.
    The death of this process therefore means nothing to a worker, and the death of the server is its end.
    """
    orphaned, not_orphaned = os.pipe()
    between = os.fork()
    if between == 0:
        if _forked_or_ended():
            os._exit(0)
        os.close(not_orphaned)
        os.read(orphaned, 1)  # returns when this process's parent was waited for
        os.close(orphaned)
        os.setpgid(0, 0)  # with the Draco decoder: one signal ends both
        signal.signal(signal.SIGTTOU, signal.SIG_IGN)  # its log may go to a terminal whose foreground group is the server's
        return True
    os.close(orphaned)
    os.waitpid(between, 0)
    os.close(not_orphaned)
    return False


def _forked_or_ended() -> int:
    """Result of a fork, which ends a process that cannot fork."""
    try:
        return os.fork()
    except OSError:
        log.exception("a worker cannot be forked")
        os._exit(1)


def _attach(server: int, name: str) -> None:
    """Asks Linux to kill this process when the server dies, even during a compilation, and names it for ``ps`` and ``top``."""
    if sys.platform != "linux":
        return
    system = ctypes.CDLL(None)
    system.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
    system.prctl(_PR_SET_NAME, name.encode())
    if os.getppid() != server:  # it has died before
        sys.exit(0)


if __name__ == "__main__":
    try:
        main(int(sys.argv[1]), int(sys.argv[2]), sys.argv[3] == "fork")
    except (BrokenPipeError, ConnectionResetError):
        sys.exit(0)  # the server is gone
