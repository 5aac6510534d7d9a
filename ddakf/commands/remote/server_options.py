"""Options of the commands that connect to a server: address, key, files of TLS."""

from __future__ import annotations

import argparse
import os

from ddakf.errors import InvalidArgument
from ddakf.evaluation.tracking.server import SYSTEM, Server

KEY_VARIABLE = "DDAKF_API_KEY"

_OPTIONS = {
    "--server": ("HOST:PORT", "gRPC address, or several of servers that share their sessions, with commas between them"),
    "--api-key": ("KEY", f"API key (default: the environment variable {KEY_VARIABLE})"),
    "--tls-ca": ("FILE", f"PEM file with the authorities of the server's certificate; {SYSTEM}: those that gRPC brings"),
    "--tls-certificate": ("FILE", "PEM file with a certificate of the client, where the server asks for one"),
    "--tls-key": ("FILE", "PEM file with the private key of that certificate"),
}


def add(parser: argparse._ActionsContainer, *, server: str | None, meaning: str = "", default: str | None = None) -> None:
    """Adds the options to a parser or a group of it.

    Args:
        server: default address.
        meaning: of ``--server``, where it is more than an address.
        default: of the other options; ``argparse.SUPPRESS`` where another parser has the defaults.
    """
    for option, (metavar, text) in _OPTIONS.items():
        first = option == "--server"
        parser.add_argument(
            option, default=server if first else default, metavar=metavar, help=meaning if first and meaning else text
        )


def server_of(arguments: argparse.Namespace) -> Server:
    """The server that the options describe. Raises InvalidArgument for an address without a port."""
    for address in arguments.server.split(","):
        host, _, port = address.strip().rpartition(":")
        if not (host and port.isascii() and port.isdecimal() and 0 < int(port) < 1 << 16) or "/" in host:
            raise InvalidArgument("server", "HOST:PORT of gRPC", arguments.server)
    key = arguments.api_key or os.environ.get(KEY_VARIABLE)
    return Server(arguments.server, key, arguments.tls_ca, arguments.tls_certificate, arguments.tls_key)


def given(arguments: argparse.Namespace) -> list[str]:
    """The options of a connection that were given, ``--server`` apart."""
    names = [option.removeprefix("--").replace("-", "_") for option in _OPTIONS if option != "--server"]
    return [name for name in names if getattr(arguments, name) is not None]
