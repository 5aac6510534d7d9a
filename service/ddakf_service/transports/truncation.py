"""Sentences cut to what a header or a control frame can hold."""

from __future__ import annotations

_DOTS = "..."


def truncated(text: str, most: int) -> str:
    """The text in at most ``most`` bytes of UTF-8, with dots where something is missing."""
    data = text.encode()
    if len(data) <= most:
        return text
    return data[: most - len(_DOTS)].decode(errors="ignore") + _DOTS
