"""Stream clouds to a service over gRPC and read results as they come.

python examples/03_stream_to_a_service.py                    starts its own service
python examples/03_stream_to_a_service.py 127.0.0.1:7701     uses a running service (ddakf serve)
"""

import sys
import time

import numpy as np
from ddakf_client import Frame, connect
from ddakf_service.commands.service_process import running_service

from ddakf import data
from ddakf.evaluation.sensors import Sensor

FRAMES = 12


def frames(sequence):
    """Frames of a depth camera; the client pulls them in its own thread."""
    camera, rng = Sensor("front"), np.random.default_rng(1)
    for number in range(1, FRAMES):
        cloud = camera.capture(sequence, number, rng)
        yield Frame(cloud.points, sequence.timestamp(number), cloud.sensor_origin)
        time.sleep(1 / sequence.fps)


def main(address: str) -> None:
    sequence = data.sample()
    with connect(address) as client:
        print(f"{address}: ddakf {client.server.server_version}, codecs {', '.join(client.server.codecs)}")
        with client.create_session(
            sequence.template,
            sequence.garment_faces,
            flow="lossless",  # every frame; "realtime" drops and counts frames that come too fast
            codec="morton-zstd",
            fabric="cotton",
        ) as session:
            session.reset(sequence.garment_vertices[0])
            for result in session.track(frames(sequence)):
                print(
                    f"frame {result.sequence:2d}  {result.state:12s}  reliability {result.reliability:.2f}"
                    f"  coverage {result.coverage:.2f}  latency {1e3 * result.latency:5.1f} ms"
                )
            info = session.info()
        print(f"{info.applied} frames tracked, {info.dropped} dropped, {info.rejected} refused")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with running_service(["--workers", "1"]) as service:
            main(service.grpc)
