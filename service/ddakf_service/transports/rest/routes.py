"""REST routes: health, readiness, sessions, metrics, OpenAPI; with the meaning, names and errors of gRPC."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from datetime import datetime
from typing import Annotated, Literal

from ddakf_api.errors import (
    DeadlineExceeded,
    Draining,
    FailedPrecondition,
    InvalidArgument,
    InvalidSnapshot,
    MessageTooLarge,
    PermissionDenied,
    ResourceExhausted,
    SessionExists,
    SessionExpired,
    SessionNotFound,
    Unauthenticated,
    Unavailable,
    VersionMismatch,
    WorkerLost,
)
from ddakf_api.v1 import tracking_pb2 as pb
from fastapi import FastAPI, Path, Query, Request, Response
from fastapi.responses import PlainTextResponse
from google.protobuf.message import Message
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from pydantic import BaseModel
from starlette.convertors import Convertor, register_url_convertor

import ddakf

from ...info import server_info
from ...observability.metrics import Metrics
from ...sessions.service import Sessions
from ...settings import Settings
from ...store.store import Store
from ..rest import bodies
from .cross_origin import add_origin_check
from .errors import add_error_handlers
from .history import HistoryOut, history_request
from .openapi import binary_body, binary_response, error_responses, json_body, openapi_document
from .requests import (
    EXAMPLE_ID,
    KEY_VALUES,
    STATES,
    TRIANGLE,
    CreateSession,
    ResetSession,
    RestoreSession,
    UpdateSession,
    key_value,
    states_from,
)
from .responses import Info, Readiness, SessionList, SessionOut, Statistics

_OCTETS = "application/octet-stream"

_SESSION_ERRORS = error_responses(SessionNotFound, SessionExpired, InvalidArgument)
_WORKER_ERRORS = {**_SESSION_ERRORS, **error_responses(WorkerLost)}
_BODY_ERRORS = error_responses(MessageTooLarge, DeadlineExceeded)
_CREATION_ERRORS = error_responses(
    *(VersionMismatch, SessionExists, SessionNotFound, SessionExpired, MessageTooLarge, InvalidArgument),
    *(ResourceExhausted, Draining, DeadlineExceeded),
)


def _example(value: object) -> dict:
    return {"example": {"value": value}}


class _SessionIdConvertor(Convertor[str]):
    """Path element after ``/v1/sessions/``, up to the next slash or the colon of a custom method."""

    regex = "[^/:]+"

    def convert(self, value: str) -> str:
        return value

    def to_string(self, value: str) -> str:
        return value


register_url_convertor("session", _SessionIdConvertor())
SessionId = Annotated[str, Path(description="of sessions/{session_id}", openapi_examples=_example(EXAMPLE_ID))]

_PageSize = Annotated[
    int, Query(ge=0, le=2**31, description="at most this many; 0: 50; lowered to 1000", openapi_examples=_example(2))
]
_States = Annotated[
    list[str],
    Query(
        description="only sessions in one of these states",
        json_schema_extra=STATES,
        openapi_examples=_example(["idle", "tracking"]),
    ),
]
_Labels = Annotated[
    list[str],
    Query(
        description="only sessions with these labels, key=value",
        json_schema_extra=KEY_VALUES,
        openapi_examples=_example(["scene=stage"]),
    ),
]

DESCRIPTION = """Garment tracking from point clouds.

