"""Deployment check: what a client sees of a server: versions, limits, certificate, clock, storage, a synthetic session."""

from __future__ import annotations

import json
import socket
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from http.client import HTTPException
from importlib import metadata
from typing import NamedTuple

import numpy as np

import ddakf
from ddakf.evaluation import metrics
from ddakf.evaluation.tracking.server import SYSTEM, Server, client_package

OK, WARNING, FAILED = "ok", "warning", "failed"
EXPIRY_WARNING = 21.0  # days before the end of a certificate
CLOCK_TOLERANCE = 2.0  # seconds between the clocks of both machines; times of keys and of the history are the server's
_PATIENCE = 10.0  # seconds for a connection
_DAY = 86400.0
_FRAMES, _RATE, _NOISE = 20, 30.0, 0.002  # of the synthetic session: frames, frames per second, metres
_LARGEST_ERROR = 20.0  # mm RMSE of its last frame


class Finding(NamedTuple):
    """Result of a check: its name, "ok", "warning" or "failed", and a sentence."""

    check: str
    outcome: str
    message: str


class _Wrong(Exception):
    """A check has failed; the message is the finding's."""


def examine(server: Server, http: str) -> Iterator[Finding]:
    """Yields the findings; the first failure to connect is the last finding.

    Args:
        http: "host:port" of REST.

    Raises:
        MissingDependency: the client is not installed.
    """
    package = client_package("`ddakf doctor --server`")
    if server.tls_ca or server.tls_certificate:
        yield _finding("certificate", _certificate, server)
    started = time.monotonic()
    try:
        client = server.connect()
    except package.ServiceError as error:
        yield Finding("connection", FAILED, str(error))
        return
    with client:
        took = time.monotonic() - started
        yield Finding("connection", OK, f"gRPC on {server.target} answers, the first call after {1e3 * took:.0f} ms")
        yield from (_versions(client.server), _limits(client.server), _open(server, package))
        yield _finding("storage", _storage, server, http)
        with _synthetic(client, package) as (clock, tracked):
            yield clock
            yield tracked


def _finding(check: str, examine_, *arguments) -> Finding:
    try:
        outcome, message = examine_(*arguments)
    except _Wrong as wrong:
        return Finding(check, FAILED, str(wrong))
    return Finding(check, outcome, message)


def _versions(info) -> Finding:
    ours, theirs = ddakf.__version__, info.server_version
    build = f", build {info.build}" if info.build else ""
    sentence = f"server {theirs}{build}, contract {info.api_version}; here ddakf-client {metadata.version('ddakf-client')}"
    if info.draining:
        return Finding("version", WARNING, f"{sentence}; the server is about to stop")
    return Finding("version", OK if ours == theirs else WARNING, sentence)


def _limits(info) -> Finding:
    limits = info.max_limits
    rate = f"{limits.max_frame_rate:g} frames per second" if limits.max_frame_rate else "any frame rate"
    return Finding("limits", OK, f"{info.max_vertices:,} vertices, {limits.max_points:,} points, {rate},"
                   f" {info.max_message_bytes >> 20} MiB per message, {limits.idle_timeout:g} s idle")  # fmt: skip


def _open(server: Server, package) -> Finding:
    """Whether calls without a key are refused where others can reach the server."""
    local = _is_local(server.target)
    try:
        with server._replace(api_key=None).connect() as client:
            next(iter(client.sessions()), None)
    except package.ServiceError as error:
        return Finding("access", OK, f"a call without a key is refused: {type(error).__name__}")
    encrypted = server.tls_ca or server.tls_certificate
    if local or (encrypted and server.tls_certificate):
        return Finding("access", OK, "calls need no key here")
    return Finding("access", WARNING, f"anyone who reaches {server.target} may use the server: it asks for no key")


def _is_local(address: str) -> bool:
    """Whether "host:port" is on this machine."""
    return address.rpartition(":")[0].strip("[]") in ("127.0.0.1", "::1", "localhost")


def _opener(address: str, context: ssl.SSLContext | None) -> urllib.request.OpenerDirector:
    """What opens pages of "host:port"; of this machine without a proxy."""
    proxies = urllib.request.ProxyHandler({} if _is_local(address) else None)
    return urllib.request.build_opener(proxies, urllib.request.HTTPSHandler(context=context))


def _storage(server: Server, http: str) -> tuple[str, str]:
    scheme = "https" if server.tls_ca or server.tls_certificate else "http"
    context = _context(server) if scheme == "https" else None
    headers = {"Authorization": f"Bearer {server.api_key}"} if server.api_key else {}
    try:
        request = urllib.request.Request(f"{scheme}://{http}/readyz", headers=headers)
        with _opener(http, context).open(request, timeout=_PATIENCE) as answer:
            state = json.load(answer)
    except urllib.error.HTTPError as error:
        raise _Wrong(f"{http} is not ready: {error.read(500).decode(errors='replace')}") from None
    except HTTPException:
        raise _Wrong(f"{http} speaks another protocol than HTTP: --http wants that port, 7702 by default") from None
    except (OSError, ValueError) as error:
        return WARNING, f"not asked: {http} gives no answer ({getattr(error, 'reason', error)}); --http has its address"
    if state.get("problems"):
        raise _Wrong("; ".join(state["problems"]))
    return OK, "database and checkpoints can be written"


