"""Past sessions: the ended ones in a list, as far as a key may read them."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest
from ddakf_api.errors import SessionNotFound
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import connect
from ddakf_service.sessions.past import past_page, position_of
from ddakf_service.store.tables.session_record import SessionRecord

from ..conftest import Talk, eventually, frame_of, held, request_of, workers

ENDED = [pb.SESSION_STATE_EXPIRED, pb.SESSION_STATE_CLOSED]


def ended(api, labels: dict[str, str], size: int = 1000, states=ENDED) -> list[pb.Session]:
    """All ended sessions with these labels, read page by page."""
    found, token = [], ""
    while True:
        page = api.call("ListSessions", pb.ListSessionsRequest(page_size=size, page_token=token, states=states, labels=labels))
        assert len(page.sessions) <= size
        found += page.sessions
        token = page.next_page_token
        if not token:
            return found


def test_a_deleted_session_stays_in_the_list_of_ended_ones_with_what_it_did(api, sheet):
    names = [api.create(sheet, labels={"test": "past"}).name for _ in range(3)]
    list(api.track(names[1], [request_of(frame_of(sheet, i)) for i in (1, 2)]))
    assert ended(api, {"test": "past"}) == [], "none while they live"
    for name in names[:2]:
        api.delete(name)
    found = eventually(lambda: sessions if len(sessions := ended(api, {"test": "past"})) == 2 else None)
    assert [session.name for session in found] == [names[1], names[0]], "newest first"
    assert {session.state for session in found} == {pb.SESSION_STATE_CLOSED}
    assert [session.statistics.frames_applied for session in found] == [2, 0]
    assert ended(api, {"test": "past"}, size=1) == found
    assert ended(api, {"test": "past"}, states=[pb.SESSION_STATE_EXPIRED]) == []
    api.delete(names[2])


@pytest.mark.parametrize("flow", [pb.FLOW_MODE_REALTIME, pb.FLOW_MODE_LOSSLESS])
def test_frames_that_wait_when_their_session_is_deleted_count_as_dropped(service, api, sheet, flow):
    label = {"test": f"past-waiting-{flow}"}
    name = api.create(sheet, labels=label).name
    with Talk(api, name, flow=flow) as talk, ThreadPoolExecutor(1) as aside:
        talk.ask(frame_of(sheet, 1))
        with held(workers(service.pid)):
            talk.send(frame_of(sheet, 2))
            talk.await_arrival()
            for number in (3, 4, 5):
                talk.send(frame_of(sheet, number))
            talk.await_arrival()
            deleting = aside.submit(api.delete, name)  # waits for the worker
            with pytest.raises(SessionNotFound):
                list(talk.answers)
        deleting.result()
    assert dropped(api, name, label) == (3, 3)


def test_a_frame_that_waits_for_its_rate_when_its_session_is_deleted_counts_as_dropped(api, sheet):
    label = {"test": "past-rate"}
    name = api.create(sheet, labels=label, limits=pb.SessionLimits(max_frame_rate=0.01)).name
    with Talk(api, name, flow=pb.FLOW_MODE_REALTIME) as talk:
        talk.ask(frame_of(sheet, 1))
        for number in (2, 3):
            talk.send(frame_of(sheet, number))
            talk.await_arrival()
        api.delete(name)
    assert dropped(api, name, label) == (2, 2)


def dropped(api, name: str, labels: dict[str, str]) -> tuple[int, int]:
    """Dropped frames of an ended session, by its statistics and by its history."""
    (found,) = eventually(lambda: ended(api, labels))
    history = api.call("GetSessionHistory", pb.GetSessionHistoryRequest(name=name))
    return found.statistics.frames_dropped, sum(sample.frames_dropped for sample in history.samples)


def test_the_list_over_http_and_from_the_client_is_the_same(service, api, http, sheet):
    name = api.create(sheet, labels={"test": "past-http"}).name
    api.delete(name)
    query = {"states": ["SESSION_STATE_CLOSED", "SESSION_STATE_EXPIRED"], "labels": "test=past-http"}
    (listed,) = eventually(lambda: http.get("/v1/sessions", params=query).json()["sessions"])
    assert (listed["name"], listed["state"]) == (name, "SESSION_STATE_CLOSED")
    with connect(service.grpc) as client:
        assert [session.name for session in client.sessions(state="closed", labels={"test": "past-http"})] == [name]


@pytest.mark.parametrize(("labels", "batches"), [({}, [11, 11]), ({"kind": "rare"}, [200, 200, 200])])
async def test_a_page_reads_little_more_than_its_rows(labels, batches):
    """However many sessions have ended; of labels it reads on until it has enough."""
    rows = [
        SessionRecord("server", pb.Session(name=f"sessions/s-{k:04}", labels={"kind": "rare" if k % 100 == 0 else "usual"}))
        for k in range(500)
    ]
    for k, row in enumerate(rows):
        row.session.create_time.FromSeconds(10_000 - k)
    asked = []

    async def ended(states, owner, before, count):
        asked.append(count)
        begin = 0 if before is None else next(k for k, row in enumerate(rows) if position_of(row) == before) + 1
        return rows[begin : begin + count]

    request, listed = pb.ListSessionsRequest(page_size=10, labels=labels), []
    for _ in range(2 if not labels else 1):
        page = await past_page(ended, request)
        listed += page.sessions
        request.page_token = page.next_page_token
    assert asked == batches
    wanted = [row.session for row in rows if all(row.session.labels[key] == value for key, value in labels.items())]
    assert listed == (wanted[:20] if not labels else wanted)
