"""Listening sockets, and the setting to blame where there can be none."""

from __future__ import annotations

import errno
import os
import socket

from ddakf.errors import InvalidConfig

_BACKLOG = 512  # connections that wait to be accepted


def listen(host: str, port: int, setting: str) -> socket.socket:
    """A listening socket.

    Args:
        setting: name of the port's setting.

    Raises:
        InvalidConfig: names ``host`` if it is no address of this machine, otherwise the port's setting.
    """
    try:
        family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
        return socket.create_server((host, port), family=family, backlog=_BACKLOG)
    except UnicodeError:  # of the codec of host names
        raise _no_address(host, "not a name") from None
    except socket.gaierror as error:
        raise _no_address(host, error.strerror) from None
    except OSError as error:
        reason = os.strerror(error.errno) if error.errno else str(error)
        if error.errno == errno.EADDRNOTAVAIL:
            raise _no_address(host, reason) from None
        raise InvalidConfig(setting, f"a free port on {host}", f"{port}: {reason}") from None


def _no_address(host: str, reason: str | None) -> InvalidConfig:
    return InvalidConfig("host", "an address of this machine", f"{host}: {reason}")
