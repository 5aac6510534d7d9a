"""Version handshake: refuses a peer with another major API version."""

from __future__ import annotations

import re

from ddakf_api import API_VERSION
from ddakf_api.errors import VersionMismatch


def require_compatible(peer_version: str, *, peer: str) -> None:
    """Checks the API version of the peer.

    Args:
        peer_version: "major.minor".
        peer: "client" or "server".

    Raises:
        VersionMismatch: another major version, or no valid version.
    """
    match = re.fullmatch(r"(\d{1,4})\.(\d{1,4})", peer_version)
    if match and int(match[1]) == int(API_VERSION.split(".")[0]):
        return
    this = "server" if peer == "client" else "client"
    raise VersionMismatch(
        f"api_version: this {this} speaks ddakf API {API_VERSION}, the {peer} {_named(peer_version)}: "
        f"install a ddakf-client of the server's release",
        field="api_version",
        expected=f"{API_VERSION.split('.')[0]}.x",
        got=_named(peer_version),
    )


def _named(version: str) -> str:
    return repr(version[:20]) if version else "none"
