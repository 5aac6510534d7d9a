"""Errors of every kind as answers of one form."""

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
    """What went wrong, in one sentence and in parts."""

    name: str
    field: str
    expected: str
    got: str
    message: str
    retry_after: float = Field(0.0, description="seconds after which trying again makes sense; 0: not said")


class ErrorOut(BaseModel):
    error: ErrorBody

    @classmethod
    def of(cls, detail: pb.ErrorDetail) -> ErrorOut:
        return cls(error=ErrorBody(**{name: getattr(detail, name) for name in ErrorBody.model_fields}))


def error_response(error: Exception) -> JSONResponse:
    """The answer to a call that failed."""
    detail = to_detail(error)
    headers = {"Retry-After": str(math.ceil(detail.retry_after))} if detail.retry_after else None
    return JSONResponse(ErrorOut.of(detail).model_dump(), class_of(error).http_status, headers=headers)


def add_error_handlers(app: FastAPI) -> None:
    """Has whatever a route raises, and what the framework refuses by itself, answered as ``ErrorOut``."""

    async def known(request: Request, error: Exception) -> JSONResponse:
        return error_response(error)

    async def invalid(request: Request, error: RequestValidationError | ValidationError) -> JSONResponse:
        return error_response(invalid_argument(error))

    async def refused(request: Request, error: HTTPException) -> JSONResponse:
        phrase = HTTPStatus(error.status_code).phrase
        detail = pb.ErrorDetail(name=phrase.replace(" ", ""), message=f"{request.method} {request.url.path}: {phrase}")
        headers = dict(error.headers or {})
        if error.status_code == HTTPStatus.METHOD_NOT_ALLOWED:  # the framework names those of one route alone
            matching = (route for route in app.routes if route.matches(request.scope)[0] is not Match.NONE)
            headers["Allow"] = ", ".join(sorted({method for route in matching for method in route.methods or ()}))
        return JSONResponse(ErrorOut.of(detail).model_dump(), error.status_code, headers=headers)

    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        return error_response(error)

    app.add_exception_handler(ServiceError, known)
    app.add_exception_handler(DdakfError, known)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(ValidationError, invalid)
    app.add_exception_handler(HTTPException, refused)
    app.add_exception_handler(Exception, unexpected)
