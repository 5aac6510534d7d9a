"""Asynchronous client, over a real socket."""

import asyncio
import time

import numpy as np
import pytest
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import FrameError, aconnect, errors

from .conftest import in_one_buffer


async def collected(stream):
    return [answer async for answer in stream]


async def note(stream, seen):
    async for answer in stream:
        seen.append(answer.sequence)


async def test_frames_in_results_out(service, mesh, frames):
    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        results = await collected(session.track(frames(20), covariance=True))
        assert (await session.info()).applied == 20
    assert service.sessions == {}
    assert [r.sequence for r in results] == list(range(1, 21))
    assert np.abs(results[19].vertices - (mesh[0] + [0.19, 0, 0])).max() < 0.0003
    assert results[0].covariance.shape == (4, 3, 3)


async def test_an_option_that_is_none_is_the_sessions(service, mesh, frames):
    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        results = await collected(session.track(frames(5), flow=None, codec=None, step=None, timeout=None))
    assert [r.sequence for r in results] == [1, 2, 3, 4, 5]


async def test_an_asynchronous_source_in_realtime(service, mesh, frames):
    service.delay = 0.03

    async def camera():
        for frame in frames(60):
            await asyncio.sleep(0.003)
            yield frame

    async with aconnect(service.target) as client, client.create_session(*mesh) as session:
        results = await collected(session.track(camera()))
    assert results[-1].sequence == 60
    assert results[-1].applied + results[-1].dropped == 60
    assert len(results) < 40


async def test_lossless_mode_slows_the_source(service, mesh, frames):
    service.delay = 0.005
    pulled, lead = [0], []

    async def source():
        for frame in frames(30):
            pulled[0] += 1
            yield frame

    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        async for result in session.track(source()):
            lead.append(pulled[0] - result.sequence)
    assert len(lead) == 30
    assert max(lead) <= 6


async def test_errors_of_frames_and_of_the_server(service, mesh, frames):
    made = frames(4)
    made[1] = (np.full((2, 3), np.nan), 0.5)
    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(errors.CodecError, match="finite"):
            await collected(session.track(made))
        answers = await collected(session.track(made, on_error="yield"))
        assert sum(isinstance(a, FrameError) for a in answers) == 1
        assert len(answers) == 4
        service.lost_from = 0
        with pytest.raises(errors.WorkerLost):
            await collected(session.track(frames(3)))


async def test_a_frame_above_the_limit_is_refused_and_the_stream_goes_on(service, mesh, frames):
    service.max_message_bytes, made = 100_000, frames(4)
    made[2] = (np.random.default_rng(0).uniform(-1, 1, (20_000, 3)), 1.0)
    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless", codec="raw") as session:
        answers = await collected(session.track(made, on_error="yield"))
    assert [type(answer).__name__ for answer in answers] == ["Result", "Result", "FrameError", "Result"]
    assert type(answers[2].error) is errors.MessageTooLarge


async def test_a_frame_that_cannot_be_sent_is_refused_although_no_other_frame_comes(service, mesh, frames):
    told = [asyncio.Event() for _ in range(4)]

    async def source():
        for i, good in enumerate(frames(4)):
            yield (np.full((2, 3), np.nan), i / 30) if i in (1, 2) else good
            await asyncio.wait_for(told[i].wait(), 10)

    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        answers = []
        async for answer in session.track(source(), on_error="yield"):
            answers.append((answer.sequence, type(answer).__name__))
            told[answer.sequence - 1].set()
    assert answers == [(1, "Result"), (2, "FrameError"), (3, "FrameError"), (4, "Result")]


@pytest.mark.parametrize("bad_frame", ["ragged points", "code that fails"], indirect=True)
async def test_a_bad_frame_names_its_field_and_the_stream_goes_on(service, mesh, frames, bad_frame):
    made, (bad, field) = frames(3), bad_frame
    made[1] = bad
    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        answers = await collected(session.track(made, on_error="yield"))
        with pytest.raises(errors.InvalidFrame, match=rf"^{field}: expected .*, got ") as refusal:
            await collected(session.track(made))
    refused = [a for a in answers if isinstance(a, FrameError)]
    assert [a.sequence for a in answers if not isinstance(a, FrameError)] == [1, 3]
    assert [(a.sequence, a.error.field) for a in refused] == [(2, field)]
    assert refusal.value.field == field


