"""Leases: one gateway has a session at a time, whatever two of them do, and an earlier one changes nothing any more."""

from __future__ import annotations

import asyncio
import threading
import time
import uuid
from dataclasses import replace

import pytest
import sqlalchemy as sa
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.sessions.session import Session
from ddakf_service.store import clock
from ddakf_service.store.tables import heartbeat
from ddakf_service.store.tables import leases as table
from ddakf_service.store.tables.heartbeat import Heartbeat
from ddakf_service.store.tables.leases import Leases
from ddakf_service.store.tables.registry import Registry

from ...conftest import eventually
from ..conftest import PATIENCE, record

SPAN = 600.0  # seconds


@pytest.fixture
def url(postgres):
    return postgres.new_database(f"leases-{uuid.uuid4()}")


@pytest.fixture
def database(url, opened):
    return opened(url)


@pytest.fixture
def connection(database):
    with database.lasting_connections().connect() as connection:
        yield connection


@pytest.fixture
def here(database, connection):
    table.reclaim(connection, "here", "here:1", SPAN, False)
    return Leases(database, "here")


@pytest.fixture
def there(database, connection):
    table.reclaim(connection, "there", "there:1", SPAN, False)
    return Leases(database, "there")


def expire(connection, gateway: str) -> None:
    table.reclaim(connection, gateway, "", -1.0, False)


async def test_one_of_many_claims_of_an_id_succeeds(here, there):
    epochs = await asyncio.gather(*((here, there)[i % 2].claim("some", i, None) for i in range(8)))
    assert sorted(epoch or 0 for epoch in epochs) == [0] * 7 + [1]


async def test_one_of_many_claims_of_a_request_succeeds(here, there):
    claims = ((here, there)[i % 2].claim(f"some-{i}", i, None, "the same") for i in range(8))
    epochs = await asyncio.gather(*claims, *(here.claim(f"other-{i}", 10 + i, f"key-{i}", "the same") for i in range(2)))
    assert sorted(epoch or 0 for epoch in epochs) == [0] * 7 + [1] * 3
    won = epochs.index(1)
    assert (await there.of_request(None, "the same")).id == f"some-{won}"
    assert (await there.of_request("key-1", "the same")).id == "other-1"


async def test_a_served_lease_cannot_be_taken(here, there):
    await here.claim("some", 7, "key")
    lease = await there.find("some")
    assert (lease.uid, lease.owner, lease.gateway, lease.address, lease.served) == (7, "key", "here", "here:1", True)
    assert await there.take(lease) is None
    assert await there.find("some") == lease


async def test_a_released_lease_is_taken_once(here, there):
    await here.claim("some", 7, None)
    await here.release(7, 1)
    lease = await there.find("some")
    assert not lease.served
    epochs = await asyncio.gather(*(gateway.take(lease) for gateway in (here, there) * 4))
    assert sorted(epoch or 0 for epoch in epochs) == [0] * 7 + [2]


async def test_an_earlier_gateway_releases_nothing(here, there, connection):
    await here.claim("some", 7, None)
    expire(connection, "here")
    assert await there.take(await there.find("some")) == 3, "the expiry, too, has increased the epoch"
    await here.release(7, 1)
    assert (await here.find("some")).gateway == "there"


async def test_a_gateway_that_wakes_up_in_time_keeps_its_leases(here, there, connection):
    """Its epoch has grown: who saw the lease expired before comes too late."""
    await here.claim("some", 7, None)
    expire(connection, "here")
    seen = await there.find("some")
    assert not seen.served
    assert not table.renew(connection, "here", "here:1", SPAN, False), "an expired row is not renewed silently"
    table.reclaim(connection, "here", "here:1", SPAN, False)
    assert await there.take(seen) is None
    assert [lease.epoch for lease in table.held_by(connection, "here")] == [seen.epoch + 1]


