"""Ownership: a session belongs to the key that created it; other keys learn nothing of it."""

from __future__ import annotations

import contextlib
import threading
import time

import grpc
import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import NotFound, ResourceExhausted, SessionNotFound
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import connect
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect as websocket

from ..conftest import TIMEOUT, eventually, make_sheet
from .conftest import As

pytestmark = pytest.mark.slow


def test_a_session_belongs_to_its_key(guarded):
    mine, other, reader, admin = (As(guarded, key) for key in ("stream", "other", "read", "admin"))
    name = mine.create(request_id="same").name
    theirs = other.create(request_id="same").name
    assert theirs != name, "a request id is its key's own"
    assert (mine.names(), other.names()) == ({name}, {theirs})
    assert reader.names() == admin.names() == {name, theirs}
    assert reader.GetSession(pb.GetSessionRequest(name=name)).name == name
    watching = pb.WatchSessionRequest(name=name, api_version=API_VERSION)
    assert reader.WatchSession(watching).started.name == name
    start = pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION))
    for call in (
        lambda: other.GetSession(pb.GetSessionRequest(name=name)),
        lambda: other.WatchSession(watching),
        lambda: other.UpdateSession(pb.UpdateSessionRequest(session=pb.Session(name=name, labels={"a": "b"}))),
        lambda: other.ResetSession(pb.ResetSessionRequest(name=name)),
        lambda: other.SnapshotSession(pb.SnapshotSessionRequest(name=name)),
        lambda: other.GetSessionHistory(pb.GetSessionHistoryRequest(name=name)),
        lambda: other.Track(iter([start])),
        lambda: other.DeleteSession(pb.DeleteSessionRequest(name=name)),
    ):
        with pytest.raises(SessionNotFound, match="no session"):
            call()
    assert mine.Track(iter([start])).started.name == name
    admin.DeleteSession(pb.DeleteSessionRequest(name=name))
    other.DeleteSession(pb.DeleteSessionRequest(name=theirs))


def test_a_mesh_belongs_to_its_key(guarded):
    mine, other, admin = (As(guarded, key) for key in ("stream", "other", "admin"))
    upload = pb.CreateMeshRequest(api_version=API_VERSION, mesh=pack_mesh(*make_sheet(4)))
    name = mine.CreateMesh(upload).name
    by_name = pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment_mesh=name))
    for call in (
        lambda: other.GetMesh(pb.GetMeshRequest(name=name)),
        lambda: other.DeleteMesh(pb.DeleteMeshRequest(name=name)),
        lambda: other.CreateSession(by_name),
    ):
        with pytest.raises(NotFound, match="there is no meshes/"):
            call()
    assert not other.ListMeshes(pb.ListMeshesRequest()).meshes
    assert admin.GetMesh(pb.GetMeshRequest(name=name)).name == name
    assert other.CreateMesh(upload).name == name, "the same content has the same name"
    other.DeleteMesh(pb.DeleteMeshRequest(name=name))
    mine.DeleteSession(pb.DeleteSessionRequest(name=mine.CreateSession(by_name).name))
    assert [mesh.name for mesh in mine.ListMeshes(pb.ListMeshesRequest()).meshes] == [name]
    admin.DeleteMesh(pb.DeleteMeshRequest(name=name))
    assert not mine.ListMeshes(pb.ListMeshesRequest()).meshes


def test_a_key_has_as_many_sessions_as_it_may(guarded):
    other, mine = As(guarded, "other"), As(guarded, "stream")
    first = other.create().name
    with pytest.raises(ResourceExhausted, match="the key has its 1 already") as caught:
        other.create()
    assert caught.value.retry_after > 0
    second = mine.create().name
    other.DeleteSession(pb.DeleteSessionRequest(name=first))
    third = other.create().name
    for who, name in ((mine, second), (other, third)):
        who.DeleteSession(pb.DeleteSessionRequest(name=name))


