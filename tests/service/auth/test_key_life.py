"""Life of a key: created, used, revoked."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import grpc
import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import ResourceExhausted, Unauthenticated, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc
from ddakf_client import Frame, connect

from ddakf.commands import cli

from ..conftest import TIMEOUT, eventually, make_sheet
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


def test_a_key_with_limits_is_held_to_them_by_every_transport(guarded):
    limits = {"requests_per_minute": 2, "frames_per_second": 5, "expires": "2h"}
    key = new_key(guarded.data, "guest", "read", **limits)
    headers = {"authorization": f"Bearer {key}"}
    answers = [httpx.get(guarded.http + "/v1/sessions", headers=headers) for _ in range(3)]
    assert [answer.status_code for answer in answers] == [200, 200, 429]
    assert 1 <= int(answers[2].headers["retry-after"]) <= 30
    refused = call(guarded, "ListSessions", key)
    assert isinstance(refused, ResourceExhausted)
    assert refused.retry_after > 0
    assert "2 requests per minute" in str(refused)
    rows = {row["name"]: row for row in json.loads(keys_command(guarded.data, "list", "--json"))}
    assert (rows["guest"]["requests_per_minute"], rows["guest"]["frames_per_second"]) == (2, 5)
    left = datetime.fromisoformat(rows["guest"]["expires"]) - datetime.now(UTC)
    assert timedelta(hours=1) < left < timedelta(hours=2)


def test_the_streams_of_a_key_share_its_frame_rate(guarded):
    """Lossless, so that no frame is dropped: together they take no less time than the rate allows."""
    guarded.keys["slow"] = new_key(guarded.data, "slow", "stream", frames_per_second=4)
    slow, sheet = As(guarded, "slow"), make_sheet()
    names = [slow.create().name for _ in range(2)]
    began, results = time.monotonic(), []
    with connect(guarded.grpc, api_key=guarded.keys["slow"], timeout=TIMEOUT) as client:
        for name in names:
            frames = [Frame(sheet.vertices, i / 100) for i in (1, 2, 3)]
            results += client.open_session(name, flow="lossless").track(iter(frames))
    assert len(results) == 6
    assert time.monotonic() - began > (6 - 1) / 4
    for name in names:
        slow.DeleteSession(pb.DeleteSessionRequest(name=name))


@pytest.mark.parametrize(
    ("flags", "words"),
    [
        (["--expires", "soon"], "expires: expected a number of m, h, d or w"),
        (["--expires", "2001-01-01"], "in the future"),
        (["--expires", "9" * 30 + "d"], "expires: expected"),
        (["--frames-per-second", "-1"], "frames_per_second: expected a number from 0, got -1"),
        (["--requests-per-minute", "nan"], "requests_per_minute: expected a number from 0, got nan"),
    ],
)
def test_limits_that_make_no_sense_are_refused_before_a_database_is_made(tmp_path, capsys, flags, words):
    assert cli.main(["keys", "--data-dir", str(tmp_path / "new"), "create", "x", "--scope", "read", *flags]) == 2
    assert words in capsys.readouterr().err
    assert not (tmp_path / "new").exists()


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
    new_key(tmp_path, "another", "read")
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
