"""Earlier JSON: forms of requests that this version of the service accepts beside the protobuf JSON mapping.

Answers never have them. ``docs/protocol.md`` lists each with its present form.
"""

from __future__ import annotations

import json
import re
from typing import Any

from ddakf_api.v1 import tracking_pb2 as pb
from google.protobuf.descriptor import Descriptor, EnumDescriptor

_CONFIG = "config"  # now the text config_json


def nested(values: Any, request: Descriptor) -> Any:
    """The values of a request whose session's fields may stand beside those of the request."""
    holder = request.fields_by_name.get("session")
    if not isinstance(values, dict) or holder is None or "session" in values:
        return values
    own = {name for field in request.fields for name in (field.name, field.json_name)}
    inner = {name: value for name, value in values.items() if name not in own and _is_field(name, holder.message_type)}
    return {**{name: value for name, value in values.items() if name not in inner}, "session": inner} if inner else values


def renamed(values: dict[str, Any], descriptor: Descriptor) -> dict[str, Any]:
    """The values of a session whose configuration may be an object instead of text."""
    if descriptor is not pb.Session.DESCRIPTOR or not isinstance(values.get(_CONFIG), dict):
        return values
    return {"config_json" if name == _CONFIG else name: _text(name, value) for name, value in values.items()}


def enum_number(enum: EnumDescriptor, name: str) -> int | None:
    """The number of a value, by its full name or in lower case without the enumeration's name; None: no such value."""
    prefix = enum.values[0].name.removesuffix("UNSPECIFIED")
    names = (name, prefix + name.upper())  # compared here: values_by_name fails at a surrogate and reads up to a NUL
    return next((value.number for value in enum.values if value.name in names), None)


def mask_paths(text: str) -> list[str]:
    """The paths of a field mask, in camel case as the mapping has them, or with the names of the contract."""
    names = (re.sub("[A-Z]", lambda letter: "_" + letter[0].lower(), path.strip()) for path in text.split(",") if text)
    return ["config_json" if name == _CONFIG else name for name in names]


def _is_field(name: str, session: Descriptor) -> bool:
    return name == _CONFIG or any(name in (field.name, field.json_name) for field in session.fields)


def _text(name: str, value: Any) -> Any:
    return json.dumps(value) if name == _CONFIG else value
