"""Health service: grpc.health.v1 with a bound on the calls that watch a status, which need no key."""

from __future__ import annotations

import grpc
from grpc_health.v1 import health, health_pb2

_MAX_WATCHERS = 100


class BoundedHealth(health.aio.HealthServicer):
    """The servicer of ``grpcio-health-checking``; more than :data:`_MAX_WATCHERS` calls of Watch are refused."""

    def __init__(self):
        super().__init__()
        self._count = 0

    async def Watch(self, request: health_pb2.HealthCheckRequest, context: grpc.aio.ServicerContext) -> None:
        if self._count >= _MAX_WATCHERS:
            reason = f"the server has its {_MAX_WATCHERS} watchers of health already; try again later, or call Check"
            await context.abort(grpc.StatusCode.RESOURCE_EXHAUSTED, reason)
        self._count += 1
        try:
            await super().Watch(request, context)
        finally:
            self._count -= 1
