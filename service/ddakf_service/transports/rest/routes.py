"""REST routes: health, readiness, sessions, metrics, OpenAPI; with the meaning, names and errors of gRPC."""

from __future__ import annotations

import asyncio
import functools
import json
from collections.abc import Callable
from datetime import datetime
from http import HTTPStatus
from typing import Annotated, Any

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
from fastapi import Depends, FastAPI, Header, Path, Query, Request, Response
from fastapi.responses import HTMLResponse, PlainTextResponse
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from starlette.convertors import Convertor, register_url_convertor

import ddakf

from ...auth.principal import Scope, current_principal
from ...info import server_info
from ...observability.metrics import Metrics
from ...sessions.service import Sessions
from ...settings import Settings
from ...store.store import Store
from ..rest import bodies
from .errors import ErrorOut, add_error_handlers, http_error_response
from .history import history_request
from .mesh_routes import add_mesh_routes
from .openapi import binary_body, binary_response, error_responses, json_body, openapi_document
from .pages import documentation
from .pages.dashboard import add_dashboard
from .query import check_query
from .requests import (
    EXAMPLE_ID,
    KEY_VALUES,
    TRIANGLE,
    RestoreSession,
    create_request,
    enum_numbers,
    is_match,
    labels_from,
    reset_request,
    update_request,
)
from .responses import LAST_SEQUENCE_NUMBER, Readiness, answer, answer_of, created

_ASK_WITH_KEY = "the reason is in the log, and in the answer to a key of the scope read"
_OCTETS = "application/octet-stream"

_SNAPSHOT_HEADERS = {LAST_SEQUENCE_NUMBER: "of the last frame in the state; 0: none"}

_SESSION_ERRORS = error_responses(SessionNotFound, SessionExpired, InvalidArgument)
_WORKER_ERRORS = {**_SESSION_ERRORS, **error_responses(WorkerLost)}
_BODY_ERRORS = error_responses(MessageTooLarge, DeadlineExceeded)
_CREATION_ERRORS = error_responses(
    *(VersionMismatch, SessionExists, SessionNotFound, SessionExpired, MessageTooLarge, InvalidArgument),
    *(ResourceExhausted, Draining, DeadlineExceeded),
)


_MATCH_ERRORS = {412: {"model": ErrorOut, "description": f"FailedPrecondition: {FailedPrecondition.__doc__}"}}

STATES = {"items": {"type": "string", "enum": pb.SessionState.keys()}}


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
        openapi_examples=_example(["SESSION_STATE_IDLE", "SESSION_STATE_TRACKING"]),
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
_View = Annotated[
    str,
    Query(description="SESSION_VIEW_BASIC, or SESSION_VIEW_FULL with the meshes", openapi_examples=_example("SESSION_VIEW_FULL")),
]


_IfMatch = Annotated[str | None, Header(description="etags of the session as last read; another present one gets 412")]


def _earlier(name: str, **options: Any) -> Any:
    """A parameter that this version still accepts by an earlier name."""
    return Query(deprecated=True, description=f"earlier name of {name}", **options)


DESCRIPTION = """Garment tracking from point clouds.

Frames travel over gRPC (`ddakf_api.v1.TrackingService/Track`) or over a WebSocket, `/v1/sessions/{session_id}/stream`. A
watcher reads the results at `/v1/sessions/{session_id}/watch`. Both accept `?mode=json` for text frames. JSON is the protobuf
JSON mapping of the contract's messages, in bodies, answers and text frames. An array of a request may also be a list of rows.
All errors have the form `ErrorOut` and the names of the classes that the clients raise."""


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
        dependencies=[Depends(check_query)],
        openapi_url=None,
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    add_error_handlers(app)
    _add_document_routes(app)
    _add_server_routes(app, sessions, settings, metrics, not_ready, store)
    _add_collection_routes(app, sessions, settings)
    _add_session_routes(app, sessions, settings)
    _add_state_routes(app, sessions, settings)
    add_mesh_routes(app, sessions.meshes, settings)
    add_dashboard(app, settings)
    app.openapi = lambda: openapi_document(app)
    return app


