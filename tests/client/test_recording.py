"""Recordings: what a session's client sent and got, for Foxglove and for a replay that gives the same to the bit."""

from __future__ import annotations

import base64
import json
import math
import threading
import time

import numpy as np
import pytest
from ddakf_api import codec
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import DeadlineExceeded, InvalidArgument, InvalidFrame, SessionNotFound
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame, connect, recordings
from ddakf_client.read_ahead import read_ahead
from ddakf_client.recordings import recording
from mcap.reader import make_reader

from ..service.conftest import TIMEOUT, make_sheet, running
from . import fake_server

FRAMES = 6


@pytest.fixture(scope="module")
def service(tmp_path_factory):
    arguments = ["--workers", "1", "--spare-workers", "0", "--data-dir", "none"]
    with running(arguments, tmp_path_factory.mktemp("recordings")) as service:
        yield service


def frames(sheet, first: int, count: int):
    rng = np.random.default_rng(3)
    for number in range(first, first + count):
        points = sheet.vertices + [0.0, 0.0, 0.002 * number] + rng.normal(scale=1e-3, size=sheet.vertices.shape)
        colors = np.rint(255 * (0.5 + 0.4 * np.sin(200.0 * sheet.vertices))).astype(np.uint8)
        yield Frame(points, number / 30, [0.1, 0.1, 1.0], colors=colors)


@pytest.fixture(scope="module")
def recorded(service, tmp_path_factory):
    """The file of a session that had tracked three frames before, and the results that its client got."""
    path, started, sheet = tmp_path_factory.mktemp("files") / "some.mcap", threading.Event(), make_sheet()
    with connect(service.grpc) as client, client.create_session(*sheet, flow="lossless") as session:
        list(session.track(frames(sheet, 1, 3)))
        observer = connect(service.grpc)
        other = observer.open_session(session.session_id)
        options = {"frames": FRAMES, "on_start": started.set}
        recorder = threading.Thread(target=recordings.record, args=(other, path), kwargs=options)
        recorder.start()
        assert started.wait(TIMEOUT)
        results = list(session.track(frames(sheet, 4, FRAMES), covariance=True))
        recorder.join(TIMEOUT)
        assert not recorder.is_alive()
        observer.close()
    return path, results


def test_a_replay_gives_the_same_to_the_bit(service, recorded):
    path, results = recorded
    with connect(service.grpc) as client:
        pairs = list(recordings.replay(client, recordings.load(path)))
        assert list(client.sessions(labels={"source": "replay"})) == []
    assert [before.sequence for before, _ in pairs] == [result.sequence for result in results]
    for result, (before, now) in zip(results, pairs, strict=True):
        for name in ("vertices", "sigma", "vertex_reliability", "observed", "covariance"):
            expected = getattr(result, name)
            assert np.array_equal(getattr(before, name), expected), name
            assert np.array_equal(getattr(now, name), expected), name


def test_resets_and_other_configurations_are_replayed(service, tmp_path):
    """Both between two streams of the client and while one is open; also before the first frame of the recording."""
    path, started, sheet = tmp_path / "changed.mcap", threading.Event(), make_sheet()
    moved = sheet.vertices + [0.0, 0.0, 0.01]
    changed = threading.Event()

    def held():
        """The first of three frames, and the others when the session has changed."""
        first, *others = frames(sheet, 10, 3)
        yield first
        assert changed.wait(TIMEOUT)
        yield from others

    with (
        connect(service.grpc) as client,
        connect(service.grpc) as other,
        client.create_session(*sheet, flow="lossless") as session,
    ):
        list(session.track(frames(sheet, 1, 3)))
        options = {"frames": 9, "on_start": started.set}
        recorder = threading.Thread(target=recordings.record, args=(other.open_session(session.session_id), path), kwargs=options)
        recorder.start()
        assert started.wait(TIMEOUT)
        session.reset()
        results = list(session.track(frames(sheet, 4, 3), covariance=True))
        session.update(fabric="denim", labels={"take": "2"})
        session.reset(moved, velocities=np.full(moved.shape, 0.1))
        results += list(session.track(frames(sheet, 7, 3), covariance=True))
        stream = session.track(held(), covariance=True)
        results.append(next(stream))
        session.update(config={"physics": {"collision": 0.0}})
        changed.set()
        results += list(stream)
        recorder.join(TIMEOUT)
        loaded = recordings.load(path)
        kinds = {number: [type(change).__name__ for change in changes] for number, changes in loaded.changes.items()}
        assert kinds == {
            4: ["ResetSessionRequest"],
            7: ["UpdateSessionRequest", "ResetSessionRequest"],
            11: ["UpdateSessionRequest"],
        }
        pairs = list(recordings.replay(client, loaded))
    assert len(pairs) == len(results) == 9
    for result, (before, now) in zip(results, pairs, strict=True):
        for name in ("vertices", "covariance"):
            assert np.array_equal(getattr(before, name), getattr(result, name)), (result.sequence, name)
            assert np.array_equal(getattr(now, name), getattr(result, name)), (result.sequence, name)