Frames travel over gRPC (`ddakf_api.v1.TrackingService/Track`) or over a WebSocket, `/v1/sessions/{session_id}/stream`. A
watcher reads the results at `/v1/sessions/{session_id}/watch`. Both accept `?mode=json` for text frames. All errors have the
form `ErrorOut` and the names of the classes that the clients raise."""


def create_app(sessions: Sessions, settings: Settings, metrics: Metrics, not_ready: Callable[[], str], store: Store) -> FastAPI:
    """The application.

    Args:
        not_ready: returns the reason why the server accepts no sessions; empty: it does.
    """
    app = FastAPI(
        title="ddakf",
        version=ddakf.__version__,
        description=DESCRIPTION,
        responses=error_responses(Unauthenticated, PermissionDenied),
    )
    add_error_handlers(app)
    add_origin_check(app, settings.cors_origins)
    _add_server_routes(app, sessions, settings, metrics, not_ready, store)
    _add_collection_routes(app, sessions, settings)
    _add_session_routes(app, sessions, settings)
    _add_state_routes(app, sessions, settings)
    app.openapi = lambda: openapi_document(app)
    return app


def _add_server_routes(
    app: FastAPI, sessions: Sessions, settings: Settings, metrics: Metrics, not_ready: Callable[[], str], store: Store
) -> None:
    @app.get("/healthz", tags=["health"])
    async def healthz() -> dict[str, str]:
        """The process is alive and its event loop runs."""
        return {"status": "ok"}

    @app.get("/readyz", tags=["health"], responses=error_responses(Unavailable))
    async def readyz() -> Readiness:
        """The server accepts sessions: every worker has compiled its kernels and tracked a frame, and no stop has begun.

        A failing database or disk makes the server "degraded", not unready: tracking continues."""
        if reason := not_ready():
            raise Unavailable(reason)
        problems = store.problems()
        return Readiness(status="degraded" if problems else "ready", problems=problems)

    @app.get("/metrics", tags=["health"], response_class=PlainTextResponse)
    async def metrics_page() -> Response:
        """Prometheus exposition."""
        return Response(generate_latest(metrics.registry), media_type=CONTENT_TYPE_LATEST)

    @app.get("/v1/info", tags=["server"])
    async def info() -> Info:
        """Versions, codecs and limits."""
        return Info.of(server_info(settings, sessions.draining))


def _add_collection_routes(app: FastAPI, sessions: Sessions, settings: Settings) -> None:
    """The standard methods of all sessions."""

    @app.post(
        "/v1/sessions",
        tags=["sessions"],
        status_code=201,
        responses=_CREATION_ERRORS,
        openapi_extra=json_body(
            CreateSession,
            named={"session_id": EXAMPLE_ID, "garment": TRIANGLE, "fabric": "cotton", "labels": {"scene": "stage"}},
            configured={"garment": TRIANGLE, "config": {"associate": {"wide_gate": 0.3}}, "limits": {"idle_timeout": 60}},
        ),
    )
    async def create_session(request: Request, response: Response) -> SessionOut:
        """Creates a session; frames are then streamed to it over gRPC or a WebSocket."""
        message = await bodies.parse_json(request, settings, lambda body: CreateSession.model_validate_json(body).to_message())
        return _created(await sessions.create(message), response)

    @app.get("/v1/sessions", tags=["sessions"], response_model=SessionList, responses=error_responses(InvalidArgument))
    async def list_sessions(
        page_size: _PageSize = 0,
        page_token: Annotated[str, Query(description="next_page_token of the page before")] = "",
        state: _States = [],  # noqa: B006
        label: _Labels = [],  # noqa: B006
    ) -> Response:
        """Lists sessions, oldest first."""
        request = pb.ListSessionsRequest(page_size=page_size, page_token=page_token, states=states_from(state))
        request.labels.update(key_value(text) for text in label)
        return await _json_response(SessionList.of, sessions.list(request))


def _add_session_routes(app: FastAPI, sessions: Sessions, settings: Settings) -> None:
    """The standard methods of one session, and its history."""

    @app.get("/v1/sessions/{session_id:session}", tags=["sessions"], response_model=SessionOut, responses=_SESSION_ERRORS)
    async def get_session(
        session_id: SessionId,
        view: Annotated[Literal["basic", "full"], Query(openapi_examples=_example("full"))] = "basic",
    ) -> Response:
        """State, reliability, coverage, frame rate and drops as of the last frame; with the meshes in the full view."""
        session_view = pb.SESSION_VIEW_FULL if view == "full" else pb.SESSION_VIEW_BASIC
        return await _json_response(SessionOut.of, await sessions.get(f"sessions/{session_id}", session_view))

    @app.patch(
        "/v1/sessions/{session_id:session}",
        tags=["sessions"],
        responses={**_WORKER_ERRORS, **_BODY_ERRORS, **error_responses(FailedPrecondition)},
        openapi_extra=json_body(
            UpdateSession,
            labels={"labels": {"scene": "stage", "take": "2"}},
            limits={"limits": {"idle_timeout": 120}},
            fabric={"fabric": "silk"},
        ),
    )
    async def update_session(
        session_id: SessionId,
        request: Request,
        update_mask: Annotated[
            str,
            Query(description="fields, separated by commas; empty: those in the body", openapi_examples=_example("labels")),
        ] = "",
    ) -> SessionOut:
        """Changes labels, limits, configuration and fabric. A field that the mask names and the body lacks is reset to its
        default."""
        name = f"sessions/{session_id}"
        message = await bodies.parse_json(
            request, settings, lambda body: UpdateSession.model_validate_json(body).to_message(name, update_mask)
        )
        return SessionOut.of(await sessions.update(message))

    @app.get(
        "/v1/sessions/{session_id:session}/history",
        tags=["sessions"],
        response_model=HistoryOut,
        responses={**_SESSION_ERRORS, **error_responses(Unavailable)},
    )
    async def get_session_history(
        session_id: SessionId,
        start: Annotated[datetime | None, Query(alias="from", description="without it the session's creation")] = None,
        end: Annotated[datetime | None, Query(alias="to", description="without it now, or the session's end")] = None,
        resolution: Annotated[float, Query(ge=0, lt=2**32, description="seconds per sample; 0: the finest that fits")] = 0,
        max_samples: Annotated[int, Query(ge=0, lt=2**32, description="at most this many; 0: 500; lowered to 10000")] = 0,
    ) -> Response:
        """Reliability, coverage, latency, frames by outcome and changes of state over time, of a live or a past session."""
        request = history_request(session_id, start, end, resolution, max_samples)
        return await _json_response(HistoryOut.of, await sessions.history(request))

    @app.delete("/v1/sessions/{session_id:session}", tags=["sessions"], status_code=204, responses=_SESSION_ERRORS)
    async def delete_session(session_id: SessionId) -> None:
        """Ends a session and its stream."""
        await sessions.delete(f"sessions/{session_id}")


def _add_state_routes(app: FastAPI, sessions: Sessions, settings: Settings) -> None:
    """The methods on the tracker of a session."""

    @app.get("/v1/sessions/{session_id:session}/statistics", tags=["state"], responses=_SESSION_ERRORS)
    async def statistics(session_id: SessionId) -> Statistics:
        """Counters, and the numbers of the last frame."""
        return Statistics.of((await sessions.get(f"sessions/{session_id}")).statistics)

    @app.post(
        "/v1/sessions/{session_id:session}:reset",
        tags=["state"],
        responses={**_WORKER_ERRORS, **_BODY_ERRORS},
        openapi_extra=json_body(ResetSession, required=False, rest={}, there={"vertices": TRIANGLE["vertices"]}),
    )
    async def reset_session(session_id: SessionId, request: Request) -> SessionOut:
        """Resets the tracker to given vertices, or without a body to the rest shape."""
        name = f"sessions/{session_id}"
        message = await bodies.parse_json(
            request, settings, lambda body: ResetSession.model_validate_json(body or b"{}").to_message(name)
        )
        return SessionOut.of(await sessions.reset(message))

    @app.get(
        "/v1/sessions/{session_id:session}/snapshot",
        tags=["state"],
        response_class=Response,
        responses={**_WORKER_ERRORS, **binary_response("the tracker's state, versioned and opaque")},
    )
    async def snapshot_session(session_id: SessionId) -> Response:
        """The full state of the tracker; a restored tracker's next frame is equal to the bit."""
        data = (await sessions.snapshot(f"sessions/{session_id}")).data
        return Response(data, media_type=_OCTETS, headers={"Content-Disposition": 'attachment; filename="ddakf.snapshot"'})

    @app.post(
        "/v1/sessions:restore",
        tags=["state"],
        status_code=201,
        responses={**_CREATION_ERRORS, **error_responses(InvalidSnapshot, InvalidArgument)},
        openapi_extra=binary_body("response of GET /v1/sessions/{session_id}/snapshot, of this server or another"),
    )
    async def restore_session(request: Request, response: Response, query: Annotated[RestoreSession, Query()]) -> SessionOut:
        """Creates a session from a snapshot."""
        data = await bodies.read(request, settings.max_message_bytes, settings.request_timeout)
        return _created(await sessions.restore(query.to_message(data)), response)


def _created(session: pb.Session, response: Response) -> SessionOut:
    response.headers["Location"] = f"/v1/{session.name}"
    return SessionOut.of(session)


async def _json_response(model_of: Callable[[Message], BaseModel], message: Message) -> Response:
    """A large response, serialised in a thread so that no stream waits. A hundred thousand vertices or ten thousand samples
    take a tenth of a second."""
    text = await asyncio.to_thread(lambda: model_of(message).model_dump_json())
    return Response(text, media_type="application/json")