@pytest.mark.parametrize("error", [OSError("unplugged"), errors.InvalidFrame("of the camera")])
@pytest.mark.parametrize("on_error", ["raise", "yield"])
async def test_an_error_of_the_source_reaches_the_caller_unchanged(service, mesh, frames, error, on_error):
    async def source():
        yield frames(1)[0]
        raise error

    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(type(error)) as raised:
            await collected(session.track(source(), on_error=on_error, timeout=3))
        assert raised.value is error


async def test_frames_before_an_error_of_the_source_are_answered_first(service, mesh, frames):
    service.delay, seen = 0.02, []

    async def source():
        for frame in frames(10):
            yield frame
        raise OSError("unplugged")

    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(OSError, match="unplugged"):
            await note(session.track(source()), seen)
    assert seen == list(range(1, 11))


@pytest.mark.parametrize("kind", ["asynchronous", "ordinary"])
async def test_a_source_that_is_cancelled_is_an_error_after_the_answers(service, mesh, frames, kind):
    camera, seen = asyncio.get_running_loop().create_future(), []

    async def source():
        for frame in frames(5):
            yield frame
        camera.cancel()
        await camera

    def ordinary():
        yield from frames(5)
        raise asyncio.CancelledError

    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        stream = session.track(source() if kind == "asynchronous" else ordinary())
        with pytest.raises(errors.Cancelled, match=r"^the source of frames was cancelled$"):
            await note(stream, seen)
    assert seen == [1, 2, 3, 4, 5]


@pytest.mark.parametrize("leave", ["break", "aclose"])
async def test_an_ordinary_source_may_be_used_again_after_its_stream(service, mesh, frames, leave):
    def camera():
        for frame in frames(100):
            time.sleep(0.05)
            yield frame

    source, seen = camera(), []
    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        for _ in range(2):
            stream = session.track(source, takeover=True)
            async for answer in stream:
                seen.append(answer.sequence)
                if len(seen) % 3 == 0:
                    break
            if leave == "aclose":
                await stream.aclose()
                assert next(source)  # no other thread runs the generator
            del stream
    assert len(seen) == 6
    assert seen == sorted(seen)


async def test_invalid_arguments_are_refused_before_sending(service, mesh):
    async with aconnect(service.target) as client:
        for call, field in [
            (lambda: client.create_session(*mesh, labels={"a": 1}), "labels['a']"),
            (lambda: client.restore_session("abc"), "snapshot"),
            (lambda: client.open_session(5), "session_id"),
            (lambda: client.delete_mesh(5), "name"),
        ]:
            with pytest.raises(errors.InvalidArgument, match="expected") as refusal:
                await call()
            assert refusal.value.field == field
        session = await client.create_session(*mesh)
        with pytest.raises(errors.InvalidArgument, match=r"^on_notice: expected"):
            session.watch(on_notice=None)
        with pytest.raises(errors.InvalidArgument, match=r"^vertices: expected"):
            await session.reset([[0, 0, 0], [1, 0]])


async def test_the_longest_timeout_is_none_that_expires(service, mesh):
    async with aconnect(service.target, timeout=1e9) as client, client.create_session(*mesh, flow="lossless") as session:
        assert [result.sequence for result in await collected(session.track([(mesh[0], 1.0)]))] == [1]


async def test_a_silent_server_runs_into_the_timeout(service, mesh, frames):
    service.silent_from = 2
    async with aconnect(service.target) as client, client.create_session(*mesh, flow="lossless") as session:
        with pytest.raises(errors.DeadlineExceeded, match=r"no answer to frame 2 within 1 s"):
            await collected(session.track(frames(3), timeout=1))


async def test_a_stream_can_be_left_and_cancelled(service, mesh, frames):
    async def endless():
        while True:
            for frame in frames(10):
                await asyncio.sleep(0.001)
                yield frame

    async with aconnect(service.target) as client, client.create_session(*mesh) as session:
        stream = session.track(endless())
        assert (await anext(stream)).sequence
        await stream.aclose()
        before = len(service.frames)
        task = asyncio.create_task(collected(session.track(endless())))
        while len(service.frames) == before:
            await asyncio.sleep(0.001)
        task.cancel()
        with pytest.raises(asyncio.CancelledError):
            await task
        assert (await session.info()).applied > 0


