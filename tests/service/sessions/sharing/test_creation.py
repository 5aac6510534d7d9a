"""Creation where servers share sessions: one session per request, whichever servers get it, and whether or not one is lost."""

from __future__ import annotations

import asyncio
import uuid

import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import Draining, InvalidMesh, ResourceExhausted, SessionExists, Unavailable
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.metrics import Metrics
from ddakf_service.sessions import lifecycle, service
from ddakf_service.settings import Settings
from ddakf_service.store.store import Store
from ddakf_service.store.tables.leases import Leases


class Pool:
    """Workers that open a session once they may.

    Attributes:
        asked: set when one is asked for.
    """

    def __init__(self):
        self.asked, self.may_open, self.refuses = asyncio.Event(), asyncio.Event(), False
        self.may_open.set()

    async def open(self, session_id, request, memory):
        self.asked.set()
        await self.may_open.wait()
        if self.refuses:
            raise InvalidMesh("no garment")
        return pb.Session().SerializeToString()

    async def snapshot(self, session_id):
        return b""

    def count_memory(self, session_id, memory):
        return

    async def close(self, session_id):
        return


class Gateway:
    """The sessions of a server that shares them."""

    def __init__(self, name: str, folder, url: str):
        settings = Settings(
            data_dir="none", server_id=name, database_url=url, checkpoint_url=str(folder), share_sessions=True
        )
        self.store, self.pool = Store(settings, Metrics()), Pool()
        self.sessions = service.Sessions(self.pool, settings, Metrics(), self.store)

    def create(self, **fields) -> asyncio.Task[pb.Session]:
        request = pb.CreateSessionRequest(api_version=API_VERSION, request_id="the same", **fields)
        return asyncio.create_task(self.sessions.create(request))


@pytest.fixture
async def gateways(postgres, tmp_path):
    url = postgres.new_database(f"creation-{uuid.uuid4()}")
    gateways = [Gateway(name, tmp_path, url) for name in ("one", "two")]
    await asyncio.gather(*(gateway.sessions.load() for gateway in gateways))
    yield gateways
    await asyncio.gather(*(asyncio.to_thread(gateway.store.close) for gateway in gateways))


@pytest.mark.parametrize("session_id", ["", "mine"])
async def test_a_creation_that_is_repeated_elsewhere_meanwhile_makes_one_session(gateways, session_id):
    one, two = gateways
    one.pool.may_open.clear()
    first = one.create(session_id=session_id)
    await one.pool.asked.wait()
    second = two.create(session_id=session_id)
    done, _ = await asyncio.wait({second}, timeout=2 * lifecycle._CREATION_LOOK_INTERVAL)
    assert not done, "it waits for the first"
    one.pool.may_open.set()
    assert (await second).name == (await first).name
    assert not two.pool.asked.is_set()


async def test_a_repeated_creation_waits_only_so_long(gateways, monkeypatch):
    monkeypatch.setattr(lifecycle, "_CREATION_PATIENCE", 0.0)
    one, two = gateways
    one.pool.may_open.clear()
    first = one.create()
    await one.pool.asked.wait()
    with pytest.raises(Unavailable, match="is being created") as refused:
        await two.create()
    assert refused.value.retry_after > 0
    one.pool.may_open.set()
    name = (await first).name
    assert (await two.create()).name == name


async def test_a_creation_that_failed_is_made_elsewhere(gateways):
    one, two = gateways
    one.pool.may_open.clear()
    one.pool.refuses = True
    first = one.create(session_id="mine")
    await one.pool.asked.wait()
    second = two.create(session_id="mine")
    one.pool.may_open.set()
    with pytest.raises(InvalidMesh):
        await first
    assert (await second).name == "sessions/mine"
    assert "mine" in two.sessions._catalog


async def test_a_creation_whose_caller_leaves_during_its_claim_leaves_no_lease(gateways, monkeypatch):
    one, two = gateways
    claim, claimed, told = Leases.claim, asyncio.Event(), asyncio.Event()

    async def slow(leases, *of, **room):
        epoch = await claim(leases, *of, **room)
        claimed.set()
        await told.wait()
        return epoch

    monkeypatch.setattr(Leases, "claim", slow)
    creation = one.create(session_id="mine")
    await claimed.wait()
    creation.cancel()
    await asyncio.wait({creation})
    told.set()
    await one.sessions._tasks.settle(10.0)
    assert await Leases(two.store.database, "two").find("mine") is None
    assert (await two.create(session_id="mine")).name == "sessions/mine"


@pytest.mark.parametrize("server", ["two", "gone"])
async def test_a_creation_that_was_cut_off_with_its_server_is_made_anew(gateways, server):
    """The server has started again, or is gone."""
    _, two = gateways
    assert await Leases(two.store.database, server).claim("mine", 7, None, "the same") == 1
    assert (await two.create(session_id="mine")).name == "sessions/mine"
    assert "mine" in two.sessions._catalog


async def test_a_key_has_no_more_sessions_than_its_quota_however_many_servers_it_asks_at_once(gateways):
    def require_room(count: int) -> None:
        if count >= 3:
            raise ResourceExhausted("full")

    leases = [Leases(gateway.store.database, gateway.store.server_id) for gateway in gateways]
    claims = [leases[uid % 2].claim(f"s-{uid}", uid, "key", require_room=require_room) for uid in range(12)]
    outcomes = await asyncio.gather(*claims, return_exceptions=True)
    assert outcomes.count(1) == 3
    assert sum(isinstance(outcome, ResourceExhausted) for outcome in outcomes) == 9


@pytest.mark.parametrize("state", ["full", "stopping"])
async def test_a_server_without_room_ends_the_sessions_of_others(gateways, state):
    one, two = gateways
    name = (await one.create(session_id="mine")).name
    admission = two.sessions._admission
    if state == "full":
        admission._settings = admission._settings.model_copy(update={"max_sessions": 0})
    else:
        admission.draining = True
    with pytest.raises((Draining, ResourceExhausted)):
        await two.sessions.reset(pb.ResetSessionRequest(name=name))
    await two.sessions.delete(name)
    assert await Leases(one.store.database, "one").find("mine") is None


async def test_a_request_is_that_of_a_key(gateways):
    one, two = gateways
    leases = Leases(one.store.database, "one")
    await leases.claim("of-a-key", 7, "key", "the same")
    assert (await two.create()).name != "sessions/of-a-key"
    with pytest.raises(SessionExists):
        await two.sessions.create(pb.CreateSessionRequest(api_version=API_VERSION, session_id="of-a-key", request_id="another"))
