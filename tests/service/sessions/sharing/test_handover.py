"""Leases without a session: a caller who left while it was opened or brought leaves none for good."""

from __future__ import annotations

import asyncio
import time
import uuid

import pytest
from ddakf_service.observability.metrics import Metrics
from ddakf_service.sessions.recovery.tenure import Tenure
from ddakf_service.sessions.sharing.handover import _LONGEST_OPENING, Handover
from ddakf_service.store.tables import leases as table
from ddakf_service.store.tables.database import Database
from ddakf_service.store.tables.heartbeat import Beat
from ddakf_service.store.tables.leases import Leases

SPAN = 600.0  # seconds


class Catalog:
    """A gateway without sessions."""

    def __iter__(self):
        return iter(())

    def live(self, ids):
        return []


class Tasks:
    """Tasks in the background."""

    def __init__(self):
        self.tasks = []

    def background(self, work) -> asyncio.Task:
        self.tasks.append(asyncio.create_task(work))
        return self.tasks[-1]


@pytest.fixture
def database(postgres):
    database = Database(postgres.new_database(f"handover-{uuid.uuid4()}"), Metrics())
    database.open()
    yield database
    database.close()


async def test_a_lease_that_stays_without_its_session_is_released(database):
    with database.lasting_connections().connect() as connection:
        table.reclaim(connection, "here", "", SPAN, False)
    leases, tasks = Leases(database, "here"), Tasks()
    await leases.claim("some-session", 7, "key")
    handover = Handover(leases, Catalog(), None, tasks, None, Tenure(), Metrics())
    began = time.monotonic()
    for seconds in (0.0, _LONGEST_OPENING / 2, _LONGEST_OPENING):
        handover.follow(Beat(began + seconds, began + SPAN, [await leases.find("some-session")]))
    assert tasks.tasks == [], "it may still be opened"
    handover.follow(Beat(began + _LONGEST_OPENING + 1, began + SPAN, [await leases.find("some-session")]))
    await asyncio.gather(*tasks.tasks)
    assert (await leases.find("some-session")).gateway == ""
    (lease, record), *_ = await leases.abandoned(10)
    assert (lease.id, record) == ("some-session", None), "the next look at abandoned sessions deletes it"
