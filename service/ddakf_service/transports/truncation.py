"""Truncation of messages to the size of a header or a control frame."""

from __future__ import annotations

_DOTS = "..."


def truncated(text: str, max_bytes: int) -> str:
    """The text in at most ``max_bytes`` bytes of UTF-8; dots mark a truncation."""
    data = text.encode()
    if len(data) <= max_bytes:
        return text
    return data[: max_bytes - len(_DOTS)].decode(errors="ignore") + _DOTS
