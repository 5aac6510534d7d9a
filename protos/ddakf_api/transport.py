"""gRPC options of both sides. They belong together: a client that pings faster than its server permits is cut off."""

from __future__ import annotations

MAX_MESSAGE_BYTES = 64 * 1024 * 1024
KEEPALIVE_SECONDS = 30.0
"""How often a client asks whether the connection lives, while a call is open."""
KEEPALIVE_TIMEOUT_SECONDS = 10.0
"""How long it waits for the answer."""
IDLE_SECONDS = 300.0
"""How long a server keeps a connection without a call; nobody pings one. A client's next call makes another."""

Options = list[tuple[str, int]]


def client_options(max_message_bytes: int = MAX_MESSAGE_BYTES) -> Options:
    """Options of a client's channel."""
    return [
        *_message_limits(max_message_bytes),
        *_pings(),
        ("grpc.keepalive_permit_without_calls", 0),
        # A server that starts again is found within seconds; left to itself gRPC looks every two minutes in the end.
        ("grpc.initial_reconnect_backoff_ms", 200),
        ("grpc.min_reconnect_backoff_ms", 200),
        ("grpc.max_reconnect_backoff_ms", 2000),
    ]


def server_options(max_message_bytes: int = MAX_MESSAGE_BYTES) -> Options:
    """Options of a server that clients with :func:`client_options` may ping."""
    return [
        *_message_limits(max_message_bytes),
        # Half the clients' interval, so that a delayed ping followed by a punctual one is no offence.
        ("grpc.http2.min_ping_interval_without_data_ms", int(500 * KEEPALIVE_SECONDS)),
        ("grpc.max_connection_idle_ms", int(1000 * IDLE_SECONDS)),
        *_pings(),
    ]


def _pings() -> Options:
    patience = int(1000 * KEEPALIVE_TIMEOUT_SECONDS)
    return [
        ("grpc.keepalive_time_ms", int(1000 * KEEPALIVE_SECONDS)),
        # The first is how long a line may keep back what was sent, the second how long the other side may not answer: a proxy, or
        # a halted process whose system lives on, takes bytes and says nothing.
        ("grpc.keepalive_timeout_ms", patience),
        ("grpc.http2.ping_timeout_ms", patience),
        # Streams are silent while no frames come: without this, pings stop after two.
        ("grpc.http2.max_pings_without_data", 0),
    ]


def _message_limits(max_message_bytes: int) -> Options:
    return [
        ("grpc.max_receive_message_length", max_message_bytes),
        ("grpc.max_send_message_length", max_message_bytes),
    ]
