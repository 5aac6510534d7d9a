"""``ddakf doctor --server``: a running server examined from outside."""

from __future__ import annotations

import json
import socket
import time
from datetime import timedelta
from types import SimpleNamespace

import pytest
from ddakf_client import connect

from ddakf.commands import cli
from ddakf.evaluation.tracking import deployment
from tests.service.auth.certificates import Authority
from tests.service.conftest import eventually, make_sheet, running
from tests.service.store.conftest import fill, small_disk  # noqa: F401

pytestmark = pytest.mark.slow


def doctor(capsys, service, *arguments: str) -> tuple[int, dict[str, dict]]:
    """The exit status, and the findings by check."""
    http = service.http.partition("://")[2]
    status = cli.main(["doctor", "--server", service.grpc, "--http", http, "--json", *arguments])
    return status, {finding["check"]: finding for finding in json.loads(capsys.readouterr().out)}


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    with running(["--workers", "1"], tmp_path_factory.mktemp("plain")) as service:
        yield service


def test_a_healthy_server_passes_and_keeps_nothing(plain, capsys):
    status, found = doctor(capsys, plain)
    assert status == 0
    assert list(found) == ["connection", "version", "limits", "access", "storage", "clock", "session"]
    assert {name: finding["outcome"] for name, finding in found.items()} == dict.fromkeys(found, "ok"), found
    assert "20 frames" in found["session"]["message"]
    with connect(plain.grpc) as client:
        assert list(client.sessions()) == []


def test_the_findings_are_lines_for_a_person(plain, capsys):
    assert cli.main(["doctor", "--server", plain.grpc]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(line.split()[0] in ("ok", "warning") for line in lines)
    assert any("--http" in line for line in lines), "the default port of REST is not this server's"


def test_the_port_of_grpc_in_place_of_the_other_is_told(plain, capsys):
    assert cli.main(["doctor", "--server", plain.grpc, "--http", plain.grpc, "--json"]) == 1
    (storage,) = (finding for finding in json.loads(capsys.readouterr().out) if finding["check"] == "storage")
    assert "another protocol than HTTP" in storage["message"]


def test_no_server_is_one_failure(capsys):
    with socket.create_server(("127.0.0.1", 0)) as nobody:
        port = nobody.getsockname()[1]
    assert cli.main(["doctor", "--server", f"127.0.0.1:{port}", "--json"]) == 1
    (finding,) = json.loads(capsys.readouterr().out)
    assert (finding["check"], finding["outcome"]) == ("connection", "failed")


def test_options_of_a_server_need_one(capsys):
    assert cli.main(["doctor", "--tls-ca", "system"]) == 2
    assert "--server" in capsys.readouterr().err


def test_a_server_that_wants_a_key_is_tried_with_it(tmp_path, capsys):
    place, key = ["--data-dir", str(tmp_path / "data")], tmp_path / "key"
    with running(["--workers", "1", "--require-keys", *place], tmp_path) as service:
        status, found = doctor(capsys, service)
        assert status == 1
        assert "key" in found["session"]["message"]
        cli.main(["keys", "create", "test", "--scope", "stream", "--file", str(key), *place])
        capsys.readouterr()
        status, found = doctor(capsys, service, "--api-key", key.read_text().strip())
    assert status == 0, found
    assert "refused" in found["access"]["message"]


def test_a_certificate_is_examined(tmp_path, capsys, monkeypatch):
    authority, other = Authority("own"), Authority("other")
    certificate, key = authority.issue("server")
    files = {"server.pem": certificate, "server.key": key, "own.pem": authority.pem, "other.pem": other.pem}
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    pair = [f"--tls-certificate={tmp_path}/server.pem", f"--tls-key={tmp_path}/server.key"]
    with running(["--workers", "1", *pair], tmp_path) as service:
        status, found = doctor(capsys, service, "--tls-ca", str(tmp_path / "own.pem"))
        assert status == 0, found
        assert found["certificate"]["outcome"] == "warning"  # it is valid for a day
        assert "1 more days" in found["certificate"]["message"]
        assert found["storage"]["outcome"] == "ok"
        monkeypatch.setattr(deployment, "EXPIRY_WARNING", 0.5)
        assert doctor(capsys, service, "--tls-ca", str(tmp_path / "own.pem"))[1]["certificate"]["outcome"] == "ok"
        status, found = doctor(capsys, service, "--tls-ca", str(tmp_path / "other.pem"))
        assert status == 1
        assert list(found) == ["certificate", "connection"]
        assert {finding["outcome"] for finding in found.values()} == {"failed"}


def test_an_expired_certificate_is_a_failure(tmp_path, capsys):
    authority = Authority("own")
    certificate, key = authority.issue("server", valid=-timedelta(minutes=1))
    for name, content in {"server.pem": certificate, "server.key": key, "own.pem": authority.pem}.items():
        (tmp_path / name).write_bytes(content)
    pair = [f"--tls-certificate={tmp_path}/server.pem", f"--tls-key={tmp_path}/server.key"]
    with running(["--workers", "1", *pair], tmp_path) as service:
        status, found = doctor(capsys, service, "--tls-ca", str(tmp_path / "own.pem"))
    assert status == 1
    assert found["certificate"]["outcome"] == "failed"
    assert "expired" in found["certificate"]["message"]


def test_a_full_disk_is_told(small_disk, tmp_path, capsys):  # noqa: F811
    arguments = ["--workers", "1", "--data-dir", str(small_disk / "data"), "--checkpoint-every", "1"]
    with running(arguments, tmp_path) as service:
        fill(small_disk)
        sheet = make_sheet()
        with connect(service.grpc) as client, client.create_session(*sheet) as session:
            list(session.track([(sheet.vertices, 0.1)]))
            status, found = eventually(lambda: (answer := doctor(capsys, service))[0] and answer)
        (small_disk / "ballast").unlink()
    assert status == 1
    assert found["storage"]["outcome"] == "failed"
    assert "disk is full" in found["storage"]["message"] or "No space left" in found["storage"]["message"]
    assert found["session"]["outcome"] == "ok"


def test_clocks_are_compared():
    now = time.time()
    assert deployment._clock(now, now - 0.1, now + 0.1).outcome == "ok"
    late = deployment._clock(now - 90, now - 0.1, now + 0.1)
    assert late.outcome == "warning"
    assert "0:01:30" in late.message


def test_another_version_is_a_warning():
    info = SimpleNamespace(server_version="9.9", build="abc", api_version="1.0", draining=False)
    assert deployment._versions(info).outcome == "warning"
    assert "9.9, build abc" in deployment._versions(info).message


def test_the_synthetic_garment_is_one():
    from ddakf import Mesh

    vertices, faces = deployment._tube()
    assert len(Mesh(vertices, faces).vertices) == 512
