"""Notices to a realtime client that sends more than is tracked: a limit holds it back, or the workers' time."""

from __future__ import annotations

import asyncio

import pytest
from ddakf_api import API_VERSION
from ddakf_api.v1 import tracking_pb2 as pb

from .test_counted_frames import Serving

REALTIME = pb.Start(name="sessions/some", api_version=API_VERSION, flow_mode=pb.FLOW_MODE_REALTIME)
LIMIT = "the session or its key may have 2 frames per second"
WORKERS = "frames arrive faster than they can be tracked: 2 per second"


@pytest.mark.parametrize(
    ("limit", "affordable", "told"), [(2.0, 0.0, LIMIT), (2.0, 9.0, LIMIT), (0.0, 2.0, WORKERS), (9.0, 2.0, WORKERS)]
)
async def test_a_notice_tells_a_limit_from_workers_without_time(monkeypatch, limit, affordable, told):
    serving = await Serving.begin(REALTIME, limit)
    monkeypatch.setattr(serving.pool, "affordable_rate", lambda session_id: affordable)
    serving.pool.free.set()
    notice = asyncio.get_running_loop().create_future()

    async def send(response):
        if response.message.HasField("notice") and not notice.done():
            notice.set_result(response.message.notice)

    delivery = asyncio.create_task(serving.stream.deliver(send))
    for number in range(1, 30):
        await serving.receive(number)
        await asyncio.sleep(0.01)
    assert (await asyncio.wait_for(notice, 5.0)).message == told
    await serving.streams.leave(serving.stream)
    await delivery
    await serving.server._tasks.settle(1.0)
    await asyncio.to_thread(serving.store.close)
