"""A session belongs to the key that made it; of another's nothing is said."""

from __future__ import annotations

import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import ResourceExhausted, SessionNotFound
from ddakf_api.v1 import tracking_pb2 as pb

from .conftest import As


def test_a_session_belongs_to_its_key(guarded):
    mine, other, reader, admin = (As(guarded, key) for key in ("stream", "other", "read", "admin"))
    name = mine.create(request_id="same").name
    theirs = other.create(request_id="same").name
    assert theirs != name, "a request id is its key's own"
    assert (mine.names(), other.names()) == ({name}, {theirs})
    assert reader.names() == admin.names() == {name, theirs}
    assert reader.GetSession(pb.GetSessionRequest(name=name)).name == name
    watching = pb.WatchSessionRequest(name=name, api_version=API_VERSION)
    assert reader.WatchSession(watching).started.name == name
    start = pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION))
    for call in (
        lambda: other.GetSession(pb.GetSessionRequest(name=name)),
        lambda: other.WatchSession(watching),
        lambda: other.UpdateSession(pb.UpdateSessionRequest(session=pb.Session(name=name, labels={"a": "b"}))),
        lambda: other.ResetSession(pb.ResetSessionRequest(name=name)),
        lambda: other.SnapshotSession(pb.SnapshotSessionRequest(name=name)),
        lambda: other.GetSessionHistory(pb.GetSessionHistoryRequest(name=name)),
        lambda: other.Track(iter([start])),
        lambda: other.DeleteSession(pb.DeleteSessionRequest(name=name)),
    ):
        with pytest.raises(SessionNotFound, match="no session"):
            call()
    assert mine.Track(iter([start])).started.name == name
    admin.DeleteSession(pb.DeleteSessionRequest(name=name))
    other.DeleteSession(pb.DeleteSessionRequest(name=theirs))


def test_a_key_has_as_many_sessions_as_it_may(guarded):
    other, mine = As(guarded, "other"), As(guarded, "stream")
    first = other.create().name
    with pytest.raises(ResourceExhausted, match="the key has its 1 already") as caught:
        other.create()
    assert caught.value.retry_after > 0
    second = mine.create().name
    other.DeleteSession(pb.DeleteSessionRequest(name=first))
    third = other.create().name
    for who, name in ((mine, second), (other, third)):
        who.DeleteSession(pb.DeleteSessionRequest(name=name))


def tell_apart(who: As, name: str, nobody: str) -> list[str]:
    """What the calls of a key answer about a name, where that is not what they answer about a name that never was."""

    def answers(about: str) -> list[str]:
        found = []
        for method, request in (
            ("GetSession", pb.GetSessionRequest(name=about)),
            ("DeleteSession", pb.DeleteSessionRequest(name=about)),
            ("GetSessionHistory", pb.GetSessionHistoryRequest(name=about)),
            ("WatchSession", pb.WatchSessionRequest(name=about, api_version=API_VERSION)),
        ):
            with pytest.raises(SessionNotFound) as refused:
                getattr(who, method)(request)
            found.append(f"{method}: {type(refused.value).__name__} {str(refused.value).replace(about, '')}")
        return found

    return [one for one, other in zip(answers(name), answers(nobody), strict=True) if one != other]


def test_of_another_keys_session_nothing_is_said_while_it_lives_or_when_it_has_ended(guarded):
    mine, other = As(guarded, "stream"), As(guarded, "other")
    name = mine.create(session_id="of-mine").name
    assert tell_apart(other, name, "sessions/nobodys") == []
    mine.DeleteSession(pb.DeleteSessionRequest(name=name))
    assert tell_apart(other, name, "sessions/nobodys") == []
    with pytest.raises(SessionNotFound, match="was deleted"):
        mine.GetSession(pb.GetSessionRequest(name=name))


def test_a_repeated_request_does_not_answer_with_the_session_that_another_key_has_under_the_name_now(guarded):
    mine, other = As(guarded, "stream"), As(guarded, "other")
    name = mine.create(session_id="passed-on", request_id="first").name
    mine.DeleteSession(pb.DeleteSessionRequest(name=name))
    assert other.create(session_id="passed-on").name == name
    with pytest.raises(SessionNotFound):
        mine.create(request_id="first")
    other.DeleteSession(pb.DeleteSessionRequest(name=name))
