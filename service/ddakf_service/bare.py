"""Errors without what they were raised through."""

from __future__ import annotations

from typing import TypeVar

E = TypeVar("E", bound=BaseException)


def bare(error: E) -> E:
    """The same error without its frames and those that led to it.

    Frames hold requests and sessions, megabytes, and whoever keeps an error that came through them makes a cycle, which stays
    until the collector of cycles finds it: after hundreds of such requests."""
    error.__cause__ = error.__context__ = None
    return error.with_traceback(None)
