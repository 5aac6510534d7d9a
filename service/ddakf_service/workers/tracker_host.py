"""Tracker host: the trackers of one worker process, behind serialised requests and answers."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

from ddakf_api.codec import DracoDecoder
from ddakf_api.errors import SessionNotFound
from ddakf_api.v1 import tracking_pb2 as pb

import ddakf
from ddakf.commands import warmup

from . import decode, encode
from .pool import Limits
from .warmup_session import warm_up_session
from .wire import Kind, Message, pack_result, unpack_frame_request


class TrackerHost:
    """Trackers by session id. One call at a time."""

    def __init__(self, limits: Limits):
        self._limits = limits
        self._trackers: dict[str, ddakf.Tracker] = {}
        self._draco = DracoDecoder(limits.max_points)
        self._handlers: dict[Kind, Callable[[str, bytes], bytes]] = {
            Kind.OPEN: self.open,
            Kind.RESTORE: self.restore,
            Kind.FRAME: self.frame,
            Kind.CONFIGURE: self.configure,
            Kind.RESET: self.reset,
            Kind.SNAPSHOT: self.snapshot,
            Kind.CLOSE: self.close,
        }

    def handle(self, request: Message) -> bytes:
        """Answers one request of the server."""
        return self._handlers[request.kind](request.session_id, request.content)

    def warm(self, progress: Callable[[int, int, str], None]) -> None:
        """Compiles the kernels and tracks a first frame on the path of every later one."""
        warmup.warm(progress)
        request, frame = warm_up_session()
        self.open("warm-up", request.SerializeToString())
        self._track("warm-up", frame, pb.ResultOptions(include_covariance=True), self._limits)
        self.close("warm-up", b"")

    def open(self, session_id: str, request: bytes) -> bytes:
        """CreateSessionRequest in, Session with its meshes out."""
        creation, limits = pb.CreateSessionRequest.FromString(request), self._limits
        session = creation.session
        garment, vertex_map = decode.garment(creation, limits.max_vertices, limits.max_faces)
        body = decode.body(session, limits.max_body_vertices, limits.max_faces)
        tracker = ddakf.Tracker(garment, body=body, config=decode.config(session))
        self._trackers[session_id] = tracker
        return encode.session_message(tracker, session.fabric, vertex_map).SerializeToString()

    def restore(self, session_id: str, request: bytes) -> bytes:
        """RestoreSessionRequest in, Session with its meshes out."""
        data = pb.RestoreSessionRequest.FromString(request).data
        self._trackers[session_id] = tracker = decode.tracker_from_snapshot(data, self._limits)
        return encode.session_message(tracker).SerializeToString()

    def frame(self, session_id: str, request: bytes) -> bytes:
        """ResultOptions, Frame and the session's bound on its points in, Result out in two parts."""
        options, frame, max_points = unpack_frame_request(request)
        limits = replace(self._limits, max_points=min(max_points, self._limits.max_points))
        return self._track(session_id, pb.Frame.FromString(frame), pb.ResultOptions.FromString(options), limits)

    def reset(self, session_id: str, request: bytes) -> bytes:
        """ResetSessionRequest in."""
        tracker = self._tracker(session_id)
        reset = pb.ResetSessionRequest.FromString(request)
        vertices = decode.optional_array(reset, "vertices", self._limits.max_vertices)
        velocities = decode.optional_array(reset, "velocities", self._limits.max_vertices)
        tracker.reset(vertices, velocities=velocities)
        return b""

    def configure(self, session_id: str, request: bytes) -> bytes:
        """Session with configuration and fabric in, with the full configuration out."""
        session = pb.Session.FromString(request)
        self._trackers[session_id] = tracker = self._tracker(session_id).configured(decode.config(session))
        return pb.Session(config_json=json.dumps(tracker.config.to_dict()), fabric=session.fabric).SerializeToString()

    def snapshot(self, session_id: str, request: bytes) -> bytes:
        """The tracker's state out; compressed unless the request is empty."""
        return self._tracker(session_id).snapshot(compressed=bool(request))

    def close(self, session_id: str, request: bytes) -> bytes:
        """Removes a session."""
        self._trackers.pop(session_id, None)
        return b""

    def _track(self, session_id: str, frame: pb.Frame, options: pb.ResultOptions, limits: Limits) -> bytes:
        started = perf_counter()
        tracker = self._tracker(session_id)
        encode.require_known_encodings(options)
        prediction = decode.prediction_seconds(frame)
        arguments = decode.step_arguments(frame, limits, self._draco)
        decoded = perf_counter()
        with decode.with_frame_fields(frame):
            result = tracker.step(**arguments)
        if prediction > 0:
            result = tracker.predicted(result, prediction)
        tracked = perf_counter()
        numbers, arrays = encode.result_numbers(frame, result), encode.result_arrays(result, options, tracker.garment)
        numbers.timings["decode"] = decoded - started
        numbers.timings["encode"] = perf_counter() - tracked
        return pack_result(numbers.SerializeToString(), arrays.SerializeToString())

    def _tracker(self, session_id: str) -> ddakf.Tracker:
        try:
            return self._trackers[session_id]
        except KeyError:
            raise SessionNotFound(f"there is no session {session_id!r} in this worker") from None
