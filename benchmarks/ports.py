"""Ports for servers that are stopped and started again while clients try to reconnect."""

from __future__ import annotations

import random
import socket

_LOWEST, _BELOW = 15_000, 32_000  # below the ports that Linux gives to outgoing connections


def lasting_port() -> int:
    """A free port of loopback that no outgoing connection can take while its server is stopped.

    A client that connects again and again to a port of the ephemeral range is given that port itself one day, connects to
    itself, and keeps the server from it.
    """
    while True:
        port = random.randrange(_LOWEST, _BELOW)
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
