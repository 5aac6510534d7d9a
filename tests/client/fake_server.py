"""Fake server for the client tests: real sockets, no tracker.

Instead of tracking, it moves the vertices of the garment by the mean of the frame's points: a result identifies its frame.
"""

from __future__ import annotations

import queue
import threading
import time
from concurrent import futures

import grpc
import numpy as np
from ddakf_api import API_VERSION, errors
from ddakf_api.arrays import pack, unpack_mesh
from ddakf_api.codec import CODECS, DracoDecoder, decode, sensor_origins
from ddakf_api.transport import server_options
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1 import tracking_pb2_grpc as rpc
from ddakf_api.version import require_compatible
from google.protobuf import empty_pb2

CREATED = 1_700_000_000
END = object()


def refusing(call):
    """Aborts a unary call with the error that it raises."""

    def answer(self, request, context):
        self.keys.append(dict(context.invocation_metadata()).get("authorization"))
        try:
            return call(self, request, context)
        except errors.ServiceError as error:
            abort(context, error)

    return answer


def abort(context, error):
    context.set_trailing_metadata(errors.to_metadata(errors.to_detail(error)))
    context.abort(error.status, str(error))


class FakeService(rpc.TrackingServiceServicer):
    """A service whose behaviour is set by attributes.

    Attributes:
        delay: seconds per frame.
        silent_from: number of the first frame that is never answered.
        ends_at: number of the frame at which the stream ends without an error.
        lost_from: number of the first frame that ends the stream with WorkerLost.
        drains_at: number of the frame at which the stream ends with Draining.
        refused: numbers of frames that are refused.
        notice: sent after the first result.
        answered: responses of each session by frame number: those after the last one that a client has are repeated to it.
        most_waiting: largest number of frames that waited at once.
        max_message_bytes: that the server announces; 0: none.
    """

    def __init__(self):
        self.api_version, self.codecs = API_VERSION, list(CODECS.values())
        self.delay, self.refused = 0.0, set()
        self.draco = DracoDecoder(100_000)
        self.silent_from = self.ends_at = self.lost_from = self.drains_at = 2**63
        self.notice = None
        self.starts = True
        self.sessions: dict[str, pb.Session] = {}
        self.answered: dict[str, dict[int, pb.TrackResponse]] = {}
        self.requests: list[pb.CreateSessionRequest] = []
        self.frames: list[pb.Frame] = []
        self.keys: list[str | None] = []
        self.most_waiting = self.max_message_bytes = 0

    @refusing
    def GetServerInfo(self, request, context):
        time.sleep(self.delay)
        return pb.ServerInfo(
            api_version=self.api_version,
            server_version="fake",
            point_codecs=self.codecs,
            fabrics=["cotton"],
            max_message_bytes=self.max_message_bytes,
        )

    @refusing
    def CreateSession(self, request, context):
        require_compatible(request.api_version, peer="client")
        name = f"sessions/{request.session_id or f'session-{len(self.requests)}'}"
        self.requests.append(request)
        if name in self.sessions:
            raise errors.SessionExists(f"{name} exists", field="session_id", expected="another id", got=name)
        vertices, faces = unpack_mesh(request.session.garment, field="garment", max_vertices=100, max_faces=100)
        session = pb.Session()
        session.CopyFrom(request.session)
        session.name, session.state = name, pb.SESSION_STATE_IDLE
        session.garment_vertex_count, session.garment_face_count = len(vertices), len(faces)
        session.create_time.FromSeconds(CREATED)
        if request.clean:
            session.vertex_map.CopyFrom(pack(np.arange(len(vertices)), pb.ARRAY_ENCODING_UINT32))
        self.sessions[name] = session
        return session

    @refusing
    def GetSession(self, request, context):
        return self._find(request.name)

    @refusing
    def ListSessions(self, request, context):
        names = sorted(name for name in self.sessions if name > request.page_token)
        matching = [name for name in names if dict(request.labels).items() <= dict(self.sessions[name].labels).items()]
        token = matching[0] if len(matching) > 1 else ""
        return pb.ListSessionsResponse(sessions=[self.sessions[n] for n in matching[:1]], next_page_token=token)

    @refusing
    def UpdateSession(self, request, context):
        session = self._find(request.session.name)
        for path in request.update_mask.paths:
            session.ClearField(path)
        session.MergeFrom(request.session)
        return session

    @refusing
    def ResetSession(self, request, context):
        session = self._find(request.name)
        session.state = pb.SESSION_STATE_INITIALIZING
        return session

    @refusing
    def DeleteSession(self, request, context):
        self._find(request.name)
        del self.sessions[request.name]
        return empty_pb2.Empty()

    @refusing
    def SnapshotSession(self, request, context):
        return pb.SessionSnapshot(data=self._find(request.name).SerializeToString())

    @refusing
    def RestoreSession(self, request, context):
        session = pb.Session.FromString(request.data)
        session.name = f"sessions/{request.session_id}"
        self.sessions[session.name] = session
        return session

    def Track(self, requests, context):
        try:
            start = next(requests).start
            require_compatible(start.api_version, peer="client")
            session = self._find(start.name)
            while not self.starts and context.is_active():
                time.sleep(0.01)
            last = session.statistics.last_sequence_number
            repeated = self._lost_answers(start, last)
            started = pb.Started(
                name=start.name, last_sequence_number=last, max_frames_in_flight=4, repeated_answers=len(repeated)
            )
            yield pb.TrackResponse(started=started)
            yield from repeated
            yield from self._answers(session, start, self._mailbox(requests, start.flow_mode), context)
        except errors.ServiceError as error:
            abort(context, error)

    def _lost_answers(self, start, last):
        if not start.HasField("answered_through"):
            return []
        answered = self.answered.get(start.name, {})
        return [answered[number] for number in range(start.answered_through + 1, last + 1) if number in answered]

    def _mailbox(self, requests, mode):
        """A queue of the requests of the stream; in realtime mode it holds the newest frame and the number of replaced ones."""
        box, dropped = queue.Queue(), [0]

        def fill():
            try:
                for request in requests:
                    if mode == pb.FLOW_MODE_REALTIME and request.HasField("frame"):
                        while not box.empty():
                            dropped[0] += box.get_nowait()[0].HasField("frame")
                    box.put((request, dropped[0]))
                    self.most_waiting = max(self.most_waiting, box.qsize())
            except Exception:
                pass  # the client has disconnected
            box.put((END, 0))

        threading.Thread(target=fill, daemon=True).start()
        return box

    def _answers(self, session, start, box, context):
        vertices, _ = unpack_mesh(session.garment, field="garment", max_vertices=100, max_faces=100)
        statistics = session.statistics
        while (item := box.get())[0] is not END:
            request, dropped = item
            if request.HasField("ping"):
                yield pb.TrackResponse(pong=pb.Pong(token=request.ping.token))
                continue
            frame = request.frame
            self.frames.append(frame)
            time.sleep(self.delay)
            while frame.sequence_number >= self.silent_from and context.is_active():
                time.sleep(0.01)
            if frame.sequence_number >= self.ends_at:
                return
            if frame.sequence_number >= self.drains_at:
                raise errors.Draining("the server has stopped")
            if frame.sequence_number >= self.lost_from:
                raise errors.WorkerLost("the worker was killed", retry_after=1.5)
            if frame.sequence_number in self.refused:
                statistics.frames_rejected += 1
                yield pb.TrackResponse(frame_error=self._refusal(frame))
                continue
            statistics.frames_applied += 1
            statistics.frames_dropped = dropped
            statistics.last_sequence_number = frame.sequence_number
            response = pb.TrackResponse(result=self._result(frame, vertices, statistics, start.result_options))
            self.answered.setdefault(start.name, {})[frame.sequence_number] = response
            yield response
            if self.notice:
                yield pb.TrackResponse(notice=self.notice)
                self.notice = None

    def _refusal(self, frame):
        error = errors.InvalidFrame(field="points", expected="something else", got="this")
        return pb.FrameError(
            sequence_number=frame.sequence_number, capture_time=frame.capture_time, error=errors.to_detail(error)
        )

    def _result(self, frame, vertices, statistics, options):
        points = decode(frame.point_cloud, max_points=100_000, draco_decoder=self.draco)
        origins = sensor_origins(frame.sensors, len(points))
        body = np.frombuffer(frame.body_vertices, "<f4").reshape(-1, 3)
        count = len(vertices)
        result = pb.Result(
            sequence_number=frame.sequence_number,
            capture_time=frame.capture_time,
            state=pb.TRACKER_STATE_TRACKING,
            reliability=0.75,
            paper_score=0.5,
            coverage=0.25,
            frames_dropped=statistics.frames_dropped,
            frames_rejected=statistics.frames_rejected,
            frames_applied=statistics.frames_applied,
            timings={"total": 0.001, "sensors": len(frame.sensors), "body": len(body)},
            vertices=pack(vertices + (points.mean(axis=0) if len(points) else 0)),
            sigma=pack(np.full(count, 0.001)),
            vertex_reliability=pack(np.full(count, 0.9 if origins is None else float(np.mean(origins)))),
            observed=pack(np.arange(count) % 2 == 0, pb.ARRAY_ENCODING_BOOL),
        )
        if options.include_velocities:
            result.velocities.CopyFrom(pack(np.ones((count, 3))))
        if options.include_covariance:
            result.covariance.CopyFrom(pack(np.tile(np.arange(1.0, 7), (count, 1))))
        return result

    def _find(self, name):
        if name not in self.sessions:
            raise errors.SessionNotFound(f"there is no {name}", field="name")
        return self.sessions[name]


def start(service: FakeService, port: int = 0) -> tuple[grpc.Server, str]:
    """Serves on a loopback port, by default a free one. Returns the server and its address."""
    server = grpc.server(futures.ThreadPoolExecutor(8), options=server_options())
    rpc.add_TrackingServiceServicer_to_server(service, server)
    port = server.add_insecure_port(f"127.0.0.1:{port}")
    server.start()
    return server, f"127.0.0.1:{port}"
