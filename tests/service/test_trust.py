"""Who gets in: keys and scopes on every call of every transport, owners, TLS with certificates that change."""

from __future__ import annotations

import asyncio
import datetime
import json
import os
import socket
import ssl
import subprocess
import sys
import threading
import time
from pathlib import Path

import grpc
import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import NameOID
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import PermissionDenied, ResourceExhausted, SessionNotFound, Unauthenticated, Unavailable, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc
from ddakf_client import connect
from ddakf_service.child import ServiceProcess
from ddakf_service.trust import keys
from ddakf_service.trust.guard import GRPC_SCOPES, STREAM
from ddakf_service.trust.principal import Scope

from .conftest import TIMEOUT, make_sheet

METHODS = {m.name: m for m in pb.DESCRIPTOR.services_by_name["TrackingService"].methods}
GUARDED = [name for name in METHODS if name != "GetServerInfo"]


def keys_command(data_dir: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "ddakf.cli", "keys", "--data-dir", str(data_dir), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def new_key(data_dir: Path, name: str, *scopes: str, **options) -> str:
    flags = [flag for scope in scopes for flag in ("--scope", scope)]
    flags += [flag for option, value in options.items() for flag in (f"--{option.replace('_', '-')}", str(value))]
    return keys_command(data_dir, "create", name, *flags).split()[-1]


@pytest.fixture(scope="module")
def guarded(tmp_path_factory):
    """A service that asks for keys, its data folder, and a key of each kind."""
    folder = tmp_path_factory.mktemp("guarded")
    data = folder / "data"
    keys = {name: new_key(data, name, name) for name in ("stream", "read", "admin")}
    keys["other"] = new_key(data, "other", "stream", max_sessions=1)
    arguments = ["--workers", "1", "--require-keys", "--data-dir", str(data), "--log-level", "debug"]
    service = ServiceProcess(arguments, log=folder / "service.log")
    try:
        service.wait_until_ready()
        service.keys, service.data, service.log = keys, data, folder / "service.log"
        yield service
    finally:
        service.stop()


def metadata(key: str | None):
    return (("authorization", f"Bearer {key}"),) if key else ()


def call(service, method: str, key: str | None):
    """The error of a call with an empty request, or None."""
    with grpc.insecure_channel(service.grpc) as channel:
        stub = getattr(rpc.TrackingServiceStub(channel), method)
        described = METHODS[method]
        request = getattr(pb, described.input_type.name)()
        given = iter([request]) if described.client_streaming else request
        try:
            answer = stub(given, timeout=TIMEOUT, metadata=metadata(key))
            if described.server_streaming:
                list(answer)
        except grpc.RpcError as error:
            return from_rpc_error(error)
    return None


@pytest.mark.parametrize("method", GUARDED)
def test_no_method_of_grpc_works_without_a_key_or_with_a_wrong_one(guarded, method):
    assert isinstance(call(guarded, method, None), Unauthenticated)
    assert isinstance(call(guarded, method, "ddakf_0123456789ab_" + 43 * "A"), Unauthenticated)
    assert isinstance(call(guarded, method, "nonsense"), Unauthenticated)


@pytest.mark.parametrize("method", GUARDED)
def test_a_method_of_grpc_needs_its_scope(guarded, method):
    refused = call(guarded, method, guarded.keys["read"])
    assert isinstance(refused, PermissionDenied) == (GRPC_SCOPES["/ddakf_api.v1.TrackingService/" + method] == STREAM)
    assert not isinstance(call(guarded, method, guarded.keys["admin"]), (PermissionDenied, Unauthenticated))


def test_reflection_needs_a_key_but_health_and_the_handshake_do_not(guarded):
    from grpc_health.v1 import health_pb2, health_pb2_grpc
    from grpc_reflection.v1alpha import reflection_pb2, reflection_pb2_grpc

    with grpc.insecure_channel(guarded.grpc) as channel:
        assert health_pb2_grpc.HealthStub(channel).Check(health_pb2.HealthCheckRequest()).status
        assert rpc.TrackingServiceStub(channel).GetServerInfo(pb.GetServerInfoRequest(api_version=API_VERSION)).server_version
        reflection = reflection_pb2_grpc.ServerReflectionStub(channel)
        with pytest.raises(grpc.RpcError) as refused:
            list(reflection.ServerReflectionInfo(iter([reflection_pb2.ServerReflectionRequest(list_services="")])))
    assert isinstance(from_rpc_error(refused.value), Unauthenticated)


def routes(service) -> list[tuple[str, str]]:
    """Method and path of every documented operation that is not open."""
    document = httpx.get(service.http + "/openapi.json").json()
    open_paths = ("/healthz", "/readyz", "/v1/info")
    return [
        (method.upper(), path.replace("{session_id}", "nobody"))
        for path, operations in document["paths"].items()
        for method in operations
        if path not in open_paths
    ]


def test_no_route_works_without_a_key_or_without_its_scope(guarded):
    found = routes(guarded)
    assert {"GET", "POST", "DELETE"} <= {method for method, _ in found}
    with httpx.Client(base_url=guarded.http, timeout=TIMEOUT) as http:
        for method, path in found:
            answer = http.request(method, path)
            assert answer.status_code == 401, (method, path)
            assert answer.json()["error"]["name"] == "Unauthenticated"
            assert answer.headers["www-authenticate"] == "Bearer"
            needs_stream = method != "GET" or path.endswith("/snapshot")
            for key, refused in (("read", needs_stream), ("stream", path == "/metrics")):
                headers = {"authorization": f"Bearer {guarded.keys[key]}"}
                assert (http.request(method, path, headers=headers).status_code == 403) == refused, (method, path, key)


def test_what_says_whether_the_service_lives_is_open(guarded):
    for path in ("/healthz", "/readyz", "/v1/info", "/openapi.json"):
        assert httpx.get(guarded.http + path).status_code == 200, path


def test_unknown_paths_are_closed(guarded):
    assert httpx.get(guarded.http + "/v1/anything").status_code == 401
    headers = {"authorization": f"Bearer {guarded.keys['read']}"}
    assert httpx.get(guarded.http + "/v1/anything", headers=headers).status_code == 403


@pytest.mark.parametrize("what", ["stream", "watch"])
def test_a_websocket_is_refused_before_it_opens(guarded, what):
    from websockets.exceptions import InvalidStatus
    from websockets.sync.client import connect as websocket

    address = guarded.http.replace("http", "ws") + f"/v1/sessions/nobody/{what}"
    with pytest.raises(InvalidStatus) as refused, websocket(address, proxy=None):
        pass
    assert refused.value.response.status_code == 401
    assert json.loads(refused.value.response.body)["error"]["name"] == "Unauthenticated"
    named = ["ddakf.v1", f"ddakf.key.{guarded.keys['read']}"]
    if what == "stream":
        with pytest.raises(InvalidStatus) as refused, websocket(address, proxy=None, subprotocols=named):
            pass
        assert refused.value.response.status_code == 403
        return
    with websocket(address, proxy=None, subprotocols=named) as connection:
        assert connection.subprotocol == "ddakf.v1"


def test_a_new_key_works_at_once_and_a_revoked_one_soon_no_more(guarded):
    key = new_key(guarded.data, "passing", "read")
    with connect(guarded.grpc, api_key=key) as client:
        assert list(client.sessions()) is not None
        key_id = key.split("_")[1]
        keys_command(guarded.data, "revoke", key_id)
        deadline = time.monotonic() + 20
        while time.monotonic() < deadline:
            try:
                list(client.sessions())
            except Unauthenticated:
                break
            time.sleep(0.2)
        else:
            pytest.fail("a revoked key still works")
    rows = {row["id"]: row for row in json.loads(keys_command(guarded.data, "list", "--json"))}
    assert rows[key_id]["revoked"]
    assert rows[key_id]["name"] == "passing"


def test_secrets_are_nowhere_but_with_their_holders(guarded):
    """Neither in the log, at its most talkative, nor in the database."""
    call(guarded, "ListSessions", guarded.keys["read"])
    httpx.get(guarded.http + "/v1/sessions", headers={"authorization": f"Bearer {guarded.keys['read']}"})
    kept = guarded.log.read_bytes() + b"".join(path.read_bytes() for path in guarded.data.rglob("*") if path.is_file())
    for key in guarded.keys.values():
        assert key.split("_", 2)[2].encode() not in kept


def test_without_keys_only_loopback_is_served(tmp_path):
    service = ServiceProcess(["--host", "0.0.0.0", "--workers", "1"], log=tmp_path / "log")
    try:
        service.wait_until_ready()
        assert isinstance(call(service, "ListSessions", None), Unauthenticated)
    finally:
        service.stop()
    assert "ddakf keys create" in (tmp_path / "log").read_text()


# TLS ------------------------------------------------------------------------------------------------------------------


class Authority:
    """Signs certificates for 127.0.0.1."""

    def __init__(self, name: str):
        self.key = ec.generate_private_key(ec.SECP256R1())
        self.name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        self.certificate = self._signed(self.name, self.key.public_key(), authority=True)
        self.pem = self.certificate.public_bytes(serialization.Encoding.PEM)

    def issue(self, name: str) -> tuple[bytes, bytes]:
        """PEM of a certificate and of its key."""
        key = ec.generate_private_key(ec.SECP256R1())
        subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, name)])
        certificate = self._signed(subject, key.public_key(), authority=False)
        private = key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
        return certificate.public_bytes(serialization.Encoding.PEM), private

    def _signed(self, subject, public_key, *, authority: bool):
        import ipaddress

        now = datetime.datetime.now(datetime.UTC)
        names = [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
        builder = x509.CertificateBuilder().subject_name(subject).issuer_name(self.name).public_key(public_key)
        builder = builder.serial_number(x509.random_serial_number()).not_valid_before(now - datetime.timedelta(hours=1))
        builder = builder.not_valid_after(now + datetime.timedelta(days=1))
        builder = builder.add_extension(x509.BasicConstraints(ca=authority, path_length=None), critical=True)
        builder = builder.add_extension(x509.SubjectAlternativeName(names), critical=False)
        return builder.sign(self.key, hashes.SHA256())


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory):
    """A service with TLS that asks clients for certificates."""
    folder = tmp_path_factory.mktemp("tls")
    authority = Authority("first")
    install(folder, authority, "server")
    files = [f"--tls-certificate={folder / 'server.pem'}", f"--tls-key={folder / 'server.key'}"]
    (folder / "clients.pem").write_bytes(authority.pem)
    service = ServiceProcess(["--workers", "1", *files, f"--tls-client-ca={folder / 'clients.pem'}"], log=folder / "log")
    try:
        service.wait_until_ready()
        service.folder, service.authority = folder, authority
        yield service
    finally:
        service.stop()


