"""The sessions of one worker: serialised messages in, serialised messages out, trackers between."""

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
from .wire import Kind, Message, split


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
        return self._handlers[request.kind](request.session_id, request.payload)

    def warm(self, progress: Callable[[int, int, str], None]) -> None:
        """Compiles the kernels, and tracks a first frame the way that every later one goes."""
        warmup.warm(progress)
        request, frame = warm_up_session()
        self.open("warm-up", request.SerializeToString())
        self._track("warm-up", frame, pb.ResultOptions(include_covariance=True), self._limits)
        self.close("warm-up", b"")

    def open(self, session_id: str, payload: bytes) -> bytes:
        """CreateSessionRequest in, Session with its meshes out."""
        request = pb.CreateSessionRequest.FromString(payload)
        session, limits = request.session, self._limits
        garment, vertex_map = decode.garment(request, limits.max_vertices, limits.max_faces)
        body = decode.body(session, limits.max_body_vertices, limits.max_faces)
        tracker = ddakf.Tracker(garment, body=body, config=decode.config(session))
        self._trackers[session_id] = tracker
        return encode.opened(tracker, session.fabric, vertex_map).SerializeToString()

    def restore(self, session_id: str, payload: bytes) -> bytes:
        """RestoreSessionRequest in, Session with its meshes out."""
        self._trackers[session_id] = tracker = decode.restored(pb.RestoreSessionRequest.FromString(payload).data, self._limits)
        return encode.opened(tracker).SerializeToString()

    def frame(self, session_id: str, payload: bytes) -> bytes:
        """ResultOptions, Frame and the session's bound on its points in, Result out."""
        options, frame, max_points = split(payload)
        limits = replace(self._limits, max_points=min(max_points, self._limits.max_points))
        return self._track(session_id, pb.Frame.FromString(frame), pb.ResultOptions.FromString(options), limits)

    def reset(self, session_id: str, payload: bytes) -> bytes:
        """ResetSessionRequest in."""
        tracker = self._tracker(session_id)
        request = pb.ResetSessionRequest.FromString(payload)
        vertices = decode.optional_array(request, "vertices", self._limits.max_vertices)
        velocities = decode.optional_array(request, "velocities", self._limits.max_vertices)
        tracker.reset(vertices, velocities=velocities)
        return b""

    def configure(self, session_id: str, payload: bytes) -> bytes:
        """Session with configuration and fabric in, with the whole configuration out."""
        session = pb.Session.FromString(payload)
        self._trackers[session_id] = tracker = self._tracker(session_id).configured(decode.config(session))
        return pb.Session(config_json=json.dumps(tracker.config.to_dict()), fabric=session.fabric).SerializeToString()

    def snapshot(self, session_id: str, payload: bytes) -> bytes:
        """The tracker's state out, compressed unless the payload is empty."""
        return self._tracker(session_id).snapshot(compressed=bool(payload))

    def close(self, session_id: str, payload: bytes) -> bytes:
        """Forgets a session."""
        self._trackers.pop(session_id, None)
        return b""

    def _track(self, session_id: str, frame: pb.Frame, options: pb.ResultOptions, limits: Limits) -> bytes:
        started = perf_counter()
        tracker = self._tracker(session_id)
        encode.require_known_encodings(options)
        ahead = decode.seconds_ahead(frame)
        arguments = decode.step_arguments(frame, limits, self._draco)
        decoded = perf_counter()
        with decode.frame_fields(frame):
            outcome = tracker.step(**arguments)
        if ahead > 0:
            outcome = tracker.predicted(outcome, ahead)
        tracked = perf_counter()
        result = encode.result(frame, outcome, options, tracker.garment)
        result.timings["decode"] = decoded - started
        result.timings["encode"] = perf_counter() - tracked
        return result.SerializeToString()

    def _tracker(self, session_id: str) -> ddakf.Tracker:
        try:
            return self._trackers[session_id]
        except KeyError:
            raise SessionNotFound(f"there is no session {session_id!r} in this worker") from None
