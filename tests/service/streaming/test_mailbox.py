"""Backpressure: mailboxes, rate limit and overload detection."""

import asyncio

import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.sessions.responses.response import Response
from ddakf_service.streaming.mailbox import LosslessMailbox, RealtimeMailbox, mailbox_for
from ddakf_service.streaming.outbox import Outbox
from ddakf_service.streaming.rate_limit import Overload, RateLimit, frame_bucket


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
async def test_what_waits_can_be_removed_and_is_counted(mode):
    mailbox = mailbox_for(mode, 3)
    await mailbox.put(frame(1), 0.0)
    assert [mailbox.clear(), mailbox.clear(), len(mailbox)] == [1, 0, 0]
    await mailbox.put(frame(2), 0.0)
    assert await take(mailbox) == 2


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
    assert mailbox.clear() + await asyncio.wait_for(sender, 30) == 2
    assert len(mailbox) == 0


async def test_one_response_waits_for_a_slow_reader():
    outbox = Outbox(lambda response, frame: None)
    await outbox.put(Response(pb.TrackResponse()))
    second = asyncio.create_task(outbox.put(Response(pb.TrackResponse())))
    await asyncio.sleep(0)
    assert not second.done()
    await outbox.get()
    await asyncio.wait_for(second, 30)


async def test_a_notice_replaces_a_queued_one_but_losses_are_all_told():
    outbox = Outbox(lambda response, frame=b"": None)
    for kind in (pb.NOTICE_KIND_WAITING, pb.NOTICE_KIND_RESUMED):
        for value in (2.0, 3.0):
            outbox.notify(pb.Notice(kind=kind, value=value))
    notices = [(await outbox.get()).message.notice for _ in range(3)]
    assert [(notice.kind, notice.value) for notice in notices] == [
        (pb.NOTICE_KIND_WAITING, 3.0), (pb.NOTICE_KIND_RESUMED, 2.0), (pb.NOTICE_KIND_RESUMED, 3.0)
    ]  # fmt: skip


@pytest.mark.parametrize("rate", [0.5, 10.0, 90.0])
def test_a_rate_is_kept_in_the_mean_and_a_stutter_is_no_offence(rate):
    limit, interval = frame_bucket(), 0.5 / rate
    passed = sum(limit.wait(rate, 100.0 + i * interval) == 0 for i in range(1000))
    assert passed == pytest.approx(500 + 0.1 * rate, abs=2)
    punctual = frame_bucket()
    stutter = (100.0 + (i + 0.1 * (i % 2)) / rate for i in range(200))
    refused = sum(punctual.wait(rate, now) > 0 for now in stutter)
    assert refused <= (0 if rate > 20 else 100)


def test_who_waits_as_long_as_is_said_may_come():
    limit, now = frame_bucket(), 5.0
    for _ in range(20):
        if pause := limit.wait(10.0, now):
            now += pause
            assert limit.wait(10.0, now) == 0
    assert now == pytest.approx(5.0 + 1.9)
    assert limit.wait(0.0, now) == 0, "no bound"


def test_the_streams_of_a_key_share_its_rate():
    of_key = frame_bucket()
    one, other = RateLimit(of_key, 20.0), RateLimit(of_key, 20.0)
    assert sum(one.wait(0.0, 100.0 + i / 60)[0] == 0 for i in range(600)) == pytest.approx(200, abs=3)
    shared = sum(stream.wait(0.0, 200.0 + i / 60)[0] == 0 for i in range(600) for stream in (one, other))
    assert shared == pytest.approx(200, abs=3)
    assert one.wait(0.0, 209.99)[1] == 20.0
    slow = RateLimit(frame_bucket(), 20.0)
    passed = sum(slow.wait(5.0, 300.0 + i / 60)[0] == 0 for i in range(600))
    assert passed == pytest.approx(50, abs=2), "a frame that the session refuses costs the key none"


def told(share, seconds, overload, start):
    """Notices to a client of 100 frames per second when this share of its frames is missed."""
    rates = []
    for i in range(int(100 * seconds)):
        if (i * share) % 1 + share >= 1:
            rates.append(overload.missed(1, start + i / 100))
        else:
            overload.applied(start + i / 100)
    return [rate for rate in rates if rate]


def test_overload_is_told_once_and_rarely_repeated():
    overload = Overload()
    assert told(0.1, 5, overload, 0.0) == []
    (rate,) = told(0.5, 8, overload, 5.0)
    assert rate == pytest.approx(50, abs=5)
    assert told(0.15, 10, overload, 13.0) == [], "between the two shares nothing changes"
    assert len(told(0.5, 25, overload, 30.0)) == 3


def test_what_is_over_and_begins_again_is_told_again():
    overload = Overload()
    assert len(told(0.5, 3, overload, 0.0)) == 1
    assert told(0.02, 2, overload, 3.0) == []
    assert len(told(0.5, 3, overload, 5.0)) == 1


@pytest.mark.parametrize("pause", [0.0, 2.0, 60.0])
@pytest.mark.parametrize("tracked", [0.4, 3.0, 40.0])
def test_the_rate_of_a_notice_was_tracked(tracked, pause):
    """A client sends 100 frames per second in bursts of 15 s; the first frames of each wait for the worker."""
    overload, now, rates = Overload(), 50.0, []
    for _ in range(3):
        now += pause
        applied, begun = 0, now
        while now < begun + 15.0:
            if now > begun + (applied + 2) / tracked:
                overload.applied(now)
                applied += 1
            else:
                rates.append(overload.missed(1, now))
            now += 0.01
    rates = [rate for rate in rates if rate]
    assert rates
    slowest = tracked if pause != 2.0 else 1 / (1 / tracked + pause + 2 / tracked)
    assert all(0.97 * slowest <= rate <= 1.03 * tracked for rate in rates), rates


def test_no_rate_is_named_before_one_is_known():
    overload = Overload()
    assert not any(overload.missed(1, i / 100) for i in range(1000))
    overload.applied(10.0)
    assert not any(overload.missed(1, 10 + i / 100) for i in range(100))
    overload.applied(11.0)
    assert overload.missed(1, 11.01) == pytest.approx(1.0)
