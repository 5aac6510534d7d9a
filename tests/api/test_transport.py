"""gRPC options of client and server are compatible."""

from ddakf_api.transport import client_options, server_options


def test_clients_ping_no_faster_than_servers_permit():
    client, server = dict(client_options()), dict(server_options())
    assert client["grpc.keepalive_time_ms"] > server["grpc.http2.min_ping_interval_without_data_ms"]


def test_both_sides_have_the_same_message_limit():
    for options in (client_options(1234), server_options(1234)):
        assert dict(options)["grpc.max_receive_message_length"] == 1234
        assert dict(options)["grpc.max_send_message_length"] == 1234
