"""Uploaded meshes: one name for one content, used in sessions over every transport, within the quotas of their key."""

from __future__ import annotations

import asyncio
import json

import numpy as np
import pytest
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack, pack_mesh, unpack_mesh
from ddakf_api.errors import InvalidArgument, InvalidMesh, NotFound, ResourceExhausted, Unavailable, VersionMismatch
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame, aconnect, connect
from ddakf_service.observability.metrics import Metrics
from ddakf_service.sessions.meshes import Meshes
from ddakf_service.settings import Settings
from ddakf_service.store.store import Store

from ..conftest import TIMEOUT, Api, frame_of, make_sheet, request_of, running


def create_mesh(mesh: pb.Mesh) -> pb.CreateMeshRequest:
    return pb.CreateMeshRequest(api_version=API_VERSION, mesh=mesh)


@pytest.fixture
def uploaded(api, sheet):
    """The name of the sheet."""
    name = api.call("CreateMesh", create_mesh(pack_mesh(*sheet))).name
    yield name
    api.call("DeleteMesh", pb.DeleteMeshRequest(name=name))


def test_the_same_content_has_the_same_name_and_place(api, sheet, uploaded):
    vertices = np.round(sheet.vertices * 1024) / 1024  # float32 holds them
    single = pb.Mesh(vertices=pack(vertices), faces=pack_mesh(*sheet).faces)
    first, again, other = (
        api.call("CreateMesh", create_mesh(mesh)) for mesh in (single, pack_mesh(vertices, sheet.faces), pack_mesh(*sheet))
    )
    assert first == again
    assert other.name == uploaded != first.name
    assert (first.vertex_count, first.face_count) == (len(vertices), len(sheet.faces))
    assert first.bytes >= 24 * len(vertices) + 12 * len(sheet.faces)
    full = api.call("GetMesh", pb.GetMeshRequest(name=first.name, include_mesh=True))
    back = unpack_mesh(full.mesh, field="mesh", max_vertices=10**6, max_faces=10**6)
    assert all(np.array_equal(a, b) for a, b in zip(back, (vertices, sheet.faces), strict=True))
    full.ClearField("mesh")
    assert full == api.call("GetMesh", pb.GetMeshRequest(name=first.name)) == first
    api.call("DeleteMesh", pb.DeleteMeshRequest(name=first.name))
    with pytest.raises(NotFound, match=f"there is no {first.name}"):
        api.call("GetMesh", pb.GetMeshRequest(name=first.name))


def test_sessions_by_name_are_sessions_by_mesh(client, http, api, sheet):
    """The same results over gRPC and REST; the deletion of the mesh leaves its sessions."""
    name = client.upload_mesh(*sheet)
    assert name in {mesh.name for mesh in client.meshes()}
    body = {"session": {"garment_mesh": name, "body_mesh": name}}
    over_rest = http.post("/v1/sessions", json=body)
    assert over_rest.status_code == 201, over_rest.text
    assert over_rest.json()["body_vertex_count"] == len(sheet.vertices)
    answers = []
    for garment in (name, sheet):
        with client.create_session(garment, body=name, flow="lossless") as session:
            client.upload_mesh(*sheet)
            client.delete_mesh(name)
            frame = Frame(sheet.vertices, 0.1, (0.0, 0.0, 3.0))
            answers.append([result.vertices.tobytes() for result in session.track([frame])])
            full = api.call("GetSession", pb.GetSessionRequest(name=session.name, view=pb.SESSION_VIEW_FULL))
            assert full.garment == full.body == pack_mesh(*sheet)
            assert not full.garment_mesh
        client.upload_mesh(*sheet)
    assert answers[0] == answers[1]
    client.delete_mesh(name)
    with pytest.raises(NotFound, match=f"garment_mesh: there is no {name}; upload it"):
        client.create_session(name)
    http.delete("/v1/" + over_rest.json()["name"])


async def test_the_asynchronous_client_uploads(service, sheet):
    async with aconnect(service.grpc) as client:
        name = await client.upload_mesh(*sheet)
        async with client.create_session(name) as session:
            assert (await session.info()).n_vertices == len(sheet.vertices)
        assert name in [mesh.name async for mesh in client.meshes()]
        await client.delete_mesh(name)


