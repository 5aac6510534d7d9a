"""Watchers see the client's responses and cannot delay them."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import threading
from pathlib import Path

import grpc
import numpy as np
import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import InvalidArgument, ResourceExhausted, SessionNotFound, VersionMismatch, from_rpc_error
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame, aconnect

from ...conftest import TIMEOUT, Api, eventually, frame_of, make_sheet, request_of

ARRAYS = {field.name for field in pb.Result.DESCRIPTOR.fields if field.message_type is pb.PackedArray.DESCRIPTOR}


@contextlib.contextmanager
def watching(api, name: str, **request):
    """The responses to an active watcher: Started is the first."""
    call = api.stub.WatchSession(pb.WatchSessionRequest(name=name, api_version=API_VERSION, **request), timeout=TIMEOUT)
    started = next(call)
    try:
        yield started, call
    finally:
        call.cancel()


def error_of(call) -> Exception:
    with pytest.raises(grpc.RpcError) as caught:
        list(call)
    return from_rpc_error(caught.value)


def resident_bytes(pid: int) -> int:
    return int(Path(f"/proc/{pid}/statm").read_text().split()[1]) * 4096


def test_a_late_watcher_is_told_where_the_session_is_and_gets_the_clients_answers(api, session, sheet):
    list(api.track(session, [request_of(frame_of(sheet, i)) for i in (1, 2)]))
    spoilt = frame_of(sheet, 4)
    spoilt.point_cloud.data = b"?"
    requests = [request_of(frame) for frame in (frame_of(sheet, 3), spoilt, frame_of(sheet, 5))]
    with watching(api, session) as (started, first), watching(api, session) as (_, second):
        assert started.started == pb.Started(name=session, last_sequence_number=2, last_capture_time=2 / 30)
        _, *answers = api.track(session, requests, result_options=pb.ResultOptions(include_covariance=True))
        assert [answer.WhichOneof("message") for answer in answers] == ["result", "frame_error", "result"]
        for watcher in (first, second):
            assert [next(watcher) for _ in answers] == answers


def test_a_watcher_may_have_the_arrays_in_every_nth_result_alone(api, session, sheet):
    with watching(api, session, every_nth=2) as (_, watcher):
        for number in range(1, 5):
            (answer,) = list(api.track(session, [request_of(frame_of(sheet, number))]))[1:]
            seen = next(watcher).result
            if number % 2 == 0:
                assert seen == answer.result
                continue
            for name in ARRAYS:
                answer.result.ClearField(name)
            assert seen == answer.result


def test_a_watcher_may_have_each_frame_before_its_result_as_it_was_sent(api, session, sheet):
    spoilt = frame_of(sheet, 2)
    spoilt.point_cloud.data = b"?"
    frames = [frame_of(sheet, 1), spoilt, frame_of(sheet, 3), frame_of(sheet, 4)]
    with watching(api, session, every_nth=3, include_frames=True) as (_, watcher), watching(api, session) as (_, other):
        _, *answers = api.track(session, [request_of(frame) for frame in frames])
        seen = [next(watcher) for _ in range(5)]
        assert [next(other) for _ in answers] == answers, "who does not ask gets none"
    assert [answer.WhichOneof("message") for answer in seen] == ["result", "frame_error", "result", "frame", "result"]
    assert seen[3].frame == frames[3], "of the third applied frame, the only one with arrays"
    assert seen[4] == answers[3]


def test_a_watcher_with_frames_learns_of_changes_of_the_tracker(api, session, sheet):
    with watching(api, session, include_frames=True) as (_, watcher), watching(api, session) as (_, other):
        api.stub.ResetSession(pb.ResetSessionRequest(name=session))
        for change in ({"fabric": "denim", "labels": {"a": "b"}}, {"labels": {"a": "c"}}):
            request = pb.UpdateSessionRequest(session=pb.Session(name=session, **change), update_mask={"paths": list(change)})
            api.stub.UpdateSession(request)
        _, answer = api.track(session, [request_of(frame_of(sheet, 1))])
        seen = [next(watcher) for _ in range(4)]
        assert next(other) == answer, "who does not ask for frames learns of none"
    assert [each.WhichOneof("message") for each in seen] == ["reset", "update", "frame", "result"]
    assert seen[0].reset.name == seen[1].update.session.name == session
    assert (seen[1].update.session.fabric, list(seen[1].update.update_mask.paths)) == ("denim", ["fabric"])


def test_a_watcher_that_never_reads_holds_nothing_up_and_takes_no_memory(service, api):
    sheet, frames, chunk = make_sheet(40, 0.01), 300, 50
    name = api.create(sheet).name
    options = pb.ResultOptions(include_covariance=True, vertex_encoding=pb.ARRAY_ENCODING_FLOAT64)
    sizes = []
    # gRPC widens the window of a connection with the machine's memory, up to all of these results
    reader = Api(service.grpc, ("grpc.http2.bdp_probe", 0), ("grpc.http2.lookahead_bytes", 1 << 16))
    with reader.channel, watching(reader, name) as (_, watcher):
        for first in range(1, frames, chunk):
            requests = [request_of(frame_of(sheet, number)) for number in range(first, first + chunk)]
            _, *answers = api.track(name, requests, result_options=options)
            assert [answer.result.sequence_number for answer in answers] == list(range(first, first + chunk))
            sizes.append(resident_bytes(service.pid))
        since = 3 * chunk * answers[-1].ByteSize()  # when what serves every stream had been allocated
        assert sizes[-1] - sizes[2] < since / 2, "what nobody reads is not kept"
        api.delete(name)
        seen = []
        with contextlib.suppress(grpc.RpcError):  # how a watcher's call ends
            seen.extend(watcher)
    numbers = [response.result.sequence_number for response in seen]
    assert len(numbers) < frames, "some were skipped"
    assert numbers == sorted(set(numbers))
    assert seen[-1] == answers[-1], "the newest one wins"


def test_a_watcher_is_told_why_the_session_ended(api, sheet):
    name = api.create(sheet).name
    with watching(api, name) as (_, watcher):
        api.delete(name)
        error = error_of(watcher)
    assert isinstance(error, SessionNotFound)
    assert "deleted" in str(error)


def test_who_may_not_watch(api, session):
    refused = [
        (pb.WatchSessionRequest(name="sessions/nobody", api_version=API_VERSION), SessionNotFound),
        (pb.WatchSessionRequest(name=session, api_version="2.0"), VersionMismatch),
    ]
    for request, error in refused:
        assert isinstance(error_of(api.stub.WatchSession(request, timeout=TIMEOUT)), error)
    with contextlib.ExitStack() as watchers:
        for _ in range(16):
            watchers.enter_context(watching(api, session))
        with pytest.raises(grpc.RpcError) as caught:
            watchers.enter_context(watching(api, session))
        refused = from_rpc_error(caught.value)
        assert isinstance(refused, ResourceExhausted)
        assert refused.retry_after > 0

    def admitted() -> bool:
        try:
            with watching(api, session):
                return True
        except grpc.RpcError:
            return False

    eventually(admitted)  # those that left make room, once their leaving is noticed


def test_the_client_watches(client, sheet):
    with client.create_session(sheet, flow="lossless") as session:
        watcher, seen, own = session.watch(), [], []
        reader = threading.Thread(target=lambda: seen.extend(itertools.islice(watcher, 3)))
        reader.start()
        while reader.is_alive():  # when its place in the session is taken is not known here
            own += session.track([Frame(sheet.vertices, 0.1 * (1 + len(own)))])
        own = own[seen[-1].applied - 1]
        assert np.array_equal(seen[-1].vertices, own.vertices)
        assert (seen[-1].applied, seen[-1].reliability) == (own.applied, own.reliability)
        assert np.isnan(seen[-1].latency)
        watcher.close()
        with pytest.raises(InvalidArgument, match="every_nth"):
            session.watch(every_nth=0)


async def test_the_asynchronous_client_watches_until_the_session_ends(service, sheet):
    async with aconnect(service.grpc) as client, client.create_session(sheet, flow="lossless") as session:
        watcher = session.watch(every_nth=2)
        numbers = []

        async def watch() -> None:
            async for result in watcher:
                numbers.append((result.applied, len(result.vertices)))

        watch_task = asyncio.create_task(watch())
        own = []
        while not numbers:
            own += [r async for r in session.track([Frame(sheet.vertices, 0.1 * len(own))])]
            await asyncio.sleep(0.01)
        own += [r async for r in session.track([Frame(sheet.vertices, 0.1 * len(own) + i / 30) for i in range(2)])]
        await session.delete()
        with pytest.raises(SessionNotFound, match="deleted"):
            await watch_task
    assert numbers == [(applied, len(sheet.vertices) * (applied % 2 == 0)) for applied, _ in numbers]
    assert numbers[-1][0] == own[-1].applied
