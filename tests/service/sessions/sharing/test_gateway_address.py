"""Address of a gateway: where other gateways send clients, and whether this one listens there."""

from __future__ import annotations

import pytest

from tests.lanes import every

from ...transports.http_alone import http_alone

NOWHERE = "postgresql+psycopg://ddakf@127.0.0.1:1/ddakf"  # refuses at once; the server tries again later


@pytest.mark.parametrize(
    ("host", "address", "warned"),
    every(
        2,
        [
            ("127.0.0.1", "track.example:7701", True),
            ("127.0.0.1", "127.0.0.1:7701", False),
            ("::1", "192.0.2.1:7701", True),
            ("localhost", "[::1]:7701", False),
            ("0.0.0.0", "track.example:7701", False),
            ("127.0.0.1", "", False),
        ],
    ),
)
def test_an_address_at_which_the_server_does_not_listen_has_a_warning(tmp_path, caplog, host, address, warned):
    shared = {"share_sessions": True, "database_url": NOWHERE, "checkpoint_url": tmp_path.as_uri()}
    with http_alone(host=host, gateway_address=address, **shared):
        pass
    assert [m for m in caplog.messages if "gateway_address" in m and "host is" in m] == (
        [f"gateway_address is {address}, but host is {host}: clients come here only through a proxy on this machine"] * warned
    )
