"""A line that goes dead without a word: neither side closes it, nothing comes through any more."""

from __future__ import annotations

import asyncio
import contextlib

import grpc
import pytest
from ddakf_api import API_VERSION, transport
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import SessionBusy, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from ddakf_service.server import Server
from ddakf_service.settings import Settings

from .conftest import TIMEOUT, frame_of, request_of


class Line:
    """A proxy that never closes a connection; ``dead`` it forwards nothing."""

    def __init__(self, port: int):
        self.dead, self._port = False, port
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
        self._copies += [asyncio.create_task(self._copy(*pair)) for pair in ((reader, far_writer), (far_reader, writer))]

    async def _copy(self, reader, writer):
        with contextlib.suppress(asyncio.CancelledError):
            while data := await reader.read(1 << 16):
                if not self.dead:
                    writer.write(data)
            await asyncio.Event().wait()
        writer.close()
        with contextlib.suppress(ConnectionError):
            await writer.wait_closed()


@contextlib.asynccontextmanager
async def serving():
    server, ready = Server(Settings(workers=1, grpc_port=0, http_port=0, data_dir="none")), asyncio.Future()
    running = asyncio.create_task(server.run(lambda *_: None, ready.set_result))
    try:
        yield await asyncio.wait_for(ready, TIMEOUT)
    finally:
        server.stop()
        await running


async def started(stub: TrackingServiceStub, name: str) -> pb.Started:
    """What a new stream is told first, before it ends."""
    call = stub.Track(iter([pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION))]), timeout=TIMEOUT)
    try:
        answers = [answer async for answer in call]
    except grpc.RpcError as error:
        raise from_rpc_error(error) from None
    return answers[0].started


async def test_a_dead_line_frees_its_session(sheet, monkeypatch):
    """The server's own pings notice it: the client sends none."""
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
