"""Writing of JSON: answers of REST and WebSocket by the protobuf JSON mapping, with the names of the contract."""

from __future__ import annotations

from google.protobuf import json_format
from google.protobuf.message import Message


def as_json(message: Message) -> str:
    """The message as one line. Numbers, texts, lists and enumerations are always there; other messages only if present."""
    return json_format.MessageToJson(
        message, preserving_proto_field_name=True, always_print_fields_with_no_presence=True, indent=None
    )
