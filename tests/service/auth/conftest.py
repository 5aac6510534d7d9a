"""A service that needs keys, shared by the tests, and its callers."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import grpc
import pytest
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc

from ..conftest import TIMEOUT, make_sheet, running

METHODS = {m.name: m for m in pb.DESCRIPTOR.services_by_name["TrackingService"].methods}


def keys_command(data_dir: Path, *arguments: str) -> str:
    command = [sys.executable, "-m", "ddakf.commands.cli", "keys", "--data-dir", str(data_dir), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=250)
    assert done.returncode == 0, done.stderr
    return done.stdout


def new_key(data_dir: Path, name: str, *scopes: str, **options) -> str:
    flags = [flag for scope in scopes for flag in ("--scope", scope)]
    flags += [flag for option, value in options.items() for flag in (f"--{option.replace('_', '-')}", str(value))]
    return keys_command(data_dir, "create", name, *flags).split()[-1]


@pytest.fixture(scope="package")
def guarded(tmp_path_factory):
    """A service that needs keys, its data folder, and a key of each kind."""
    folder = tmp_path_factory.mktemp("guarded")
    data = folder / "data"
    keys = {name: new_key(data, name, name) for name in ("stream", "read", "admin")}
    keys["other"] = new_key(data, "other", "stream", max_sessions=1)
    arguments = ["--workers", "1", "--require-keys", "--data-dir", str(data), "--log-level", "debug"]
    arguments += ["--max-streams-per-key", "4"]
    with running(arguments, folder) as service:
        service.keys, service.data, service.log = keys, data, folder / "service.log"
        yield service


def metadata(key: str | None):
    return (("authorization", f"Bearer {key}"),) if key else ()


def call(service, method: str, key: str | None):
    """The error of a call with an empty request, or None."""
    with grpc.insecure_channel(service.grpc) as channel:
        stub = getattr(rpc.TrackingServiceStub(channel), method)
        described = METHODS[method]
        request = getattr(pb, described.input_type.name)()
        given = iter([request]) if described.client_streaming else request
        try:
            answer = stub(given, timeout=TIMEOUT, metadata=metadata(key))
            if described.server_streaming:
                list(answer)
        except grpc.RpcError as error:
            return from_rpc_error(error)
    return None


class As:
    """Calls with a key."""

    def __init__(self, service, key: str):
        self._channel = grpc.insecure_channel(service.grpc)
        self._stub, self._metadata = rpc.TrackingServiceStub(self._channel), metadata(service.keys[key])

    def __getattr__(self, method: str):
        def called(request):
            try:
                answer = getattr(self._stub, method)(request, timeout=TIMEOUT, metadata=self._metadata)
                return next(answer) if METHODS[method].server_streaming else answer
            except grpc.RpcError as error:
                raise from_rpc_error(error) from None

        return called

    def begin(self, method: str, request) -> grpc.Call:
        """A call that stays open, after its first answer."""
        call = getattr(self._stub, method)(request, timeout=TIMEOUT, metadata=self._metadata)
        next(call)
        return call

    def create(self, **request) -> pb.Session:
        session = pb.Session(garment=pack_mesh(*make_sheet()))
        return self.CreateSession(pb.CreateSessionRequest(api_version=API_VERSION, session=session, **request))

    def names(self) -> set[str]:
        return {session.name for session in self.ListSessions(pb.ListSessionsRequest()).sessions}
