"""Listening sockets: the setting to blame, and no line that is not the service's own."""

import socket
import subprocess
import sys

import pytest
from ddakf_service.transports.listener import listen

from ddakf.errors import InvalidConfig

from ..conftest import TIMEOUT


@pytest.mark.parametrize("host", ["999.1.1.1", "no-such-host.invalid", "192.0.2.1", "x" * 70])
def test_an_address_of_no_interface_is_blamed_on_the_host(host):
    with pytest.raises(InvalidConfig, match=f"host: expected an address of this machine, got {host}: "):
        listen(host, 0, "grpc_port")


def test_a_port_in_use_is_blamed_on_its_setting():
    with listen("127.0.0.1", 0, "http_port") as first:
        port = first.getsockname()[1]
        with pytest.raises(
            InvalidConfig, match=f"http_port: expected a free port on 127.0.0.1, got {port}: Address already in use"
        ):
            listen("127.0.0.1", port, "http_port")


def test_a_name_is_resolved():
    with listen("localhost", 0, "http_port") as listener, socket.create_connection(listener.getsockname()[:2]):
        pass


@pytest.mark.parametrize(
    ("option", "words"),
    [("--host=999.1.1.1", "host: expected an address"), ("--grpc-port={}", "grpc_port: expected a free port")],
)
def test_a_server_that_cannot_listen_says_so_in_lines_of_its_own(option, words):
    with listen("127.0.0.1", 0, "grpc_port") as taken:
        option = option.format(taken.getsockname()[1])
        command = [sys.executable, "-m", "ddakf_service", "--data-dir=none", "--log-format=json", "--http-port=0", option]
        ended = subprocess.run(command, capture_output=True, text=True, timeout=TIMEOUT, check=False)
    assert ended.returncode == 2
    *log, sentence = ended.stderr.splitlines()
    assert sentence.startswith(f"ddakf serve: {words}")
    assert [line for line in log if not line.startswith('{"time"')] == []