def _add_document_routes(app: FastAPI) -> None:
    """The OpenAPI document and its page. The first call makes them in a thread, as that takes a tenth of a second."""

    @functools.cache
    def texts() -> tuple[str, str]:
        document = openapi_document(app)
        return json.dumps(document), documentation.documentation_page(document)

    @app.get("/openapi.json", include_in_schema=False)
    async def openapi_json() -> Response:
        return Response((await asyncio.to_thread(texts))[0], media_type="application/json")

    @app.get(documentation.PATH, include_in_schema=False)
    async def docs() -> Response:
        return HTMLResponse((await asyncio.to_thread(texts))[1])


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

        A failing database or disk makes the server "degraded", not unready: tracking continues. The sentences are for keys of
        the scope read, where keys are needed; others learn which part fails."""
        if reason := not_ready():
            raise Unavailable(reason)
        knows = current_principal.get().allows(Scope.READ)
        problems = [sentence if knows else f"{part}: {_ASK_WITH_KEY}" for part, sentence in store.problems().items()]
        return Readiness(status="degraded" if problems else "ready", problems=problems)

    @app.get("/metrics", tags=["health"], response_class=PlainTextResponse)
    async def metrics_page() -> Response:
        """Prometheus exposition."""
        await store.measure(metrics)
        return Response(generate_latest(metrics.registry), media_type=CONTENT_TYPE_LATEST)

    @app.get("/v1/info", tags=["server"], responses={**answer_of(pb.ServerInfo), **error_responses(InvalidArgument)})
    async def info() -> Response:
        """Versions, codecs and limits."""
        return await answer(server_info(settings, sessions.draining))


def _add_collection_routes(app: FastAPI, sessions: Sessions, settings: Settings) -> None:
    """The standard methods of all sessions."""

    @app.post(
        "/v1/sessions",
        tags=["sessions"],
        status_code=201,
        responses={**answer_of(pb.Session, 201), **_CREATION_ERRORS},
        openapi_extra=json_body(
            pb.CreateSessionRequest,
            named={
                "session": {"garment": TRIANGLE, "fabric": "cotton", "labels": {"scene": "stage"}},
                "session_id": EXAMPLE_ID,
            },
            configured={
                "session": {
                    "garment": TRIANGLE,
                    "config_json": '{"associate": {"wide_gate": 0.3}}',
                    "limits": {"idle_timeout": 60},
                }
            },
        ),
    )
    async def create_session(request: Request) -> Response:
        """Creates a session; frames are then streamed to it over gRPC or a WebSocket."""
        message = await bodies.parse_json(request, settings, create_request)
        return await created(await sessions.create(message))

    @app.get(
        "/v1/sessions", tags=["sessions"], responses={**answer_of(pb.ListSessionsResponse), **error_responses(InvalidArgument)}
    )
    async def list_sessions(
        page_size: _PageSize = 0,
        page_token: Annotated[str, Query(description="next_page_token of the page before")] = "",
        states: _States = [],  # noqa: B006
        labels: _Labels = [],  # noqa: B006
        state: Annotated[list[str], _earlier("states")] = [],  # noqa: B006
        label: Annotated[list[str], _earlier("labels")] = [],  # noqa: B006
    ) -> Response:
        """Lists live sessions, oldest first; with no other states than EXPIRED and CLOSED the ended ones, newest first. Without
        config_json and vertex_map, which a session alone has."""
        numbers = enum_numbers([*states, *state], pb.SessionState.DESCRIPTOR, "states")
        request = pb.ListSessionsRequest(page_size=page_size, page_token=page_token, states=numbers)
        request.labels.update(labels_from([*labels, *label]))
        return await answer(await sessions.list(request))


def _add_session_routes(app: FastAPI, sessions: Sessions, settings: Settings) -> None:
    """The standard methods of one session, and its history."""

    @app.get("/v1/sessions/{session_id:session}", tags=["sessions"], responses={**answer_of(pb.Session), **_SESSION_ERRORS})
    async def get_session(session_id: SessionId, view: _View = "SESSION_VIEW_BASIC") -> Response:
        """State, reliability, coverage, frame rate and drops as of the last frame; with the meshes in the full view."""
        (session_view,) = enum_numbers([view], pb.SessionView.DESCRIPTOR, "view")
        return await answer(await sessions.get(f"sessions/{session_id}", session_view))

    @app.patch(
        "/v1/sessions/{session_id:session}",
        tags=["sessions"],
        responses={
            **answer_of(pb.Session),
            **_WORKER_ERRORS,
            **_BODY_ERRORS,
            **_MATCH_ERRORS,
            **error_responses(FailedPrecondition),
        },
        openapi_extra=json_body(
            pb.UpdateSessionRequest,
            labels={"session": {"labels": {"scene": "stage", "take": "2"}}},
            limits={"session": {"limits": {"idle_timeout": 120}}, "update_mask": "labels,limits"},
            fabric={"session": {"fabric": "silk"}, "update_mask": "labels,fabric"},
        ),
    )
    async def update_session(
        session_id: SessionId,
        request: Request,
        update_mask: Annotated[
            str,
            Query(description="fields, separated by commas; empty: those in the body", openapi_examples=_example("labels")),
        ] = "",
        if_match: _IfMatch = None,
    ) -> Response:
        """Changes labels, limits, configuration and fabric. A field that the mask names and the body lacks is reset to its
        default."""
        name = f"sessions/{session_id}"
        message = await bodies.parse_json(request, settings, lambda body: update_request(body, name, update_mask))
        updated = await sessions.update(message, _accepting(if_match))
        return _unmatched(name, updated, if_match) if isinstance(updated, str) else await answer(updated)

    @app.get(
        "/v1/sessions/{session_id:session}/history",
        tags=["sessions"],
        responses={**answer_of(pb.SessionHistory), **_SESSION_ERRORS, **error_responses(Unavailable)},
    )
    async def get_session_history(
        session_id: SessionId,
        start_time: Annotated[datetime | None, Query(description="without it the session's creation")] = None,
        end_time: Annotated[datetime | None, Query(description="without it now, or the session's end")] = None,
        resolution: Annotated[float, Query(ge=0, lt=2**32, description="seconds per sample; 0: the finest that fits")] = 0,
        max_samples: Annotated[int, Query(ge=0, lt=2**32, description="at most this many; 0: 500; lowered to 10000")] = 0,
        earlier_start: Annotated[datetime | None, _earlier("start_time", alias="from")] = None,
        earlier_end: Annotated[datetime | None, _earlier("end_time", alias="to")] = None,
    ) -> Response:
        """Reliability, coverage, latency, frames by outcome and changes of state over time, of a live or a past session."""
        span = start_time or earlier_start, end_time or earlier_end
        return await answer(await sessions.history(history_request(session_id, *span, resolution, max_samples)))

    @app.delete(
        "/v1/sessions/{session_id:session}", tags=["sessions"], status_code=204, responses={**_SESSION_ERRORS, **_MATCH_ERRORS}
    )
    async def delete_session(session_id: SessionId, if_match: _IfMatch = None) -> Response:
        """Ends a session and its stream."""
        name = f"sessions/{session_id}"
        if (etag := await sessions.delete(name, _accepting(if_match))) is not None:
            return _unmatched(name, etag, if_match)
        return Response(status_code=204)


def _accepting(if_match: str | None) -> Callable[[str], bool] | None:
    """Whether a header If-Match has an etag; None: there is no such header."""
    return None if if_match is None else functools.partial(is_match, if_match)


def _unmatched(name: str, etag: str, if_match: str) -> Response:
    """The answer to a header If-Match without a session's etag."""
    message = f'If-Match: expected "{etag}", the etag of {name}, or *, got {if_match[:80]!r}'
    return http_error_response(HTTPStatus.PRECONDITION_FAILED, message)


