"""JSON schemas of the contract's messages; descriptions are the comments of the schema file."""

from __future__ import annotations

import functools
import re
from importlib import resources
from typing import Any

from google.protobuf.descriptor import Descriptor, EnumDescriptor, FieldDescriptor
from google.protobuf.message import Message

REFERENCE = "#/components/schemas/{name}"
_SPECIAL = {
    "google.protobuf.Timestamp": {"type": "string", "format": "date-time"},
    "google.protobuf.FieldMask": {"type": "string"},
}
_NOT_NUMBERS = ["NaN", "Infinity", "-Infinity"]
_REAL = {"anyOf": [{"type": "number"}, {"type": "string", "enum": _NOT_NUMBERS}]}
_SMALL, _LARGE = {"type": "integer"}, {"type": "string", "pattern": "^-?[0-9]+$"}
_BASE64 = {"type": "string", "contentEncoding": "base64", "pattern": "^[A-Za-z0-9+/]*={0,2}$"}
_BY_TYPE = {
    FieldDescriptor.CPPTYPE_UINT32: {**_SMALL, "minimum": 0},
    FieldDescriptor.CPPTYPE_UINT64: {**_LARGE, "format": "uint64"},
    FieldDescriptor.CPPTYPE_INT32: _SMALL,
    FieldDescriptor.CPPTYPE_INT64: {**_LARGE, "format": "int64"},
    FieldDescriptor.CPPTYPE_DOUBLE: _REAL,
    FieldDescriptor.CPPTYPE_FLOAT: _REAL,
    FieldDescriptor.CPPTYPE_BOOL: {"type": "boolean"},
}
_BEGINNING = re.compile(r"(?:message|enum) (\w+) \{")
_MEMBER = re.compile(r"\s+(?:(?:repeated|optional) )?(?:[\w.<>, ]+ )?(\w+) = \d+;")


def reference(kind: type[Message]) -> dict[str, str]:
    """A reference to the schema of a message."""
    return {"$ref": REFERENCE.format(name=kind.DESCRIPTOR.name)}


def schemas(*kinds: type[Message]) -> dict[str, dict[str, Any]]:
    """The schemas of messages, and of all messages and enumerations in them, by name."""
    found: dict[str, dict[str, Any]] = {}
    for kind in kinds:
        _add(kind.DESCRIPTOR, found)
    return found


@functools.cache
def comments() -> dict[str, str]:
    """Comments of messages, enumerations and their members in the schema file, by names such as ``Session.labels``."""
    found, lines, holder = {}, [], ""
    for line in resources.files("ddakf_api.v1").joinpath("tracking.proto").read_text().splitlines():
        if (text := line.strip()).startswith("//"):
            lines.append(text.removeprefix("//").strip())
            continue
        if beginning := _BEGINNING.match(line):
            holder = beginning[1]
            found[holder] = " ".join(lines)
        elif member := _MEMBER.match(line):
            found[f"{holder}.{member[1]}"] = " ".join(lines)
        lines = []
    return found


def _add(descriptor: Descriptor | EnumDescriptor, found: dict[str, dict[str, Any]]) -> None:
    if descriptor.name in found:
        return
    description = {"description": text} if (text := comments().get(descriptor.name)) else {}
    if isinstance(descriptor, EnumDescriptor):
        found[descriptor.name] = {"type": "string", "enum": [value.name for value in descriptor.values], **description}
        return
    found[descriptor.name] = schema = {"type": "object", "properties": {}, **description}
    for field in descriptor.fields:
        text = comments().get(f"{descriptor.name}.{field.name}")
        schema["properties"][field.name] = {**_of_field(field, found), **({"description": text} if text else {})}


def _of_field(field: FieldDescriptor, found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    kind = field.message_type
    if kind is not None and kind.GetOptions().map_entry:
        return {"type": "object", "additionalProperties": _of_value(kind.fields_by_name["value"], found)}
    value = _of_value(field, found)
    return {"type": "array", "items": value} if field.is_repeated else value


def _of_value(field: FieldDescriptor, found: dict[str, dict[str, Any]]) -> dict[str, Any]:
    if (kind := field.message_type or field.enum_type) is None:
        return _BY_TYPE.get(field.cpp_type) or (_BASE64 if field.type == FieldDescriptor.TYPE_BYTES else {"type": "string"})
    if kind.full_name in _SPECIAL:
        return _SPECIAL[kind.full_name]
    _add(kind, found)
    return {"$ref": REFERENCE.format(name=kind.name)}