def install(folder: Path, authority: Authority, name: str) -> None:
    certificate, key = authority.issue(name)
    (folder / "server.key").write_bytes(key)
    (folder / "server.pem").write_bytes(certificate)


def https(service, authority: Authority, client: tuple[bytes, bytes] | None) -> int:
    context = ssl.create_default_context(cadata=authority.pem.decode())
    if client:
        certificate, key = service.folder / "c.pem", service.folder / "c.key"
        certificate.write_bytes(client[0])
        key.write_bytes(client[1])
        context.load_cert_chain(certificate, key)
    with httpx.Client(verify=context, timeout=TIMEOUT) as http:
        return http.get(service.http.replace("http:", "https:") + "/healthz").status_code


def secure(service, authority: Authority, client: tuple[bytes, bytes] | None):
    certificate, key = client or (None, None)
    credentials = grpc.ssl_channel_credentials(authority.pem, key, certificate)
    with connect(service.grpc, credentials=credentials, timeout=5.0) as connected:
        return list(connected.sessions())


def test_a_client_needs_a_certificate_of_the_authority(encrypted):
    client, stranger = encrypted.authority.issue("client"), Authority("stranger").issue("client")
    assert https(encrypted, encrypted.authority, client) == 200
    assert secure(encrypted, encrypted.authority, client) == []
    for wrong in (None, stranger):
        with pytest.raises((httpx.HTTPError, ssl.SSLError)):
            https(encrypted, encrypted.authority, wrong)
        with pytest.raises(Exception, match=r"does not answer|handshake|certificate"):
            secure(encrypted, encrypted.authority, wrong)