def _certificate(server: Server) -> tuple[str, str]:
    """Certificate of the gRPC port: trusted, of this host, not about to expire."""
    host, _, port = server.target.rpartition(":")
    context = _context(server)
    context.set_alpn_protocols(["h2"])
    try:
        with (
            socket.create_connection((host.strip("[]"), int(port)), timeout=_PATIENCE) as plain,
            context.wrap_socket(plain, server_hostname=host.strip("[]")) as encrypted,
        ):
            found, version = encrypted.getpeercert(), encrypted.version()
    except ssl.SSLCertVerificationError as error:
        raise _Wrong(f"the certificate is refused: {error.verify_message}") from None
    except OSError as error:
        raise _Wrong(f"no encrypted connection to {server.target}: {error}") from None
    days = (ssl.cert_time_to_seconds(found["notAfter"]) - time.time()) / _DAY
    return (
        OK if days > EXPIRY_WARNING else WARNING,
        f"{version}, trusted, valid for {days:.0f} more days, until {found['notAfter']}",
    )


def _context(server: Server) -> ssl.SSLContext:
    """TLS as the client has it, but for "system": with the authorities of the machine."""
    context = ssl.create_default_context(cafile=None if server.tls_ca in (None, SYSTEM) else server.tls_ca)
    if server.tls_certificate:
        context.load_cert_chain(server.tls_certificate, server.tls_key)
    return context


@contextmanager
def _synthetic(client, package) -> Iterator[tuple[Finding, Finding]]:
    """The findings about the clock and about a session that is created, tracked and deleted."""
    before = time.time()
    try:
        vertices, faces = _tube()
        session = client.create_session(vertices, faces, flow="lossless", labels={"purpose": "ddakf doctor"})
    except package.ServiceError as error:
        yield Finding("clock", WARNING, "not compared: there is no session"), Finding("session", FAILED, str(error))
        return
    after = time.time()
    try:
        with session:
            clock = _clock(session.info().create_time.timestamp(), before, after)
            tracked = _tracked(package, session, vertices)
    except package.ServiceError as error:
        tracked = Finding("session", FAILED, str(error))
    yield clock, tracked


def _clock(theirs: float, before: float, after: float) -> Finding:
    off = max(before - theirs, theirs - after, 0.0)
    sentence = f"the server's clock differs by {timedelta(seconds=round(off))}" if off >= 1.0 else "both clocks agree"
    return Finding("clock", OK if off <= CLOCK_TOLERANCE else WARNING, sentence)


def _tracked(package, session, vertices: np.ndarray) -> Finding:
    """A tube that moves by 5 mm per frame, seen all around with noise."""
    random = np.random.default_rng(1)
    truths = [vertices + [0.005 * k, 0.0, 0.0] for k in range(_FRAMES)]
    clouds = [np.repeat(truth, 4, axis=0) + random.normal(0.0, _NOISE, (4 * len(truth), 3)) for truth in truths]
    frames = [package.Frame(cloud, k / _RATE) for k, cloud in enumerate(clouds, 1)]
    results = list(session.track(frames))
    error = metrics.rmse_mm(results[-1].vertices, truths[-1])
    latency = 1e3 * float(np.median([result.latency for result in results]))
    sentence = f"{len(results)} frames, {error:.1f} mm RMSE, {latency:.0f} ms per frame in the median, state {results[-1].state}"
    good = len(results) == _FRAMES and results[-1].state == "tracking" and error < _LARGEST_ERROR
    return Finding("session", OK if good else FAILED, sentence)


def _tube(radius: float = 0.15, around: int = 32, along: int = 16) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) metres and (F, 3) of an open tube that widens, so that it cannot slide along itself unnoticed."""
    angle, height = np.meshgrid(2 * np.pi * np.arange(around) / around, np.arange(along), indexing="xy")
    radii = radius + 0.006 * height + 0.02 * np.cos(2 * angle)
    vertices = np.stack([radii * np.cos(angle), 0.03 * height, radii * np.sin(angle)], axis=-1).reshape(-1, 3)
    i = (np.arange(along - 1)[:, None] * around + np.arange(around)).ravel()
    j = i - i % around + (i + 1) % around
    lower, upper = np.stack([i, i + around, j], axis=1), np.stack([j, i + around, j + around], axis=1)
    return vertices, np.concatenate([lower, upper])
