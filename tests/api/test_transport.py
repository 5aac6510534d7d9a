"""gRPC options of client and server are compatible."""

import pytest
from ddakf_api.transport import client_options, server_options


def test_clients_ping_no_faster_than_servers_permit():
    client, server = dict(client_options("a:1")), dict(server_options())
    assert client["grpc.keepalive_time_ms"] > server["grpc.http2.min_ping_interval_without_data_ms"]


def test_both_sides_have_the_same_message_limit():
    for options in (client_options("a:1", 1234), server_options(1234)):
        assert dict(options)["grpc.max_receive_message_length"] == 1234
        assert dict(options)["grpc.max_send_message_length"] == 1234


@pytest.mark.parametrize(
    ("target", "proxied"),
    [
        *(("127.0.0.1:1", 0), ("127.1.2.3:1", 0), ("[::1]:1", 0), ("localhost:1", 0), ("10.0.0.1:1", 1)),
        *(("garments.example:1", 1), ("dns:///garments.example:1", 1), ("dns://localhost/garments.example:1", 1)),
        *(("dns:///localhost:1", 0), ("dns:localhost:1", 0), ("dns://8.8.8.8/localhost:1", 0)),
        *(("ipv4:127.0.0.1:1", 0), ("ipv6:[::1]:1", 0), ("dns:1", 1)),
    ],
)
def test_a_server_of_this_machine_is_reached_without_a_proxy(target, proxied):
    assert dict(client_options(target))["grpc.enable_http_proxy"] == proxied