async def test_a_lease_is_not_taken_while_its_renewal_is_on_its_way(database, here, there, connection):
    """A renewal that has begun comes first: the other gateway waits for it and finds the lease valid."""
    await here.claim("some", 7, None)
    table.renew(connection, "here", "here:1", 0.4, False)
    seen = (await there.find("some"))._replace(served=False)
    with database.lasting_connections().execution_options(isolation_level="READ COMMITTED").begin() as renewal:
        assert table.renew(renewal, "here", "here:1", SPAN, False)
        taking = asyncio.create_task(there.take(seen))
        await asyncio.sleep(0.5)  # the earlier span is over
        assert not taking.done()
    assert await taking is None


async def test_a_request_reaches_the_gateway_of_a_lease(database, here, there):
    await here.claim("some", 7, None)
    beats = []
    heart = Heartbeat(database.lasting_connections(), "here", "here:1", SPAN, lambda: True, beats.append)
    heart.start()
    try:
        eventually(lambda: beats, PATIENCE)
        await there.ask(await there.find("some"), takeover=True)
        eventually(lambda: beats[-1].held[0].wanted_by == "there", PATIENCE)  # long before the next regular beat
        assert beats[-1].held[0].takeover
        await here.refuse(beats[-1].held[0])
        assert (await there.find("some")).wanted_by == ""
    finally:
        await asyncio.to_thread(heart.stop)
    assert not (await there.find("some")).served, "a gateway that has stopped serves nothing"


async def test_a_heartbeat_without_its_name_renews_nothing(database, here, connection):
    beats, answers = [], iter([False, False, True])
    heart = Heartbeat(database.lasting_connections(), "here", "", 0.3, lambda: next(answers, True), beats.append)
    began = time.monotonic()
    heart.start()
    try:
        eventually(lambda: beats, PATIENCE)
        assert beats[0].began - began > 0.2, "two beats later"
    finally:
        await asyncio.to_thread(heart.stop)


async def test_rows_of_an_earlier_gateway_are_not_written(url, opened):
    """What it still registers of a session, its end too, changes neither the row nor the lease."""
    registries = []
    database = opened(url, attach=lambda database: registries.append(Registry(database, 1e9)))
    (registry,) = registries
    there = Leases(database, "there")
    await there.claim("some-session", 7, None)
    newer = replace(record(server_id="there"), uid=7, epoch=2)
    older = replace(record(server_id="here"), uid=7, epoch=1)
    registry.save(newer)
    assert await registry.written(7, PATIENCE)
    registry.end(older, pb.ErrorDetail(name="SessionExpired"))
    assert await registry.written(7, PATIENCE)
    found = await registry.newest("some-session")
    assert (found.server_id, found.epoch, found.reason) == ("there", 2, None)
    assert await there.find("some-session") is not None
    registry.end(newer, pb.ErrorDetail(name="SessionNotFound"))
    assert await registry.written(7, PATIENCE)
    assert await there.find("some-session") is None


async def test_the_session_with_the_lease_of_an_id_counts_whatever_the_clocks_say(url, opened):
    """An earlier one was created later, by the clock of its server."""
    registries = []
    database = opened(url, attach=lambda database: registries.append(Registry(database, 1e9)))
    (registry,), there = registries, Leases(database, "there")
    present, earlier = (replace(record("reused"), uid=uid, epoch=1) for uid in (2, 1))
    for gone in (pb.ErrorDetail(name="SessionNotFound"), pb.ErrorDetail(name="SessionExpired")):
        registry.end(earlier, gone)
        assert (await registry.newest("reused")).reason == gone
        assert await registry.written(1, PATIENCE)
    await there.claim("reused", 2, None)
    registry.save(present)
    assert (await registry.newest("reused")).uid == 2, "queued"
    assert await registry.written(2, PATIENCE)
    assert (await registry.newest("reused")).uid == 2
    registry.end(present, pb.ErrorDetail(name="SessionNotFound"))
    assert (await registry.newest("reused")).reason is not None


