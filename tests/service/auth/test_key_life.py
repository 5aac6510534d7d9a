"""Life of a key: created, used, revoked."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from pathlib import Path

import grpc
import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import Unauthenticated, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc
from ddakf_client import connect

from ..conftest import TIMEOUT, eventually
from .conftest import As, call, keys_command, metadata, new_key

pytestmark = pytest.mark.slow


def test_a_new_key_works_at_once_and_a_revoked_one_soon_no_more(guarded):
    key = new_key(guarded.data, "passing", "read")
    with connect(guarded.grpc, api_key=key) as client:

        def refused() -> bool:
            try:
                list(client.sessions())
            except Unauthenticated:
                return True
            return False

        assert not refused()
        key_id = key.split("_")[1]
        keys_command(guarded.data, "revoke", key_id)
        eventually(refused)
    rows = {row["id"]: row for row in json.loads(keys_command(guarded.data, "list", "--json"))}
    assert rows[key_id]["revoked"]
    assert rows[key_id]["name"] == "passing"


def test_secrets_are_nowhere_but_with_their_holders(guarded):
    """Neither in the log at its lowest level nor in the database."""
    call(guarded, "ListSessions", guarded.keys["read"])
    httpx.get(guarded.http + "/v1/sessions", headers={"authorization": f"Bearer {guarded.keys['read']}"})
    kept = guarded.log.read_bytes() + b"".join(path.read_bytes() for path in guarded.data.rglob("*") if path.is_file())
    for key in guarded.keys.values():
        assert key.split("_", 2)[2].encode() not in kept


def test_a_recording_is_tracked_with_the_key_of_the_environment(guarded):
    sample = Path(__file__).parents[3] / "ddakf/data/sample.npz"
    command = [sys.executable, "-m", "ddakf.commands.cli", "track", str(sample), "--frames", "0:3", "--server", guarded.grpc]
    for key, status in ((guarded.keys["stream"], 0), ("", 2)):
        done = subprocess.run(
            command, env={**os.environ, "DDAKF_API_KEY": key}, capture_output=True, text=True, timeout=250, check=False
        )
        assert done.returncode == status, done.stderr
    assert "key" in done.stderr


def test_keys_command_refuses_what_it_cannot_do(tmp_path):
    command = [sys.executable, "-m", "ddakf.commands.cli", "keys", "--data-dir", str(tmp_path), "revoke", "0123456789ab"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 2
    assert "0123456789ab" in done.stderr


def test_a_revoked_key_loses_its_streams_and_watchers(guarded):
    guarded.keys["leaked"] = new_key(guarded.data, "leaked", "stream", "read")
    leaked, mine = As(guarded, "leaked"), As(guarded, "stream")
    name, kept = leaked.create().name, mine.create().name
    held = threading.Event()

    def requests(of: str):
        yield pb.TrackRequest(start=pb.Start(name=of, api_version=API_VERSION))
        held.wait(TIMEOUT)

    with grpc.insecure_channel(guarded.grpc) as channel:
        stub = rpc.TrackingServiceStub(channel)
        streams = [
            stub.Track(requests(of), timeout=TIMEOUT, metadata=metadata(guarded.keys[key]))
            for of, key in ((name, "leaked"), (kept, "stream"))
        ]
        watching = pb.WatchSessionRequest(name=kept, api_version=API_VERSION)
        readers = (metadata(guarded.keys[key]) for key in ("leaked", "read"))
        watches = [stub.WatchSession(watching, timeout=TIMEOUT, metadata=reader) for reader in readers]
        late, begun = threading.Event(), threading.Event()

        def later():
            begun.set()
            late.wait(TIMEOUT)
            yield pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION))

        waiting = stub.Track(later(), timeout=TIMEOUT, metadata=metadata(guarded.keys["leaked"]))
        begun.wait(TIMEOUT)
        for opened in (*streams, *watches):
            assert next(opened).HasField("started")
        keys_command(guarded.data, "revoke", guarded.keys["leaked"])
        for opened in (streams[0], watches[0], waiting):
            if opened is waiting:  # that passed the guard before
                late.set()
            with pytest.raises(grpc.RpcError) as ended:
                list(opened)
            assert isinstance(from_rpc_error(ended.value), Unauthenticated)
        assert streams[1].is_active()
        assert watches[1].is_active()
        held.set()
        list(streams[1])
        watches[1].cancel()
    admin = As(guarded, "admin")
    for of in (name, kept):
        admin.DeleteSession(pb.DeleteSessionRequest(name=of))
