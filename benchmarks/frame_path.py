"""CPU time of the network process per frame: ``python benchmarks/frame_path.py OTHER_CHECKOUT [--blocks N] [--frames N]``.

Runs the service of this checkout and that of another one side by side and sends each frame to both, one frame in flight. Prints
the CPU microseconds that the network process (not its worker) takes per frame: medians over blocks of frames, and the median and
the quartiles of the ratios of the blocks. The other checkout is that of the commit to compare with, made by
``git worktree add ../before COMMIT``.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import grpc
import numpy as np
from ddakf_api import API_VERSION, codec
from ddakf_api.arrays import pack_mesh
from ddakf_api.transport import client_options
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub
from websockets.sync.client import connect

HERE = Path(__file__).resolve().parents[1]
PACKAGES = ("service", "protos", "clients/python")
WARM = 20  # frames before the first block
POINTS = 10_000
COMPACT = pb.ResultOptions(
    vertex_encoding=pb.ARRAY_ENCODING_QUANTISED_16,
    sigma_encoding=pb.ARRAY_ENCODING_FLOAT16,
    reliability_encoding=pb.ARRAY_ENCODING_QUANTISED_8,
)
FULL = pb.ResultOptions()
COVARIANCE = pb.ResultOptions(include_velocities=True, include_covariance=True)

Ask = Callable[[bytes], bytes]


class Service:
    """A service of a checkout with one worker."""

    def __init__(self, checkout: Path, folder: Path):
        paths = [str(HERE), *(str(checkout / package) for package in PACKAGES)]  # one core, whose kernels are compiled once
        command = [sys.executable, "-m", "ddakf_service", "--json", "--grpc-port", "0", "--http-port", "0"]
        self.process = subprocess.Popen(
            [*command, "--workers", "1", "--data-dir", str(folder), "--with-parent"],
            cwd=folder,
            env={**os.environ, "PYTHONPATH": os.pathsep.join(paths)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        for line in self.process.stdout:
            if (event := json.loads(line))["event"] == "ready":
                self.grpc, self.http = event["grpc"], event["http"]
                return
        raise RuntimeError(f"the service of {checkout} ended before it was ready")

    def cpu_seconds(self) -> float:
        """CPU time of the network process with all its threads."""
        return time.clock_gettime(~self.process.pid << 3 | 2)  # the CPU clock of another process, clock_getcpuclockid(3)

    def stop(self) -> None:
        self.process.stdin.close()  # which ends it
        self.process.wait(60)


def main() -> int:
    arguments = _parser().parse_args()
    with contextlib.ExitStack() as stack:
        services = []
        for checkout in (arguments.other.resolve(), HERE):
            folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            services.append(Service(checkout, folder))
            stack.callback(services[-1].stop)
        print("| frames | results | transport | bytes in | bytes out | before, us | after, us | ratio |")
        print("|---|---|---|---|---|---|---|---|")
        for case in cases():
            if all(word in " ".join(case[:3]) for word in arguments.only):
                print(_measured(*case, services, arguments.blocks, arguments.frames), flush=True)
    return 0


def cases() -> Iterator[tuple[str, str, str, Callable[[], pb.Frame], pb.ResultOptions, int]]:
    """Names of the frames, the results and the transport, the frame, the result options and the side of the sheet in vertices."""
    yield "morton-zstd", "float32", "grpc", lambda: _cloud("morton-zstd"), FULL, 50
    yield "morton-zstd", "float32", "websocket", lambda: _cloud("morton-zstd"), FULL, 50
    yield "morton-zstd", "compact", "grpc", lambda: _cloud("morton-zstd"), COMPACT, 50
    yield "raw", "covariance", "grpc", lambda: _cloud("raw"), COVARIANCE, 50
    yield "raw", "covariance", "websocket", lambda: _cloud("raw"), COVARIANCE, 50
    yield "depth float32 640x480", "float32", "grpc", _image, FULL, 50
    yield "depth float32 640x480", "float32", "websocket", _image, FULL, 50


def _measured(frames: str, results: str, transport: str, frame: Callable[[], pb.Frame], options: pb.ResultOptions, side: int,
              services: list[Service], blocks: int, count: int) -> str:  # fmt: skip
    message, spent, sizes = frame(), [[], []], (0, 0)
    with contextlib.ExitStack() as stack:
        opened = _grpc if transport == "grpc" else _websocket
        asks = [stack.enter_context(opened(service, side, options)) for service in services]
        number = 0
        for block in range(blocks + 1):
            requests = []
            for _ in range(count if block else WARM):
                number += 1
                message.sequence_number, message.capture_time = number, number / 30
                requests.append(pb.TrackRequest(frame=message).SerializeToString())
            before = [service.cpu_seconds() for service in services]
            for k, request in enumerate(requests):
                for ask in asks if k % 2 else reversed(asks):
                    answer = ask(request)
            for service, begun, values in zip(services, before, spent, strict=True):
                if block:
                    values.append(1e6 * (service.cpu_seconds() - begun) / count)
            sizes = len(request), len(answer)
            if not pb.TrackResponse.FromString(answer).HasField("result"):
                raise RuntimeError(f"no result: {pb.TrackResponse.FromString(answer)}")
    low, ratio, high = statistics.quantiles([after / before for before, after in zip(*spent, strict=True)])
    before, after = map(statistics.median, spent)
    return (
        f"| {frames} | {results} | {transport} | {sizes[0]} | {sizes[1]} | {before:.0f} | {after:.0f} | "
        f"{ratio:.3f} ({low:.3f} to {high:.3f}) |"
    )


@contextlib.contextmanager
def _grpc(service: Service, side: int, options: pb.ResultOptions) -> Iterator[Ask]:
    import queue

    with grpc.insecure_channel(service.grpc, client_options(service.grpc)) as channel:
        start, requests = _start(channel, side, options), queue.SimpleQueue()
        track = channel.stream_stream("/ddakf_api.v1.TrackingService/Track")  # bytes in, bytes out
        requests.put(start)
        answers = track(iter(requests.get, None))
        next(answers)

        def ask(request: bytes) -> bytes:
            requests.put(request)
            return next(answers)

        yield ask
        requests.put(None)


@contextlib.contextmanager
def _websocket(service: Service, side: int, options: pb.ResultOptions) -> Iterator[Ask]:
    with grpc.insecure_channel(service.grpc, client_options(service.grpc)) as channel:
        start = _start(channel, side, options)
    name = pb.TrackRequest.FromString(start).start.name
    address = f"{service.http.replace('http', 'ws', 1)}/v1/{name}/stream"
    with connect(address, max_size=None, compression=None) as socket:
        socket.send(start)
        socket.recv()

        def ask(request: bytes) -> bytes:
            socket.send(request)
            return socket.recv()

        yield ask
        socket.send(b"")


def _start(channel: grpc.Channel, side: int, options: pb.ResultOptions) -> bytes:
    """Creates a session of a sheet of cloth; returns the first message of its stream."""
    x, y = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    corner = (x[:-1, :-1] * side + y[:-1, :-1]).ravel()
    lower, upper = (corner, corner + side, corner + 1), (corner + 1, corner + side, corner + side + 1)
    faces = np.concatenate([np.stack(lower, 1), np.stack(upper, 1)])
    vertices = np.stack([x.ravel(), y.ravel(), np.zeros(side * side)], 1) / (side - 1)
    request = pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment=pack_mesh(vertices, faces)))
    session = TrackingServiceStub(channel).CreateSession(request)
    start = pb.Start(
        name=session.name, api_version=API_VERSION, flow_mode=pb.FLOW_MODE_LOSSLESS, result_options=options, takeover=True
    )
    return pb.TrackRequest(start=start).SerializeToString()


def _cloud(name: str) -> pb.Frame:
    points = np.zeros((POINTS, 3))
    points[:, :2] = np.random.default_rng(1).uniform(0, 1, (POINTS, 2))
    points[:, 2] += np.random.default_rng(2).normal(0, 0.001, POINTS)
    return pb.Frame(point_cloud=codec.encode(points, name).cloud, sensors=[pb.Sensor(origin=pb.Vector3(x=0.5, y=0.5, z=2.0))])


def _image() -> pb.Frame:
    """The sheet from 1.5 m, with nothing around it; the mask keeps every sixteenth pixel, so that the tracker takes less time."""
    depth = np.full((480, 640), 1.5, np.float32) + np.random.default_rng(3).normal(0, 0.001, (480, 640)).astype(np.float32)
    mask = np.zeros(depth.shape, bool)
    mask[::4, ::4] = True
    pose = np.array([[1.0, 0, 0, 0.5], [0, -1.0, 0, 0.5], [0, 0, -1.0, 1.5]])
    return pb.Frame(depth_image=codec.encode_depth(depth, (525.0, 525.0, 319.5, 239.5), pose=pose, mask=mask, codec="none"))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path, help="checkout to compare with")
    parser.add_argument("--blocks", type=int, default=12, help="blocks of frames per case (default 12)")
    parser.add_argument("--frames", type=int, default=25, help="frames per block (default 25)")
    parser.add_argument("--only", nargs="*", default=(), help="words of the cases to run (default: all)")
    return parser


if __name__ == "__main__":
    sys.exit(main())
