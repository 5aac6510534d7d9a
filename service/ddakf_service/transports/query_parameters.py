"""Query parameters of REST and WebSocket: an unknown one, or a second value of a single one, is refused by its name."""

from __future__ import annotations

from collections.abc import Collection

from ddakf_api.errors import InvalidArgument
from starlette.datastructures import QueryParams

from ddakf.errors import nearest

from .truncation import printable


def require_known(given: QueryParams, known: Collection[str], repeatable: Collection[str] = ()) -> None:
    """Refuses unknown parameters, and several values of one that is not repeatable.

    Raises:
        InvalidArgument: names the parameter, and the nearest known one.
    """
    for name in given:
        if name not in known:
            expected = f"one of {', '.join(known)}" if known else "no parameters"
            shown = printable(name)
            raise InvalidArgument(field=shown, expected=expected, got=f"an unknown parameter{nearest(shown, known)}")
        if name not in repeatable and (count := len(given.getlist(name))) > 1:
            raise InvalidArgument(field=name, expected="one value", got=str(count))
