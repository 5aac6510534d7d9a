"""Recordings: the frames and results of a session in an MCAP file, and their replay against a server.

| topic | schema | content |
|---|---|---|
| `/session` | `ddakf_api.v1.Session` | meshes and configuration, once |
| `/frame`, `/result` | `ddakf_api.v1.Frame`, `.Result` | as sent and answered |
| `/reset`, `/update` | `ddakf_api.v1.ResetSessionRequest`, `.UpdateSessionRequest` | before the next frame |
| `/cloud`, `/garment` | `foxglove.PointCloud`, `foxglove.SceneUpdate` | for Foxglove, see :mod:`.foxglove` |
| `/numbers` | `ddakf.Numbers` | reliability, score, coverage, counters, seconds per stage |

The attachment ``snapshot`` holds the tracker's state before the first frame: a replay continues from it and gives the same
results to the bit, until a frame that is missing. A key that may only read gets no snapshot; its replay starts from the first
result that has arrays.

All frames and results come first: while more than a few wait to be written, ``/cloud`` and ``/garment`` are left out.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import pairwise
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import grpc
import numpy as np
from ddakf_api import API_VERSION
from ddakf_api.errors import (
    Cancelled,
    DeadlineExceeded,
    InvalidArgument,
    PermissionDenied,
    SessionNotFound,
    first_line,
    from_rpc_error,
)
from ddakf_api.v1 import tracking_pb2 as pb
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from ddakf_client.calls import failure
from ddakf_client.client import Client, Session
from ddakf_client.read_ahead import read_ahead
from ddakf_client.recordings import foxglove
from ddakf_client.results import Result, frame_error_from, result_from

SESSION, FRAME, RESULT, CLOUD, GARMENT, NUMBERS = "/session", "/frame", "/result", "/cloud", "/garment", "/numbers"
RESET, UPDATE = "/reset", "/update"
SNAPSHOT = "snapshot"
Change = pb.ResetSessionRequest | pb.UpdateSessionRequest
_CHANGES = {RESET: pb.ResetSessionRequest, UPDATE: pb.UpdateSessionRequest}
_MESSAGES = {SESSION: pb.Session, FRAME: pb.Frame, RESULT: pb.Result, **_CHANGES}
_SCHEMAS = {
    CLOUD: ("foxglove.PointCloud", foxglove.POINT_CLOUD),
    GARMENT: ("foxglove.SceneUpdate", foxglove.SCENE_UPDATE),
    NUMBERS: ("ddakf.Numbers", foxglove.NUMBERS),
}
_NANOSECONDS = 1e9
_NO_LIMIT = float("inf")
_READ_AHEAD = 128  # answers that may wait to be written
_BEHIND = 32  # frames that wait: with more, those for Foxglove are left out


class Recorded(NamedTuple):
    """What is in a recording.

    Attributes:
        frames: with their results.
        missing: frames in between that the session tracked, and that this reader came too late for.
    """

    frames: int
    missing: int


def record(
    session: Session,
    path: str | PathLike,
    *,
    seconds: float = _NO_LIMIT,
    frames: float = _NO_LIMIT,
    on_start: Callable[[], None] = lambda: None,
    on_result: Callable[[Result], None] = lambda result: None,
) -> Recorded:
    """Records what a session's client sends and gets from now on, without slowing it.

    The recording ends after ``seconds`` or ``frames``, with the session, or with KeyboardInterrupt.

    Args:
        path: of the file; it is replaced.
        on_start: called when the next frame will be recorded.
        on_result: called after each recorded frame.

    Raises:
        ImportError: mcap is not installed.
        InvalidArgument: ``seconds`` or ``frames`` is not above 0.
        SessionNotFound, Unavailable: no such session, or no server.
        DeadlineExceeded: the server did not begin within ``seconds``.
    """
    for name, value in (("seconds", seconds), ("frames", frames)):
        if isinstance(value, bool) or not isinstance(value, (int, float)) or not value > 0:
            raise InvalidArgument(field=name, expected="a number above 0", got=repr(value)[:80])
    client = session._client
    call = client.open_watch(pb.WatchSessionRequest(name=session.name, api_version=API_VERSION, include_frames=True))
    end = time.monotonic() + seconds
    timer = threading.Timer(min(seconds, threading.TIMEOUT_MAX), call.cancel)
    timer.daemon = True
    timer.start()
    try:
        next(call)  # Started: answers from now on are queued
        with open(path, "wb") as file, _Writer(file) as writer:
            after = _write_beginning(client, session.name, writer)
            on_start()
            return _write_frames(_pairs(call, after), writer, end, frames, on_result)
    except grpc.RpcError as error:
        failed = failure(error, client.target, _NO_LIMIT)
        if type(failed) is Cancelled and time.monotonic() >= end:  # by the timer
            failed = DeadlineExceeded(f"{client.target} gave no answer within {seconds:g} s")
        raise failed from None
    finally:
        timer.cancel()
        call.cancel()


def _write_beginning(client: Client, name: str, writer: _Writer) -> int:
    """Writes the session with its meshes, and its state if the key may read it. Returns the last frame of that state; 0: none."""
    try:
        state = client.call("SnapshotSession", pb.SnapshotSessionRequest(name=name))
    except PermissionDenied:
        state = None
    whole = client.call("GetSession", pb.GetSessionRequest(name=name, view=pb.SESSION_VIEW_FULL))
    if state is not None:
        whole.statistics.CopyFrom(state.session.statistics)
        writer.attach(SNAPSHOT, state.data)
    writer.indices = foxglove.indices(np.frombuffer(whole.garment.faces.data, "<u4"))
    writer.write(SESSION, whole.SerializeToString(), whole.statistics.last_capture_time)
    return 0 if state is None else state.session.statistics.last_sequence_number


class _Pair(NamedTuple):
    frame: pb.Frame
    result: pb.Result
    changes: tuple[Change, ...]  # of the tracker since the frame before


def _pairs(call: grpc.Call, after: int) -> Iterator[_Pair | None]:
    """Each frame above a number with its result; None for another answer."""
    frame, changes = None, ()
    for response in call:
        if response.HasField("frame"):
            frame = response.frame
        elif response.HasField("reset") or response.HasField("update"):
            changes += (response.reset if response.HasField("reset") else response.update,)
        elif response.HasField("result") and frame is not None:
            if frame.sequence_number > after:
                yield _Pair(frame, response.result, changes)
            frame, changes = None, ()
            continue
        yield None


def _write_frames(
    pairs: Iterator[_Pair | None],
    writer: _Writer,
    end: float,
    most: float,
    on_result: Callable[[Result], None],
) -> Recorded:
    """Writes frames with their results until an end is reached."""
    count, missing, applied = 0, 0, 0
    try:
        for pair, behind in read_ahead(pairs, _READ_AHEAD):
            if pair is not None:
                result = _converted(pair.result)
                writer.write_changes(pair)
                writer.write_pair(pair.frame, pair.result, result, with_pictures=behind <= _BEHIND)
                missing += max(result.applied - applied - 1, 0) if count else 0
                count, applied = count + 1, result.applied
                on_result(result)
            if count >= most or time.monotonic() > end:
                break
    except KeyboardInterrupt:
        pass
    except grpc.RpcError as error:
        if time.monotonic() < end and not (count and isinstance(from_rpc_error(error), SessionNotFound)):
            raise  # otherwise the time is over, or the session has ended and the recording with it
    return Recorded(count, missing)


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording in memory.

    Attributes:
        session: with its meshes and configuration.
        frames, results: of equal length, in their order.
        changes: of the tracker, by the number of the frame before which each was made.
        snapshot: state of the tracker before the first frame; empty: none.
    """

    session: pb.Session
    frames: list[pb.Frame] = field(default_factory=list)
    results: list[pb.Result] = field(default_factory=list)
    changes: dict[int, list[Change]] = field(default_factory=dict)
    snapshot: bytes = b""


