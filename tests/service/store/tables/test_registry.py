"""Registry: saved sessions are known at once and after a restart."""

from __future__ import annotations

import dataclasses
import time

import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.store.tables.registry import Registry

from ..conftest import PATIENCE, record

GONE = pb.ErrorDetail(name="SessionExpired", message="it has expired")


@pytest.fixture
def open_registry(opened, url):
    """A registry on one database; each call is another start of the server."""

    def open_(keep: float = 3600.0) -> Registry:
        registries = []
        opened(url, attach=lambda database: registries.append(Registry(database, keep)))
        return registries[0]

    return open_


async def test_sessions_come_back_as_they_were(open_registry):
    registry = open_registry()
    first = record("first", labels={"who": "me\0 ünïcode"}, config_json='{"a": 1}', fabric="silk", etag="3")
    first = dataclasses.replace(first, owner="key-1", request_id="request-1")
    second, other = record("second"), record("other", server_id="there")
    for each in (second, other, first):
        registry.save(each)
    registry.save_request(first.uid, b"\0meshes")
    assert registry._database.flush(PATIENCE)
    again = open_registry()
    assert await again.alive("here") == [first, second]
    assert await again.request(first.uid) == b"\0meshes"
    assert await again.request(second.uid) is None


async def test_the_newest_record_of_a_session_counts_written_or_not(open_registry):
    registry = open_registry()
    before = record("changing", etag="1")
    after = dataclasses.replace(before, session=pb.Session())
    after.session.CopyFrom(before.session)
    after.session.etag = "2"
    registry.save(before)
    registry._database.flush(PATIENCE)
    registry.save(after)
    assert (await registry.newest("changing")).session.etag == "2"
    registry._database.flush(PATIENCE)
    assert (await registry.newest("changing")).session.etag == "2"


async def test_a_queued_record_counts_for_nothing_once_a_later_lease_has_written_one(open_registry, monkeypatch):
    """The session's next server reached the database while this one did not."""
    cut_off, later = open_registry(), open_registry()
    monkeypatch.setattr(cut_off._sessions, "_flush", lambda engine: None)
    before = dataclasses.replace(record("moved"), epoch=1)
    after = dataclasses.replace(before, session=pb.Session(), epoch=2)
    after.session.CopyFrom(before.session)
    after.session.etag = "2"
    cut_off.save(before)
    assert await cut_off.newest("moved") == before
    for newer in (after, dataclasses.replace(after, reason=GONE, end_time=time.time(), epoch=3)):
        later.save(newer)
        assert later._database.flush(PATIENCE)
        assert await cut_off.newest("moved") == newer


async def test_ended_sessions_are_remembered_but_not_alive(open_registry):
    registry = open_registry()
    ended = record("ended")
    registry.save(ended)
    registry.save_request(ended.uid, b"meshes")
    registry._database.flush(PATIENCE)
    registry.end(ended, GONE)
    registry._database.flush(PATIENCE)
    assert await registry.alive("here") == []
    assert await registry.request(ended.uid) is None
    found = await registry.newest("ended")
    assert (found.uid, found.reason) == (ended.uid, GONE)
    assert abs(found.end_time - time.time()) < 60


async def test_an_id_used_again_means_the_later_session(open_registry):
    registry = open_registry()
    earlier, later = record("reused"), record("reused")
    registry.end(earlier, GONE)
    registry.save(later)
    registry._database.flush(PATIENCE)
    assert (await registry.newest("reused")).uid == later.uid
    assert await registry.newest("never") is None


async def test_old_sessions_are_forgotten_at_a_start(open_registry):
    registry = open_registry()
    ended, alive = record("ended"), record("alive")
    registry.save(alive)
    registry.save(dataclasses.replace(ended, reason=GONE, end_time=time.time() - 100))
    registry._database.flush(PATIENCE)
    again = open_registry(keep=10.0)
    again.save(record("another"))  # behind the chores of the start
    again._database.flush(PATIENCE)
    again._database.close()
    last = open_registry()
    assert await last.newest("ended") is None
    assert (await last.newest("alive")).uid == alive.uid


async def test_ended_sessions_are_listed_newest_first_page_by_page(open_registry):
    registry, closed, expired = open_registry(), pb.SESSION_STATE_CLOSED, pb.SESSION_STATE_EXPIRED
    records = [dataclasses.replace(record(f"past-{i}"), owner=f"key-{i % 3}") for i in range(7)]
    for i, each in enumerate(records):
        each.session.state = (closed, expired)[i % 2]
        each.session.create_time.FromNanoseconds(int((1.7e9 + (i // 2) * 1e-6) * 1e9))  # some at the same microsecond
        registry.end(each, GONE)
    registry.save(record("alive"))
    assert registry._database.flush(PATIENCE)

    async def listed(states, owner=None, count=100) -> list[str]:
        ids, before = [], None
        while page := await registry.ended(states, owner, before, count):
            ids += [each.id for each in page]
            before = int(page[-1].create_time * 1e6), page[-1].id
        return ids

    newest_first = [f"past-{i}" for i in range(6, -1, -1)]
    for count in (1, 2, 3, 100):
        assert await listed([closed, expired], count=count) == newest_first
    assert await listed([expired]) == ["past-5", "past-3", "past-1"]
    assert await listed([closed, expired], owner="key-1") == ["past-4", "past-1"]
