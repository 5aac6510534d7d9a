"""REST errors: one response form for all kinds of errors."""

from __future__ import annotations

import math
from http import HTTPStatus

from ddakf_api.errors import ServiceError, class_of, to_detail
from ddakf_api.v1 import tracking_pb2 as pb
from fastapi import FastAPI, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import BaseModel, Field, ValidationError
from starlette.exceptions import HTTPException
from starlette.routing import Match

from ddakf.errors import DdakfError

from .validation import invalid_argument


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


def add_error_handlers(app: FastAPI) -> None:
    """Answers errors of the routes and of the framework as ``ErrorOut``."""

    async def service_error(request: Request, error: Exception) -> JSONResponse:
        return error_response(error)

    async def invalid_request(request: Request, error: RequestValidationError | ValidationError) -> JSONResponse:
        return error_response(invalid_argument(error))

    async def http_error(request: Request, error: HTTPException) -> JSONResponse:
        phrase = HTTPStatus(error.status_code).phrase
        detail = pb.ErrorDetail(name=phrase.replace(" ", ""), message=f"{request.method} {request.url.path}: {phrase}")
        headers = dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:  # the framework names the methods of one route only
            matching = (route for route in app.routes if route.matches(request.scope)[0] is not Match.NONE)
            headers["Allow"] = ", ".join(sorted({method for route in matching for method in route.methods or ()}))
        return JSONResponse(ErrorOut.of(detail).model_dump(), error.status_code, headers=headers)

    async def unexpected_error(request: Request, error: Exception) -> JSONResponse:
        return error_response(error)

    app.add_exception_handler(ServiceError, service_error)
    app.add_exception_handler(DdakfError, service_error)
    app.add_exception_handler(RequestValidationError, invalid_request)
    app.add_exception_handler(ValidationError, invalid_request)
    app.add_exception_handler(HTTPException, http_error)
    app.add_exception_handler(Exception, unexpected_error)
