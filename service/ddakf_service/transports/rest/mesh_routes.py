"""REST routes of meshes: uploads, and what the caller's key has uploaded."""

from __future__ import annotations

from typing import Annotated

from ddakf_api import API_VERSION
from ddakf_api.errors import (
    DeadlineExceeded,
    InvalidArgument,
    InvalidMesh,
    MessageTooLarge,
    NotFound,
    ResourceExhausted,
    Unavailable,
    VersionMismatch,
)
from ddakf_api.v1 import tracking_pb2 as pb
from fastapi import FastAPI, Path, Query, Request, Response

from ...sessions.meshes import Meshes
from ...settings import Settings
from ..dialect.reading import read
from ..rest import bodies
from .openapi import error_responses, json_body
from .requests import TRIANGLE
from .responses import answer, answer_of, created

EXAMPLE_MESH_ID = "6699ae6b2e8ccd4ce2e3a61a0288ec45"  # of the mesh that the example of the creation uploads
MeshId = Annotated[str, Path(description="of meshes/{mesh_id}", openapi_examples={"example": {"value": EXAMPLE_MESH_ID}})]
_ERRORS = error_responses(NotFound, InvalidArgument, Unavailable)
_CREATION_ERRORS = error_responses(
    *(VersionMismatch, MessageTooLarge, InvalidMesh, InvalidArgument, ResourceExhausted, DeadlineExceeded, Unavailable)
)


def add_mesh_routes(app: FastAPI, meshes: Meshes, settings: Settings) -> None:
    """The methods of ``/v1/meshes``."""

    @app.post(
        "/v1/meshes",
        tags=["meshes"],
        status_code=201,
        responses={**answer_of(pb.StoredMesh, 201), **_CREATION_ERRORS},
        openapi_extra=json_body(pb.CreateMeshRequest, triangle={"mesh": TRIANGLE}),
    )
    async def create_mesh(request: Request) -> Response:
        """Uploads a mesh, for any number of sessions. The same content has the same name."""
        message = await bodies.parse_json(request, settings, lambda body: read(body, pb.CreateMeshRequest))
        message.api_version = message.api_version or API_VERSION
        return await created(await meshes.create(message))

    @app.get(
        "/v1/meshes",
        tags=["meshes"],
        responses={**answer_of(pb.ListMeshesResponse), **error_responses(InvalidArgument, Unavailable)},
    )
    async def list_meshes(
        page_size: Annotated[int, Query(ge=0, le=2**31, description="at most this many; 0: 50; lowered to 1000")] = 0,
        page_token: Annotated[str, Query(description="next_page_token of the page before")] = "",
    ) -> Response:
        """Lists the meshes of the key, oldest first."""
        return await answer(await meshes.list(pb.ListMeshesRequest(page_size=page_size, page_token=page_token)))

    @app.get("/v1/meshes/{mesh_id}", tags=["meshes"], responses={**answer_of(pb.StoredMesh), **_ERRORS})
    async def get_mesh(
        mesh_id: MeshId, include_mesh: Annotated[bool, Query(description="answer the mesh itself too")] = False
    ) -> Response:
        """Number of vertices and faces, bytes and time of the upload."""
        request = pb.GetMeshRequest(name=f"meshes/{mesh_id}", include_mesh=include_mesh)
        return await answer(await meshes.get(request))

    @app.delete("/v1/meshes/{mesh_id}", tags=["meshes"], status_code=204, responses=_ERRORS)
    async def delete_mesh(mesh_id: MeshId) -> None:
        """Deletes a mesh. Sessions that use it have their own copy."""
        await meshes.delete(f"meshes/{mesh_id}")
