"""Past sessions: the ended ones in a list, as far as a key may read them."""

from __future__ import annotations

from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import connect

from ..conftest import eventually, frame_of, request_of

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


def test_the_list_over_http_and_from_the_client_is_the_same(service, api, http, sheet):
    name = api.create(sheet, labels={"test": "past-http"}).name
    api.delete(name)
    query = {"states": ["SESSION_STATE_CLOSED", "SESSION_STATE_EXPIRED"], "labels": "test=past-http"}
    (listed,) = eventually(lambda: http.get("/v1/sessions", params=query).json()["sessions"])
    assert (listed["name"], listed["state"]) == (name, "SESSION_STATE_CLOSED")
    with connect(service.grpc) as client:
        assert [session.name for session in client.sessions(state="closed", labels={"test": "past-http"})] == [name]
