"""Certificates in use: when they expire, and a changed one that gRPC cannot use."""

from __future__ import annotations

import asyncio
import datetime
import math
import time
from pathlib import Path

import grpc
import httpx
import pytest
from cryptography import x509
from ddakf_service.auth import tls
from ddakf_service.auth.certificate import expiry
from ddakf_service.auth.tls import Tls
from ddakf_service.build import build
from prometheus_client.parser import text_string_to_metric_families

import ddakf

from ..conftest import TIMEOUT, eventually
from ..transports.http_alone import http_alone
from .certificates import Authority

EXPIRY = "ddakf_tls_certificate_expiry_seconds"


def install(folder: Path, authority: Authority, valid: datetime.timedelta = datetime.timedelta(days=1)) -> Tls:
    certificate, key = authority.issue("server", valid=valid)
    (folder / "server.key").write_bytes(key)
    (folder / "server.key").chmod(0o600)
    (folder / "server.pem").write_bytes(certificate)
    return Tls(folder / "server.pem", folder / "server.key")


def samples(url: str, **options) -> dict[str, list]:
    text = httpx.get(url + "/metrics", **options).text
    return {family.name: family.samples for family in text_string_to_metric_families(text)}


@pytest.mark.parametrize("days", [-0.01, 1, 30_000])
def test_the_expiry_is_that_of_the_first_certificate(days):
    """Years from 2050 on have another form."""
    authority = Authority("first")
    pem, _ = authority.issue("server", valid=datetime.timedelta(days=days))
    right = x509.load_pem_x509_certificate(pem).not_valid_after_utc.timestamp()
    assert expiry((pem + authority.pem).decode()) == right


@pytest.mark.parametrize("cut", [0, 40, 200, 400])
def test_what_is_no_certificate_has_no_expiry(cut):
    head, *lines, last = Authority("first").pem.decode().splitlines()
    body = "".join(lines)[:cut]
    with pytest.raises(ValueError, match=r".+"):
        expiry("\n".join((head, body, last)))


def test_the_metrics_have_the_end_of_the_certificate_in_use(tmp_path, monkeypatch):
    monkeypatch.setattr(tls, "_INTERVAL", 0.05)
    files = install(tmp_path, Authority("first"))
    with http_alone(tls_certificate=str(files.certificate), tls_key=str(files.key)) as port:
        url = f"https://127.0.0.1:{port.number}"

        def left() -> float:
            return samples(url, verify=False)[EXPIRY][0].value - time.time()

        assert 0.9 < left() / 86400 < 1.1
        install(tmp_path, Authority("second"), datetime.timedelta(days=9))
        eventually(lambda: 8.9 < left() / 86400 < 9.1)
        files.certificate.write_bytes(b"none")
        time.sleep(0.2)
        assert 8.9 < left() / 86400 < 9.1, "the one in use"


def test_the_metrics_tell_program_and_limit_and_no_expiry_without_tls():
    with http_alone(max_sessions=7) as port:
        found = samples(port.url)
    assert found[EXPIRY][0].value == math.inf
    assert found["ddakf_sessions_limit"][0].value == 7
    (info,) = found["ddakf_build_info"]
    assert (info.labels, info.value) == ({"version": ddakf.__version__, "build": build()}, 1)


async def test_a_changed_certificate_that_grpc_cannot_use_is_logged_once(tmp_path, caplog):
    authority = Authority("first")
    files = install(tmp_path, authority)
    server = grpc.aio.server()
    port = server.add_secure_port("127.0.0.1:0", files.grpc_credentials())
    await server.start()

    async def connect() -> None:
        credentials = grpc.ssl_channel_credentials(authority.pem)
        options = [("grpc.use_local_subchannel_pool", 1)]
        async with grpc.aio.secure_channel(f"127.0.0.1:{port}", credentials, options) as channel:
            await asyncio.wait_for(channel.channel_ready(), TIMEOUT)

    await connect()
    assert caplog.messages == []
    files.certificate.write_bytes(b"half a certificate")
    for _ in range(3):
        await connect()
    await server.stop(None)
    (message,) = caplog.messages
    assert message.startswith("gRPC does not use the changed certificate: ")
    assert str(files.certificate) in message