def load(path: str | PathLike) -> Recording:
    """Reads a recording.

    Raises:
        ImportError: mcap is not installed. InvalidArgument: not a recording of a session.
    """
    reading = _mcap("reader")
    with open(path, "rb") as file:
        try:
            reader = reading.make_reader(file)
            in_order = reader.iter_messages(list(_MESSAGES), log_time_order=False)
            messages = [(channel.topic, message.data) for _, channel, message in in_order]
            attachments = {each.name: each.data for each in reader.iter_attachments()}
            read = {topic: [kind.FromString(data) for at, data in messages if at == topic] for topic, kind in _MESSAGES.items()}
        except Exception as error:  # errors of mcap, struct, a compression, protobuf: any damage of the file
            raise InvalidArgument(field="path", expected="an MCAP file", got=f"{Path(path).name}: {first_line(error)}") from None
    if len(read[FRAME]) != len(read[RESULT]):
        got = f"{len(read[FRAME])} frames and {len(read[RESULT])} results in {Path(path).name}"
        raise InvalidArgument(field="path", expected="a result of every frame", got=got)
    if not read[SESSION]:
        raise InvalidArgument(field="path", expected="a recording of a session", got=f"{Path(path).name} without {SESSION}")
    known = read[SESSION][0].statistics.last_sequence_number if SNAPSHOT in attachments else 0
    pairs = [(f, r) for f, r in zip(read[FRAME], read[RESULT], strict=True) if f.sequence_number > known]
    snapshot = attachments.get(SNAPSHOT, b"")
    return Recording(read[SESSION][0], [f for f, _ in pairs], [r for _, r in pairs], _changes_of(messages), snapshot)


