"""Truncation of messages to the size of a header or a control frame, and of a client's texts in them and in the log to a part of
one line.
"""

from __future__ import annotations

from collections.abc import Mapping

_DOTS = "..."
_MAX_SHOWN = 80  # characters of a client's text


def truncated(text: str, max_bytes: int) -> str:
    """The text in at most ``max_bytes`` bytes of UTF-8; dots mark a truncation."""
    data = text.encode()
    if len(data) <= max_bytes:
        return text
    return data[: max_bytes - len(_DOTS)].decode(errors="ignore") + _DOTS


def printable(text: str) -> str:
    """The beginning of a client's text, which may have any length and letters; line feeds and the like are escaped."""
    return "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text[:_MAX_SHOWN])[:_MAX_SHOWN]


def call_of(scope: Mapping) -> str:
    """Method and path of an HTTP call or a WebSocket, for a line of the log."""
    return f"{printable(scope.get('method', 'WebSocket'))} {printable(scope['path'])}"


def peer_of(scope: Mapping) -> str:
    """Address of the caller, or of its proxy."""
    host, port = scope.get("client") or ("-", 0)
    return f"{host}:{port}"
