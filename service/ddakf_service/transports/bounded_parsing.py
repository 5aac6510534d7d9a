"""Requests of countless parts: counted in their serialised form, before objects are made of them.

A sub-message of two bytes becomes an object of forty, so that a request within ``max_message_bytes`` could take a gigabyte and
seconds of the event loop. Arrays travel as bytes, which are one part: no real request has more than some thousand.
"""

from __future__ import annotations

import functools
from typing import TypeVar

from ddakf_api.errors import MessageTooLarge
from google.protobuf.descriptor import Descriptor, FieldDescriptor
from google.protobuf.message import DecodeError, Message

MOST_PARTS = 1 << 14  # 64 sensors with poses have 8,000
_HARMLESS = 1 << 16  # bytes that cannot hold enough parts to do harm
_VARINT, _FIXED_64, _SIZED, _FIXED_32 = 0, 1, 2, 5  # wire types; groups have no content of their own
_LONGEST_VARINT = 70  # bits
_TEXTS = (FieldDescriptor.TYPE_STRING, FieldDescriptor.TYPE_BYTES)
_JSON_PARTS = ",:[{"  # each part of a JSON text has one of these; base64 has none

T = TypeVar("T", bound=Message)


def parsed(kind: type[T], data: bytes) -> T:
    """The message.

    Raises:
        MessageTooLarge: it has more than :data:`MOST_PARTS`. DecodeError: it is none.
    """
    if len(data) > _HARMLESS:
        try:
            _count(data, 0, len(data), kind.DESCRIPTOR, MOST_PARTS)
        except IndexError:
            raise DecodeError("cut off") from None
    return kind.FromString(data)


def require_few_in_json(text: str) -> None:
    """Raises :class:`MessageTooLarge` for a JSON text of more than :data:`MOST_PARTS`."""
    if len(text) > _HARMLESS and sum(map(text.count, _JSON_PARTS)) > MOST_PARTS:
        raise _too_many()


def _count(data: bytes, at: int, end: int, descriptor: Descriptor, left: int) -> int:
    """How many parts are left of those that a message may have, after those between two positions."""
    messages, numbers = _fields(descriptor)
    while at < end:
        left -= 1
        tag, at = _varint(data, at)
        kind = tag & 7
        if kind == _VARINT:
            _, at = _varint(data, at)
        elif kind == _FIXED_64:
            at += 8
        elif kind == _FIXED_32:
            at += 4
        elif kind == _SIZED:
            size, at = _varint(data, at)
            if (inner := messages.get(tag >> 3)) is not None:
                left = _count(data, at, min(at + size, end), inner, left)
            elif tag >> 3 in numbers:
                left -= size  # packed, of a byte each at least
            at += size
        if left < 0:
            raise _too_many()
    return left


@functools.cache
def _fields(descriptor: Descriptor) -> tuple[dict[int, Descriptor], frozenset[int]]:
    """By number the fields that hold messages, and the numbers of those that hold lists of numbers."""
    messages = {f.number: f.message_type for f in descriptor.fields if f.message_type is not None}
    numbers = (f.number for f in descriptor.fields if f.is_repeated and f.message_type is None and f.type not in _TEXTS)
    return messages, frozenset(numbers)


def _varint(data: bytes, at: int) -> tuple[int, int]:
    """A number of variable length, and the position behind it."""
    value = shift = 0
    while (byte := data[at]) & 0x80:
        value |= (byte & 0x7F) << shift
        shift, at = shift + 7, at + 1
        if shift >= _LONGEST_VARINT:
            raise DecodeError("a number of more than 64 bits")
    return value | byte << shift, at + 1


def _too_many() -> MessageTooLarge:
    return MessageTooLarge(field="message", expected=f"at most {MOST_PARTS} parts", got="more")
