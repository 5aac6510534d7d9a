"""Synchronous client: connection and session calls, over a real socket."""

from datetime import UTC, datetime
from types import SimpleNamespace

import numpy as np
import pytest
from ddakf_client import CODECS, Limits, aconnect, connect, errors
from ddakf_client.calls import require_target
from ddakf_client.history import history_request

from .fake_server import CREATED


def test_create_session_sends_mesh_body_and_options(service, mesh):
    garment = SimpleNamespace(vertices=mesh[0], faces=mesh[1])
    with (
        connect(service.target, api_key="secret") as client,
        client.create_session(
            garment,
            body=mesh,
            config={"associate": {"gate": 0.2}},
            fabric="cotton",
            clean=True,
            labels={"shop": "3"},
            limits=Limits(max_points=500),
            session_id="mine",
        ) as session,
    ):
        info = session.info()
        assert session.vertex_map.tolist() == [0, 1, 2, 3]
    sent = service.requests[0]
    assert sent.session.HasField("body")
    assert sent.clean
    assert sent.request_id
    assert sent.session.limits.max_points == 500
    assert info.name == "sessions/mine"
    assert (info.session_id, info.state, info.labels, info.fabric) == ("mine", "idle", {"shop": "3"}, "cotton")
    assert info.config == {"associate": {"gate": 0.2}}
    assert info.create_time == datetime.fromtimestamp(CREATED, UTC)
    assert (info.n_vertices, info.n_faces) == (4, 2)
    assert set(service.keys) == {"Bearer secret"}


def test_session_calls(service, mesh):
    with connect(service.target) as client:
        for name in ("alpha", "beta-1", "beta-2"):
            client.create_session(*mesh, session_id=name, labels={"group": name[0]})
        assert [s.session_id for s in client.sessions()] == ["alpha", "beta-1", "beta-2"]
        assert [s.session_id for s in client.sessions(labels={"group": "b"})] == ["beta-1", "beta-2"]
        session = client.open_session("alpha")
        assert session.reset(mesh[0], velocities=np.zeros((4, 3))).state == "initializing"
        assert session.update(labels={"a": "b"}).labels == {"a": "b"}
        with client.restore_session(session.snapshot(), session_id="other") as restored:
            assert restored.name == "sessions/other"
        session.delete()
        with pytest.raises(errors.SessionNotFound, match="there is no sessions/alpha"):
            session.info()
        with pytest.raises(errors.SessionExists) as exists:
            client.create_session(*mesh, session_id="beta-1")
        assert exists.value.field == "session_id"
        assert client.server_info().fabrics == ("cotton",)


