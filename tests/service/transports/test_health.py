"""Health over gRPC: a status may be watched without a key, by a bounded number of calls."""

from __future__ import annotations

import asyncio

import grpc
import pytest
from ddakf_service.transports.grpc import health
from grpc_health.v1 import health_pb2, health_pb2_grpc

from ..conftest import TIMEOUT

SERVING = health_pb2.HealthCheckResponse.SERVING


async def test_watchers_of_health_are_bounded_and_leave_their_places(monkeypatch):
    monkeypatch.setattr(health, "_MAX_WATCHERS", 2)
    server, request = grpc.aio.server(), health_pb2.HealthCheckRequest()
    health_pb2_grpc.add_HealthServicer_to_server(health.BoundedHealth(), server)
    port = server.add_insecure_port("127.0.0.1:0")
    await server.start()
    async with asyncio.timeout(TIMEOUT), grpc.aio.insecure_channel(f"127.0.0.1:{port}") as channel:
        stub = health_pb2_grpc.HealthStub(channel)
        first, second = stub.Watch(request), stub.Watch(request)
        assert [(await call.read()).status for call in (first, second)] == [SERVING] * 2
        with pytest.raises(grpc.aio.AioRpcError, match="2 watchers of health already") as refused:
            await stub.Watch(request).read()
        assert refused.value.code() is grpc.StatusCode.RESOURCE_EXHAUSTED
        assert (await stub.Check(request)).status == SERVING
        first.cancel()
        while True:
            try:
                assert (await stub.Watch(request).read()).status == SERVING
                break
            except grpc.aio.AioRpcError:
                await asyncio.sleep(0.01)
    await server.stop(None)
