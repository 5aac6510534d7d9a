"""Tracker host: the trackers of one worker process, behind serialised requests and answers."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from time import perf_counter, thread_time

from ddakf_api.codec import DracoDecoder
from ddakf_api.errors import SessionNotFound
from ddakf_api.v1 import tracking_pb2 as pb

import ddakf

from ..messages import decode, encode
from ..messages.wire import FrameRequest, Kind, Message, Spent, pack_result, unpack_frame_request
from ..pool import Limits
from .busy_time import BusyTime
from .session_tracker import SessionTracker
from .warmup_session import warm_up_session

_PATIENCE = 1.0  # seconds that an opened session waits for its lighter tracker
_LEAST_BUDGET = 1e-4  # seconds, of a frame whose decoding has used all of it


class TrackerHost:
    """Trackers by session id. One call of a session at a time, from any thread.

    Attributes:
        busy: time in which frames are tracked.
    """

    def __init__(self, limits: Limits):
        self._limits = limits
        self._trackers: dict[str, SessionTracker] = {}
        self.busy = BusyTime()
        self._builder = ThreadPoolExecutor(1, "lighter")
        self._draco = DracoDecoder(limits.max_points)
        self._handlers: dict[Kind, Callable[[str, bytes], bytes]] = {
            Kind.OPEN: self.open,
            Kind.RESTORE: self.restore,
            Kind.IMPORT: self.restore,
            Kind.FRAME: self.frame,
            Kind.HEAVY_FRAME: self.frame,
            Kind.CONFIGURE: self.configure,
            Kind.RESET: self.reset,
            Kind.SNAPSHOT: self.snapshot,
            Kind.CLOSE: self.close,
        }

    def handle(self, request: Message) -> bytes:
        """Answers one request of the server."""
        return self._handlers[request.kind](request.session_id, request.content)

    def processor_seconds(self) -> float:
        """Processor time of the calling thread, and of the decoder processes for it."""
        return thread_time() + self._draco.processor_seconds()

    def warm(self) -> None:
        """Tracks a first frame on the path of every later one."""
        request, frame = warm_up_session()
        self.open("warm-up", request.SerializeToString())
        unhurried, options = replace(self._limits, frame_limit=math.inf), pb.ResultOptions(include_covariance=True)
        sent = FrameRequest(options.SerializeToString(), memoryview(frame.SerializeToString()), unhurried.max_points)
        self._track("warm-up", sent, unhurried)
        self.close("warm-up", b"")

    def open(self, session_id: str, request: bytes) -> bytes:
        """CreateSessionRequest in, Session with its meshes out."""
        creation, limits = pb.CreateSessionRequest.FromString(request), self._limits
        session = creation.session
        garment, vertex_map = decode.garment(creation, limits.max_vertices, limits.max_faces)
        body = decode.body(session, limits.max_body_vertices, limits.max_faces)
        tracker = ddakf.Tracker(garment, body=body, config=decode.config(session))
        self._add(session_id, tracker)
        # built beside the first frames it would take time from those of all
        self._trackers[session_id].await_lighter(_PATIENCE)
        return encode.session_message(tracker, vertex_map).SerializeToString()

    def restore(self, session_id: str, request: bytes) -> bytes:
        """RestoreSessionRequest in, Session with its meshes out."""
        data = pb.RestoreSessionRequest.FromString(request).data
        tracker = decode.tracker_from_snapshot(data, self._limits)
        self._add(session_id, tracker)
        return encode.session_message(tracker).SerializeToString()

    def frame(self, session_id: str, request: bytes) -> bytes:
        """FrameRequest in, Result out in two parts."""
        sent = unpack_frame_request(request)
        return self._track(session_id, sent, replace(self._limits, max_points=min(sent.max_points, self._limits.max_points)))

    def reset(self, session_id: str, request: bytes) -> bytes:
        """ResetSessionRequest in."""
        tracker = self._tracker(session_id).own()
        reset = pb.ResetSessionRequest.FromString(request)
        vertices = decode.optional_array(reset, "vertices", self._limits.max_vertices)
        velocities = decode.optional_array(reset, "velocities", self._limits.max_vertices)
        tracker.reset(vertices, velocities=velocities)
        return b""

    def configure(self, session_id: str, request: bytes) -> bytes:
        """UpdateSessionRequest with configuration, fabric or both in; Session with the full configuration and its fabric out."""
        change, tracker = pb.UpdateSessionRequest.FromString(request), self._tracker(session_id).own()
        tracker = tracker.configured(decode.changed_config(change, tracker.config))
        self._add(session_id, tracker)
        return encode.configuration(tracker.config).SerializeToString()

    def snapshot(self, session_id: str, request: bytes) -> bytes:
        """The tracker's state out; compressed unless the request is empty."""
        return self._tracker(session_id).brought_up().snapshot(compressed=bool(request))

    def close(self, session_id: str, request: bytes) -> bytes:
        """Removes a session."""
        self._trackers.pop(session_id, None)
        return b""

    def _track(self, session_id: str, sent: FrameRequest, limits: Limits) -> bytes:
        with self.busy:
            return self._tracked(session_id, sent, limits)

    def _tracked(self, session_id: str, sent: FrameRequest, limits: Limits) -> bytes:
        started, used_before = perf_counter(), self.processor_seconds()
        frame, options = pb.Frame.FromString(sent.frame), pb.ResultOptions.FromString(sent.options)
        session = self._tracker(session_id)
        tracker = session.of_frame(sent.grant.lighter)
        encode.require_known_encodings(options)
        prediction = decode.prediction_seconds(frame)
        arguments = decode.step_arguments(frame, limits, self._draco)
        decoded, used = perf_counter(), self.processor_seconds() - used_before
        limit = limits.processor_limit(tracker.garment.n_vertices, len(arguments["points"])) - used
        budget = max(sent.grant.budget - used, _LEAST_BUDGET) if sent.grant.budget else None
        with decode.with_frame_fields(frame):
            result = tracker.step(**arguments, budget=budget, limit=limit)
        if prediction > 0:
            result = tracker.predicted(result, prediction)
        tracked = perf_counter()
        numbers, arrays = encode.result_numbers(frame, result), encode.result_arrays(result, options, tracker.garment)
        numbers.timings["decode"] = decoded - started
        ended, spent = perf_counter(), self.processor_seconds() - used_before
        numbers.timings["encode"] = ended - tracked
        numbers.usage.processor_seconds, numbers.usage.budget_seconds = spent, sent.grant.budget
        numbers.usage.lighter = session.is_lighter
        prediction, trackers = result.usage.prediction, (session.is_lighter, session.has_lighter)
        spent = Spent(spent, prediction, self.busy.taken(), result.usage.widening, *trackers)
        return pack_result(numbers.SerializeToString(), arrays.SerializeToString(), spent)

    def _add(self, session_id: str, tracker: ddakf.Tracker) -> None:
        """Adds a session. Where there are several, lighter trackers are built at once: they are needed when time is short."""
        self._trackers[session_id] = SessionTracker(tracker, self._builder)
        if len(self._trackers) > 1:
            for session in list(self._trackers.values()):  # another lane may change them meanwhile
                session.prepare()

    def _tracker(self, session_id: str) -> SessionTracker:
        try:
            return self._trackers[session_id]
        except KeyError:
            raise SessionNotFound(f"there is no session {session_id!r} in this worker") from None