def _changes_of(messages: list[tuple[str, bytes]]) -> dict[int, list[Change]]:
    """The changes of the tracker, in their order, by the number of the frame that follows."""
    found, waiting = {}, []
    for topic, data in messages:
        if topic in _CHANGES:
            waiting.append(_CHANGES[topic].FromString(data))
        elif topic == FRAME and waiting:
            found[pb.Frame.FromString(data).sequence_number], waiting = waiting, []
    return found


def replay(client: Client, recording: Recording) -> Iterator[tuple[Result, Result]]:
    """Sends the recorded frames to a new session and yields each recorded result with its new one; deletes the session.

    With a snapshot of the same version of the tracker the arrays are equal to the bit. Without one the replay begins at the
    first frame whose result has arrays. The deadlines of the frames do not hold: the server has all frames at once.

    Raises:
        ServiceError: the server refuses the session or a frame, whose number ``sequence`` is, or ends its stream.
    """
    first, frames = _first_with_arrays(recording), recording.frames
    if first is not None and not recording.snapshot:
        frames = [frame for frame in frames if frame.sequence_number >= first.sequence_number]
    recorded = {result.sequence_number: result for result in recording.results}
    with _session_of(client, recording, first) as session:
        for part in _unchanged(frames, recording.changes):
            known = part[0] is frames[0] and not recording.snapshot  # the session starts at the result of that frame
            for change in recording.changes.get(part[0].sequence_number, ()):
                if not (known and isinstance(change, pb.ResetSessionRequest)):
                    _make(client, session.name, change)
            for result in _tracked(client, session.name, part, first or pb.Result()):
                yield _converted(recorded[result.sequence_number]), _converted(result)


def _unchanged(frames: list[pb.Frame], changes: dict[int, list[Change]]) -> Iterator[list[pb.Frame]]:
    """The frames in parts, before each of which the tracker was changed; also before the first one, or not."""
    starts = [0, *(k for k, frame in enumerate(frames) if k and frame.sequence_number in changes), len(frames)]
    yield from (frames[first:last] for first, last in pairwise(starts) if first < last)


def _make(client: Client, name: str, change: Change) -> None:
    """Makes a recorded change of the tracker in a session."""
    renamed = type(change)()
    renamed.CopyFrom(change)
    if isinstance(renamed, pb.ResetSessionRequest):
        renamed.name = name
        client.call("ResetSession", renamed)
    else:
        renamed.session.name = name
        client.call("UpdateSession", renamed)


def _tracked(client: Client, name: str, frames: list[pb.Frame], first: pb.Result) -> Iterator[pb.Result]:
    """The results of frames that a stream of their own sends to a session."""
    call = client.open_track(_requests(name, frames, first))
    try:
        for response in call:
            if response.HasField("frame_error"):
                raise frame_error_from(response.frame_error).error
            if response.HasField("result"):
                yield response.result
    except grpc.RpcError as error:
        raise failure(error, client.target, _NO_LIMIT) from None
    finally:
        call.cancel()


def _first_with_arrays(recording: Recording) -> pb.Result | None:
    """The first result with arrays, which those between every nth lack; None: there is none."""
    return next((result for result in recording.results if result.HasField("vertices")), None)


