"""Encryption in front of the service: Caddy with the configuration of the compose file, gRPC and HTTP on one port."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest
from ddakf_service.settings import Settings
from ports import lasting_port

from ddakf.commands import cli

from ..service.conftest import eventually, running
from .conftest import COMPOSE, ROOT, program

pytestmark = pytest.mark.slow

CADDYFILE = (ROOT / "docker/caddy/Caddyfile").read_text()


def test_a_client_reaches_both_ports_through_the_proxy(tmp_path, capsys):
    caddy, port, place = program("caddy", "caddy"), lasting_port(), ["--data-dir", str(tmp_path / "data")]
    ports = f"\tadmin off\n\thttps_port {port}\n\thttp_port {lasting_port()}\n"
    (tmp_path / "Caddyfile").write_text(CADDYFILE.replace("\tadmin off\n", ports, 1))
    with running(["--workers", "1", "--require-keys", *place], tmp_path) as service:
        environment = {"XDG_DATA_HOME": str(tmp_path), "HOME": str(tmp_path), "DDAKF_DOMAIN": "localhost",
                       "DDAKF_GRPC": service.grpc, "DDAKF_HTTP": service.http.removeprefix("http://")}  # fmt: skip
        command = [part.replace("/etc/caddy", str(tmp_path)) for part in COMPOSE["services"]["tls"]["command"]]
        with (tmp_path / "caddy.log").open("wb") as log:
            proxy = subprocess.Popen([caddy, *command[1:]], env=environment, stdout=log, stderr=log)
        try:
            authority = tmp_path / "caddy/pki/authorities/local/root.crt"
            eventually(lambda: authority.exists() or proxy.poll() is not None)
            assert proxy.poll() is None, (tmp_path / "caddy.log").read_text()
            key = tmp_path / "key"
            cli.main(["keys", "create", "test", "--scope", "stream", "--file", str(key), *place])
            capsys.readouterr()
            here = ["--server", f"localhost:{port}", "--http", f"localhost:{port}", "--tls-ca", str(authority)]
            doctor = ["doctor", *here, "--json", "--api-key", key.read_text().strip()]

            def found() -> dict:
                status = cli.main(doctor)
                findings = {finding["check"]: finding for finding in json.loads(capsys.readouterr().out)}
                return findings if status == 0 else {}

            findings = eventually(found)
            assert findings["session"]["outcome"] == findings["storage"]["outcome"] == "ok"
            assert "TLSv1.3" in findings["certificate"]["message"]
        finally:
            proxy.terminate()
            proxy.wait(60)


def test_the_proxy_of_compose_uses_this_configuration():
    service = COMPOSE["services"]["tls"]
    assert "./caddy:/etc/caddy:ro" in service["volumes"]
    assert service["command"][-1] == "/etc/caddy/Caddyfile"
    assert Path(ROOT / "docker/caddy/Caddyfile").is_file()
    for name in ("grpc_port", "http_port"):
        assert f"ddakf:{Settings.model_fields[name].default}" in CADDYFILE
