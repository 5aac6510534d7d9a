"""Traffic of the operational benchmarks: pre-encoded frames, clients that send them on schedule, and the server's resources.

The clients speak the contract itself, so that neither encoding nor a client library counts as the server's work. All of them
run in one event loop.
"""

from __future__ import annotations

import asyncio
import itertools
import math
import os
import tempfile
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import grpc
import inputs
import numpy as np
from ddakf_api import API_VERSION, codec
from ddakf_api.arrays import pack, pack_mesh, unpack
from ddakf_api.errors import ServiceError, from_detail, from_rpc_error
from ddakf_api.transport import client_options
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from ddakf_client.calls import metadata_for
from ddakf_service.commands.service_process import ServiceProcess
from service_metrics import metrics_of

from ddakf import data
from ddakf.evaluation import metrics

SPARES = 1  # workers of a service beside those that take frames
SPARE_PATIENCE = 300.0  # seconds in which they have to be warm

_TICKS = os.sysconf("SC_CLK_TCK")


class Script:
    """A garment and its frames, encoded once; they are played forth and back without an end.

    Args:
        vertices: approximate number of the garment's; None for the sample's own.
        points: of each frame.
        view: of the virtual sensor.
        codec: a name of ``ddakf_api.codec.CODECS``.
        frames: different ones.
        body: the body's vertices travel with every frame.
    """

    def __init__(self, vertices: int | None, points: int, *, view: str = "full", codec_name: str = codec.DEFAULT_CODEC,
                 frames: int = 149, body: bool = False):  # fmt: skip
        sequence = data.sample()
        run = inputs.run_of(inputs.resampled(sequence, vertices) if vertices else sequence, frames, view, points, body=body)
        s = self._sequence = run.sequence
        self.fps, self.vertices = s.fps, len(s.template)
        self.mesh, self.begin = (s.template, s.garment_faces), s.garment_vertices[0]
        self._body = pack_mesh(s.body_vertices[0], s.body_faces) if body else None
        self._frames = []
        for _, cloud, how in run.frames():
            encoded = codec.encode(cloud.points, codec_name).cloud
            frame = pb.Frame(point_cloud=encoded)
            if how["sensor_origin"] is not None and np.ndim(how["sensor_origin"]) == 1:
                frame.sensors.add(origin=pb.Vector3(**dict(zip("xyz", map(float, how["sensor_origin"]), strict=True))))
            if how["body_vertices"] is not None:
                frame.body_vertices = np.asarray(how["body_vertices"], "<f4").tobytes()
            self._frames.append(frame)
        self.bytes = round(float(np.mean([frame.ByteSize() for frame in self._frames])))

    def frame(self, number: int, rate: float) -> pb.TrackRequest:
        """Frame ``number``, from 1, of a stream of ``rate`` frames per second."""
        request = pb.TrackRequest(frame=self._frames[self._place(number)])
        request.frame.sequence_number, request.frame.capture_time = number, number / rate
        return request

    def session(self, number: int) -> pb.Session:
        """A session with a garment of its own, ``number`` micrometres aside: equal ones share constants in a worker."""
        vertices, faces = self.mesh
        return pb.Session(garment=pack_mesh(vertices + [1e-6 * number, 0.0, 0.0], faces), body=self._body)

    def reset(self, name: str) -> pb.ResetSessionRequest:
        """Starts a session at the truth."""
        return pb.ResetSessionRequest(name=name, vertices=pack(self._sequence.garment_vertices[0], pb.ARRAY_ENCODING_FLOAT32))

    def rmse_mm(self, result: pb.Result) -> float:
        """Error of a result's vertices."""
        vertices = unpack(result.vertices, 3, field="vertices", max_items=self.vertices)
        return metrics.rmse_mm(vertices, self._sequence.garment_vertices[1 + self._place(result.sequence_number)])

    def _place(self, number: int) -> int:
        """There and back: no jump where the recording ends."""
        place = (number - 1) % (2 * len(self._frames))
        return min(place, 2 * len(self._frames) - 1 - place)


