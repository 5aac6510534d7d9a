"""REST responses: messages of the contract as JSON."""

from __future__ import annotations

import asyncio
from typing import Any, Literal

from fastapi import Response
from google.protobuf.message import Message
from pydantic import BaseModel, Field

from ..dialect.schema import reference
from ..dialect.writing import as_json

LAST_SEQUENCE_NUMBER = "Ddakf-Last-Sequence-Number"
"""Header of a snapshot."""

_JSON = "application/json"


class Readiness(BaseModel):
    """Readiness for sessions, and problems of other parts."""

    status: Literal["ready", "degraded"]
    problems: list[str] = Field(description="one sentence for each failing part; tracking continues")


def answer_of(kind: type[Message], status: int = 200, description: str = "") -> dict[int | str, dict[str, Any]]:
    """The ``responses`` of an operation that answers with this message."""
    return {status: {"description": description, "content": {_JSON: {"schema": reference(kind)}}}}


async def answer(message: Message) -> Response:
    """A message, serialised in a thread so that no stream waits. A hundred thousand vertices or ten thousand samples take a
    tenth of a second."""
    return Response(await asyncio.to_thread(as_json, message), media_type=_JSON)


async def created(message: Message) -> Response:
    """A new resource, with its address."""
    headers = {"Location": f"/v1/{message.name}"}
    return Response(await asyncio.to_thread(as_json, message), 201, headers, _JSON)
