"""Leases without a session: a caller who left while it was opened or brought leaves none for good."""

from __future__ import annotations

import time
import uuid
from dataclasses import replace

import pytest
from ddakf_api.errors import SessionExpired, to_detail
from ddakf_service.background_tasks import BackgroundTasks
from ddakf_service.observability.metrics import Metrics
from ddakf_service.sessions.recovery.persistence import Persistence
from ddakf_service.sessions.recovery.tenure import Tenure
from ddakf_service.sessions.sharing.handover import _LONGEST_OPENING, Handover
from ddakf_service.store.tables import leases as table
from ddakf_service.store.tables.database import Database
from ddakf_service.store.tables.heartbeat import Beat
from ddakf_service.store.tables.leases import Leases
from ddakf_service.store.tables.registry import Registry

from ...store.conftest import record

SPAN = 600.0  # seconds


class Catalog:
    """A gateway without sessions."""

    def __iter__(self):
        return iter(())

    def live(self, ids):
        return []


@pytest.fixture
def database(postgres):
    return Database(postgres.new_database(f"handover-{uuid.uuid4()}"), Metrics())


@pytest.fixture
def registry(database):
    """The sessions of an open database with the leases of this gateway."""
    registry = Registry(database, retention=SPAN)
    database.open()
    with database.lasting_connections().connect() as connection:
        table.reclaim(connection, "here", "", SPAN, False)
    yield registry
    database.close()


@pytest.fixture
def leases(database, registry):
    return Leases(database, "here")


def handover_of(leases, registry, tasks) -> Handover:
    persistence = Persistence(registry, None, None, "here", lambda: None, Tenure(), leases)
    return Handover(leases, Catalog(), persistence, None, tasks, None, Tenure(), Metrics())


async def test_a_lease_that_stays_without_its_session_is_released(leases, registry):
    tasks = BackgroundTasks()
    await leases.claim("some-session", 7, "key")
    handover = handover_of(leases, registry, tasks)
    began = time.monotonic()
    for seconds in (0.0, _LONGEST_OPENING / 2, _LONGEST_OPENING - 1):
        handover.follow(Beat(began + seconds, began + SPAN, [await leases.find("some-session")]))
    assert not tasks, "it may still be opened"
    handover.follow(Beat(began + _LONGEST_OPENING + 1, began + SPAN, [await leases.find("some-session")]))
    await tasks.settle(10.0)
    assert (await leases.find("some-session")).gateway == ""
    (lease, record), *_ = await leases.abandoned(10)
    assert (lease.id, record) == ("some-session", None), "the next look at abandoned sessions deletes it"


async def test_a_session_whose_end_is_not_written_yet_is_left_to_no_other_gateway(leases, registry):
    """Another one asks for it meanwhile."""
    tasks, began = BackgroundTasks(), time.monotonic()
    session = replace(record(), uid=7, epoch=await leases.claim("some-session", 7, "key"))
    registry.save(session)
    assert await registry.written(7, SPAN)
    asked = (await leases.find("some-session"))._replace(wanted_by="there")
    registry.end(session, to_detail(SessionExpired("it was left")))
    handover_of(leases, registry, tasks).follow(Beat(began, began + SPAN, [asked]))
    await tasks.settle(10.0)
    assert await leases.find("some-session") is None, "its end has deleted it"


async def test_only_the_lease_of_the_session_itself_is_released(leases, registry):
    """Its id belongs to a later session meanwhile, with a lease of the same epoch."""
    tasks, began = BackgroundTasks(), time.monotonic()
    await leases.claim("some-session", 7, "key")
    asked = (await leases.find("some-session"))._replace(wanted_by="there")
    await leases.drop(7)
    await leases.claim("some-session", 8, "key")
    handover_of(leases, registry, tasks).follow(Beat(began, began + SPAN, [asked]))
    await tasks.settle(10.0)
    assert (await leases.find("some-session")).gateway == "here"
