"""Health check of the image, against a service, against TLS, and without a service."""

from __future__ import annotations

import http.server
import os
import socket
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from ddakf_service.auth.tls import Tls

from .auth.certificates import Authority

pytestmark = pytest.mark.slow

HEALTHY = Path(__file__).parents[2] / "docker/healthy"


def status(port: int | str, **environment: str) -> int:
    variables = {**os.environ, "DDAKF_HTTP_PORT": str(port), **environment}
    return subprocess.run([sys.executable, HEALTHY], env=variables, capture_output=True, timeout=250, check=False).returncode


class Readiness(http.server.BaseHTTPRequestHandler):
    code = 200

    def do_GET(self):
        self.send_response(self.code if self.path == "/readyz" else 404)
        self.end_headers()

    def log_message(self, *_):
        pass


class Quiet(http.server.ThreadingHTTPServer):
    daemon_threads = True

    def handle_error(self, *_):
        """Failed handshakes are expected here."""


@pytest.fixture
def encrypted(tmp_path):
    """Starts a server with the service's TLS and returns its port."""
    authority, servers = Authority("own"), []
    files = [tmp_path / name for name in ("server.pem", "server.key", "clients.pem")]
    for path, pem in zip(files, (*authority.issue("server"), authority.pem), strict=True):
        path.write_bytes(pem)

    def start(client_ca: bool) -> int:
        server = Quiet(("127.0.0.1", 0), Readiness)
        context = Tls(files[0], files[1], files[2] if client_ca else None).context()
        server.socket = context.wrap_socket(server.socket, server_side=True, do_handshake_on_connect=False)
        threading.Thread(target=server.serve_forever).start()
        servers.append(server)
        return server.server_address[1]

    yield start
    for server in servers:
        server.shutdown()
        server.server_close()


ONE_SIDE = {"DDAKF_TLS_CERTIFICATE": "server.pem"}
BOTH_SIDES = {**ONE_SIDE, "DDAKF_TLS_CLIENT_CA": "clients.pem"}


def test_a_service_that_is_ready_is_healthy(service):
    assert status(service.http.rpartition(":")[2]) == 0


def test_with_tls_too_whatever_its_certificate(encrypted):
    assert status(encrypted(client_ca=False), **ONE_SIDE) == 0


def test_one_that_asks_for_certificates_is_healthy_when_it_does(encrypted):
    port = encrypted(client_ca=True)
    assert status(port, **BOTH_SIDES) == 0
    assert status(port, **ONE_SIDE) == 1


@pytest.mark.parametrize("environment", [{}, ONE_SIDE, BOTH_SIDES])
def test_what_is_not_there_is_not_healthy(environment):
    with socket.create_server(("127.0.0.1", 0)) as nobody:
        free = nobody.getsockname()[1]
    assert status(free, **environment) == 1


def test_one_that_is_not_ready_is_not_healthy(encrypted, monkeypatch):
    monkeypatch.setattr(Readiness, "code", 503)
    assert status(encrypted(client_ca=False), **ONE_SIDE) == 1
