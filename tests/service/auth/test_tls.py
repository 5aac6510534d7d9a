"""TLS on both ports: certificates of clients, and certificates that change while the service runs."""

from __future__ import annotations

import asyncio
import socket
import ssl
import subprocess
import sys
from pathlib import Path

import grpc
import httpx
import pytest
from ddakf_api.errors import InvalidArgument, ServiceError
from ddakf_client import connect, tls_credentials
from ddakf_service.auth import tls
from ddakf_service.auth.tls import Tls

from ddakf.commands import cli

from ..conftest import TIMEOUT, eventually, running
from .certificates import Authority

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def encrypted(tmp_path_factory):
    """A service with TLS that requires client certificates."""
    folder = tmp_path_factory.mktemp("tls")
    authority = Authority("first")
    install(folder, authority, "server")
    files = [f"--tls-certificate={folder / 'server.pem'}", f"--tls-key={folder / 'server.key'}"]
    (folder / "clients.pem").write_bytes(authority.pem)
    arguments = ["--workers", "1", *files, f"--tls-client-ca={folder / 'clients.pem'}"]
    with running(arguments, folder) as service:
        service.folder, service.authority = folder, authority
        yield service


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
        return http.get(service.http + "/healthz").status_code


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


@pytest.fixture
def own(encrypted) -> dict[str, str]:
    """The options of a connection with a certificate of the authority."""
    contents = {"ca": encrypted.authority.pem, **dict(zip(("certificate", "key"), encrypted.authority.issue("own"), strict=True))}
    for name, content in contents.items():
        (encrypted.folder / f"own.{name}").write_bytes(content)
    return {f"--tls-{name}": str(encrypted.folder / f"own.{name}") for name in contents}


@pytest.mark.parametrize("after_the_action", [True, False])
def test_the_commands_connect_with_tls(encrypted, own, after_the_action, capsys):
    options = [word for pair in own.items() for word in pair] + ["--server", encrypted.grpc]
    arguments = ["list", "--json", *options] if after_the_action else [*options, "list", "--json"]
    assert cli.main(["sessions", *arguments]) == 0
    assert capsys.readouterr().out == "[]\n"


@pytest.mark.parametrize("lacking", ["--tls-ca", "--tls-certificate"])
def test_a_command_without_the_right_files_is_refused_in_a_sentence(encrypted, own, lacking, capsys):
    """The system's authorities did not sign the server's certificate; without a certificate of its own a client is nobody."""
    own = {**own, "--tls-ca": "system"} if lacking == "--tls-ca" else {"--tls-ca": own["--tls-ca"]}
    options = [word for pair in own.items() for word in pair]
    assert cli.main(["sessions", "list", "--server", encrypted.grpc, *options]) == 2
    said = capsys.readouterr().err
    assert said.startswith(f"ddakf: {encrypted.grpc} does not answer")
    assert said.count("\n") == 1


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"--tls-ca": "/nowhere"}, "tls_ca"),
        ({"--tls-ca": __file__}, "tls_ca"),
        ({"--tls-key": None}, "tls_key"),
        ({"--tls-certificate": None}, "tls_certificate"),
        ({"--tls-key": __file__}, "tls_key"),
    ],
)
def test_files_of_a_client_that_cannot_be_used_are_named(encrypted, own, changes, field):
    files = {name.removeprefix("--tls-"): path for name, path in {**own, **changes}.items()}
    with pytest.raises(InvalidArgument) as caught:
        tls_credentials(**files)
    assert caught.value.field == field


def test_plain_text_is_not_served_beside_it(encrypted):
    host, port = encrypted.http.rsplit("/", 1)[1].rsplit(":", 1)
    with socket.create_connection((host, int(port)), timeout=10) as plain:
        plain.sendall(b"GET /healthz HTTP/1.1\r\nHost: x\r\n\r\n")
        assert not plain.recv(100).startswith(b"HTTP/1.1 200")


def test_changed_files_are_used_by_new_connections_and_a_broken_one_is_not(encrypted):
    second = Authority("second")
    (encrypted.folder / "clients.pem").write_bytes(second.pem)
    (encrypted.folder / "server.pem").write_bytes(b"half a certificate")
    eventually(lambda: "the changed certificate is not used" in (encrypted.folder / "service.log").read_text())
    old = encrypted.authority.issue("client")
    assert https(encrypted, encrypted.authority, old) == 200
    install(encrypted.folder, second, "server")
    new = second.issue("client")

    def served() -> bool:
        try:
            return https(encrypted, second, new) == 200 and secure(encrypted, second, new) == []
        except (httpx.HTTPError, ssl.SSLError, ServiceError):
            return False

    eventually(served)
    with pytest.raises((httpx.HTTPError, ssl.SSLError)):
        https(encrypted, second, old)
    encrypted.authority = second


async def test_a_file_that_stays_broken_is_told_of_once(tmp_path, monkeypatch, caplog):
    install(tmp_path, Authority("only"), "server")
    files, looks, stamp = Tls(tmp_path / "server.pem", tmp_path / "server.key"), [], Tls.modification_times
    monkeypatch.setattr(tls, "_INTERVAL", 0.001)
    monkeypatch.setattr(Tls, "modification_times", lambda self: looks.append(caplog.messages[:]) or stamp(self))
    following = asyncio.create_task(files.follow(files.context()))

    async def told(count: int) -> list[str]:
        """The warnings, some checks after this many have appeared."""
        async with asyncio.timeout(TIMEOUT):
            while len(looks) < 5 or len(looks[-5]) < count:
                await asyncio.sleep(0.01)
        return caplog.messages

    await told(0)
    files.certificate.write_bytes(b"no certificate")
    assert [f"{files.certificate}" in message for message in await told(1)] == [True]
    files.key.unlink()
    assert [f"{files.key}" in message for message in await told(2)] == [False, True], "another reason is told"
    following.cancel()


@pytest.mark.parametrize(
    ("flags", "named"),
    [
        (["--tls-key", "/nonexistent"], "tls_certificate"),
        (["--tls-certificate", "/nonexistent", "--tls-key", "/nonexistent"], "tls_certificate"),
    ],
)
def test_files_that_cannot_be_used_are_refused_by_name(flags, named):
    command = [sys.executable, "-m", "ddakf_service", "--data-dir", "none", "--http-port", "0", "--grpc-port", "0", *flags]
    done = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 2
    assert named in done.stderr


def test_a_session_of_tls_outlives_no_authority(encrypted):
    """Each new connection of a client needs its certificate again."""
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
