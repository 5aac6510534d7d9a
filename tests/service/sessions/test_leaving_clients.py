"""Clients leave in every possible way; the server keeps nothing of them."""

from __future__ import annotations

import asyncio
import contextlib
import gc
from collections import Counter

import grpc
import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.arrays import pack_mesh
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from websockets.asyncio.client import connect

from ..conftest import TIMEOUT, frame_of, request_of, serving

pytestmark = pytest.mark.slow

COUNTED = ("ddakf_", "google.", "grpc", "_asyncio", "uvicorn", "websockets", "starlette", "prometheus_client", "socket", "_io")
PATIENCE = 60.0  # seconds


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
    """Live objects of the service, its messages and its transports by type, and coroutines by name."""
    found = Counter()
    for thing in gc.get_objects():
        kind = type(thing)
        if str(kind.__module__).startswith(COUNTED):
            found[f"{kind.__module__}.{kind.__qualname__}"] += 1
        elif kind.__name__ == "coroutine" and "ddakf_service" in getattr(thing.cr_code, "co_filename", ""):
            found[thing.__qualname__] += 1
    return found


def held() -> Counter[str]:
    """The potentially large ones among the counts."""
    small = ("ddakf_api.errors.", "ddakf_api.v1.tracking_pb2.ErrorDetail")  # which gRPC keeps with what it has aborted
    return Counter({name: n for name, n in counts().items() if name.startswith("ddakf_") and not name.startswith(small)})


async def settled(addresses, look) -> Counter[str]:
    """The counts after all sessions have ended and nothing changes."""
    async with grpc.aio.insecure_channel(addresses.grpc) as channel:
        while (await TrackingServiceStub(channel).ListSessions(pb.ListSessionsRequest())).sessions:
            await asyncio.sleep(0.05)
    before, now = None, look()
    while now != before:
        await asyncio.sleep(0.5)
        before, now = now, look()
    return now


async def left(addresses, look, first: Counter[str]) -> Counter[str]:
    """Objects beyond the first counts, after time for a slow disk."""
    now = await settled(addresses, look) - first
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(PATIENCE):
            while now:
                await asyncio.sleep(0.5)
                now = look() - first
    return now


@contextlib.contextmanager
def without_collector():
    """Without the garbage collector reference cycles stay, as in a large server before its next collection."""
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        gc.enable()


async def test_nothing_is_left_of_clients_that_came_and_went(sheet, tmp_path):
    def look() -> Counter[str]:
        gc.collect()
        return counts()

    async with serving(spare_workers=0, data_dir=str(tmp_path), checkpoint_every=1) as addresses, asyncio.timeout(3 * TIMEOUT):

        async def visits() -> None:
            for leave in WAYS:
                await visit(addresses.grpc, sheet, leave)
            await visit_by_websocket(addresses, sheet)

        await visits()  # which leave what is made once and kept
        first = await settled(addresses, look)
        for _ in range(3):
            await visits()
        assert not await left(addresses, look, first)
        first = held()
        with without_collector():
            for _ in range(3):
                await visits()
            assert not await left(addresses, held, first)


async def test_what_was_refused_is_not_kept(sheet, tmp_path):
    bad_mesh = pb.Mesh(vertices=pack_mesh(*sheet).vertices)
    bad_frame = frame_of(sheet, 1)
    bad_frame.point_cloud.data += b"?"

    async def refusals(addresses) -> None:
        async with grpc.aio.insecure_channel(addresses.grpc) as channel, httpx.AsyncClient(base_url=addresses.http) as http:
            stub = TrackingServiceStub(channel)
            for limits in (pb.SessionLimits(), pb.SessionLimits(idle_timeout=-1)):  # by the worker, at the door
                request = pb.CreateSessionRequest(
                    api_version=API_VERSION, session=pb.Session(garment=bad_mesh, limits=limits), request_id="again"
                )
                with pytest.raises(grpc.RpcError):
                    await stub.CreateSession(request, timeout=TIMEOUT)
            body = {"garment": {"vertices": sheet.vertices.tolist(), "faces": [[0, 0, 1]]}}
            for more in ({}, {"limits": {"idle_timeout": -1}}):
                assert (await http.post("/v1/sessions", json=body | more, timeout=TIMEOUT)).status_code == 422
            name = await created(stub, sheet)
            call = stub.Track(timeout=TIMEOUT)
            await call.write(pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION)))
            await call.write(request_of(bad_frame))
            await call.done_writing()
            assert [answer.WhichOneof("message") async for answer in call] == ["started", "frame_error"]
            bad_reset = pb.ResetSessionRequest(name=name, vertices=bad_mesh.vertices, velocities=pb.PackedArray(data=b"?"))
            with pytest.raises(grpc.RpcError):
                await stub.ResetSession(bad_reset)
            await stub.DeleteSession(pb.DeleteSessionRequest(name=name))

    async with serving(spare_workers=0, data_dir=str(tmp_path)) as addresses, asyncio.timeout(3 * TIMEOUT):
        await refusals(addresses)
        gc.collect()
        first = await settled(addresses, held)
        with without_collector():
            for _ in range(3):
                await refusals(addresses)
            assert not await left(addresses, held, first)


async def test_an_expired_session_is_not_kept(sheet, tmp_path):
    async with serving(spare_workers=0, data_dir=str(tmp_path)) as addresses, asyncio.timeout(TIMEOUT):
        await visit(addresses.grpc, sheet, in_order)  # which leaves what is made once and kept
        gc.collect()
        first = await settled(addresses, held)
        with without_collector():
            await visit(addresses.grpc, sheet, gone)
            assert not await left(addresses, held, first)