def test_rest_speaks_of_meshes_as_grpc_does(http, api, sheet):
    rows = {"vertices": sheet.vertices.tolist(), "faces": sheet.faces.tolist()}
    created = http.post("/v1/meshes", json={"mesh": rows})
    assert created.status_code == 201
    name = created.json()["name"]
    assert created.headers["location"] == f"/v1/{name}"
    assert name == api.call("CreateMesh", create_mesh(pack_mesh(*sheet))).name
    assert http.get(f"/v1/{name}").json() == created.json()
    assert "mesh" in http.get(f"/v1/{name}", params={"include_mesh": True}).json()
    assert name in [mesh["name"] for mesh in http.get("/v1/meshes").json()["meshes"]]
    assert http.delete(f"/v1/{name}").status_code == 204
    missing = http.delete(f"/v1/{name}")
    assert (missing.status_code, missing.json()["error"]["name"]) == (404, "NotFound")


def test_meshes_are_listed_by_pages_in_order(api):
    names = [api.call("CreateMesh", create_mesh(pack_mesh(*make_sheet(n)))).name for n in (5, 6, 7)]
    found, token = [], ""
    while True:
        page = api.call("ListMeshes", pb.ListMeshesRequest(page_size=2, page_token=token))
        assert len(page.meshes) <= 2
        found += [mesh.name for mesh in page.meshes if mesh.name in names]
        if not (token := page.next_page_token):
            break
    assert found == names
    with pytest.raises(InvalidArgument, match="page_token: expected next_page_token of the page before, got 'garbage'"):
        api.call("ListMeshes", pb.ListMeshesRequest(page_token="garbage"))
    for name in names:
        api.call("DeleteMesh", pb.DeleteMeshRequest(name=name))


def test_a_bad_mesh_or_name_is_refused(api, sheet):
    mesh = pack_mesh(*sheet)
    halved = pb.Mesh(vertices=pb.PackedArray(encoding=mesh.vertices.encoding, data=mesh.vertices.data[:-24]), faces=mesh.faces)
    uneven = pb.Mesh(vertices=pb.PackedArray(encoding=mesh.vertices.encoding, data=b"123"), faces=mesh.faces)
    for bad, field in ((None, "mesh"), (halved, "mesh.faces"), (uneven, "mesh.vertices.data")):
        with pytest.raises(InvalidMesh) as refused:
            api.call("CreateMesh", create_mesh(bad))
        assert refused.value.field == field
    with pytest.raises(VersionMismatch, match="api_version"):
        api.call("CreateMesh", pb.CreateMeshRequest(mesh=mesh))
    for name in ("meshes/../../etc/passwd", "shirt", "meshes/" + "0" * 31):
        with pytest.raises(InvalidArgument, match="name: expected meshes/ and 32 hexadecimal digits"):
            api.call("GetMesh", pb.GetMeshRequest(name=name))
    both = pb.Session(garment=mesh, garment_mesh="meshes/" + "0" * 32)
    with pytest.raises(InvalidArgument, match="garment_mesh: expected nothing beside garment"):
        api.call("CreateSession", pb.CreateSessionRequest(api_version="1.0", session=both))
    with pytest.raises(InvalidArgument, match="body_mesh: expected meshes/"):
        api.call("CreateSession", pb.CreateSessionRequest(api_version="1.0", session={"garment": mesh, "body_mesh": "x"}))


@pytest.fixture(scope="module")
def frugal(tmp_path_factory):
    folder = tmp_path_factory.mktemp("frugal")
    arguments = ["--workers", "1", "--spare-workers", "0", "--data-dir", str(folder / "data")]
    quotas = ["--max-meshes-per-key", "2", "--max-mesh-bytes-per-key", "10000", "--max-vertices", "300"]
    with running([*arguments, *quotas, "--max-body-vertices", "300"], folder) as service:
        yield service, folder / "data" / "meshes"


def test_uploads_have_quotas_in_number_and_bytes(frugal):
    service, folder = frugal
    with connect(service.grpc, timeout=TIMEOUT) as client:
        names = [client.upload_mesh(*make_sheet(n)) for n in (5, 6)]
        assert client.upload_mesh(*make_sheet(5)) == names[0]  # no third one
        with pytest.raises(ResourceExhausted, match="may store 2 meshes, this would make 3; delete one"):
            client.upload_mesh(*make_sheet(7))
        client.delete_mesh(names[0])
        with pytest.raises(ResourceExhausted, match="10000 bytes"):
            client.upload_mesh(*make_sheet(17))
        with pytest.raises(InvalidMesh, match=r"mesh\.vertices: expected at most 300 items"):
            client.upload_mesh(*make_sheet(18))
        files = [path.stem for path in folder.rglob("*") if path.is_file()]
        assert [f"meshes/{stem}" for stem in files] == names[1:]
        client.delete_mesh(names[1])


