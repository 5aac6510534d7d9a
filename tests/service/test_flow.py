"""Mailboxes: the newest wins, or all in order with a bounded queue."""

import asyncio

import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.flow import LosslessMailbox, RealtimeMailbox, mailbox_for


def frame(number):
    return pb.Frame(sequence_number=number)


async def take(mailbox):
    waiting = await mailbox.get()
    return waiting and waiting.frame.sequence_number


async def test_realtime_keeps_the_newest_and_counts_the_others():
    mailbox = RealtimeMailbox()
    assert [await mailbox.put(frame(i)) for i in (1, 2, 3)] == [0, 1, 1]
    assert len(mailbox) == 1
    assert await take(mailbox) == 3


async def test_lossless_keeps_all_in_order_and_holds_the_sender_back():
    mailbox = LosslessMailbox(2)
    await mailbox.put(frame(1))
    await mailbox.put(frame(2))
    third = asyncio.create_task(mailbox.put(frame(3)))
    await asyncio.sleep(0.01)
    assert not third.done()
    assert await take(mailbox) == 1
    await third
    assert [await take(mailbox), await take(mailbox)] == [2, 3]


@pytest.mark.parametrize("mode", [pb.FLOW_MODE_REALTIME, pb.FLOW_MODE_LOSSLESS])
async def test_after_closing_what_waits_is_still_handed_out(mode):
    mailbox = mailbox_for(mode, 4)
    await mailbox.put(frame(7))
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
    await mailbox.put(frame(1))
    sender = asyncio.create_task(mailbox.put(frame(2)))
    await asyncio.sleep(0)
    mailbox.close()
    await asyncio.wait_for(sender, 1)
