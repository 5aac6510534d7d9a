"""OpenAPI document: bodies, answers and errors that FastAPI cannot derive, because the routes read and write JSON themselves."""

from __future__ import annotations

from typing import Any

from ddakf_api.errors import ServiceError
from ddakf_api.v1 import tracking_pb2 as pb
from fastapi import FastAPI
from google.protobuf.message import Message

from ..dialect.schema import reference, schemas
from .errors import ErrorOut

_RETRY_AFTER = {"Retry-After": {"description": "seconds", "schema": {"type": "integer", "minimum": 1}}}
_MESSAGES = (
    *(pb.CreateSessionRequest, pb.UpdateSessionRequest, pb.ResetSessionRequest),
    *(pb.ListSessionsResponse, pb.SessionHistory, pb.ServerInfo),
    *(pb.CreateMeshRequest, pb.ListMeshesResponse),
)


def error_responses(*classes: type[ServiceError]) -> dict[int | str, dict[str, Any]]:
    """The ``responses`` of an operation that may raise these errors."""
    responses: dict[int | str, dict[str, Any]] = {}
    for error in classes:
        response = responses.setdefault(error.http_status, {"model": ErrorOut, "description": ""})
        response["description"] = f"{response['description']} {error.__name__}: {error.__doc__}".strip()
        if error.retryable:
            response["headers"] = _RETRY_AFTER
    return responses


def json_body(kind: type[Message], *, required: bool = True, **examples: dict) -> dict[str, Any]:
    """``openapi_extra`` of an operation with this body and named examples of it."""
    content = {
        "schema": reference(kind),
        "examples": {name: {"value": value} for name, value in examples.items()},
    }
    return {"requestBody": {"required": required, "content": {"application/json": content}}}


def binary_body(description: str) -> dict[str, Any]:
    """``openapi_extra`` of an operation with a binary body."""
    content = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
    return {"requestBody": {"required": True, "description": description, "content": content}}


def binary_response(description: str, headers: dict[str, str] | None = None) -> dict[int | str, dict[str, Any]]:
    """The ``responses`` of an operation that returns bytes, and perhaps numbers in headers with a meaning each."""
    content = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
    described = {name: {"description": meaning, "schema": {"type": "integer"}} for name, meaning in (headers or {}).items()}
    return {200: {"description": description, "content": content, **({"headers": described} if described else {})}}


def openapi_document(app: FastAPI) -> dict[str, Any]:
    """FastAPI's document, extended with the schemas of the contract's messages."""
    if app.openapi_schema is None:
        document = FastAPI.openapi(app)
        document["components"]["schemas"].update(schemas(*_MESSAGES))
        document["components"]["securitySchemes"] = {"key": {"type": "http", "scheme": "bearer"}}
        document["security"] = [{"key": []}, {}]
    return app.openapi_schema