def _session_of(client: Client, recording: Recording, first: pb.Result | None) -> Session:
    labels = {"source": "replay"}
    if recording.snapshot:
        return client.restore_session(recording.snapshot, labels=labels)
    message = pb.Session(garment=recording.session.garment, config_json=recording.session.config_json, labels=labels)
    if recording.session.HasField("body"):
        message.body.CopyFrom(recording.session.body)
    request = pb.CreateSessionRequest(api_version=API_VERSION, session=message)
    session = client._session("CreateSession", request, keep=False)
    if first is not None:
        session.reset(_converted(first).vertices)
    return session


def _requests(name: str, frames: list[pb.Frame], first: pb.Result) -> Iterator[pb.TrackRequest]:
    """The frames as they were recorded, but without deadlines, answered in the encodings of the first recorded result with
    arrays."""
    options = pb.ResultOptions(
        vertex_encoding=first.vertices.encoding,
        sigma_encoding=first.sigma.encoding,
        reliability_encoding=first.vertex_reliability.encoding,
        include_covariance=first.HasField("covariance"),
        include_velocities=first.HasField("velocities"),
    )
    flow = pb.FLOW_MODE_LOSSLESS
    yield pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION, flow_mode=flow, result_options=options))
    for frame in frames:
        request = pb.TrackRequest(frame=frame)
        request.frame.ClearField("deadline")
        yield request


def _converted(message: pb.Result) -> Result:
    return result_from(message, dropped_before_sending=0, latency=float("nan"))


class _Writer:
    """An MCAP file with the channels of a recording."""

    def __init__(self, file):
        self._writer = _mcap("writer").Writer(file)
        self.indices, self._now = "[]", 0

    def __enter__(self) -> _Writer:
        self._writer.start(profile="", library="ddakf")
        self._channels = {topic: self._message_channel(topic, kind) for topic, kind in _MESSAGES.items()}
        for topic, (name, schema) in _SCHEMAS.items():
            identifier = self._writer.register_schema(name, "jsonschema", json.dumps(schema).encode())
            self._channels[topic] = self._writer.register_channel(topic, "json", identifier)
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.finish()

    def attach(self, name: str, data: bytes) -> None:
        now = time.time_ns()
        self._writer.add_attachment(now, now, name, "application/octet-stream", data)

    def write(self, topic: str, data: bytes, capture_time: float, sequence: int = 0) -> None:
        published = max(0, int(capture_time * _NANOSECONDS))
        self._now = max(self._now + 1, time.time_ns())  # readers go by it, and a clock may be set back
        self._writer.add_message(self._channels[topic], self._now, data, published, sequence & 0xFFFFFFFF)

    def write_pair(self, frame: pb.Frame, message: pb.Result, result: Result, with_pictures: bool) -> None:
        """A frame, its result, and both for Foxglove: numbers, and cloud and garment ``with_pictures``."""
        now, number = frame.capture_time, frame.sequence_number
        self.write(FRAME, frame.SerializeToString(), now, number)
        self.write(RESULT, message.SerializeToString(), now, number)
        documents = {NUMBERS: foxglove.numbers(result)}
        if with_pictures:
            documents |= {CLOUD: foxglove.point_cloud(frame), GARMENT: foxglove.garment(result, self.indices)}
        for topic, document in documents.items():
            if document is not None:
                self.write(topic, document.encode(), now, number)

    def write_changes(self, pair: _Pair) -> None:
        """The changes of the tracker before a frame."""
        for change in pair.changes:
            topic = RESET if isinstance(change, pb.ResetSessionRequest) else UPDATE
            self.write(topic, change.SerializeToString(), pair.frame.capture_time, pair.frame.sequence_number)

    def _message_channel(self, topic: str, kind) -> int:
        schema = _descriptor_set(kind.DESCRIPTOR.file).SerializeToString()
        return self._writer.register_channel(
            topic, "protobuf", self._writer.register_schema(kind.DESCRIPTOR.full_name, "protobuf", schema)
        )


def _descriptor_set(file: FileDescriptor) -> FileDescriptorSet:
    """A schema with those that it depends on, which come first."""
    files: dict[str, FileDescriptor] = {}

    def add(each: FileDescriptor) -> None:
        for dependency in each.dependencies:
            add(dependency)
        files[each.name] = each

    add(file)
    described = FileDescriptorSet()
    for each in files.values():
        each.CopyToProto(described.file.add())
    return described


def _mcap(module: str):
    """A module of mcap, which only recordings need."""
    import importlib

    try:
        return importlib.import_module(f"mcap.{module}")
    except ImportError as error:
        raise ImportError("recordings need mcap: pip install 'ddakf-client[recording]'") from error
