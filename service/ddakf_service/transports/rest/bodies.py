"""Request bodies: bounds on size, time and number of elements before they are read and parsed."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from ddakf_api.errors import Cancelled, DeadlineExceeded, MessageTooLarge
from fastapi import Request
from google.protobuf.message import Message
from starlette.requests import ClientDisconnect

from ...settings import Settings

_MAX_JSON_BYTES = 32 << 20  # the largest meshes fit as lists; larger ones travel as base64 or over gRPC
_MAX_MEMBERS = 1 << 16  # members of all objects in a body; enough for the largest labels


async def read(request: Request, max_bytes: int, patience: float) -> bytes:
    """Reads a body. A declared length beyond the bound is rejected at once; no more than the bound is read.

    Args:
        max_bytes: bound, bytes.
        patience: seconds for the body to arrive.

    Raises:
        MessageTooLarge: too long. DeadlineExceeded: too slow. Cancelled: the client has left.
    """
    declared = request.headers.get("content-length", "")
    if declared.isdigit() and int(declared[:20]) > max_bytes:
        raise MessageTooLarge(field="body", expected=f"at most {max_bytes} bytes", got=f"{declared} bytes")
    try:
        async with asyncio.timeout(patience):
            return await _read_bounded(request, max_bytes)
    except TimeoutError:
        raise DeadlineExceeded(f"the body did not come within {patience:g} s") from None
    except ClientDisconnect:
        raise Cancelled("the client left before its request was complete") from None


async def _read_bounded(request: Request, max_bytes: int) -> bytes:
    chunks, size = [], 0
    async for chunk in request.stream():
        size += len(chunk)
        if size > max_bytes:
            raise MessageTooLarge(field="body", expected=f"at most {max_bytes} bytes", got="more")
        chunks.append(chunk)
    return b"".join(chunks)


async def parse_json(request: Request, settings: Settings, parse: Callable[[bytes], Message]) -> Message:
    """Parses a JSON body in a thread: some hundred thousand numbers would block the event loop.

    The parser makes one object of each element. The elements are therefore counted before: every member of an object has a
    colon, every row of a mesh a bracket, every number but the first of a row a comma, as has every row.
    """
    body = await read(request, min(_MAX_JSON_BYTES, settings.max_message_bytes), settings.request_timeout)
    max_rows = settings.max_vertices + settings.max_body_vertices + 2 * settings.max_faces

    bounds = (
        (b":", _MAX_MEMBERS, "members"),
        (b"[", max_rows + _MAX_MEMBERS, "lists"),
        (b",", 3 * max_rows + _MAX_MEMBERS, "numbers"),
    )

    def parse_bounded() -> Message:
        for separator, maximum, elements in bounds:
            if (count := body.count(separator)) > maximum:
                raise MessageTooLarge(field="body", expected=f"at most {maximum} {elements}", got=f"up to {count}")
        return parse(body)

    return await asyncio.to_thread(parse_bounded)
