"""Validation errors of queries and addresses, from pydantic, as field, expected and got."""

from __future__ import annotations

import itertools
import json

from ddakf_api.errors import InvalidArgument
from fastapi.exceptions import RequestValidationError
from pydantic import ValidationError

from ..truncation import printable

_MAX_SHOWN = 80  # characters of a value in a message
# Expected values by type of pydantic's error; formatted with its context.
_EXPECTED = {
    "extra_forbidden": "no field of this name",
    "missing": "a value",
    "float_type": "a number",
    "float_parsing": "a number",
    "finite_number": "a finite number",
    "int_type": "an integer",
    "int_parsing": "an integer",
    "int_parsing_size": "an integer of fewer digits",
    "int_from_float": "an integer",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
    "string_type": "a string",
    "list_type": "a list",
    "tuple_type": "a list",
    "dict_type": "an object",
    "model_type": "an object",
    "model_attributes_type": "an object",
    "string_too_long": "at most {max_length} characters",
    "too_long": "at most {max_length} items",
    "literal_error": "{expected}",
    "greater_than_equal": "at least {ge:g}",
    "less_than_equal": "at most {le:.15g}",
}


def invalid_argument(error: RequestValidationError | ValidationError) -> InvalidArgument:
    """The first error, in the form of the service's other errors."""
    first = error.errors()[0]
    kind, value, context = first["type"], first.get("input"), first.get("ctx", {})
    location = [part for part in first["loc"] if part not in ("query", "path", "body")]
    field = ".".join(itertools.takewhile(_is_field, map(str, location))) or "body"
    if kind == "extra_forbidden":  # the name comes from the client and may have any letters
        field = printable(".".join(map(str, location)))
    expected = _EXPECTED[kind].format(**context) if kind in _EXPECTED else first["msg"].removeprefix("Input should be ")
    got = {"missing": "nothing", "string_too_long": "more"}.get(kind) or _shown(value)
    return InvalidArgument(field=field, expected=expected, got=got)


def _is_field(part: str) -> bool:
    """Whether an element of pydantic's location is a field or an index, rather than a type of a union."""
    return (part.islower() and "[" not in part) or part.isdigit()


def _shown(value) -> str:
    try:
        text = json.dumps(value, ensure_ascii=False)
    except (TypeError, ValueError):
        text = repr(value)
    return printable(text if len(text) <= _MAX_SHOWN else text[: _MAX_SHOWN - 3] + "...")
