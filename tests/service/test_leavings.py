"""Clients come and go in every way that there is: nothing of them is left in the server."""

from __future__ import annotations

import asyncio
import contextlib
import gc
from collections import Counter

import grpc
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from websockets.asyncio.client import connect

from .conftest import TIMEOUT, frame_of, request_of, serving

COUNTED = ("ddakf_", "google.", "grpc", "_asyncio", "uvicorn", "websockets", "starlette", "prometheus_client", "socket", "_io")


async def in_order(stub, call, name):
    await stub.DeleteSession(pb.DeleteSessionRequest(name=name))
    with contextlib.suppress(grpc.RpcError):
        while await call.read() is not grpc.aio.EOF:
            pass


async def half_closed(stub, call, name):
    await call.done_writing()
    while await call.read() is not grpc.aio.EOF:
        pass
    await stub.DeleteSession(pb.DeleteSessionRequest(name=name))


async def cancelled(stub, call, name):
    call.cancel()
    await stub.DeleteSession(pb.DeleteSessionRequest(name=name))


async def gone(stub, call, name):
    """The connection closes above the stream's head, and the session expires."""


WAYS = (in_order, half_closed, cancelled, gone)


async def created(stub, sheet) -> str:
    limits = pb.SessionLimits(departure_timeout=0.1)
    request = pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment=pack_mesh(*sheet), limits=limits))
    return (await stub.CreateSession(request, timeout=TIMEOUT)).name


async def visit(address, sheet, leave) -> None:
    async with grpc.aio.insecure_channel(address, [("grpc.use_local_subchannel_pool", 1)]) as channel:
        stub = TrackingServiceStub(channel)
        name = await created(stub, sheet)
        watcher = stub.WatchSession(pb.WatchSessionRequest(name=name, api_version=API_VERSION))
        await watcher.read()
        call = stub.Track(timeout=TIMEOUT)
        start = pb.Start(name=name, api_version=API_VERSION, flow_mode=pb.FLOW_MODE_LOSSLESS)
        for request in (pb.TrackRequest(start=start), *(request_of(frame_of(sheet, number)) for number in (1, 2, 3))):
            await call.write(request)
        assert [(await call.read()).WhichOneof("message") for _ in range(2)] == ["started", "result"]
        await leave(stub, call, name)


async def visit_by_websocket(addresses, sheet) -> None:
    async with grpc.aio.insecure_channel(addresses.grpc, [("grpc.use_local_subchannel_pool", 1)]) as channel:
        name = await created(TrackingServiceStub(channel), sheet)
    url = f"{addresses.http.replace('http', 'ws', 1)}/v1/{name}"
    async with connect(f"{url}/watch?api_version={API_VERSION}", proxy=None) as watcher:
        await watcher.recv()
        line = await connect(f"{url}/stream", proxy=None)
        await line.send(pb.TrackRequest(start=pb.Start(api_version=API_VERSION)).SerializeToString())
        await line.send(request_of(frame_of(sheet, 1)).SerializeToString())
        await line.recv()
        line.transport.abort()


def counts() -> Counter[str]:
    """Live objects by type, of the service, its messages and what it speaks through; and coroutines, by name."""
    gc.collect()
    found = Counter()
    for thing in gc.get_objects():
        kind = type(thing)
        if str(kind.__module__).startswith(COUNTED):
            found[f"{kind.__module__}.{kind.__qualname__}"] += 1
        elif kind.__name__ in ("coroutine", "async_generator"):
            found[thing.__qualname__] += 1
    return found


async def test_nothing_is_left_of_clients_that_came_and_went(sheet, tmp_path):
    async with serving(spare_workers=0, data_dir=str(tmp_path), checkpoint_every=1) as addresses:

        async def visits() -> None:
            for leave in WAYS:
                await visit(addresses.grpc, sheet, leave)
            await visit_by_websocket(addresses, sheet)

        async def settled() -> Counter[str]:
            """What is there once the sessions are gone and nothing moves."""
            async with grpc.aio.insecure_channel(addresses.grpc) as channel:
                while (await TrackingServiceStub(channel).ListSessions(pb.ListSessionsRequest())).sessions:
                    await asyncio.sleep(0.05)
            before, now = None, counts()
            while now != before:
                await asyncio.sleep(0.5)
                before, now = now, counts()
            return now

        async with asyncio.timeout(3 * TIMEOUT):
            await visits()  # which leave what is made once and kept
            first = await settled()
            for _ in range(3):
                await visits()
            assert await settled() - first == Counter()
