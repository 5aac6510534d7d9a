"""Metrics of the program and its limits, and a changed certificate that gRPC cannot use."""

from __future__ import annotations

import asyncio
from pathlib import Path

import grpc
import httpx
from ddakf_service.auth.tls import Tls
from ddakf_service.build import build
from prometheus_client.parser import text_string_to_metric_families

import ddakf

from ..conftest import TIMEOUT
from ..transports.http_alone import http_alone
from .certificates import Authority


def install(folder: Path, authority: Authority) -> Tls:
    certificate, key = authority.issue("server")
    (folder / "server.key").write_bytes(key)
    (folder / "server.key").chmod(0o600)
    (folder / "server.pem").write_bytes(certificate)
    return Tls(folder / "server.pem", folder / "server.key")


def samples(url: str, **options) -> dict[str, list]:
    text = httpx.get(url + "/metrics", **options).text
    return {family.name: family.samples for family in text_string_to_metric_families(text)}


def test_the_metrics_tell_program_and_limit():
    with http_alone(max_sessions=7) as port:
        found = samples(port.url)
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