def test_a_key_has_as_many_streams_and_watchers_as_it_may(guarded):
    """The quota is four: a fifth is rejected, a takeover of the key's own stream is allowed, other keys are unaffected."""
    mine, admin = As(guarded, "stream"), As(guarded, "admin")
    name, other = mine.create().name, mine.create().name
    watching = pb.WatchSessionRequest(name=name, api_version=API_VERSION)
    done = threading.Event()

    def begun(name: str, **start):
        yield pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION, **start))
        done.wait(TIMEOUT)

    stream = mine.begin("Track", begun(name))
    watchers = [mine.begin("WatchSession", watching) for _ in range(3)]
    for refused in (lambda: mine.WatchSession(watching), lambda: mine.Track(begun(other))):
        with pytest.raises(ResourceExhausted, match="the key has its 4 streams and watchers already") as caught:
            refused()
        assert caught.value.retry_after > 0
    address = guarded.http.replace("http", "ws", 1) + f"/v1/{name}/watch?api_version={API_VERSION}"
    with websocket(address, proxy=None, subprotocols=["ddakf.v1", f"ddakf.key.{guarded.keys['stream']}"]) as line:
        assert pb.TrackResponse.FromString(line.recv(TIMEOUT)).error.name == "ResourceExhausted"
        with pytest.raises(ConnectionClosed) as closed:
            line.recv(TIMEOUT)
        assert closed.value.rcvd.code == 4429
    assert admin.WatchSession(watching).started.name == name
    again = mine.begin("Track", begun(name, takeover=True))
    with pytest.raises(grpc.RpcError):
        list(stream)
    watchers.pop().cancel()
    deadline = time.monotonic() + TIMEOUT
    while True:
        try:
            watchers.append(mine.begin("WatchSession", watching))
            break
        except grpc.RpcError:  # the server has not noticed yet that the other one has left
            assert time.monotonic() < deadline
    done.set()
    for call in (again, *watchers):
        call.cancel()
    for session in (name, other):
        mine.DeleteSession(pb.DeleteSessionRequest(name=session))


def tell_apart(who: As, name: str, nobody: str) -> list[str]:
    """Calls of a key whose answer differs between this name and a name that never existed."""

    def answers(about: str) -> list[str]:
        found = []
        for method, request in (
            ("GetSession", pb.GetSessionRequest(name=about)),
            ("DeleteSession", pb.DeleteSessionRequest(name=about)),
            ("GetSessionHistory", pb.GetSessionHistoryRequest(name=about)),
            ("WatchSession", pb.WatchSessionRequest(name=about, api_version=API_VERSION)),
        ):
            with pytest.raises(SessionNotFound) as refused:
                getattr(who, method)(request)
            found.append(f"{method}: {type(refused.value).__name__} {str(refused.value).replace(about, '')}")
        return found

    return [one for one, other in zip(answers(name), answers(nobody), strict=True) if one != other]


def test_of_another_keys_session_nothing_is_said_while_it_lives_or_when_it_has_ended(guarded):
    mine, other = As(guarded, "stream"), As(guarded, "other")
    name = mine.create(session_id="of-mine").name
    assert tell_apart(other, name, "sessions/nobodys") == []
    mine.DeleteSession(pb.DeleteSessionRequest(name=name))
    assert tell_apart(other, name, "sessions/nobodys") == []
    with pytest.raises(SessionNotFound, match="was deleted"):
        mine.GetSession(pb.GetSessionRequest(name=name))


def test_a_repeated_request_does_not_answer_with_the_session_that_another_key_has_under_the_name_now(guarded):
    mine, other = As(guarded, "stream"), As(guarded, "other")
    name = mine.create(session_id="passed-on", request_id="first").name
    mine.DeleteSession(pb.DeleteSessionRequest(name=name))
    assert other.create(session_id="passed-on").name == name
    with pytest.raises(SessionNotFound):
        mine.create(request_id="first")
    other.DeleteSession(pb.DeleteSessionRequest(name=name))


def test_a_key_lists_its_own_ended_sessions_and_one_that_reads_lists_all(guarded):
    names, sheet = {}, make_sheet()
    for key in ("stream", "admin"):
        with connect(guarded.grpc, api_key=guarded.keys[key]) as client, contextlib.ExitStack() as stack:
            names[key] = stack.enter_context(client.create_session(*sheet, labels={"test": "past-keys"})).name

    def listed(key: str) -> set[str]:
        query = {"states": "SESSION_STATE_CLOSED", "labels": "test=past-keys"}
        headers = {"authorization": f"Bearer {guarded.keys[key]}"}
        answer = httpx.get(f"{guarded.http}/v1/sessions", params=query, headers=headers, timeout=TIMEOUT)
        return {session["name"] for session in answer.json()["sessions"]}

    assert eventually(lambda: listed("read") == set(names.values()))
    assert listed("admin") == set(names.values())
    assert listed("stream") == {names["stream"]}


def test_the_log_tells_which_key_has_created_and_deleted_a_session(guarded):
    owner, admin = As(guarded, "stream"), As(guarded, "admin")
    name = owner.create().name
    admin.DeleteSession(pb.DeleteSessionRequest(name=name))
    log = guarded.log.read_text()
    for done, key in (("created", "stream"), ("deleted", "admin")):
        (line,) = (x for x in log.splitlines() if f"{name.removeprefix('sessions/')} the session was {done}" in x)
        assert f"key={guarded.keys[key].split('_')[1]}" in line
