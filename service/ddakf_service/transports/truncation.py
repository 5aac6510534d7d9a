"""Truncation of messages to the size of a header or a control frame."""

from __future__ import annotations

_DOTS = "..."


def truncated(text: str, most: int) -> str:
    """The text in at most ``most`` bytes of UTF-8; dots mark a truncation."""
    data = text.encode()
    if len(data) <= most:
        return text
    return data[: most - len(_DOTS)].decode(errors="ignore") + _DOTS
