"""REST: health, readiness, sessions, metrics, OpenAPI. The same meaning, names and errors as over gRPC."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import math
import socket
from collections.abc import Callable
from http import HTTPStatus
from typing import Annotated, Literal

import uvicorn
from ddakf_api.errors import InvalidArgument, ResourceExhausted, ServiceError, Unavailable, class_of, to_detail
from ddakf_api.v1 import tracking_pb2 as pb
from fastapi import FastAPI, Query, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from pydantic import ValidationError
from starlette.exceptions import HTTPException

import ddakf
from ddakf import errors as library

from .info import server_info
from .rest_models import CreateSession, ErrorOut, Info, Readiness, SessionList, SessionOut, states_from
from .sessions import Sessions
from .settings import Settings
from .store import Store
from .telemetry import Metrics
from .validation import invalid_argument

log = logging.getLogger(__name__)

_MAX_BODY_BYTES = 32 << 20  # JSON lists of the largest meshes fit; larger ones travel as base64 or over gRPC
_STOP_PATIENCE = 2  # seconds that a stop waits for calls in progress
_ERRORS = {code: {"model": ErrorOut} for code in (404, 409, 410, 422, 429, 503)}
_SESSION_BODY = {
    "requestBody": {
        "required": True,
        "content": {"application/json": {"schema": {"$ref": "#/components/schemas/CreateSession"}}},
    }
}


def create_app(
    sessions: Sessions, settings: Settings, metrics: Metrics, not_ready: Callable[[], str], store: Store
) -> FastAPI:
    """The application.

    Args:
        not_ready: why the server takes no sessions now, in a few words; empty when it does.
    """
    app = FastAPI(
        title="ddakf",
        version=ddakf.__version__,
        description="Garment tracking from point clouds. Frames travel over gRPC (`ddakf_api.v1.TrackingService`).",
    )
    _add_error_handlers(app)

    @app.get("/healthz", tags=["health"])
    async def healthz() -> dict[str, str]:
        """The process lives and its event loop turns."""
        return {"status": "ok"}

    @app.get("/readyz", tags=["health"], responses={503: {"model": ErrorOut}})
    async def readyz() -> Readiness:
        """Sessions are taken: every worker has compiled its kernels and tracked a frame, and no stop has begun.

        A database or a disk that does not work makes the server "degraded", not unready: it tracks."""
        if reason := not_ready():
            raise Unavailable(reason)
        problems = store.problems()
        return Readiness(status="degraded" if problems else "ready", problems=problems)

    @app.get("/metrics", tags=["health"], response_class=Response)
    async def metrics_page() -> Response:
        """Prometheus exposition."""
        return Response(generate_latest(metrics.registry), media_type=CONTENT_TYPE_LATEST)

    @app.get("/v1/info", tags=["server"])
    async def info() -> Info:
        """Versions, codecs and limits."""
        return Info.of(server_info(settings, sessions.draining))

    @app.post("/v1/sessions", tags=["sessions"], status_code=201, responses=_ERRORS, openapi_extra=_SESSION_BODY)
    async def create_session(request: Request, response: Response) -> SessionOut:
        """Creates a session; frames are then streamed to it over gRPC."""
        body = await _bounded_body(request)
        # In a thread, because parsing some hundred thousand numbers would hold up every stream.
        message = await asyncio.to_thread(lambda: CreateSession.model_validate_json(body).to_message())
        session = await sessions.create(message)
        response.headers["Location"] = f"/v1/{session.name}"
        return SessionOut.of(session)

    @app.get("/v1/sessions", tags=["sessions"], responses={422: {"model": ErrorOut}})
    async def list_sessions(
        page_size: Annotated[int, Query(ge=0, le=2**31, description="at most this many; 0: 50; lowered to 1000")] = 0,
        page_token: Annotated[str, Query(description="next_page_token of the page before")] = "",
        state: Annotated[list[str], Query(description="only sessions in one of these states")] = [],  # noqa: B006
        label: Annotated[list[str], Query(description="only sessions with these labels, key=value")] = [],  # noqa: B006
    ) -> SessionList:
        """Lists sessions, oldest first."""
        request = pb.ListSessionsRequest(page_size=page_size, page_token=page_token, states=states_from(state))
        request.labels.update(_key_value(text) for text in label)
        answer = sessions.list(request)
        return SessionList(sessions=[SessionOut.of(s) for s in answer.sessions], next_page_token=answer.next_page_token)

    @app.get("/v1/sessions/{session_id}", tags=["sessions"], responses={404: {"model": ErrorOut}, 410: {"model": ErrorOut}})
    async def get_session(session_id: str, view: Literal["basic", "full"] = "basic") -> SessionOut:
        """State, reliability, coverage, frame rate and drops as of the last frame; with the meshes in the full view."""
        wanted = pb.SESSION_VIEW_FULL if view == "full" else pb.SESSION_VIEW_BASIC
        return SessionOut.of(sessions.get(f"sessions/{session_id}", wanted))

    @app.delete("/v1/sessions/{session_id}", tags=["sessions"], status_code=204, responses={404: {"model": ErrorOut}})
    async def delete_session(session_id: str) -> None:
        """Ends a session and its stream."""
        await sessions.delete(f"sessions/{session_id}")

    app.openapi = lambda: _openapi(app)
    return app


class HttpServer:
    """uvicorn in an event loop that others share."""

    def __init__(self, app: FastAPI, settings: Settings):
        self._settings = settings
        config = uvicorn.Config(
            app,
            log_config=None,
            access_log=False,
            lifespan="off",
            ws_per_message_deflate=False,
            timeout_graceful_shutdown=_STOP_PATIENCE,
        )
        self._server = _QuietServer(config)
        self._task: asyncio.Task | None = None

    async def start(self) -> int:
        """Listens, and returns the port.

        Raises:
            InvalidConfig: the port cannot be had.
        """
        host, port = self._settings.host, self._settings.http_port
        try:
            family = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0][0]
            listener = socket.create_server((host, port), family=family, backlog=512)
        except OSError as error:
            raise library.InvalidConfig("http_port", f"a free port on {host}", f"{port}: {error.strerror}") from None
        self._task = asyncio.create_task(self._server.serve(sockets=[listener]))
        while not self._server.started and not self._task.done():
            await asyncio.sleep(0.01)
        return listener.getsockname()[1]

    async def stop(self) -> None:
        """Ends once the calls in progress are answered."""
        self._server.should_exit = True
        if self._task:
            await self._task


class _QuietServer(uvicorn.Server):
    @contextlib.contextmanager
    def capture_signals(self):
        yield  # signals belong to the whole service, not to its HTTP side


def _add_error_handlers(app: FastAPI) -> None:
    async def known(request: Request, error: Exception) -> JSONResponse:
        return _error_response(error)

    async def invalid(request: Request, error: RequestValidationError | ValidationError) -> JSONResponse:
        return _error_response(invalid_argument(error))

    async def refused(request: Request, error: HTTPException) -> JSONResponse:
        phrase = HTTPStatus(error.status_code).phrase
        detail = pb.ErrorDetail(name=phrase.replace(" ", ""), message=f"{request.method} {request.url.path}: {phrase}")
        return JSONResponse(ErrorOut.of(detail).model_dump(), error.status_code, headers=error.headers)

    async def unexpected(request: Request, error: Exception) -> JSONResponse:
        return _error_response(error)

    app.add_exception_handler(ServiceError, known)
    app.add_exception_handler(library.DdakfError, known)
    app.add_exception_handler(RequestValidationError, invalid)
    app.add_exception_handler(ValidationError, invalid)
    app.add_exception_handler(HTTPException, refused)
    app.add_exception_handler(Exception, unexpected)


def _error_response(error: Exception) -> JSONResponse:
    detail = to_detail(error)
    headers = {"Retry-After": str(math.ceil(detail.retry_after))} if detail.retry_after else None
    return JSONResponse(ErrorOut.of(detail).model_dump(), class_of(error).http_status, headers=headers)


async def _bounded_body(request: Request) -> bytes:
    """The body, read no further than its bound."""
    chunks, size = [], 0
    async for chunk in request.stream():
        size += len(chunk)
        if size > _MAX_BODY_BYTES:
            raise ResourceExhausted(field="body", expected=f"at most {_MAX_BODY_BYTES} bytes", got="more")
        chunks.append(chunk)
    return b"".join(chunks)


def _key_value(text: str) -> tuple[str, str]:
    key, separator, value = text.partition("=")
    if not separator:
        raise InvalidArgument(field="label", expected="key=value", got=repr(text[:80]))
    return key, value


def _openapi(app: FastAPI) -> dict:
    """FastAPI's document, with the schema of the body that is parsed by hand."""
    if app.openapi_schema is None:
        document = FastAPI.openapi(app)
        schema = CreateSession.model_json_schema(ref_template="#/components/schemas/{model}")
        document["components"]["schemas"].update(schema.pop("$defs"))
        document["components"]["schemas"]["CreateSession"] = schema
    return app.openapi_schema
