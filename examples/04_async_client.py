"""Track two garments at once from one asyncio program.

python examples/04_async_client.py [HOST:PORT]
"""

import asyncio
import sys

import numpy as np
from ddakf_client import Frame, aconnect
from ddakf_service.commands.service_process import running_service

from ddakf import data
from ddakf.evaluation.sensors import Sensor

FRAMES = 8


async def camera(sequence, view: str):
    """Frames at the camera's rate, 30 per second."""
    sensor, rng = Sensor(view), np.random.default_rng(1)
    for number in range(1, FRAMES):
        cloud = sensor.capture(sequence, number, rng)
        yield Frame(cloud.points, sequence.timestamp(number), cloud.sensor_origin)
        await asyncio.sleep(1 / sequence.fps)


async def track(client, sequence, view: str) -> str:
    """Tracks one garment to the end."""
    async with client.create_session(
        sequence.template, sequence.garment_faces, flow="lossless", labels={"view": view}
    ) as session:
        await session.reset(sequence.garment_vertices[0])
        latency = []
        async for result in session.track(camera(sequence, view)):
            latency.append(result.latency)
        return (
            f"{view:5s}  {result.applied} frames  reliability {result.reliability:.2f}"
            f"  coverage {result.coverage:.2f}  median latency {1e3 * np.median(latency):.1f} ms"
        )


async def track_both(address: str) -> None:
    sequence = data.sample()
    async with aconnect(address) as client:
        for line in await asyncio.gather(track(client, sequence, "front"), track(client, sequence, "full")):
            print(line)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        asyncio.run(track_both(sys.argv[1]))
    else:
        with running_service(["--workers", "2"]) as service:
            asyncio.run(track_both(service.grpc))