def test_plain_text_is_not_served_beside_it(encrypted):
    host, port = encrypted.http.rsplit("/", 1)[1].rsplit(":", 1)
    with socket.create_connection((host, int(port)), timeout=10) as plain:
        plain.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert not plain.recv(100).startswith(b"HTTP/1.1 200")


def test_changed_files_are_used_by_new_connections_and_a_broken_one_is_not(encrypted):
    second = Authority("second")
    (encrypted.folder / "clients.pem").write_bytes(second.pem)
    (encrypted.folder / "server.pem").write_bytes(b"half a certificate")
    time.sleep(2.5)
    old = encrypted.authority.issue("client")
    assert https(encrypted, encrypted.authority, old) == 200
    install(encrypted.folder, second, "server")
    new = second.issue("client")
    deadline = time.monotonic() + 20
    while True:
        try:
            assert https(encrypted, second, new) == 200
            assert secure(encrypted, second, new) == []
            break
        except (httpx.HTTPError, ssl.SSLError, Exception):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
    with pytest.raises((httpx.HTTPError, ssl.SSLError)):
        https(encrypted, second, old)
    encrypted.authority = second


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--tls-key", "/nonexistent"], "tls_certificate"),
        (["--tls-certificate", "/nonexistent", "--tls-key", "/nonexistent"], "tls_certificate"),
    ],
)
def test_files_that_cannot_be_used_are_refused_by_name(flags, named):
    command = [sys.executable, "-m", "ddakf_service", "--data-dir", "none", "--http-port", "0", "--grpc-port", "0", *flags]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert named in done.stderr


