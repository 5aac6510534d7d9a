"""Bodies of requests, bounded before they are read and before they are parsed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from ddakf_api.errors import Cancelled, DeadlineExceeded, MessageTooLarge
from fastapi import Request
from google.protobuf.message import Message
from pydantic import ValidationError
from starlette.requests import ClientDisconnect

from ...settings import Settings
from .validation import invalid_argument

_MAX_JSON_BYTES = 32 << 20  # lists of the largest meshes fit; larger ones travel as base64 or over gRPC
_MAX_MEMBERS = 1 << 16  # of the objects in a body, all together; labels of the longest texts have room


async def read(request: Request, most: int, patience: float) -> bytes:
    """The body, refused by its declared length before it is read, and read no further than its bound.

    Args:
        most: bytes.
        patience: seconds in which it has to come.

    Raises:
        MessageTooLarge: it is longer. DeadlineExceeded: it takes longer. Cancelled: the client has left.
    """
    declared = request.headers.get("content-length", "")
    if declared.isdigit() and int(declared[:20]) > most:
        raise MessageTooLarge(field="body", expected=f"at most {most} bytes", got=f"{declared} bytes")
    try:
        async with asyncio.timeout(patience):
            return await _within(request, most)
    except TimeoutError:
        raise DeadlineExceeded(f"the body did not come within {patience:g} s") from None
    except ClientDisconnect:
        raise Cancelled("the client left before its request was complete") from None


async def _within(request: Request, most: int) -> bytes:
    chunks, size = [], 0
    async for chunk in request.stream():
        size += len(chunk)
        if size > most:
            raise MessageTooLarge(field="body", expected=f"at most {most} bytes", got="more")
        chunks.append(chunk)
    return b"".join(chunks)


async def parsed(request: Request, settings: Settings, parse: Callable[[bytes], Message]) -> Message:
    """What a JSON body says, read in a thread: some hundred thousand numbers would hold up every stream.

    Whatever is in it, pydantic makes one object of each of its parts, and one error of each that is wrong, so the parts are
    counted before: every member of an object has a colon, every row of a mesh a bracket.
    """
    body = await read(request, min(_MAX_JSON_BYTES, settings.max_message_bytes), settings.request_timeout)
    most_rows = settings.max_vertices + settings.max_body_vertices + 2 * settings.max_faces

    def checked() -> Message:
        for sign, most, what in ((b":", _MAX_MEMBERS, "members"), (b"[", most_rows + _MAX_MEMBERS, "lists")):
            if (count := body.count(sign)) > most:
                raise MessageTooLarge(field="body", expected=f"at most {most} {what}", got=f"up to {count}")
        try:
            return parse(body)
        except ValidationError as error:  # which may show much of the body
            raise invalid_argument(error) from None

    return await asyncio.to_thread(checked)
