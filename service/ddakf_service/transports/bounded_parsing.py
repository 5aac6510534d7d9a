"""Bounded parsing: a request's elements are counted in its serialised form before objects are made of them.

An element is a field, a sub-message or a number of a list. A sub-message of two bytes becomes an object of forty. A request
within ``max_message_bytes`` could therefore take a gigabyte and seconds of the event loop. An array travels as bytes, one
element: no real request has more than some thousand.
"""

from __future__ import annotations

import functools
from typing import TypeVar

from ddakf_api.errors import MessageTooLarge
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError, Message

MAX_ELEMENTS = 1 << 14  # 64 sensors with poses have 8,000
_UNCHECKED_BYTES = 1 << 16  # size up to which a request is harmless and not counted
_VARINT, _FIXED_64, _LENGTH_DELIMITED, _FIXED_32 = 0, 1, 2, 5  # wire types; groups have no content of their own
_MAX_VARINT_BITS = 70  # bits
_TEXTS = (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)
_JSON_SEPARATORS = ",:[{"  # each element of a JSON text has one of these; base64 has none

T = TypeVar("T", bound=Message)


def parse(kind: type[T], data: bytes) -> T:
    """Parses a message after its elements are counted.

    Raises:
        MessageTooLarge: more than :data:`MAX_ELEMENTS`. DecodeError: no message of this kind.
    """
    if len(data) > _UNCHECKED_BYTES:
        try:
            _count(data, 0, len(data), kind.DESCRIPTOR, MAX_ELEMENTS)
        except IndexError:
            raise DecodeError("truncated") from None
    return kind.FromString(data)


def require_bounded_json(text: str) -> None:
    """Rejects a JSON text with more than :data:`MAX_ELEMENTS`.

    Raises:
        MessageTooLarge
    """
    if len(text) > _UNCHECKED_BYTES and sum(map(text.count, _JSON_SEPARATORS)) > MAX_ELEMENTS:
        raise _too_many()


def _count(data: bytes, at: int, end: int, descriptor: Descriptor, remaining: int) -> int:
    """Remaining number of allowed elements after those between two positions of the data."""
    messages, numbers = _fields(descriptor)
    while at < end:
        remaining -= 1
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == _VARINT:
            _, at = _varint(data, at)
        elif kind == _FIXED_64:
            at += 8
        elif kind == _FIXED_32:
            at += 4
        elif kind == _LENGTH_DELIMITED:
            size, at = _varint(data, at)
            if (inner := messages.get(tag >> 3)) is not None:
                remaining = _count(data, at, min(at + size, end), inner, remaining)
            elif tag >> 3 in numbers:
                remaining -= size  # packed numbers, at least one byte each
            at += size
        if remaining < 0:
            raise _too_many()
    return remaining


@functools.cache
def _fields(descriptor: Descriptor) -> tuple[dict[int, Descriptor], frozenset[int]]:
    """Message types by field number, and the field numbers of lists of numbers."""
    messages = {f.number: f.message_type for f in descriptor.fields if f.message_type is not None}
    numbers = (f.number for f in descriptor.fields if f.is_repeated and f.message_type is None and f.type not in _TEXTS)
    return messages, frozenset(numbers)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A varint and the position after it."""
    value = shift = 0
    while (byte := data[at]) & 0x80:
        value |= (byte & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if shift >= _MAX_VARINT_BITS:
            raise DecodeError("varint of more than 64 bits")
    return value | byte << shift, at + 1


def _too_many() -> MessageTooLarge:
    return MessageTooLarge(field="message", expected=f"at most {MAX_ELEMENTS} elements", got="more")
