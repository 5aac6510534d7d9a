"""Frame reader: the fields of a large serialised frame without a parse, which would copy its points or images.

The reader accepts a subset of the wire format: fields of the schema with their wire types, each at most once, at most 64 sensors.
It returns None for every other message, which then has to be parsed. Its tables of fields come from the descriptors.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from ddakf_api.codec.sensors import MAX_SENSORS
from ddakf_api.v1 import tracking_pb2 as pb
from google.protobuf.descriptor import Descriptor, FieldDescriptor

from .frame_message import LARGE_FIELDS, FrameMessage

_DOUBLE = struct.Struct("<d")
_LONGEST_VARINT = 63  # bits before the last byte of a 64-bit number
_FRAME_TAG = 0x12  # of a TrackRequest

_VARINT, _FIXED64, _FIXED32, _BYTES, _DOUBLES, _MESSAGE, _MESSAGES = range(7)
_BITS = {FieldDescriptor.TYPE_UINT64: 64, FieldDescriptor.TYPE_UINT32: 32, FieldDescriptor.TYPE_ENUM: 31}


class _Field(NamedTuple):
    """A field of the schema.

    Attributes:
        bits: of a number of variable length.
        fields: of a message, by tag.
        others: names of the other members of its oneof.
    """

    name: str
    kind: int
    bits: int
    fields: dict[int, _Field]
    others: frozenset[str]


class _UnsupportedError(Exception):
    """The message is damaged, or outside the subset."""


def read_frame(data: bytes) -> FrameMessage | None:
    """The frame of a serialised TrackRequest, or None if the request has to be parsed."""
    try:
        if (frame := frame_bytes(data)) is None:
            return None
        values = _read(data, len(data) - len(frame), len(data), _FRAME)
    except (_UnsupportedError, IndexError, struct.error):
        return None
    message = FrameMessage(
        frame,
        sequence_number=values.get("sequence_number", 0),
        capture_time=values.get("capture_time", 0.0),
        deadline=values.get("deadline", 0.0),
        sensor_count=values.get("sensors", 0),
    )
    for measurement, names in LARGE_FIELDS.items():
        if (fields := values.get(measurement)) is not None:
            return message._replace(
                measurement=measurement,
                codec=fields.get("codec", 0) or fields.get("compression", 0),
                point_count=fields.get("point_count", 0),
                width=fields.get("width", 0),
                height=fields.get("height", 0),
                sizes={name: fields.get(name, 0) for name in names},
            )
    return message


def frame_bytes(data: bytes) -> memoryview | None:
    """The serialised frame of a TrackRequest that consists of nothing else; None for any other request."""
    if data[0] != _FRAME_TAG:
        return None
    size, start = _varint(data, 1)
    return memoryview(data)[start:] if start + size == len(data) else None


def _read(data: bytes, at: int, end: int, fields: dict[int, _Field]) -> dict:
    """Values by name between two positions: numbers, the length of bytes, the fields of a message, the count of repeated ones."""
    values = {}
    while at < end:
        tag, at = _varint(data, at)
        if (field := fields.get(tag)) is None:
            raise _UnsupportedError
        name, kind, bits, inner, others = field
        if (name in values and kind != _MESSAGES) or not others.isdisjoint(values):
            raise _UnsupportedError
        if kind == _VARINT:
            values[name], at = _varint(data, at)
            if values[name] >> bits:
                raise _UnsupportedError
        elif kind == _FIXED64:
            values[name] = _DOUBLE.unpack_from(data, at)[0]
            at += 8
        elif kind == _FIXED32:
            values[name] = None
            at += 4
        else:
            size, at = _varint(data, at)
            begin, at = at, at + size
            if at > end:
                raise _UnsupportedError
            if kind == _BYTES:
                values[name] = size
            elif kind == _MESSAGE:
                values[name] = _read(data, begin, at, inner)
            elif kind == _MESSAGES:
                values[name] = count = values.get(name, 0) + 1
                if count > MAX_SENSORS:
                    raise _UnsupportedError
                _read(data, begin, at, inner)
            elif size % 8:
                raise _UnsupportedError
            else:
                values[name] = None
    if at != end:
        raise _UnsupportedError
    return values


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of variable length, and the position behind it."""
    if (byte := data[at]) < 0x80:
        return byte, at + 1
    value, shift = byte & 0x7F, 7
    while (byte := data[at := at + 1]) & 0x80:
        value |= (byte & 0x7F) << shift
        shift += 7
        if shift > _LONGEST_VARINT:
            raise _UnsupportedError
    return value | byte << shift, at + 1


def _fields(descriptor: Descriptor) -> dict[int, _Field]:
    """The fields of a message by tag; the table of an unknown kind of field lacks it."""
    table = {}
    for field in descriptor.fields:
        repeated = field.is_repeated
        if field.type == FieldDescriptor.TYPE_MESSAGE:
            kind, wire_type = _MESSAGES if repeated else _MESSAGE, 2
        elif field.type == FieldDescriptor.TYPE_DOUBLE:
            kind, wire_type = (_DOUBLES, 2) if repeated else (_FIXED64, 1)
        elif field.type == FieldDescriptor.TYPE_BYTES and not repeated:
            kind, wire_type = _BYTES, 2
        elif field.type == FieldDescriptor.TYPE_FIXED32 and not repeated:
            kind, wire_type = _FIXED32, 5
        elif field.type in _BITS and not repeated:
            kind, wire_type = _VARINT, 0
        else:
            continue
        members = field.containing_oneof.fields if field.containing_oneof else ()
        others = frozenset(member.name for member in members if member.name != field.name)
        inner = _fields(field.message_type) if field.message_type else {}
        table[field.number << 3 | wire_type] = _Field(field.name, kind, _BITS.get(field.type, 0), inner, others)
    return table


_FRAME = _fields(pb.Frame.DESCRIPTOR)
