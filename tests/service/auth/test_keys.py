"""The key ring, in front of a store that fails, recovers and changes."""

from __future__ import annotations

import asyncio
import time
from dataclasses import replace

import pytest
from ddakf_api.errors import ResourceExhausted, Unauthenticated, Unavailable
from ddakf_service.auth import guard, keys
from ddakf_service.auth.principal import Scope
from ddakf_service.auth.refusals import Refusals
from ddakf_service.observability.metrics import Metrics


class UnreachableKeys:
    """A key store that fails until it is ``there``."""

    def __init__(self):
        self.there, self.looks, self.kept = False, 0, []

    def all(self):
        self.looks += 1
        if not self.there:
            raise OSError("away")
        return self.kept


async def test_before_the_keys_are_read_nobody_is_told_that_theirs_is_unknown(monkeypatch):
    store, (_, presented) = UnreachableKeys(), keys.generate("somebody", [Scope.STREAM], 0.0)
    ring = keys.KeyRing(store, on_revoked=set)
    with pytest.raises(Unavailable, match="the keys cannot be read now"):
        await ring.principal(presented)
    store.there = True
    monkeypatch.setattr(keys, "_UNKNOWN_KEY_REFRESH", 0.0)
    with pytest.raises(Unauthenticated):
        await ring.principal(presented)


async def test_a_key_that_is_made_right_after_the_keys_were_read_counts_at_once():
    ring = keys.KeyRing(store := UnreachableKeys(), on_revoked=set)
    store.there = True
    await ring.start()
    key, presented = keys.generate("somebody", [Scope.STREAM], 0.0)
    store.kept.append(key)
    assert await ring.principal(presented) == key.principal
    await ring.stop()


async def test_an_expired_key_is_refused_with_its_time_and_loses_its_streams():
    shut_out = []
    ring = keys.KeyRing(store := UnreachableKeys(), on_revoked=shut_out.append)
    store.there = True
    limits = keys.KeyLimits(expires=time.time() + 3600)
    key, presented = keys.generate("guest", [Scope.STREAM], 0.0, limits)
    store.kept = [key]
    await ring.start()
    assert await ring.principal(presented) == key.principal
    await ring.stop()
    store.kept = [replace(key, limits=keys.KeyLimits(expires=1e9))]
    await ring.start()
    with pytest.raises(Unauthenticated, match="the key expired at 2001-09-09T01:46:40Z: ask for a new one"):
        await ring.principal(presented)
    with pytest.raises(Unauthenticated, match="not known"):
        await ring.principal(presented[:-1] + ("A" if presented[-1] != "A" else "B"))
    assert shut_out == [set(), {key.id}]
    await ring.stop()


async def test_a_key_calls_no_more_often_than_it_may(monkeypatch):
    now = 1000.0
    monkeypatch.setattr(guard, "monotonic", lambda: now)
    limits = keys.KeyLimits(requests_per_minute=30)
    (key, presented), (free, unlimited) = (keys.generate("k", [Scope.READ], 0.0, of) for of in (limits, keys.NO_LIMITS))
    ring = keys.KeyRing(store := UnreachableKeys(), on_revoked=set)
    store.there, store.kept = True, [key, free]
    await ring.start()
    door = guard.Guard(ring, Refusals(Metrics().calls_refused), anonymous=False, local=False)
    for _ in range(30):
        await door.admit(presented, guard.READ, {})
    with pytest.raises(ResourceExhausted, match="30 requests per minute; try again in 2 s") as refused:
        await door.admit(presented, guard.READ, {})
    assert refused.value.retry_after == pytest.approx(2.0)
    now += 2.0
    assert await door.admit(presented, guard.READ, {}) == key.principal
    for _ in range(100):
        await door.admit(unlimited, guard.READ, {})
    await ring.stop()


async def test_many_who_come_with_unknown_keys_share_one_look():
    ring = keys.KeyRing(store := UnreachableKeys(), on_revoked=set)
    store.there = True
    unknown = [keys.generate("nobody", [Scope.STREAM], 0.0)[1] for _ in range(20)]
    outcomes = await asyncio.gather(*(ring.principal(key) for key in unknown), return_exceptions=True)
    assert {type(outcome) for outcome in outcomes} == {Unauthenticated}
    assert store.looks == 1


async def test_trouble_with_one_change_does_not_end_the_watch_for_others(monkeypatch):
    told, (key, _) = [], keys.generate("somebody", [Scope.STREAM], 0.0)

    def on_revoked(ids):
        told.append(set(ids))
        if len(told) == 2:
            raise RuntimeError("a stream could not be ended")

    monkeypatch.setattr(keys, "_REFRESH", 0.0)
    ring = keys.KeyRing(store := UnreachableKeys(), on_revoked=on_revoked)
    store.there, store.kept = True, [key]
    await ring.start()
    async with asyncio.timeout(60):
        while len(told) < 3:
            await asyncio.sleep(0)
        store.kept = []
        while told[-1] != {key.id}:
            await asyncio.sleep(0)
    await ring.stop()