@dataclass
class StreamLog:
    """Log of one client's stream.

    Attributes:
        latency: seconds of each answered frame, from when it was due: a late send counts as the service's delay.
        answers: when each came (monotonic clock, seconds).
        resumed: when each notice came that the session goes on in another worker, and how many frames were forgotten.
        rmse: mm of each.
        used: seconds of the worker's processor, of each answered frame.
        curtailed: answered frames of which a budget left work out.
        lighter: those of lighter trackers.
        errors: refusals and ends of streams, by name.
        ended: name of the error that ended the stream before its time; empty when none did.
    """

    sent: int = 0
    answered: int = 0
    dropped: int = 0
    late: int = 0
    latency: list[float] = field(default_factory=list)
    answers: list[float] = field(default_factory=list)
    resumed: list[tuple[float, float]] = field(default_factory=list)
    rmse: list[float] = field(default_factory=list)
    used: list[float] = field(default_factory=list)
    curtailed: int = 0
    lighter: int = 0
    states: list[int] = field(default_factory=list)
    numbers: list[int] = field(default_factory=list)
    errors: dict[str, int] = field(default_factory=dict)
    ended: str = ""

    def failed(self, error: ServiceError) -> str:
        """Counts an error and returns its name."""
        name = type(error).__name__
        self.errors[name] = self.errors.get(name, 0) + 1
        return name


class _WithKey(grpc.aio.UnaryUnaryClientInterceptor, grpc.aio.StreamStreamClientInterceptor):
    """Sends a key with every call."""

    def __init__(self, key: str):
        self._metadata = metadata_for(key)

    async def intercept_unary_unary(self, continuation, client_call_details, request):
        return await continuation(client_call_details._replace(metadata=self._metadata), request)

    async def intercept_stream_stream(self, continuation, client_call_details, request_iterator):
        return await continuation(client_call_details._replace(metadata=self._metadata), request_iterator)


@asynccontextmanager
async def channel_to(address: str, key: str | None = None, authority: Path | None = None) -> AsyncIterator[grpc.aio.Channel]:
    """A connection of its own, as every client has one; encrypted where the certificates of an authority are given."""
    options = [*client_options(address), ("grpc.use_local_subchannel_pool", 1)]
    interceptors = [_WithKey(key)] if key else []
    if authority:
        credentials = grpc.ssl_channel_credentials(authority.read_bytes())
        opened = grpc.aio.secure_channel(address, credentials, options, interceptors=interceptors)
    else:
        opened = grpc.aio.insecure_channel(address, options, interceptors=interceptors)
    async with opened as channel:
        yield channel


async def created(
    stub: TrackingServiceStub, script: Script, limits: pb.SessionLimits | None = None, *, number: int = 0
) -> str:
    """The name of a new session at the truth; sessions of the same ``number`` have the same garment."""
    request = pb.CreateSessionRequest(api_version=API_VERSION, session=script.session(number))
    if limits is not None:
        request.session.limits.CopyFrom(limits)
    session = await stub.CreateSession(request)
    await stub.ResetSession(script.reset(session.name))
    return session.name


async def play(
    stub: TrackingServiceStub, name: str, script: Script, rate: float, seconds: float, record: StreamLog, *,
    flow: pb.FlowMode = pb.FLOW_MODE_REALTIME, first: int = 1, accuracy_every: int = 10, delay: float = 0.0,
) -> None:  # fmt: skip
    """Sends frames on schedule for ``seconds``, and reads until the last answer.

    Args:
        first: number of the first frame.
        accuracy_every: stride of the answers whose error is computed.
        delay: seconds before the first frame, so that clients do not all send at the same moment.
    """
    begun = time.monotonic() + delay
    due: dict[int, float] = {}

    async def requests() -> AsyncIterator[pb.TrackRequest]:
        yield pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION, flow_mode=flow))
        for k in range(round(seconds * rate)):
            at = begun + k / rate
            await asyncio.sleep(max(0.0, at - time.monotonic()))
            due[first + k] = at
            record.sent += 1
            yield script.frame(first + k, rate)

    try:
        async for response in stub.Track(requests()):
            now, kind = time.monotonic(), response.WhichOneof("message")
            if kind == "result":
                result = response.result
                record.answered += 1
                record.dropped, record.late = result.frames_dropped, result.frames_late
                record.answers.append(now)
                record.latency.append(now - due.get(result.sequence_number, now))
                record.states.append(result.state)
                record.numbers.append(result.sequence_number)
                record.used.append(result.usage.processor_seconds)
                record.curtailed += result.usage.widening > 1.0
                record.lighter += result.usage.lighter
                if record.answered % accuracy_every == 0 and result.HasField("vertices"):
                    record.rmse.append(script.rmse_mm(result))
            elif kind == "frame_error":
                record.failed(from_detail(response.frame_error.error))
            elif kind == "notice" and response.notice.kind == pb.NOTICE_KIND_RESUMED:
                record.resumed.append((now, response.notice.value))
    except grpc.RpcError as error:
        record.ended = record.failed(from_rpc_error(error))