def test_invalid_arguments_are_refused_before_sending(service, mesh):
    with connect(service.target) as client:
        for arguments, options, error, said in [
            ((mesh[0],), {}, errors.InvalidMesh, "garment: expected vertices and faces"),
            ((mesh[0], mesh[1] + 2), {}, errors.InvalidMesh, "garment.faces: expected indices from 0 to 3"),
            (mesh, {"body": (mesh[0], [[0, 1]])}, errors.InvalidMesh, "body.faces"),
            (mesh, {"config": {"a": float("nan")}}, errors.InvalidConfig, "config"),
            (mesh, {"config": [1]}, errors.InvalidConfig, "a dict or a ddakf.Config, got list"),
            ((mesh[0].tolist() + [[1.0]], mesh[1]), {}, errors.InvalidMesh, "garment.vertices: expected numbers"),
            ((mesh[0], [[0, 1, 2], [0, 1]]), {}, errors.InvalidMesh, "garment.faces: expected integers"),
            (mesh, {"body": mesh * 2}, errors.InvalidMesh, "body: expected vertices and faces"),
            (mesh, {"labels": {"a": 1}}, errors.InvalidArgument, "labels['a']: expected text, got int 1"),
            (mesh, {"labels": {1: "a"}}, errors.InvalidArgument, "labels: expected text as keys, got int 1"),
            (mesh, {"labels": "a"}, errors.InvalidArgument, "labels: expected a dict of text to text, got str 'a'"),
            (mesh, {"session_id": 5}, errors.InvalidArgument, "session_id: expected text, got int 5"),
            (mesh, {"session_id": "\ud800"}, errors.InvalidArgument, "session_id: expected text that UTF-8 can encode"),
            (mesh, {"fabric": 5}, errors.InvalidArgument, "fabric: expected text, got int 5"),
            (mesh, {"clean": "no"}, errors.InvalidArgument, "clean: expected True or False, got str 'no'"),
            (mesh, {"limits": {"max_points": 5}}, errors.InvalidArgument, "limits: expected a ddakf_client.Limits"),
            (mesh, {"limits": Limits(max_points=-1)}, errors.InvalidArgument, "limits.max_points: expected a whole"),
            (mesh, {"limits": Limits(idle_timeout="a")}, errors.InvalidArgument, "limits.idle_timeout: expected a num"),
            (mesh, {"flow": ["realtime"]}, errors.InvalidArgument, "flow: expected realtime or lossless"),
            (mesh, {"codec": "zip"}, errors.InvalidArgument, "codec: expected raw or quantised"),
            (mesh, {"flow": "fast"}, errors.InvalidArgument, "flow: expected realtime or lossless, got 'fast'"),
        ]:
            with pytest.raises(error) as refusal:
                client.create_session(*arguments, **options)
            assert said in str(refusal.value)
        assert service.requests == []
        session = client.create_session(*mesh)
        with pytest.raises(errors.InvalidArgument, match="on_error: expected raise or yield"):
            session.track([], on_error="ignore")
        for call, field in [
            (lambda: session.track([], takeover="yes"), "takeover"),
            (lambda: session.reset([[0, 0, 0], [1, 0]]), "vertices"),
            (lambda: session.reset(velocities=[["a", "b", "c"]]), "velocities"),
            (lambda: session.update(labels={"a": 1}), "labels['a']"),
            (lambda: client.restore_session("abc"), "snapshot"),
            (lambda: client.restore_session(b"", labels={"a": 1}), "labels['a']"),
            (lambda: client.restore_session(b"", session_id=5), "session_id"),
            (lambda: client.open_session(5), "session_id"),
            (lambda: client.delete_mesh(5), "name"),
            (lambda: list(client.sessions(labels={"a": 1})), "labels['a']"),
            (lambda: list(client.sessions(state=["idle"])), "state"),
            (lambda: client.create_session(*mesh).watch(on_notice=None), "on_notice"),
        ]:
            with pytest.raises(errors.InvalidArgument) as refusal:
                call()
            assert refusal.value.field == field
            assert str(refusal.value).startswith(f"{field}: expected ")


def test_a_codec_that_the_server_lacks_is_refused(service, mesh):
    service.codecs = [CODECS["raw"]]
    with connect(service.target) as client, pytest.raises(errors.CodecError, match=r"a codec of the server, raw"):
        client.create_session(*mesh)


def test_another_major_version_is_refused(service):
    service.api_version = "2.3"
    with pytest.raises(errors.VersionMismatch, match=r"this client speaks ddakf API 1\.\d+, the server '2\.3'"):
        connect(service.target)


@pytest.mark.parametrize("key", ["abc\n", "\tabc \r\n"])
def test_a_key_as_its_file_has_it_is_sent_without_the_end_of_the_line(service, key):
    with connect(service.target, api_key=key):
        assert set(service.keys) == {"Bearer abc"}


@pytest.mark.parametrize("key", ["\u00fcber", "two\nlines", "\x1b[1m", b"abc", 5])
async def test_a_key_that_no_header_can_have_is_refused_and_not_shown(service, key):
    with pytest.raises(errors.InvalidArgument, match=r"^api_key: expected printable") as refusal:
        connect(service.target, api_key=key)
    with pytest.raises(errors.InvalidArgument, match=r"^api_key: expected printable"):
        await aconnect(service.target, api_key=key)
    assert str(key) not in str(refusal.value)
    assert service.keys == []


FOREIGN = [f"{scheme}://127.0.0.1:7701" for scheme in ("http", "https", "grpc", "ws", "tcp")]


@pytest.mark.parametrize("target", ["here", "127.0.0.1:99999", "[::1]", "dns:///here", ":7701", *FOREIGN])
def test_a_target_without_a_port_is_refused(target):
    """gRPC would take its own default port, or another one than was written."""
    with pytest.raises(errors.InvalidArgument, match="target: expected HOST:PORT"):
        connect(target)