def test_a_recording_is_tracked_with_the_key_of_the_environment(guarded):
    sample = Path(__file__).parents[2] / "ddakf/data/sample.npz"
    command = [sys.executable, "-m", "ddakf.cli", "track", str(sample), "--frames", "0:3", "--server", guarded.grpc]
    for key, status in ((guarded.keys["stream"], 0), ("", 2)):
        done = subprocess.run(
            command, env={**os.environ, "DDAKF_API_KEY": key}, capture_output=True, text=True, timeout=100, check=False
        )
        assert done.returncode == status, done.stderr
    assert "key" in done.stderr


def test_keys_command_refuses_what_it_cannot_do(tmp_path):
    command = [sys.executable, "-m", "ddakf.cli", "keys", "--data-dir", str(tmp_path), "revoke", "0123456789ab"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert "0123456789ab" in done.stderr


class As:
    """The calls of whoever has a key."""

    def __init__(self, service, key: str):
        self._channel = grpc.insecure_channel(service.grpc)
        self._stub, self._metadata = rpc.TrackingServiceStub(self._channel), metadata(service.keys[key])

    def __getattr__(self, method: str):
        def called(request):
            try:
                answer = getattr(self._stub, method)(request, timeout=TIMEOUT, metadata=self._metadata)
                return next(answer) if METHODS[method].server_streaming else answer
            except grpc.RpcError as error:
                raise from_rpc_error(error) from None

        return called

    def create(self, **request) -> pb.Session:
        session = pb.Session(garment=pack_mesh(*make_sheet()))
        return self.CreateSession(pb.CreateSessionRequest(api_version=API_VERSION, session=session, **request))

    def names(self) -> set[str]:
        return {session.name for session in self.ListSessions(pb.ListSessionsRequest()).sessions}


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


class UnreachableKeys:
    """A database that is away, until it is ``there``."""

    def __init__(self):
        self.there, self.looks, self.kept = False, 0, []

    def all(self):
        self.looks += 1
        if not self.there:
            raise OSError("away")
        return self.kept


async def test_before_the_keys_are_read_nobody_is_told_that_theirs_is_unknown(monkeypatch):
    store, (_, presented) = UnreachableKeys(), keys.generate("somebody", [Scope.STREAM], 0.0)
    ring = keys.KeyRing(store, on_revoked=set)
    with pytest.raises(Unavailable, match="the keys cannot be read now"):
        await ring.principal(presented)
    store.there = True
    monkeypatch.setattr(keys, "_UNKNOWN_REFRESH", 0.0)
    with pytest.raises(Unauthenticated):
        await ring.principal(presented)


async def test_a_key_that_is_made_right_after_the_keys_were_read_counts_at_once():
    ring = keys.KeyRing(store := UnreachableKeys(), on_revoked=set)
    store.there = True
    await ring.start()
    key, presented = keys.generate("somebody", [Scope.STREAM], 0.0)
    store.kept.append(key)
    assert await ring.principal(presented) == key.principal
    await ring.stop()


async def test_many_who_come_with_unknown_keys_share_one_look():
    ring = keys.KeyRing(store := UnreachableKeys(), on_revoked=set)
    store.there = True
    unknown = [keys.generate("nobody", [Scope.STREAM], 0.0)[1] for _ in range(20)]
    outcomes = await asyncio.gather(*(ring.principal(key) for key in unknown), return_exceptions=True)
    assert {type(outcome) for outcome in outcomes} == {Unauthenticated}
    assert store.looks == 1


def tell_apart(who: As, name: str, nobody: str) -> list[str]:
    """What the calls of a key answer about a name, where that is not what they answer about a name that never was."""

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


def test_a_line_feed_at_the_end_of_a_path_does_not_change_its_scope(guarded):
    headers = {"authorization": f"Bearer {guarded.keys['read']}"}
    for path in ("/v1/sessions/nobody/snapshot", "/v1/sessions/nobody/snapshot%0A", "/v1/sessions/nobody/snapshot/%0A"):
        assert httpx.get(guarded.http + path, headers=headers).status_code == 403, path


def test_a_refused_call_of_grpc_is_not_read(guarded):
    """What would be too large for anybody is refused for the want of a key, before it has come."""
    sent = bytes(65 << 20)
    with grpc.insecure_channel(guarded.grpc) as channel:
        for kind, request in ((channel.unary_unary, sent), (channel.stream_stream, iter([sent]))):
            method = "CreateSession" if request is sent else "Track"
            with pytest.raises(grpc.RpcError) as refused:
                list(kind(f"/ddakf_api.v1.TrackingService/{method}")(request, timeout=TIMEOUT))
            assert isinstance(from_rpc_error(refused.value), Unauthenticated), method


def test_a_revoked_key_loses_its_streams_and_watchers(guarded):
    guarded.keys["leaked"] = new_key(guarded.data, "leaked", "stream", "read")
    leaked, mine = As(guarded, "leaked"), As(guarded, "stream")
    name, kept = leaked.create().name, mine.create().name
    held = threading.Event()

    def requests(of: str):
        yield pb.TrackRequest(start=pb.Start(name=of, api_version=API_VERSION))
        held.wait(TIMEOUT)

    with grpc.insecure_channel(guarded.grpc) as channel:
        stub = rpc.TrackingServiceStub(channel)
        streams = [
            stub.Track(requests(of), timeout=TIMEOUT, metadata=metadata(guarded.keys[key]))
            for of, key in ((name, "leaked"), (kept, "stream"))
        ]
        watching = pb.WatchSessionRequest(name=kept, api_version=API_VERSION)
        readers = (metadata(guarded.keys[key]) for key in ("leaked", "read"))
        watches = [stub.WatchSession(watching, timeout=TIMEOUT, metadata=reader) for reader in readers]
        late, begun = threading.Event(), threading.Event()

        def later():
            begun.set()
            late.wait(TIMEOUT)
            yield pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION))

        waiting = stub.Track(later(), timeout=TIMEOUT, metadata=metadata(guarded.keys["leaked"]))
        begun.wait(TIMEOUT)
        for opened in (*streams, *watches):
            assert next(opened).HasField("started")
        keys_command(guarded.data, "revoke", guarded.keys["leaked"])
        for opened in (streams[0], watches[0], waiting):
            if opened is waiting:  # that passed the guard before
                late.set()
            with pytest.raises(grpc.RpcError) as ended:
                list(opened)
            assert isinstance(from_rpc_error(ended.value), Unauthenticated)
        assert streams[1].is_active()
        assert watches[1].is_active()
        held.set()
        list(streams[1])
        watches[1].cancel()
    admin = As(guarded, "admin")
    for of in (name, kept):
        admin.DeleteSession(pb.DeleteSessionRequest(name=of))


