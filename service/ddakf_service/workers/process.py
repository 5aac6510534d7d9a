"""Main program of a worker process: answers requests on its end of a pipe until the pipe closes.

Run as ``python -m ddakf_service.workers.process DESCRIPTOR LIMITS``, LIMITS being the JSON of :class:`Limits`.
"""

from __future__ import annotations

import ctypes
import json
import logging
import os
import signal
import socket
import sys

from ddakf_api.errors import to_detail

from ..observability.logs import configure_logging, current_session
from .pool import Limits
from .tracker_host import TrackerHost
from .wire import BlockingChannel, Kind, Message

log = logging.getLogger(__name__)

_PR_SET_PDEATHSIG = 1


def main(descriptor: int, limits: Limits) -> None:
    """Warms up, reports READY, and answers requests one at a time."""
    # Ctrl-C or a stop reaches the whole process group, but the server ends its workers by closing their pipes.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    _die_with_parent()
    channel = BlockingChannel(socket.socket(fileno=descriptor))
    host = TrackerHost(limits)
    host.warm(lambda *step: channel.send(Message(Kind.PROGRESS, content=json.dumps(step).encode())))
    channel.send(Message(Kind.READY))
    while (request := channel.receive()) is not None:
        channel.send(_answer(host, request))


def _answer(host: TrackerHost, request: Message) -> Message:
    current_session.set(request.session_id)
    try:
        content = host.handle(request)
        return Message(Kind.RESULT, request.number, content=content)
    except Exception as error:
        detail = to_detail(error)
        if detail.name == "Internal":
            log.exception("a request failed")
        return Message(Kind.ERROR, request.number, content=detail.SerializeToString())


def _die_with_parent() -> None:
    """Asks Linux to kill this process when the server dies, even during a compilation."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    configure_logging(os.environ.get("DDAKF_LOG_LEVEL", "info"), os.environ.get("DDAKF_LOG_FORMAT", "text"))
    try:
        main(int(sys.argv[1]), Limits.from_json(sys.argv[2]))
    except (BrokenPipeError, ConnectionResetError):
        sys.exit(0)  # the server is gone