def test_a_damaged_content_is_not_used_and_can_be_uploaded_again(frugal):
    service, folder = frugal
    with connect(service.grpc, timeout=TIMEOUT) as client:
        name = client.upload_mesh(*make_sheet(8))
        (file,) = (path for path in folder.rglob("*.mesh"))
        assert file.stat().st_mode & 0o77 == 0
        file.write_bytes(b"\0" * 100)
        with pytest.raises(NotFound, match="upload it"):
            client.create_session(name)
        assert client.upload_mesh(*make_sheet(8)) == name
        with client.create_session(name) as session:
            assert session.info().n_vertices == 64
        client.delete_mesh(name)


def test_a_repeated_creation_needs_its_mesh_no_more(api, sheet):
    stored = api.call("CreateMesh", create_mesh(pack_mesh(*sheet))).name
    request = pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment_mesh=stored), request_id="by-mesh")
    name = api.call("CreateSession", request).name
    api.call("DeleteMesh", pb.DeleteMeshRequest(name=stored))
    assert api.call("CreateSession", request).name == name
    api.delete(name)


async def test_a_mesh_that_is_uploaded_while_it_is_deleted_has_its_content(sheet, tmp_path, monkeypatch):
    store = Store(Settings(data_dir=str(tmp_path)), Metrics())
    meshes, request, remove = Meshes(store.meshes, Settings()), create_mesh(pack_mesh(*sheet)), store.meshes.remove

    async def slowly(record):
        await remove(record)
        await asyncio.sleep(0.1)

    monkeypatch.setattr(store.meshes, "remove", slowly)
    name = (await meshes.create(request)).name
    await asyncio.gather(meshes.delete(name), meshes.create(request))
    assert (await meshes.get(pb.GetMeshRequest(name=name, include_mesh=True))).mesh == request.mesh
    await asyncio.to_thread(store.close)


@pytest.fixture
async def small_store(tmp_path):
    """The meshes of a server, and the folder of their contents."""
    store = Store(Settings(data_dir=str(tmp_path)), Metrics())
    yield Meshes(store.meshes, Settings()), tmp_path
    await asyncio.to_thread(store.close)


@pytest.mark.parametrize("pause", [0.0, 0.001, 0.003, 0.01, 0.03])
async def test_an_upload_whose_caller_leaves_has_a_row_if_it_has_a_content(small_store, pause):
    """A content without a row would be outside the quota for ever."""
    meshes, folder = small_store
    upload = asyncio.create_task(meshes.create(create_mesh(pack_mesh(*make_sheet(60, 0.01)))))
    await asyncio.sleep(pause)
    upload.cancel()
    await asyncio.wait({upload})
    await meshes._tasks.settle(TIMEOUT)
    listed = (await meshes.list(pb.ListMeshesRequest())).meshes
    assert len(listed) == len(list(folder.rglob("*.mesh")))


async def test_uploads_into_a_store_that_does_not_answer_are_bounded(small_store, monkeypatch):
    meshes, _ = small_store
    answers = asyncio.Event()

    async def waits(record, data):
        await answers.wait()

    monkeypatch.setattr(meshes._store, "add", waits)
    for size in range(8):
        with pytest.raises(TimeoutError):
            await asyncio.wait_for(meshes.create(create_mesh(pack_mesh(*make_sheet(4 + size)))), 0.05)
    with pytest.raises(Unavailable, match="other uploads wait for the store, try again later"):
        await meshes.create(create_mesh(pack_mesh(*make_sheet(20))))
    answers.set()
    await meshes._tasks.settle(TIMEOUT)
    await meshes.create(create_mesh(pack_mesh(*make_sheet(20))))


async def test_an_upload_that_finds_no_database_leaves_no_content(small_store, sheet, monkeypatch):
    meshes, folder = small_store
    read, calls = meshes._store._database.read, []

    async def only_once(query):
        calls.append(query)
        if len(calls) > 1:
            raise Unavailable("no database")
        return await read(query)

    monkeypatch.setattr(meshes._store._database, "read", only_once)
    with pytest.raises(Unavailable):
        await meshes.create(create_mesh(pack_mesh(*sheet)))
    assert len(calls) == 2
    assert list(folder.rglob("*.mesh")) == []


@pytest.mark.slow
def test_meshes_outlive_the_server(tmp_path, sheet):
    arguments = ["--workers", "1", "--spare-workers", "0", "--data-dir", str(tmp_path / "data")]
    with running(arguments, tmp_path) as service, connect(service.grpc, timeout=TIMEOUT) as client:
        name = client.upload_mesh(*sheet)
    with running(arguments, tmp_path) as service:
        api = Api(service.grpc)
        session = pb.Session(garment_mesh=name)
        created = api.call("CreateSession", pb.CreateSessionRequest(api_version="1.0", session=session))
        assert json.loads(created.config_json)
        assert list(api.track(created.name, [request_of(frame_of(sheet, 1))]))[-1].result.coverage > 0.9
        api.channel.close()