def test_on_loopback_a_key_is_asked_of_whom_a_proxy_forwards_and_of_names_that_point_here(service):
    port = service.http.rsplit(":", 1)[1]
    for headers, status in (
        ({}, 200),
        ({"host": f"localhost:{port}"}, 200),
        ({"host": f"[::1]:{port}"}, 200),
        ({"host": f"rebound.example:{port}"}, 401),
        ({"host": "127.0.0.1.example"}, 401),
        ({"x-forwarded-for": "192.0.2.1"}, 401),
        ({"forwarded": "for=192.0.2.1"}, 401),
    ):
        assert httpx.get(service.http + "/v1/sessions", headers=headers).status_code == status, headers
        assert httpx.get(service.http + "/healthz", headers=headers).status_code == 200, headers
    with grpc.insecure_channel(service.grpc) as channel:
        list_sessions = rpc.TrackingServiceStub(channel).ListSessions
        list_sessions(pb.ListSessionsRequest(), timeout=TIMEOUT)
        with pytest.raises(grpc.RpcError) as refused:
            list_sessions(pb.ListSessionsRequest(), timeout=TIMEOUT, metadata=(("x-forwarded-for", "192.0.2.1"),))
    assert isinstance(from_rpc_error(refused.value), Unauthenticated)


def test_a_session_of_tls_outlives_no_authority(encrypted):
    """A client that shows its certificate once is asked for it again by each connection."""
    certificate, key = encrypted.authority.issue("client")
    (encrypted.folder / "r.pem").write_bytes(certificate)
    (encrypted.folder / "r.key").write_bytes(key)
    context = ssl.create_default_context(cadata=encrypted.authority.pem.decode())
    context.load_cert_chain(encrypted.folder / "r.pem", encrypted.folder / "r.key")
    host, port = encrypted.http.rsplit("/", 1)[1].rsplit(":", 1)
    session = None
    for _ in range(2):
        plain = socket.create_connection((host, int(port)), timeout=10)
        with context.wrap_socket(plain, server_hostname=host, session=session) as connection:
            connection.sendall(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n")
            assert connection.recv(1000).startswith(b"HTTP/1.1 200")
            assert not connection.session_reused
            session = connection.session
    context.maximum_version = ssl.TLSVersion.TLSv1_2  # whose sessions could be resumed whatever the server does
    with pytest.raises((ssl.SSLError, ConnectionError)), socket.create_connection((host, int(port)), timeout=10) as plain:
        context.wrap_socket(plain, server_hostname=host).close()
