"""Reading of JSON: requests of REST and WebSocket as messages of the contract.

The text is the protobuf JSON mapping; field names may be those of the contract or in camel case. An array of triples may also
be a list of rows, and :mod:`.earlier` has what requests of an earlier version may contain. An unknown field is refused by name.
"""

from __future__ import annotations

import base64
import functools
import json
from typing import Any, TypeVar

import numpy as np
from ddakf_api.errors import InvalidArgument
from ddakf_api.v1 import tracking_pb2 as pb
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import Message

from ddakf.errors import nearest

from ..truncation import printable
from . import earlier

M = TypeVar("M", bound=Message)

_MAX_SHOWN = 80  # characters of a value in a message
_ROWS_AT_ONCE = 1 << 13  # rows between which other threads have their turn
_SIGNED_32, _SIGNED_64 = (-(2**31), 2**31 - 1), (-(2**63), 2**63 - 1)
_RANGES = {
    FieldDescriptor.CPPTYPE_UINT32: (0, 2**32 - 1),
    FieldDescriptor.CPPTYPE_UINT64: (0, 2**64 - 1),
    FieldDescriptor.CPPTYPE_INT32: _SIGNED_32,
    FieldDescriptor.CPPTYPE_INT64: _SIGNED_64,
}
_REALS = (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT)


def read(text: str | bytes, kind: type[M], field: str = "body") -> M:
    """Reads a message; an empty text is an empty message.

    Args:
        field: name of the whole text in errors.

    Raises:
        InvalidArgument: no JSON, an unknown field or an invalid value; names the field.
    """
    return message_from(parsed(text, kind, field), kind, field)


def parsed(text: str | bytes, kind: type[Message], field: str = "body") -> Any:
    """The values of a JSON text, before they are read as a message. Raises as :func:`read`."""
    expected = f"a {kind.DESCRIPTOR.name} as JSON"
    try:
        return json.loads(text, parse_float=_parse_float, parse_int=_parse_int) if text else {}
    except (ValueError, RecursionError) as error:  # no JSON, no UTF-8, too deep, an integer of thousands of digits
        raise InvalidArgument(field=field, expected=expected, got=f"invalid text: {error}") from None


def _parse_float(text: str) -> float:
    """As ``float``, which the parser would call without a chance for other threads; it may have a million numbers to read."""
    return float(text)


def _parse_int(text: str) -> int:
    return int(text)


def message_from(values: Any, kind: type[M], field: str = "body") -> M:
    """Reads a message from parsed JSON. Raises as :func:`read`."""
    message = kind()
    try:
        _fill(message, earlier.nested(values, kind.DESCRIPTOR), "", field)
    except RecursionError:  # of a configuration that becomes text
        raise InvalidArgument(field=field, expected="fewer levels", got="objects within objects") from None
    return message


def shown(value: Any) -> str:
    """A value in an error message; of a large one only the beginning is written."""
    text = ""
    for part in json.JSONEncoder(ensure_ascii=False).iterencode(value):
        text += part[:_MAX_SHOWN]
        if len(text) > _MAX_SHOWN:
            return printable(text[: _MAX_SHOWN - 3] + "...")
    return printable(text)


@functools.cache
def fields_of(descriptor: Descriptor) -> dict[str, FieldDescriptor]:
    """Fields by their names in the contract and in camel case."""
    return {name: field for field in descriptor.fields for name in (field.json_name, field.name)}


def _fill(message: Message, values: Any, path: str, whole: str) -> None:
    """Sets the fields of a message.

    Args:
        path: of the message, with a dot at its end.
        whole: name of the message in errors about itself.
    """
    if not isinstance(values, dict):
        raise _invalid(whole, "an object", values)
    fields = fields_of(message.DESCRIPTOR)
    for name, value in earlier.renamed(values, message.DESCRIPTOR).items():
        if (field := fields.get(name)) is None:
            meant = nearest(name, message.DESCRIPTOR.fields_by_name)
            raise InvalidArgument(field=printable(path + name), expected="no field of this name", got=shown(value) + meant)
        if value is None:
            continue
        if (group := field.containing_oneof) is not None and (other := message.WhichOneof(group.name)):
            raise InvalidArgument(field=path + name, expected=f"nothing beside {other}", got=shown(value))
        _set(message, field, value, path + name)


def _set(message: Message, field: FieldDescriptor, value: Any, path: str) -> None:
    if field.message_type is not None and field.message_type.GetOptions().map_entry:
        if not isinstance(value, dict):
            raise _invalid(path, "an object", value)
        entries, kind = getattr(message, field.name), field.message_type.fields_by_name["value"]
        for key, item in value.items():
            entries[_text(key, path)] = _scalar(kind, item, printable(f"{path}.{key}"))
    elif field.is_repeated:
        if not isinstance(value, list):
            raise _invalid(path, "a list", value)
        for item in value:
            _append(getattr(message, field.name), field, item, path)
    elif field.message_type is not None:
        getattr(message, field.name).SetInParent()
        _read_message(getattr(message, field.name), field, value, path)
    else:
        setattr(message, field.name, _scalar(field, value, path))


