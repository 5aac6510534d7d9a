"""Errors. Each message is one sentence: the field, what was expected, what came."""

import difflib
from collections.abc import Iterable
from numbers import Real

_MOST_NEAREST, _SIMILAR = 2, 0.6  # names in a hint, and their least similarity to the given one
SERVICE_PACKAGES = "in the repository: pip install -e protos -e 'clients/python[recording]' -e '.[service]'"
_LONGEST = 80  # characters of it that are compared, and of a name or value that an error shows


def nearest(name: str, known: Iterable[str]) -> str:
    """The known names that a mistyped one resembles, to be added to a message; empty: none does."""
    found = difflib.get_close_matches(str(name)[:_LONGEST], map(str, known), _MOST_NEAREST, _SIMILAR)
    return f"; did you mean {' or '.join(found)}?" if found else ""


def shown(value: object) -> str:
    """A value as a short text of one line."""
    text = repr(value)
    return text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."


def shown_name(name: object) -> str:
    """A name as a short text of one line, without quotes."""
    return shown(str(name)[:_LONGEST]).strip("'\"")


def is_number(value: object) -> bool:
    """Whether a value is a real number, of Python or NumPy, and no bool."""
    return isinstance(value, Real) and not isinstance(value, bool)


class DdakfError(Exception):
    """Base of every error that ddakf raises on purpose."""


class InvalidArgument(DdakfError, ValueError):
    """An input that cannot be used; nothing has been changed.

    Attributes:
        field: name of the argument or of the part of it, e.g. ``points`` or ``garment.faces``.
        expected: what would have been accepted.
        got: what came.
    """

    def __init__(self, field: str, expected: str, got: str):
        self.field, self.expected, self.got = field, expected, got
        super().__init__(f"{field}: expected {expected}, got {got}")

    def __reduce__(self):
        return type(self), (self.field, self.expected, self.got)


class InvalidMesh(InvalidArgument):
    """A mesh that cannot serve as a garment or body."""


class InvalidFrame(InvalidArgument):
    """A frame that cannot be tracked: points, time, origin or body."""


class FrameTooCostly(DdakfError):
    """A frame that exceeded its limit of processor time; nothing has been changed."""


class InvalidConfig(InvalidArgument):
    """A configuration value outside its range, or an unknown field."""


class InvalidFile(InvalidArgument):
    """A file that is not what its name or its use says."""


class InvalidSnapshot(InvalidArgument):
    """Bytes that are no snapshot of a tracker, or of an unknown version."""


class MissingDependency(DdakfError, ImportError):
    """An optional package, or a system library that it needs, is absent; the message says what to install."""


class NotApplicable(DdakfError):
    """A method that cannot be used here, in one sentence: no body, or an optional package that is absent."""


class PoorQuality(DdakfError):
    """A simulated recording that is not fit for use; the message names the figure, its limit and its value."""
