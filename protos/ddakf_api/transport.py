"""gRPC options of client and server. They must agree: a server disconnects a client that pings more often than permitted."""

from __future__ import annotations

import ipaddress
import re

MAX_MESSAGE_BYTES = 64 * 1024 * 1024
CLIENT_KEEPALIVE_SECONDS = 3.0
"""Time without data after which a client pings while a call is open."""
CLIENT_KEEPALIVE_TIMEOUT_SECONDS = 4.0
"""Timeout of the answer to a client's ping. With the time before it, it is below the default timeout of a frame."""
KEEPALIVE_SECONDS = 30.0
"""Interval of a server's pings while a call is open."""
KEEPALIVE_TIMEOUT_SECONDS = 10.0
"""Timeout of the answer to a server's ping."""
IDLE_SECONDS = 300.0
"""Time after which a server closes a connection without calls, which nobody pings. The next call opens another."""

CONNECT_SECONDS = 3.0
"""Timeout of a client's connection: TCP, TLS and HTTP/2 need up to four round trips."""

Options = list[tuple[str, int]]


def is_loopback(host: str) -> bool:
    """Whether a host, a name or an address with or without brackets, is this machine."""
    host = host.strip("[]")
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"


def client_options(target: str, max_message_bytes: int = MAX_MESSAGE_BYTES) -> Options:
    """Options of a client's channel to "host:port", also with a scheme of gRPC, such as "dns:///host:port"."""
    host = re.sub(r"^(dns|ipv4|ipv6):(//[^/]*/)?", "", target).rpartition(":")[0]
    return [
        # gRPC, unlike browsers, asks the proxy of http_proxy for this machine too
        ("grpc.enable_http_proxy", int(not is_loopback(host))),
        *_message_limits(max_message_bytes),
        *_pings(CLIENT_KEEPALIVE_SECONDS, CLIENT_KEEPALIVE_TIMEOUT_SECONDS),
        ("grpc.keepalive_permit_without_calls", 0),
        # Finds a restarted server at once; the default backoff of gRPC grows to two minutes.
        ("grpc.initial_reconnect_backoff_ms", 200),
        # gRPC takes this for the timeout of a connection as well, its TLS handshake included
        ("grpc.min_reconnect_backoff_ms", int(1000 * CONNECT_SECONDS)),
        ("grpc.max_reconnect_backoff_ms", 400),
    ]


def server_options(max_message_bytes: int = MAX_MESSAGE_BYTES) -> Options:
    """Options of a server for clients with :func:`client_options`."""
    return [
        *_message_limits(max_message_bytes),
        # Half of the interval of the clients: a late ping followed by a punctual one is permitted.
        ("grpc.http2.min_ping_interval_without_data_ms", int(500 * CLIENT_KEEPALIVE_SECONDS)),
        ("grpc.max_connection_idle_ms", int(1000 * IDLE_SECONDS)),
        *_pings(KEEPALIVE_SECONDS, KEEPALIVE_TIMEOUT_SECONDS),
    ]


def _pings(interval: float, timeout: float) -> Options:
    timeout_ms = int(1000 * timeout)
    return [
        ("grpc.keepalive_time_ms", int(1000 * interval)),
        # The first bounds the time until sent bytes are acknowledged, the second the time until a ping is answered: a proxy, or a
        # stopped process on a running system, acknowledges bytes without an answer.
        ("grpc.keepalive_timeout_ms", timeout_ms),
        ("grpc.http2.ping_timeout_ms", timeout_ms),
        # Streams without frames are silent; by default, gRPC stops after two pings without data.
        ("grpc.http2.max_pings_without_data", 0),
    ]


def _message_limits(max_message_bytes: int) -> Options:
    return [
        ("grpc.max_receive_message_length", max_message_bytes),
        ("grpc.max_send_message_length", max_message_bytes),
    ]
