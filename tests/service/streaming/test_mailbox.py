"""Backpressure: mailboxes, rate limit and overload detection."""

import asyncio

import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.streaming.mailbox import LosslessMailbox, RealtimeMailbox, mailbox_for
from ddakf_service.streaming.rate_limit import Overload, RateLimit


def frame(number):
    return pb.Frame(sequence_number=number)


async def take(mailbox):
    waiting = await mailbox.get()
    return waiting and waiting.frame.sequence_number


async def test_realtime_keeps_the_newest_and_counts_the_others():
    mailbox = RealtimeMailbox()
    assert [await mailbox.put(frame(i), 0.0) for i in (1, 2, 3)] == [0, 1, 1]
    assert len(mailbox) == 1
    assert await take(mailbox) == 3


async def test_lossless_keeps_all_in_order_and_holds_the_sender_back():
    mailbox = LosslessMailbox(2)
    await mailbox.put(frame(1), 0.0)
    await mailbox.put(frame(2), 0.0)
    third = asyncio.create_task(mailbox.put(frame(3), 0.0))
    await asyncio.sleep(0.01)
    assert not third.done()
    assert await take(mailbox) == 1
    await third
    assert [await take(mailbox), await take(mailbox)] == [2, 3]


@pytest.mark.parametrize("mode", [pb.FLOW_MODE_REALTIME, pb.FLOW_MODE_LOSSLESS])
async def test_after_closing_what_waits_is_still_handed_out(mode):
    mailbox = mailbox_for(mode, 4)
    await mailbox.put(frame(7), 0.0)
    mailbox.close()
    assert await take(mailbox) == 7
    assert await take(mailbox) is None


@pytest.mark.parametrize("mode", [pb.FLOW_MODE_REALTIME, pb.FLOW_MODE_LOSSLESS])
async def test_closing_wakes_who_waits(mode):
    mailbox = mailbox_for(mode, 1)
    taker = asyncio.create_task(take(mailbox))
    await asyncio.sleep(0)
    mailbox.close()
    assert await taker is None


async def test_closing_frees_a_sender_that_is_held_back():
    mailbox = LosslessMailbox(1)
    await mailbox.put(frame(1), 0.0)
    sender = asyncio.create_task(mailbox.put(frame(2), 0.0))
    await asyncio.sleep(0)
    mailbox.close()
    await asyncio.wait_for(sender, 30)


@pytest.mark.parametrize("rate", [0.5, 10.0, 90.0])
def test_a_rate_is_kept_in_the_mean_and_a_stutter_is_no_offence(rate):
    limit, interval = RateLimit(), 0.5 / rate
    passed = sum(limit.wait(rate, 100.0 + i * interval) == 0 for i in range(1000))
    assert passed == pytest.approx(500 + 0.1 * rate, abs=2)
    punctual = RateLimit()
    stutter = (100.0 + (i + 0.1 * (i % 2)) / rate for i in range(200))
    refused = sum(punctual.wait(rate, now) > 0 for now in stutter)
    assert refused <= (0 if rate > 20 else 100)


def test_who_waits_as_long_as_is_said_may_come():
    limit, now = RateLimit(), 5.0
    for _ in range(20):
        if pause := limit.wait(10.0, now):
            now += pause
            assert limit.wait(10.0, now) == 0
    assert now == pytest.approx(5.0 + 1.9)
    assert limit.wait(0.0, now) == 0, "no bound"


def told(share, seconds, overload, start):
    """Notices to a client of 100 frames per second when this share of its frames is missed."""
    rates = []
    for i in range(int(100 * seconds)):
        if (i * share) % 1 + share >= 1:
            rates.append(overload.missed(1, start + i / 100))
        else:
            overload.applied()
    return [rate for rate in rates if rate]


def test_overload_is_told_once_and_rarely_repeated():
    overload = Overload(0.0)
    assert told(0.1, 5, overload, 0.0) == []
    (rate,) = told(0.5, 8, overload, 5.0)
    assert rate == pytest.approx(50, abs=5)
    assert told(0.15, 10, overload, 13.0) == [], "between the two shares nothing changes"
    assert len(told(0.5, 25, overload, 30.0)) == 3


def test_what_is_over_and_begins_again_is_told_again():
    overload = Overload(0.0)
    assert len(told(0.5, 3, overload, 0.0)) == 1
    assert told(0.02, 2, overload, 3.0) == []
    assert len(told(0.5, 3, overload, 5.0)) == 1
