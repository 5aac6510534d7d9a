"""Half-open connections: dead, slow or unused, without a close from either side."""

from __future__ import annotations

import asyncio
import contextlib
import math

import grpc
import numpy as np
import pytest
from ddakf_api import API_VERSION, transport
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import DeadlineExceeded, SessionBusy, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub

from ..conftest import TIMEOUT, frame_of, request_of, serving

pytestmark = pytest.mark.slow


class Line:
    """A proxy that never closes a connection: ``dead`` it forwards nothing; after ``swift`` bytes to the server it is slow."""

    def __init__(self, port: int, swift: float = math.inf):
        self.dead, self._port, self._swift = False, port, swift
        self._copies: list[asyncio.Task] = []

    @contextlib.asynccontextmanager
    async def open(self):
        server = await asyncio.start_server(self._join, "127.0.0.1", 0)
        try:
            yield f"127.0.0.1:{server.sockets[0].getsockname()[1]}"
        finally:
            server.close()
            for copy in self._copies:
                copy.cancel()
            await asyncio.gather(*self._copies)

    async def _join(self, reader, writer):
        far_reader, far_writer = await asyncio.open_connection("127.0.0.1", self._port)
        ways = (reader, far_writer, self._swift), (far_reader, writer, math.inf)
        self._copies += [asyncio.create_task(self._copy(*way)) for way in ways]

    async def _copy(self, reader, writer, swift):
        with contextlib.suppress(asyncio.CancelledError):
            while data := await reader.read((1 << 14) if swift > 0 else 1):
                swift -= len(data)
                if not self.dead:
                    writer.write(data)
                if swift <= 0:
                    await asyncio.sleep(0.05)
            await asyncio.Event().wait()
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


async def started(stub: TrackingServiceStub, name: str) -> pb.Started:
    """The first response of a new stream, before it ends."""
    call = stub.Track(iter([pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION))]), timeout=TIMEOUT)
    try:
        answers = [answer async for answer in call]
    except grpc.RpcError as error:
        raise from_rpc_error(error) from None
    return answers[0].started


async def test_a_dead_line_frees_its_session(sheet, monkeypatch):
    """The server's own pings detect it: the client sends none."""
    monkeypatch.setattr(transport, "KEEPALIVE_SECONDS", 1.0)
    monkeypatch.setattr(transport, "KEEPALIVE_TIMEOUT_SECONDS", 1.0)
    async with serving() as addresses:
        line = Line(addresses.grpc_port)
        direct = grpc.aio.insecure_channel(addresses.grpc)
        async with direct, line.open() as target, grpc.aio.insecure_channel(target) as through_it:
            stub = TrackingServiceStub(direct)
            request = pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment=pack_mesh(*sheet)))
            name = (await stub.CreateSession(request, timeout=TIMEOUT)).name
            stream = TrackingServiceStub(through_it).Track()
            await stream.write(pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION)))
            await stream.write(request_of(frame_of(sheet, 1)))
            assert [(await stream.read()).WhichOneof("message") for _ in range(2)] == ["started", "result"]
            with pytest.raises(SessionBusy):
                await started(stub, name)
            line.dead = True
            async with asyncio.timeout(TIMEOUT):
                while True:
                    try:
                        assert (await started(stub, name)).last_sequence_number == 1
                        break
                    except SessionBusy:
                        await asyncio.sleep(0.1)
            stream.cancel()


async def test_a_request_that_drips_and_a_connection_without_a_call_are_given_up(sheet, monkeypatch):
    monkeypatch.setattr(transport, "IDLE_SECONDS", 1.0)
    mesh = pack_mesh(np.zeros((20_000, 3)), sheet.faces)
    request = pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment=mesh))
    async with serving(request_timeout=1.0) as addresses:
        line = Line(addresses.grpc_port, swift=50_000)
        async with line.open() as target, grpc.aio.insecure_channel(target) as dripping:
            with pytest.raises(grpc.RpcError) as caught:
                await TrackingServiceStub(dripping).CreateSession(request, timeout=TIMEOUT)
            with pytest.raises(DeadlineExceeded, match="the request did not come within 1 s"):
                raise from_rpc_error(caught.value)
        async with asyncio.timeout(TIMEOUT), grpc.aio.insecure_channel(addresses.grpc) as channel:
            stub, ready = TrackingServiceStub(channel), grpc.ChannelConnectivity.READY
            await stub.GetServerInfo(pb.GetServerInfoRequest(), timeout=TIMEOUT)
            assert channel.get_state() is ready
            await channel.wait_for_state_change(ready)
            await stub.GetServerInfo(pb.GetServerInfoRequest(), timeout=TIMEOUT)


async def test_a_call_without_a_request_is_refused(service):
    async with grpc.aio.insecure_channel(service.grpc) as channel:
        method = f"/{pb.DESCRIPTOR.services_by_name['TrackingService'].full_name}/ListSessions"
        call = channel.stream_unary(method)(iter([]), timeout=TIMEOUT)
        with pytest.raises(grpc.RpcError) as caught:
            await call
    assert caught.value.code() is grpc.StatusCode.INVALID_ARGUMENT
