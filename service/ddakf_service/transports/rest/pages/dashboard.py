"""Dashboard: the built web page at ``/`` and its assets, the sample that the page can track, and the recording that it shows.

``clients/dashboard`` has the page's source. Its addresses are relative, so that a proxy may serve it under any path.
"""

from __future__ import annotations

import asyncio
import functools
import gzip
import hashlib
from pathlib import Path
from typing import NamedTuple

from ddakf_api.errors import NotFound
from fastapi import FastAPI, Request, Response
from fastapi.responses import FileResponse

from ddakf import data

from ....settings import Settings
from ..openapi import binary_response, error_responses

FOLDER = Path(__file__).parents[3] / "static" / "dashboard"
INDEX = "index.html"
ASSETS = "assets"

POLICY = "; ".join(
    (
        *("default-src 'none'", "script-src 'self'", "style-src 'self'", "img-src 'self' data: blob:", "connect-src 'self'"),
        *("worker-src 'self'", "base-uri 'none'", "form-action 'none'", "frame-ancestors 'none'"),
    )
)
"""Content-Security-Policy of the page: its own scripts and styles, and calls of its own server."""

_ASK_AGAIN = "no-cache"  # a cached copy is used only after the server has confirmed it
_FOREVER = "public, max-age=31536000, immutable"  # the names of assets change with their content
_TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".txt": "text/plain; charset=utf-8",
}
_OCTETS = "application/octet-stream"


class File(NamedTuple):
    """A file as it is sent."""

    content: bytes
    compressed: bytes
    media_type: str
    etag: str


def add_dashboard(app: FastAPI, settings: Settings) -> None:
    """The routes ``/``, ``/assets/{name}``, ``/v1/sample`` and ``/v1/recording``."""

    @app.get("/", include_in_schema=False)
    async def page(request: Request) -> Response:
        return await _sent(request, INDEX, _ASK_AGAIN)

    @app.get("/assets/{name}", include_in_schema=False)
    async def asset(request: Request, name: str) -> Response:
        return await _sent(request, f"{ASSETS}/{name}", _FOREVER)

    @app.get("/v1/sample", tags=["server"], response_class=Response, responses=binary_response("the recording"))
    async def sample(request: Request) -> Response:
        """The bundled recording of a garment and a body in motion, an NPZ archive; ddakf/data/README.md has its arrays."""
        file = await asyncio.to_thread(sample_file)
        headers = {"ETag": file.etag, "Cache-Control": _ASK_AGAIN}
        if _is_current(request, file):
            return Response(status_code=304, headers=headers)
        return Response(file.content, media_type=file.media_type, headers=headers)

    @app.get(
        "/v1/recording",
        tags=["server"],
        response_class=Response,
        responses={**binary_response("the file"), **error_responses(NotFound)},
    )
    async def recording() -> Response:
        """The recording or result that the setting ``recording`` names, for ``ddakf view``."""
        if not settings.recording:
            raise NotFound("the server was started without a recording")
        path = Path(settings.recording)
        return FileResponse(path, media_type=_OCTETS, filename=path.name, headers={"Cache-Control": _ASK_AGAIN})


@functools.cache
def files() -> dict[str, File]:
    """The files of the built page by their path; empty where it was not built."""
    paths = (path for path in FOLDER.rglob("*") if path.suffix in _TYPES)
    return {path.relative_to(FOLDER).as_posix(): _file(path.read_bytes(), _TYPES[path.suffix]) for path in paths}


@functools.cache
def sample_file() -> File:
    """The sample recording, which is compressed already."""
    content = data.SAMPLE.read_bytes()
    return File(content, content, _OCTETS, _etag(content))


async def _sent(request: Request, name: str, caching: str) -> Response:
    file = (await asyncio.to_thread(files)).get(name)
    if file is None:
        raise NotFound(f"there is no {request.url.path[:80]!r}")
    headers = {"ETag": file.etag, "Cache-Control": caching, "Content-Security-Policy": POLICY, "Vary": "Accept-Encoding"}
    if _is_current(request, file):
        return Response(status_code=304, headers=headers)
    if "gzip" in request.headers.get("accept-encoding", ""):
        return Response(file.compressed, media_type=file.media_type, headers=headers | {"Content-Encoding": "gzip"})
    return Response(file.content, media_type=file.media_type, headers=headers)


def _is_current(request: Request, file: File) -> bool:
    """Whether the client has this file already; a proxy that compresses marks the tag as weak."""
    tags = request.headers.get("if-none-match", "").split(",")
    return file.etag in (tag.strip().removeprefix("W/") for tag in tags)


def _file(content: bytes, media_type: str) -> File:
    return File(content, gzip.compress(content, 9, mtime=0), media_type, _etag(content))


def _etag(content: bytes) -> str:
    return f'"{hashlib.sha256(content).hexdigest()[:20]}"'