def test_without_a_snapshot_a_reset_before_the_first_frame_is_not_made(service, recorded):
    whole = recordings.load(recorded[0])
    reset = pb.ResetSessionRequest()
    bare = recordings.Recording(whole.session, whole.frames, whole.results, {whole.frames[0].sequence_number: [reset]})
    unchanged = recordings.Recording(whole.session, whole.frames, whole.results)
    with connect(service.grpc) as client:
        found, expected = (list(recordings.replay(client, each)) for each in (bare, unchanged))
    assert all(np.array_equal(a.vertices, b.vertices) for (_, a), (_, b) in zip(found, expected, strict=True))


def test_without_a_snapshot_the_replay_starts_from_the_first_result(service, recorded):
    whole = recordings.load(recorded[0])
    bare = recordings.Recording(whole.session, whole.frames, whole.results)
    with connect(service.grpc) as client:
        pairs = list(recordings.replay(client, bare))
    assert len(pairs) == FRAMES
    assert max(np.abs(before.vertices - now.vertices).max() for before, now in pairs) < 5e-3


def test_without_a_snapshot_the_replay_begins_at_the_first_result_with_arrays(service, recorded):
    """Those before it are between every nth."""
    whole = recordings.load(recorded[0])
    for result in whole.results[:2]:
        for name in ("vertices", "sigma", "vertex_reliability", "observed", "covariance"):
            result.ClearField(name)
    with connect(service.grpc) as client:
        pairs = list(recordings.replay(client, recordings.Recording(whole.session, whole.frames, whole.results)))
    assert [now.sequence for _, now in pairs] == [frame.sequence_number for frame in whole.frames[2:]]
    assert max(np.abs(before.vertices - now.vertices).max() for before, now in pairs) < 5e-3
    assert all(now.covariance is not None for _, now in pairs)


def test_a_replay_tracks_frames_whose_deadline_was_short(service, recorded):
    recording = recordings.load(recorded[0])
    for frame in recording.frames:
        frame.deadline = 1e-6
    with connect(service.grpc) as client:
        pairs = list(recordings.replay(client, recording))
    assert [np.abs(before.vertices - now.vertices).max() for before, now in pairs] == [0.0] * FRAMES
    assert {frame.deadline for frame in recording.frames} == {1e-6}


def test_a_frame_that_is_refused_in_a_replay_is_an_error(service, recorded):
    recording = recordings.load(recorded[0])
    recording.frames[2].ClearField("point_cloud")
    seen = []
    with connect(service.grpc) as client, pytest.raises(InvalidFrame, match="payload") as refused:
        seen.extend(now.sequence for _, now in recordings.replay(client, recording))
    numbers = [frame.sequence_number for frame in recording.frames]
    assert (seen, refused.value.sequence) == (numbers[:2], numbers[2])