@pytest.mark.parametrize("scheme", ["", "dns:", "dns:///", "ipv4:"])
def test_a_target_may_have_a_scheme_of_grpc(service, scheme):
    with connect(scheme + service.target) as client:
        assert client.target == scheme + service.target


@pytest.mark.parametrize("host", ["httpd", "http-proxy.lan"])
def test_a_host_may_have_any_name(host):
    require_target(f"{host}:7701")


@pytest.mark.parametrize("target", [None, 5, b"127.0.0.1:7701", [5], {"127.0.0.1:7701": 1}])
def test_a_target_that_is_no_text_is_refused(target):
    with pytest.raises(errors.InvalidArgument, match=r"target: expected HOST:PORT of gRPC, or a list of such, got "):
        connect(target)


@pytest.mark.parametrize("timeout", [float("inf"), float("nan"), 1e12, 10**400, 0, -1, "a", None, True, [1]])
def test_a_timeout_that_is_no_number_of_seconds_is_refused(service, mesh, timeout):
    said = r"timeout: expected seconds above 0, at most 1e\+09, got "
    with pytest.raises(errors.InvalidArgument, match=said):
        connect(service.target, timeout=timeout)
    with pytest.raises(errors.InvalidArgument, match=said):
        aconnect(service.target, timeout=timeout)
    with connect(service.target) as client, client.create_session(*mesh) as session:
        if timeout is not None:  # else that of the client
            with pytest.raises(errors.InvalidArgument, match=said):
                session.track([], timeout=timeout)


def test_the_longest_timeout_is_none_that_expires(service, mesh):
    with connect(service.target, timeout=1e9) as client, client.create_session(*mesh, flow="lossless") as session:
        assert [result.sequence for result in session.track([(mesh[0], 1.0)])] == [1]


async def test_a_timeout_may_be_a_number_of_numpy(service, mesh):
    for timeout in (np.float32(10), np.int64(10)):
        with connect(service.target, timeout=timeout) as client:
            assert type(client.timeout) in (int, float)
            assert client.server_info().fabrics == ("cotton",)
        async with aconnect(service.target, timeout=timeout) as client:
            assert type(client.timeout) in (int, float)


def test_the_history_names_its_own_arguments():
    for name in ("start", "end"):
        with pytest.raises(errors.InvalidArgument, match=rf"^{name}: expected a datetime with a time zone, got "):
            history_request("some", **{name: datetime(2026, 1, 1)})
    day = datetime(2026, 1, 1, tzinfo=UTC)
    assert history_request("some", start=day).start_time.ToDatetime(UTC) == day


def test_a_missing_server_is_an_immediate_error():
    """An exceeded timeout would be another error."""
    with pytest.raises(errors.Unavailable, match=r"127\.0\.0\.1:1 does not answer"):
        connect("127.0.0.1:1")


def test_a_server_that_does_not_answer_runs_into_the_timeout(service):
    service.delay = 1.0
    with pytest.raises(errors.DeadlineExceeded, match=r"gave no answer within 0\.2 s"):
        connect(service.target, timeout=0.2)


@pytest.mark.parametrize("closed", [False, True])
def test_an_error_inside_a_context_precedes_one_of_its_exit(service, mesh, closed):
    def leave_with_an_error():
        with connect(service.target) as client, client.create_session(*mesh):
            service._find = None  # every later call fails in the server
            if closed:
                client.close()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        leave_with_an_error()


def test_a_closed_client_says_so(service, mesh):
    client = connect(service.target)
    session = client.create_session(*mesh)
    client.close()
    for call in (
        lambda: list(session.track([(mesh[0], 1.0)])),
        lambda: list(session.watch()),
        session.info,
        lambda: client.create_session(*mesh),
    ):
        with pytest.raises(errors.FailedPrecondition, match=r"^the client is closed$"):
            call()


def test_closing_a_client_ends_its_stream_with_an_error(service, mesh, frames):
    client = connect(service.target)
    stream = client.create_session(*mesh, flow="lossless").track(frames(5))
    assert next(stream).sequence == 1
    client.close()
    with pytest.raises(errors.Cancelled, match=r"^the client is closed$"):
        list(stream)
