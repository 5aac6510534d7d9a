"""Hostile session, the largest that the default limits allow: ``python benchmarks/hostile.py ADDRESS [--seconds 20]``.

A fifth of the points of every frame, 100,000, are on one spot: with many more the frame is refused. The next frame follows each
answer at once. Prints the numbers of answers by kind as JSON. ``make chaos`` measures what neighbours notice of such a session.
"""

from __future__ import annotations

import argparse
import asyncio
import collections
import itertools
import json
import sys
import time
from pathlib import Path

import grpc
import numpy as np
from ddakf_api import API_VERSION, codec
from ddakf_api.arrays import pack_mesh
from ddakf_api.errors import from_rpc_error
from ddakf_api.transport import client_options
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_api.v1.tracking_pb2_grpc import TrackingServiceStub

SIDE, SPACING = 310, 0.01  # vertices, and metres between them: a cloth of three metres
POINTS = 500_000


async def started(address: str, seconds: float) -> asyncio.subprocess.Process:
    """This program as a process of its own, so that it takes no time of the caller's event loop."""
    command = [sys.executable, str(Path(__file__)), address, "--seconds", str(seconds)]
    return await asyncio.create_subprocess_exec(*command, stdout=asyncio.subprocess.PIPE)


def main(argv: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("address")
    parser.add_argument("--seconds", type=float, default=20.0)
    a = parser.parse_args(argv)
    with grpc.insecure_channel(a.address, client_options(a.address)) as channel:
        print(json.dumps(_attack(TrackingServiceStub(channel), a.seconds)))
    return 0


def _attack(stub: TrackingServiceStub, seconds: float) -> dict[str, int]:
    """Numbers of answers: results, and refusals by name; and the name of the error that ended the session, if any."""
    vertices, faces = _cloth()
    request = pb.CreateSessionRequest(api_version=API_VERSION, session=pb.Session(garment=pack_mesh(vertices, faces)))
    name = stub.CreateSession(request).name
    answers: collections.Counter[str] = collections.Counter()
    points = np.resize(vertices, (POINTS, 3))
    points[::5] = vertices.mean(axis=0)
    frame = pb.Frame(point_cloud=codec.encode(points, "raw").cloud)
    end = time.monotonic() + seconds

    def requests():
        yield pb.TrackRequest(start=pb.Start(name=name, api_version=API_VERSION, flow_mode=pb.FLOW_MODE_LOSSLESS))
        for number in itertools.count(1):
            if time.monotonic() > end:
                return
            frame.sequence_number, frame.capture_time = number, number / 30
            sent = answers.total()
            yield pb.TrackRequest(frame=frame)
            while answers.total() == sent and time.monotonic() < end:
                time.sleep(0.002)

    try:
        for response in stub.Track(requests()):
            if response.HasField("result"):
                answers["result"] += 1
            elif response.HasField("frame_error"):
                answers[response.frame_error.error.name] += 1
        stub.DeleteSession(pb.DeleteSessionRequest(name=name))
    except grpc.RpcError as error:
        answers[f"ended with {type(from_rpc_error(error)).__name__}"] += 1
    return dict(answers)


def _cloth() -> tuple[np.ndarray, np.ndarray]:
    """A flat square: (V, 3) vertices in metres, (F, 3) faces."""
    x, y = np.meshgrid(np.arange(SIDE), np.arange(SIDE), indexing="ij")
    vertices = SPACING * np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    corner = (x[:-1, :-1] * SIDE + y[:-1, :-1]).ravel()
    lower = np.stack([corner, corner + SIDE, corner + 1], axis=1)
    upper = np.stack([corner + 1, corner + SIDE, corner + SIDE + 1], axis=1)
    return vertices, np.concatenate([lower, upper])


if __name__ == "__main__":
    sys.exit(main())
