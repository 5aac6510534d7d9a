"""Servers of the benchmarks: they start again on their port, and a failure of theirs is told apart from one of the service."""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path

import chaos
import pytest
from ports import lasting_port
from postgres import NoPostgres, Postgres, PostgresFailed

EPHEMERAL = Path("/proc/sys/net/ipv4/ip_local_port_range")


@pytest.mark.skipif(not EPHEMERAL.exists(), reason="the system does not say which ports outgoing connections get")
def test_no_outgoing_connection_gets_the_port_of_a_stopped_server():
    lowest, highest = map(int, EPHEMERAL.read_text().split())
    assert not any(lowest <= lasting_port() <= highest for _ in range(200))


@pytest.fixture
def cluster():
    try:
        cluster = Postgres()
    except NoPostgres as error:
        pytest.skip(str(error))
    yield cluster
    cluster.remove()


@pytest.mark.slow
def test_a_database_starts_again_while_clients_try_to_connect(cluster):
    for _ in range(3):
        cluster.start()
        cluster.stop()
        for _ in range(1000):
            with contextlib.suppress(ConnectionRefusedError):
                socket.create_connection(("127.0.0.1", cluster._port)).close()


def test_a_database_that_does_not_start_says_why(cluster):
    reason = r"ended with status 1 at its start.*could not create any TCP/IP sockets"
    with socket.create_server(("127.0.0.1", cluster._port)), pytest.raises(PostgresFailed, match=reason):
        cluster.start()


@pytest.mark.parametrize("failure", [PostgresFailed("PostgreSQL did not stop in 30 s"), chaos.HarnessFailed("no client")])
def test_a_failure_of_the_chaos_test_is_not_one_of_the_service(failure, monkeypatch, capsys, tmp_path):
    def fail(_):
        raise failure

    monkeypatch.setattr(chaos, "_measured", fail)
    out = tmp_path / "chaos.json"
    assert chaos.main(["--out", str(out)]) == 2
    assert f"THE TEST FAILED, not the service: {failure}" in capsys.readouterr().out
    assert not out.exists()
