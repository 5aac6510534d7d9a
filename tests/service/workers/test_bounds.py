"""Bounds of a worker as a client sees them: memory, replacement in order."""

from __future__ import annotations

import httpx
import pytest
from ddakf_api.errors import ResourceExhausted

from ..conftest import Api, eventually, frame_of, request_of, running

ARGUMENTS = ["--workers", "1", "--max-points", "1000", "--max-memory-bytes", "5000000", "--recycle-frames", "20"]


@pytest.fixture(scope="module")
def bounded(tmp_path_factory):
    with running(ARGUMENTS, tmp_path_factory.mktemp("bounded")) as service:
        yield service


@pytest.fixture
def api(bounded):
    api = Api(bounded.grpc)
    with api.channel:
        yield api


def test_sessions_whose_memory_finds_no_room_are_refused_until_there_is_some(bounded, api, sheet):
    names = [api.create(sheet).name]
    names += [api.create(sheet).name for _ in range(5_000_000 // api.get(names[0]).statistics.memory_bytes - 1)]

    def one_more():
        names.append(api.create(sheet).name)

    with pytest.raises(ResourceExhausted, match="memory") as refused:
        eventually(one_more)
    assert len(names) < 8
    assert refused.value.retry_after > 0
    body = {"garment": {"vertices": sheet.vertices.tolist(), "faces": sheet.faces.tolist()}}
    answer = httpx.post(bounded.http + "/v1/sessions", json=body)
    assert (answer.status_code, answer.json()["error"]["name"]) == (429, "ResourceExhausted")
    assert int(answer.headers["retry-after"]) >= 1
    api.delete(names.pop())
    one_more()
    for name in names:
        api.delete(name)


@pytest.mark.slow
def test_a_worker_is_replaced_in_order_and_no_frame_is_lost(bounded, api, sheet):
    name = api.create(sheet).name
    seen, none = [], "ddakf_workers_recycled_total 0.0"

    def replaced() -> bool:
        first = len(seen) + 1
        answers = list(api.track(name, [request_of(frame_of(sheet, i)) for i in range(first, first + 10)]))
        seen.extend(answer.result.sequence_number for answer in answers if answer.HasField("result"))
        return len(seen) > 20 and none not in httpx.get(bounded.http + "/metrics").text

    eventually(replaced)
    assert seen == list(range(1, len(seen) + 1))
    statistics = api.get(name).statistics
    assert (statistics.frames_applied, statistics.frames_lost) == (len(seen), 0)
    api.delete(name)