async def test_session_calls(service, mesh):
    client = await aconnect(service.target, api_key="k")
    session = await client.create_session(*mesh, session_id="alpha", labels={"a": "b"})
    assert [s.session_id async for s in client.sessions(labels={"a": "b"})] == ["alpha"]
    assert (await session.reset()).state == "initializing"
    assert (await session.update(labels={"c": "d"})).labels == {"c": "d"}
    async with client.restore_session(await session.snapshot(), session_id="other") as restored:
        assert restored.name == "sessions/other"
    async with client.open_session("alpha") as again:
        assert again.session_id == "alpha"
    assert list(service.sessions) == ["sessions/alpha"]
    await session.delete()
    with pytest.raises(errors.SessionNotFound):
        await session.info()
    await client.close()
    assert set(service.keys) == {"Bearer k"}


async def test_no_server_and_another_version(service):
    with pytest.raises(errors.Unavailable, match="does not answer"):
        await aconnect("127.0.0.1:1")
    service.api_version = "7.0"
    with pytest.raises(errors.VersionMismatch, match=r"'7\.0'"):
        async with aconnect(service.target):
            pass


@pytest.mark.parametrize("forget", [0, 3])
async def test_a_stream_reconnects_without_losing_a_frame(outage, mesh, frames, forget):
    outage.service.delay = 0.01
    notices, sequences = [], []
    async with aconnect(outage.target) as client, client.create_session(*mesh, flow="lossless") as session:
        async for result in session.track(in_one_buffer(frames(40)), on_notice=notices.append):
            sequences.append(result.sequence)
            assert result.vertices[0, 0] == pytest.approx((result.sequence - 1) / 100, abs=0.001)
            if result.sequence in (10, 25):
                await asyncio.to_thread(outage.strike, forget=forget)
    assert sequences == sorted(sequences)
    assert sequences[-1] == 40
    assert {frame.sequence_number for frame in outage.service.frames} == set(range(1, 41))
    assert [notice.kind for notice in notices] == ["resumed"] * 2


async def test_a_connection_lost_for_too_long_is_an_error(outage, mesh, frames):
    async with aconnect(outage.target) as client:
        session = await client.create_session(*mesh, flow="lossless")
        stream = session.track(frames(1000), resume=0.5)
        await anext(stream)
        outage.server.stop(0).wait()
        with pytest.raises(errors.Unavailable):
            await collected(stream)
        outage.start()


async def test_a_reconnect_notice_redirects_the_client(outage, service, mesh, frames):
    async with aconnect(outage.target) as client:
        session = await client.create_session(*mesh, flow="lossless")
        service.answered = outage.service.answered
        moved = service.sessions[session.name] = pb.Session()
        moved.CopyFrom(outage.service.sessions[session.name])
        moved.statistics.last_sequence_number = 2
        outage.service.drains_at = 3
        outage.service.notice = pb.Notice(kind=pb.NOTICE_KIND_RECONNECT, message="elsewhere", target=service.target)
        results = await collected(session.track(frames(6), on_notice=lambda _: None))
        assert client.target == service.target
    assert [result.sequence for result in results] == [1, 2, 3, 4, 5, 6]


async def test_a_closed_client_says_so(service, mesh, frames):
    client = await aconnect(service.target)
    session = await client.create_session(*mesh, flow="lossless")
    await client.close()
    for call in (lambda: collected(session.track(frames(3))), lambda: collected(session.watch()), session.info):
        with pytest.raises(errors.FailedPrecondition, match=r"^the client is closed$"):
            await call()


async def test_closing_a_client_ends_its_calls_with_an_error_and_cancels_no_task(service, mesh, frames):
    async def closing():
        await asyncio.sleep(0.1)
        await client.close()

    client = await aconnect(service.target)
    stream = (await client.create_session(*mesh, flow="lossless")).track(frames(5))
    assert (await anext(stream)).sequence == 1
    await client.close()
    with pytest.raises(errors.Cancelled, match=r"^the client is closed$"):
        await collected(stream)
    client, service.delay = await aconnect(service.target), 0.5
    closer = asyncio.create_task(closing())
    with pytest.raises(errors.Cancelled, match=r"^the client is closed$"):
        await client.server_info()
    await closer


async def test_an_error_inside_a_context_precedes_that_of_a_closed_client(service, mesh):
    async def leave_with_an_error():
        client = await aconnect(service.target)
        async with client.create_session(*mesh):
            await client.close()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await leave_with_an_error()