def _append(items, field: FieldDescriptor, value: Any, path: str) -> None:
    if field.message_type is not None:
        _read_message(items.add(), field, value, path)
    else:
        items.append(_scalar(field, value, path))


def _read_message(message: Message, field: FieldDescriptor, value: Any, path: str) -> None:
    name = message.DESCRIPTOR.full_name
    if isinstance(message, pb.PackedArray) and isinstance(value, list):
        message.CopyFrom(_packed_rows(value, field.name, path))
    elif isinstance(message, pb.PackedArray) and not isinstance(value, dict):
        raise _invalid(path, "a list of triples, or an object of encoding and data", value)
    elif name == "google.protobuf.Timestamp":
        try:
            message.FromJsonString(_text(value, path))
        except ValueError:
            raise _invalid(path, "a time as in 2026-01-31T12:00:00Z", value) from None
    elif name == "google.protobuf.FieldMask":
        message.paths.extend(earlier.mask_paths(_text(value, path)))
    else:
        # as in all errors of a session's fields: a request has one session
        _fill(message, value, "" if isinstance(message, pb.Session) else f"{path}.", path)


def _packed_rows(rows: list, name: str, path: str) -> pb.PackedArray:
    """A list of rows of three numbers as packed bytes: indices as uint32, all else as float64. The first invalid row is
    refused."""
    numbers, expected = ((int,), "an integer") if name == "faces" else ((int, float), "a number")
    for row in rows:
        if not isinstance(row, list) or len(row) != 3:
            raise _invalid(path, "three numbers in each row", row)
        for number in row:
            if type(number) not in numbers:  # a boolean is an int
                raise _invalid(path, expected, number)
    dtype, encoding = ("<u4", "UINT32") if name == "faces" else ("<f8", "FLOAT64")
    try:
        data = b"".join(np.array(rows[at : at + _ROWS_AT_ONCE], dtype).tobytes() for at in range(0, len(rows), _ROWS_AT_ONCE))
    except OverflowError:
        raise InvalidArgument(field=path, expected=f"numbers within {encoding.lower()}", got="one outside") from None
    return pb.PackedArray(encoding=f"ARRAY_ENCODING_{encoding}", data=data)


def _scalar(field: FieldDescriptor, value: Any, path: str):
    """The value of a field that is no message."""
    if field.cpp_type == FieldDescriptor.CPPTYPE_ENUM:
        return _enumerated(field, value, path)
    if field.cpp_type == FieldDescriptor.CPPTYPE_BOOL:
        if not isinstance(value, bool):
            raise _invalid(path, "true or false", value)
        return value
    if field.cpp_type in _RANGES:
        return _integer(value, *_RANGES[field.cpp_type], path)
    if field.cpp_type in _REALS:
        return _real(value, path)
    return _bytes(value, path) if field.type == FieldDescriptor.TYPE_BYTES else _text(value, path)


def _enumerated(field: FieldDescriptor, value: Any, path: str) -> int:
    if isinstance(value, int) and not isinstance(value, bool):
        return _integer(value, *_SIGNED_32, path)
    number = earlier.enum_number(field.enum_type, value) if isinstance(value, str) else None
    if number is None:
        raise _invalid(path, " or ".join(value.name for value in field.enum_type.values[1:]), value)
    return number


def _integer(value: Any, low: int, high: int, path: str) -> int:
    try:
        number = int(value) if isinstance(value, str) else value
        if isinstance(number, bool) or number != int(number):
            raise ValueError
    except (TypeError, ValueError, OverflowError):
        raise _invalid(path, "an integer", value) from None
    if not low <= number <= high:
        raise _invalid(path, f"at least {low}" if number < low else f"at most {high}", value)
    return int(number)


def _real(value: Any, path: str) -> float:
    try:
        if isinstance(value, bool):
            raise ValueError
        return float(value)
    except (TypeError, ValueError, OverflowError):
        raise _invalid(path, "a number", value) from None


def _text(value: Any, path: str) -> str:
    if not isinstance(value, str):
        raise _invalid(path, "a string", value)
    try:
        value.encode()
    except UnicodeEncodeError:
        raise _invalid(printable(path), "text that UTF-8 can encode", value) from None
    return value


def _bytes(value: Any, path: str) -> bytes:
    """Base64, standard or for URLs, with or without padding."""
    text = _text(value, path).rstrip("=").replace("-", "+").replace("_", "/")
    try:
        return base64.b64decode(text + "=" * (-len(text) % 4), validate=True)
    except ValueError as error:
        raise InvalidArgument(field=path, expected="base64", got=str(error)) from None


def _invalid(path: str, expected: str, value: Any) -> InvalidArgument:
    return InvalidArgument(field=path, expected=expected, got=shown(value))