def _add_state_routes(app: FastAPI, sessions: Sessions, settings: Settings) -> None:
    """The methods on the tracker of a session."""

    @app.get(
        "/v1/sessions/{session_id:session}/statistics",
        tags=["state"],
        responses={**answer_of(pb.SessionStatistics), **_SESSION_ERRORS},
    )
    async def statistics(session_id: SessionId) -> Response:
        """Counters, and the numbers of the last frame."""
        return await answer((await sessions.get(f"sessions/{session_id}")).statistics)

    @app.post(
        "/v1/sessions/{session_id:session}:reset",
        tags=["state"],
        responses={**answer_of(pb.Session), **_WORKER_ERRORS, **_BODY_ERRORS},
        openapi_extra=json_body(pb.ResetSessionRequest, required=False, rest={}, there={"vertices": TRIANGLE["vertices"]}),
    )
    async def reset_session(session_id: SessionId, request: Request) -> Response:
        """Resets the tracker to given vertices, or without a body to the rest shape."""
        name = f"sessions/{session_id}"
        message = await bodies.parse_json(request, settings, lambda body: reset_request(body, name))
        return await answer(await sessions.reset(message))

    @app.get(
        "/v1/sessions/{session_id:session}/snapshot",
        tags=["state"],
        response_class=Response,
        responses={**_WORKER_ERRORS, **binary_response("the tracker's state, versioned and opaque", _SNAPSHOT_HEADERS)},
    )
    async def snapshot_session(session_id: SessionId) -> Response:
        """The full state of the tracker; a restored tracker's next frame is equal to the bit."""
        snapshot = await sessions.snapshot(f"sessions/{session_id}")
        headers = {
            "Content-Disposition": 'attachment; filename="ddakf.snapshot"',
            LAST_SEQUENCE_NUMBER: str(snapshot.session.statistics.last_sequence_number),
        }
        return Response(snapshot.data, media_type=_OCTETS, headers=headers)

    @app.post(
        "/v1/sessions:restore",
        tags=["state"],
        status_code=201,
        responses={**answer_of(pb.Session, 201), **_CREATION_ERRORS, **error_responses(InvalidSnapshot, InvalidArgument)},
        openapi_extra=binary_body("response of GET /v1/sessions/{session_id}/snapshot, of this server or another"),
    )
    async def restore_session(request: Request, query: Annotated[RestoreSession, Query()]) -> Response:
        """Creates a session from a snapshot."""
        data = await bodies.read(request, settings.max_message_bytes, settings.request_timeout)
        return await created(await sessions.restore(query.to_message(data)))