def test_the_file_has_clouds_meshes_and_numbers_in_the_schemas_of_foxglove(recorded):
    path, results = recorded
    with path.open("rb") as file:
        messages = [(schema, channel.topic, message) for schema, channel, message in make_reader(file).iter_messages()]
    schemas = {topic: schema.name for schema, topic, _ in messages}
    assert (schemas["/cloud"], schemas["/garment"]) == ("foxglove.PointCloud", "foxglove.SceneUpdate")
    by_topic = {topic: [m for _, t, m in messages if t == topic] for topic in schemas}
    assert {topic: len(found) for topic, found in by_topic.items() if topic != "/session"} == {
        topic: FRAMES for topic in ("/frame", "/result", "/cloud", "/garment", "/numbers")
    }
    cloud, mesh, numbers = (json.loads(by_topic[topic][-1].data) for topic in ("/cloud", "/garment", "/numbers"))
    points = np.frombuffer(base64.b64decode(cloud["data"]), "<f4").reshape(-1, cloud["point_stride"] // 4)
    sheet = make_sheet()
    assert points.shape == sheet.vertices.shape
    (triangles,) = mesh["entities"][0]["triangles"]
    assert np.allclose([[p[axis] for axis in "xyz"] for p in triangles["points"]], results[-1].vertices, atol=1e-5)
    assert np.array_equal(np.reshape(triangles["indices"], (-1, 3)), sheet.faces)
    assert (numbers["sequence"], numbers["state"]) == (results[-1].sequence, results[-1].state)
    assert numbers["reliability"] == pytest.approx(results[-1].reliability)
    assert by_topic["/cloud"][-1].publish_time == pytest.approx(1e9 * results[-1].timestamp)


@pytest.mark.parametrize("content", [b"", b"junk", b"nothing of the kind", b"\x89MCAP0\r\n" + bytes(range(60))])
def test_a_file_that_is_no_recording_is_refused(tmp_path, content):
    path = tmp_path / "no.mcap"
    path.write_bytes(content)
    with pytest.raises(InvalidArgument, match=r"^path: expected an MCAP file, got no\.mcap: ."):
        recordings.load(path)


def test_a_damaged_recording_is_refused_or_read(recorded, tmp_path):
    whole, path, rng = recorded[0].read_bytes(), tmp_path / "damaged.mcap", np.random.default_rng(0)
    refused = 0
    for number in range(60):
        damaged = np.frombuffer(whole, np.uint8)[: rng.integers(len(whole)) if number % 2 else None].copy()
        damaged[rng.integers(len(damaged), size=20)] = rng.integers(256, size=20)
        path.write_bytes(damaged.tobytes())
        try:
            recordings.load(path)
        except InvalidArgument:
            refused += 1
    assert refused > 30


@pytest.mark.parametrize("limit", [{"seconds": -1.0}, {"seconds": float("nan")}, {"seconds": 0}, {"frames": 0}, {"frames": -3}])
def test_a_limit_that_leaves_nothing_to_record_is_refused(service, tmp_path, limit):
    path = tmp_path / "none.mcap"
    said = rf"^{next(iter(limit))}: expected a number above 0, got "
    with (
        connect(service.grpc) as client,
        client.create_session(*make_sheet()) as session,
        pytest.raises(InvalidArgument, match=said),
    ):
        recordings.record(session, path, **limit)
    assert not path.exists()


def test_a_server_that_does_not_begin_in_the_time_of_the_recording_is_named(mesh, tmp_path):
    class Silent(fake_server.FakeService):
        def WatchSession(self, request, context):
            while context.is_active():
                time.sleep(0.01)
            yield from ()

    server, target = fake_server.start(Silent())
    said = rf"^{target} gave no answer within 0\.2 s$"
    with connect(target) as client, client.create_session(*mesh) as session, pytest.raises(DeadlineExceeded, match=said):
        recordings.record(session, tmp_path / "none.mcap", seconds=0.2)
    server.stop(0).wait()


def test_a_recording_ends_in_time_although_no_frame_comes(service, tmp_path):
    with connect(service.grpc) as client, client.create_session(*make_sheet()) as session:
        assert recordings.record(session, tmp_path / "empty.mcap", seconds=0.2) == (0, 0)
    assert recordings.load(tmp_path / "empty.mcap").frames == []


def test_a_session_that_is_not_there_is_not_recorded(service, tmp_path):
    with connect(service.grpc) as client, client.create_session(*make_sheet()) as session:
        session.delete()
        with pytest.raises(SessionNotFound):
            recordings.record(session, tmp_path / "none.mcap")
    assert not (tmp_path / "none.mcap").exists()


def written(path, results: int) -> None:
    """A recording of so many frames."""
    garment = pack_mesh(*make_sheet())
    with path.open("wb") as file, recording._Writer(file) as writer:
        writer.write(recording.SESSION, pb.Session(garment=garment).SerializeToString(), 0.0)
        for number in range(1, results + 1):
            cloud = codec.encode(make_sheet().vertices).cloud
            frame = pb.Frame(sequence_number=number, capture_time=number / 30, point_cloud=cloud)
            result = pb.Result(sequence_number=number, capture_time=number / 30, frames_applied=number)
            writer.write_pair(frame, result, recording._converted(result), True)


def test_a_clock_that_is_set_back_leaves_the_frames_in_order(tmp_path, monkeypatch):
    clock = iter([*range(100, 0, -1)])
    monkeypatch.setattr(recording.time, "time_ns", lambda: 10**18 + 10**9 * next(clock))
    written(tmp_path / "some.mcap", 6)
    assert [frame.sequence_number for frame in recordings.load(tmp_path / "some.mcap").frames] == [1, 2, 3, 4, 5, 6]
    with (tmp_path / "some.mcap").open("rb") as file:
        times = [message.log_time for *_, message in make_reader(file).iter_messages(log_time_order=False)]
    assert times == sorted(set(times))


def test_frames_that_the_reader_missed_are_counted(tmp_path):
    def pairs(numbers):
        for number in numbers:
            result = pb.Result(sequence_number=number, frames_applied=number + 40)
            yield recording._Pair(pb.Frame(sequence_number=number), result, ())

    with (tmp_path / "some.mcap").open("wb") as file, recording._Writer(file) as writer:
        found = recording._write_frames(pairs([4, 5, 9, 10, 12]), writer, math.inf, math.inf, lambda result: None)
    assert found == (5, 4)


def test_reading_goes_on_while_frames_are_written():
    read, passed = [], []

    def source():
        for number in range(40):
            read.append(number)
            yield number

    for item, behind in read_ahead(source(), 128):
        if item == 0:
            deadline = time.monotonic() + TIMEOUT
            while len(read) < 40 and time.monotonic() < deadline:
                time.sleep(0.01)
        passed.append((item, behind))
    assert [item for item, _ in passed] == list(range(40))
    assert passed[1][1] >= 38  # all were read while the first was written


def test_what_ends_the_reading_is_raised_behind_what_was_read():
    def source():
        yield 1
        raise DeadlineExceeded("too late")

    items = read_ahead(source(), 128)
    assert next(items)[0] == 1
    with pytest.raises(DeadlineExceeded):
        next(items)