@contextmanager
def service(arguments: list[str], *, folder: Path | None = None) -> Iterator[ServiceProcess]:
    """A service of our own, ready and with its spare worker warm, which takes a core as long as it is not; its log is in
    ``folder`` (a temporary one if None)."""
    with tempfile.TemporaryDirectory() as own:
        process = ServiceProcess([*arguments, "--spare-workers", str(SPARES)], log=Path(folder or own) / "service.log")
        try:
            process.wait_until_ready()
            deadline = time.monotonic() + SPARE_PATIENCE
            while spare_workers(process) < SPARES:
                if time.monotonic() > deadline:
                    raise TimeoutError(f"the service has no spare worker after {SPARE_PATIENCE:g} s")
                time.sleep(0.1)
            yield process
        finally:
            process.stop()


def spare_workers(process: ServiceProcess) -> int:
    """Warm workers that wait, as the service's metrics tell."""
    return int(metrics_of(process)["ddakf_workers_spare"])


class Usage:
    """Memory, CPU time and descriptors of a process and its descendants, from /proc."""

    def __init__(self, pid: int):
        self._pid = pid

    def tree(self) -> list[int]:
        """The process and its descendants."""
        children: dict[int, list[int]] = {}
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit() and (stat := _stat(int(entry.name))):
                children.setdefault(int(stat[1]), []).append(int(entry.name))
        found = [self._pid]
        for pid in found:
            found.extend(children.get(pid, ()))
        return found

    def cpu_seconds(self) -> float:
        """User and system time of all that are alive."""
        return sum(sum(map(int, stat[11:13])) for pid in self.tree() if (stat := _stat(pid))) / _TICKS

    def memory(self) -> dict[int, int]:
        """Allocated bytes of each: its anonymous pages. Pages of files depend on other processes that map them."""
        return {pid: size for pid in self.tree() if (size := _anonymous(pid))}

    def descriptors(self) -> dict[int, int]:
        """Open files, pipes and sockets of each."""
        return {pid: count for pid in self.tree() if (count := _descriptors(pid)) is not None}


def workers(pid: int) -> list[int]:
    """Worker processes of a service, the oldest first."""
    named = [child for child in Usage(pid).tree() if _name(child) == "ddakf-worker"]
    return sorted(named, key=_started)


def _started(pid: int) -> float:
    """When a process was started, in ticks since the system was; infinite when it is gone."""
    return int(stat[19]) if (stat := _stat(pid)) else math.inf


def _name(pid: int) -> str:
    try:
        return (Path("/proc") / str(pid) / "comm").read_text().strip()
    except OSError:
        return ""


def _stat(pid: int) -> list[str] | None:
    """Fields of /proc/PID/stat from the state on; None when the process is gone."""
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()
    except OSError:
        return None


def _anonymous(pid: int) -> int:
    try:
        lines = (Path("/proc") / str(pid) / "smaps_rollup").read_text().splitlines()
    except OSError:
        return 0
    return next((1024 * int(line.split()[1]) for line in lines if line.startswith("Anonymous:")), 0)


def _descriptors(pid: int) -> int | None:
    try:
        return len(os.listdir(f"/proc/{pid}/fd"))
    except OSError:
        return None


def spread(clients: int, rate: float) -> Iterator[float]:
    """Delays that place the frames of several clients evenly within an interval."""
    return (k / clients / rate for k in itertools.count())
