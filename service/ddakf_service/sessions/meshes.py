"""Meshes: uploads of meshes, and their use by name in new sessions."""

from __future__ import annotations

import asyncio
import re
import time

from ddakf_api.arrays import unpack_mesh
from ddakf_api.errors import InvalidArgument, InvalidMesh, NotFound, ResourceExhausted, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.version import require_compatible

from ..auth.principal import Scope, current_principal
from ..background_tasks import BackgroundTasks
from ..settings import Settings
from ..store.meshes import ID_DIGITS, MeshContent, MeshRecord, MeshStore, mesh_of
from .page_token import Position, page_size, page_token, position_after

_MOST_WAITING = 8  # uploads that are being stored: a store that does not answer keeps their content in memory
_RETRY_AFTER = 5.0  # seconds
_NAME = re.compile(rf"meshes/([0-9a-f]{{{ID_DIGITS}}})")


class Meshes:
    """The uploaded meshes that the caller's key owns; a key with the scope ``admin`` reads and deletes those of all keys."""

    def __init__(self, store: MeshStore, settings: Settings):
        self._store, self._settings = store, settings
        self._storing = asyncio.Lock()  # the quota counts what another call is about to store
        self._tasks = BackgroundTasks()

    async def create(self, request: pb.CreateMeshRequest) -> pb.StoredMesh:
        """Stores a mesh for the caller's key, or returns the one of the same content.

        Raises:
            InvalidMesh: larger than any garment or body may be, or no mesh. ResourceExhausted: beyond a quota of the key.
            Unavailable: the store cannot be reached, or many uploads wait for it.
        """
        require_compatible(request.api_version, peer="client")
        if len(self._tasks) >= _MOST_WAITING:
            raise Unavailable("meshes: other uploads wait for the store, try again later", retry_after=_RETRY_AFTER)
        content, owner = await asyncio.to_thread(self._content, request), current_principal.get().id
        storing = self._tasks.start(self._stored(content, owner))
        try:
            return _message(await asyncio.shield(storing))  # of a caller who leaves no content stays without its row
        finally:
            del storing  # the traceback of its error refers to this Python frame: a reference cycle

    async def _stored(self, content: MeshContent, owner: str) -> MeshRecord:
        async with self._storing:
            owned = await self._store.find(owner)
            record = next((mesh for mesh in owned if mesh.id == content.id), None)
            if record is not None:
                await self._store.replace(record, content.data)  # which may be damaged
                return record
            self._require_room(owned, len(content.data))
            record = MeshRecord(content.id, owner, *content.counts, len(content.data), time.time())
            await self._store.add(record, content.data)
            return record

    def _content(self, request: pb.CreateMeshRequest) -> MeshContent:
        s = self._settings
        if not request.HasField("mesh"):
            raise InvalidMesh(field="mesh", expected="a mesh", got="nothing")
        max_vertices = max(s.max_vertices, s.max_body_vertices)
        vertices, faces = unpack_mesh(request.mesh, field="mesh", max_vertices=max_vertices, max_faces=s.max_faces)
        if faces.size and faces.max() >= len(vertices):
            expected = f"indices below {len(vertices)}, the number of vertices"
            raise InvalidMesh(field="mesh.faces", expected=expected, got=str(faces.max()))
        return MeshContent((vertices, faces))

    def _require_room(self, owned: list[MeshRecord], size: int) -> None:
        s = self._settings
        for quantity, used, maximum in (
            ("meshes", len(owned) + 1, s.max_meshes_per_key),
            ("bytes", sum(record.size for record in owned) + size, s.max_mesh_bytes_per_key),
        ):
            if used > maximum:
                raise ResourceExhausted(f"meshes: the key may store {maximum} {quantity}, this would make {used}; delete one")

    async def get(self, request: pb.GetMeshRequest) -> pb.StoredMesh:
        """A mesh of the caller, with its content on request."""
        record, *_ = await self._readable("name", request.name)
        return _message(record, await self._read("name", record) if request.include_mesh else None)

    async def list(self, request: pb.ListMeshesRequest) -> pb.ListMeshesResponse:
        """One page of the caller's meshes, oldest first; the token identifies the last mesh of the previous page."""
        after = position_after(request)
        size = page_size(request)
        records = [r for r in await self._store.find(_owner()) if _position(r) > after]
        more = page_token(request, _position(records[size - 1])) if len(records) > size else ""
        return pb.ListMeshesResponse(meshes=[_message(record) for record in records[:size]], next_page_token=more)

    async def delete(self, name: str) -> None:
        """Deletes a mesh, for ``admin`` that of every key; sessions have copies."""
        async with self._storing:  # an upload of the same mesh would lose its content
            for record in await self._readable("name", name):
                await self._store.remove(record)

    async def resolve(self, session: pb.Session) -> None:
        """Replaces the names of meshes in a new session by the meshes.

        Raises:
            NotFound: the caller has no mesh of this name. InvalidArgument: no name of a mesh, or a mesh beside the name.
        """
        for field, target in (("garment_mesh", "garment"), ("body_mesh", "body")):
            if not (name := getattr(session, field)):
                continue
            if session.HasField(target):
                raise InvalidArgument(field=field, expected=f"nothing beside {target}", got=repr(name[:80]))
            record, *_ = await self._readable(field, name)
            getattr(session, target).CopyFrom(await self._read(field, record))
            session.ClearField(field)

    async def _readable(self, field: str, name: str) -> list[MeshRecord]:
        """The meshes of a name that the caller may read, at least one."""
        if (matched := _NAME.fullmatch(name)) is None:
            expected = f"meshes/ and {ID_DIGITS} hexadecimal digits, as CreateMesh answers"
            raise InvalidArgument(field=field, expected=expected, got=repr(name[:80]))
        if not (records := await self._store.find(_owner(), matched[1])):
            raise _not_found(field, name)
        return records

    async def _read(self, field: str, record: MeshRecord) -> pb.Mesh:
        if (data := await self._store.content(record)) is None:
            raise _not_found(field, f"meshes/{record.id}")
        return mesh_of(data)


def _owner() -> str | None:
    """The key whose meshes the caller reads; None: all keys'."""
    principal = current_principal.get()
    return None if Scope.ADMIN in principal.scopes else principal.id


def _not_found(field: str, name: str) -> NotFound:
    return NotFound(f"{field}: there is no {name}; upload it with CreateMesh", field=field)


def _message(record: MeshRecord, mesh: pb.Mesh | None = None) -> pb.StoredMesh:
    message = pb.StoredMesh(
        name=f"meshes/{record.id}",
        vertex_count=record.vertex_count,
        face_count=record.face_count,
        bytes=record.size,
        mesh=mesh,
    )
    message.create_time.FromNanoseconds(int(record.create_time * 1e9))
    return message


def _position(record: MeshRecord) -> Position:
    return Position(int(record.create_time * 1e6), f"{record.id}-{record.owner}")
