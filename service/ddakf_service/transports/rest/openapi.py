"""OpenAPI document: request bodies and error responses that FastAPI cannot derive, because the routes read bodies themselves."""

from __future__ import annotations

from typing import Any

from ddakf_api.errors import ServiceError
from fastapi import FastAPI
from pydantic import BaseModel
from pydantic.json_schema import models_json_schema

from .errors import ErrorOut
from .requests import CreateSession, ResetSession, UpdateSession

_BODIES = (CreateSession, UpdateSession, ResetSession)
_RETRY_AFTER = {"Retry-After": {"description": "seconds", "schema": {"type": "integer", "minimum": 1}}}
_REFERENCE = "#/components/schemas/{model}"


def error_responses(*classes: type[ServiceError]) -> dict[int | str, dict[str, Any]]:
    """The ``responses`` of an operation that may raise these errors."""
    responses: dict[int | str, dict[str, Any]] = {}
    for error in classes:
        response = responses.setdefault(error.http_status, {"model": ErrorOut, "description": ""})
        response["description"] = f"{response['description']} {error.__name__}: {error.__doc__}".strip()
        if error.retryable:
            response["headers"] = _RETRY_AFTER
    return responses


def json_body(model: type[BaseModel], *, required: bool = True, **examples: dict) -> dict[str, Any]:
    """``openapi_extra`` of an operation with this body and named examples of it."""
    content = {
        "schema": {"$ref": _REFERENCE.format(model=model.__name__)},
        "examples": {name: {"value": value} for name, value in examples.items()},
    }
    return {"requestBody": {"required": required, "content": {"application/json": content}}}


def binary_body(description: str) -> dict[str, Any]:
    """``openapi_extra`` of an operation with a binary body."""
    content = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
    return {"requestBody": {"required": True, "description": description, "content": content}}


def binary_response(description: str) -> dict[int | str, dict[str, Any]]:
    """The ``responses`` of an operation that returns bytes."""
    content = {"application/octet-stream": {"schema": {"type": "string", "format": "binary"}}}
    return {200: {"description": description, "content": content}}


def openapi_document(app: FastAPI) -> dict[str, Any]:
    """FastAPI's document, extended with the schemas of the bodies."""
    if app.openapi_schema is None:
        document = FastAPI.openapi(app)
        _, schemas = models_json_schema([(model, "validation") for model in _BODIES], ref_template=_REFERENCE)
        document["components"]["schemas"].update(schemas["$defs"])
        document["components"]["securitySchemes"] = {"key": {"type": "http", "scheme": "bearer"}}
        document["security"] = [{"key": []}, {}]
    return app.openapi_schema
