"""Meshes: uploaded meshes of the keys, their rows in the database and their content in files or objects.

The id of a mesh is the beginning of the SHA-256 of its content, so that equal meshes have one name. Each key has its own rows
and objects: no key learns what another has, or loses what another deletes.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import logging
import struct
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import sqlalchemy as sa
from ddakf_api.errors import Unavailable
from ddakf_api.v1 import tracking_pb2 as pb
from fsspec.implementations.local import LocalFileSystem

from .files.object_store import file_system, reaching_store
from .files.permissions import make_folder
from .files.written_file import write_atomically
from .tables.database import Database
from .tables.schema import meshes

log = logging.getLogger(__name__)

ID_DIGITS = 32  # hexadecimal; of 128 bits
_SIZES = struct.Struct("<QQ")  # vertices, faces
_SUFFIX = ".mesh"
_ANONYMOUS = "anonymous"  # folder of the meshes of callers without a key
_THREADS = 4
_RETRY_AFTER = 5.0  # seconds


@dataclass(frozen=True)
class MeshRecord:
    """An uploaded mesh.

    Attributes:
        id: as of :class:`MeshContent`.
        owner: id of the key; empty: no key was needed.
        size: of the content, bytes.
        create_time: seconds since 1970.
    """

    id: str
    owner: str
    vertex_count: int
    face_count: int
    size: int
    create_time: float


class MeshContent:
    """A mesh in the form that is stored: float64 vertices and uint32 indices, whichever encoding was sent.

    Args:
        mesh: (V, 3) vertices and (F, 3) indices.

    Attributes:
        counts: of vertices and faces. id: see the module.
    """

    def __init__(self, mesh: tuple[np.ndarray, np.ndarray]):
        vertices, faces = mesh
        self.counts = len(vertices), len(faces)
        self.data = _SIZES.pack(*self.counts) + vertices.astype("<f8").tobytes() + faces.astype("<u4").tobytes()
        self.id = _id_of(self.data)


def mesh_of(data: bytes) -> pb.Mesh:
    """The mesh of a stored content."""
    count, _ = _SIZES.unpack_from(data)
    end = _SIZES.size + 24 * count
    return pb.Mesh(
        vertices=pb.PackedArray(encoding=pb.ARRAY_ENCODING_FLOAT64, data=data[_SIZES.size : end]),
        faces=pb.PackedArray(encoding=pb.ARRAY_ENCODING_UINT32, data=data[end:]),
    )


class MeshStore:
    """Rows of meshes in the database, contents through fsspec. Only coroutines wait.

    Args:
        url: folder of the contents for fsspec.
    """

    def __init__(self, database: Database, url: str):
        self._database = database
        self._files, root = file_system(url)
        self._root = root.rstrip("/")
        self._local = isinstance(self._files, LocalFileSystem)
        # A pool of its own: an unreachable store must not occupy the shared threads.
        self._threads = ThreadPoolExecutor(_THREADS, "meshes")

    async def find(self, owner: str | None, mesh_id: str | None = None) -> list[MeshRecord]:
        """Meshes, oldest first: of one owner unless it is None, of one content unless ``mesh_id`` is None.

        Raises:
            Unavailable: the database cannot be reached.
        """
        query = sa.select(meshes).order_by(meshes.c.create_time, meshes.c.id, meshes.c.owner)
        query = query if owner is None else query.where(meshes.c.owner == owner)
        query = query if mesh_id is None else query.where(meshes.c.id == mesh_id)
        return await self._database.read(lambda c: [_record(row) for row in c.execute(query)])

    async def add(self, record: MeshRecord, data: bytes) -> None:
        """Stores a new mesh: first its content, so that no row lacks one. Raises ``Unavailable``."""
        await self.replace(record, data)
        values = {column.name: getattr(record, column.name) for column in meshes.columns}
        try:
            await self._database.read(lambda c: c.execute(self._database.upsert(meshes).values(values)))
        except BaseException:
            with contextlib.suppress(Unavailable):
                await self._remove_content(record)
            raise

    async def replace(self, record: MeshRecord, data: bytes) -> None:
        """Writes the content of a mesh once more. Raises ``Unavailable``."""
        await self._in_thread(self._write, self._path(record.owner, record.id), data)

    async def content(self, record: MeshRecord) -> bytes | None:
        """The stored content; None: it was deleted meanwhile, or is damaged. Raises ``Unavailable``."""
        with contextlib.suppress(FileNotFoundError):
            data = await self._in_thread(self._files.cat_file, self._path(record.owner, record.id))
            if _id_of(data) == record.id:
                return data
            log.error("a damaged mesh is not used", extra={"mesh": record.id})
        return None

    async def remove(self, record: MeshRecord) -> None:
        """Removes the row, then the content. Raises ``Unavailable``."""
        change = sa.delete(meshes).where(meshes.c.id == record.id, meshes.c.owner == record.owner)
        await self._database.read(lambda c: c.execute(change))
        await self._remove_content(record)

    async def _remove_content(self, record: MeshRecord) -> None:
        with contextlib.suppress(FileNotFoundError):
            await self._in_thread(self._files.rm_file, self._path(record.owner, record.id))

    def close(self) -> None:
        self._threads.shutdown(wait=False, cancel_futures=True)

    async def _in_thread(self, call, *arguments):
        def reach():
            with reaching_store():
                return call(*arguments)

        try:
            return await asyncio.get_running_loop().run_in_executor(self._threads, reach)
        except FileNotFoundError:
            raise
        except OSError as error:
            message = f"the meshes cannot be reached or written: {error}; try again later"
            raise Unavailable(message, retry_after=_RETRY_AFTER) from error

    def _write(self, path: str, data: bytes) -> None:
        if self._local:
            make_folder(Path(path).parent)
            write_atomically(path, data)
        else:
            self._files.pipe_file(path, data)

    def _path(self, owner: str, mesh_id: str) -> str:
        return f"{self._root}/{owner or _ANONYMOUS}/{mesh_id}{_SUFFIX}"


def _id_of(data: bytes) -> str:
    return hashlib.sha256(data).hexdigest()[:ID_DIGITS]


def _record(row: sa.Row) -> MeshRecord:
    return MeshRecord(row.id, row.owner, row.vertex_count, row.face_count, row.size, row.create_time)
