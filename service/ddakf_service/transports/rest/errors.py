"""REST errors: one response form for all kinds of errors."""

from __future__ import annotations

import math
from http import HTTPStatus

from ddakf_api.errors import (
    FailedPrecondition,
    InvalidArgument,
    MessageTooLarge,
    MethodNotAllowed,
    NotFound,
    ServiceError,
    Unimplemented,
    class_of,
    to_detail,
)
from ddakf_api.v1 import tracking_pb2 as pb
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field, ValidationError
from starlette.exceptions import HTTPException
from starlette.routing import Match
from starlette.types import Receive, Scope, Send

from ddakf.errors import DdakfError

from ..truncation import printable
from .validation import invalid_argument

_FRAMEWORK_ERRORS = {
    HTTPStatus.NOT_FOUND: NotFound,
    HTTPStatus.METHOD_NOT_ALLOWED: MethodNotAllowed,
    HTTPStatus.PRECONDITION_FAILED: FailedPrecondition,
    HTTPStatus.REQUEST_HEADER_FIELDS_TOO_LARGE: MessageTooLarge,
    HTTPStatus.NOT_IMPLEMENTED: Unimplemented,
}


class ErrorBody(BaseModel):
    """An error as one sentence and as fields."""

    name: str
    field: str
    expected: str
    got: str
    message: str
    retry_after: float = Field(0.0, description="seconds until a retry makes sense; 0: not known")


class ErrorOut(BaseModel):
    error: ErrorBody

    @classmethod
    def of(cls, detail: pb.ErrorDetail) -> ErrorOut:
        return cls(error=ErrorBody(**{name: getattr(detail, name) for name in ErrorBody.model_fields}))


def error_response(error: Exception) -> JSONResponse:
    """The response to a failed call."""
    detail = to_detail(error)
    headers = {"Retry-After": str(math.ceil(detail.retry_after))} if detail.retry_after else None
    return JSONResponse(ErrorOut.of(detail).model_dump(), class_of(error).http_status, headers=headers)


def http_error_response(status: HTTPStatus, message: str) -> JSONResponse:
    """The response to a request that is none of the contract."""
    detail = to_detail(_FRAMEWORK_ERRORS.get(status, InvalidArgument)(message))
    return JSONResponse(ErrorOut.of(detail).model_dump(), status)


def add_error_handlers(app: FastAPI) -> None:
    """Answers errors of the routes and of the framework as ``ErrorOut``."""

    async def service_error(request: Request, error: Exception) -> JSONResponse:
        return error_response(error)

    async def invalid_request(request: Request, error: RequestValidationError | ValidationError) -> JSONResponse:
        return error_response(invalid_argument(error))

    async def http_error(request: Request, error: HTTPException) -> JSONResponse:
        status = HTTPStatus(error.status_code)
        response = http_error_response(status, f"{printable(request.method)} {printable(request.url.path)}: {status.phrase}")
        response.headers.update(error.headers or {})
        if status == HTTPStatus.METHOD_NOT_ALLOWED:  # the framework names the methods of one route only
            response.headers["Allow"] = _allowed(app, request)
        return response

    async def unexpected_error(request: Request, error: Exception) -> JSONResponse:
        return error_response(error)

    app.add_exception_handler(ServiceError, service_error)
    app.add_exception_handler(DdakfError, service_error)
    app.add_exception_handler(RequestValidationError, invalid_request)
    app.add_exception_handler(ValidationError, invalid_request)
    app.add_exception_handler(HTTPException, http_error)
    app.add_exception_handler(Exception, unexpected_error)

    app.router.default = _no_route


def _allowed(app: FastAPI, request: Request) -> str:
    """The methods of a path."""
    matching = (route for route in app.routes if route.matches(request.scope)[0] is not Match.NONE)
    methods = {method for route in matching for method in getattr(route, "methods", None) or ()}
    return ", ".join(sorted(methods | ({"HEAD"} if "GET" in methods else set())))


async def _no_route(scope: Scope, receive: Receive, send: Send) -> None:
    """Answers a path without a route, also a WebSocket's, which the framework would refuse with 403 and no reason."""
    what = "WebSocket" if scope["type"] == "websocket" else scope["method"]
    response = http_error_response(HTTPStatus.NOT_FOUND, f"{what} {printable(scope['path'])}: {HTTPStatus.NOT_FOUND.phrase}")
    await response(scope, receive, send)