async def test_a_gateway_dates_sessions_by_the_clock_of_the_database(database, here, monkeypatch):
    real = time.time
    monkeypatch.setattr(clock.clock, "_ahead", 0.0)
    monkeypatch.setattr(clock.time, "time", lambda: real() + 100.0)
    beats = []
    heart = Heartbeat(database.lasting_connections(), "here", "", SPAN, lambda: True, beats.append)
    heart.start()
    try:
        eventually(lambda: beats, PATIENCE)
    finally:
        await asyncio.to_thread(heart.stop)
    message = Session("some", pb.Session(), pb.Session(), pb.SessionLimits(idle_timeout=200.0)).message()
    assert abs(message.create_time.ToSeconds() - real()) < 50
    assert abs(message.expire_time.ToSeconds() - 200 - real()) < 50
    limits = pb.SessionLimits(idle_timeout=900.0, max_lifetime=200.0)
    moved = Session("some", pb.Session(), pb.Session(), limits, created=real())
    assert abs(moved.expiry()[0] - 200 - time.monotonic()) < 50


async def test_clients_are_sent_to_the_gateway_with_the_fewest_sessions(here, there, connection):
    assert await here.another_gateway() == "there:1"
    table.reclaim(connection, "idle", "idle:1", SPAN, False)
    table.reclaim(connection, "draining", "draining:1", SPAN, True)
    table.reclaim(connection, "hidden", "", SPAN, False)
    await there.claim("some", 7, None)
    assert await here.another_gateway() == "idle:1"
    for gateway in ("there", "idle"):
        expire(connection, gateway)
    assert await here.another_gateway() == ""


async def test_no_client_is_sent_to_a_gateway_that_is_not_ready(database, here):
    ready, beats = threading.Event(), []
    heart = Heartbeat(database.lasting_connections(), "starting", "starting:1", SPAN, lambda: True, beats.append)
    heart.ready = ready.is_set
    heart.start()
    try:
        eventually(lambda: beats, PATIENCE)
        assert await here.another_gateway() == ""
        ready.set()
        heart.beat_now()
        eventually(lambda: len(beats) > 1, PATIENCE)
        assert await here.another_gateway() == "starting:1"
    finally:
        await asyncio.to_thread(heart.stop)


def test_a_database_that_hangs_holds_no_stop_up(database, connection, monkeypatch):
    """As where its machine answers the network and nothing else: the lock stands for that."""
    monkeypatch.setattr(heartbeat, "_STOP_PATIENCE", 0.5)
    beats = []
    heart = Heartbeat(database.lasting_connections(), "here", "", 0.3, lambda: True, beats.append)
    heart.start()
    eventually(lambda: beats, PATIENCE)
    connection.execute(sa.text("BEGIN"))
    connection.execute(sa.text("LOCK TABLE gateways IN ACCESS EXCLUSIVE MODE"))
    time.sleep(0.5)  # the next beat waits
    begun = time.monotonic()
    heart.stop()
    assert time.monotonic() - begun < 3
    connection.execute(sa.text("ROLLBACK"))


async def test_abandoned_sessions_are_those_that_nobody_serves_and_that_have_expired(url, opened):
    registries = []
    database = opened(url, attach=lambda database: registries.append(Registry(database, 1e9)))
    leases = Leases(database, "here")
    with database.lasting_connections().connect() as connection:
        table.reclaim(connection, "here", "", SPAN, False)
        for uid, (name, expiry) in enumerate({"over": time.time() - 60, "fresh": time.time() + 60, "served": 1.0}.items()):
            await leases.claim(name, uid, None)
            session = record(name, "here")
            session.session.expire_time.FromNanoseconds(int(expiry * 1e9))
            registries[0].save(replace(session, uid=uid))
            assert await registries[0].written(uid, PATIENCE)
            if name != "served":
                await leases.release(uid, 1)
        await leases.claim("unregistered", 9, None)
        await leases.release(9, 1)
    found = {lease.id: row and row.id for lease, row in await leases.abandoned(10)}
    assert found == {"over": "over", "unregistered": None}


def test_sqlite_has_no_lasting_connections(tmp_path, opened):
    assert opened(f"sqlite:///{tmp_path}/test.sqlite").lasting_connections() is None


def test_a_statement_that_is_fenced_names_its_column(database):
    text = str(
        database.upsert(
            sa.Table("t", sa.MetaData(), sa.Column("a", sa.Integer, primary_key=True), sa.Column("epoch", sa.Integer)),
            fence="epoch",
        )
    )
    assert "epoch <=" in text
