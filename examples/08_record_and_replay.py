"""Record a session as MCAP, read the file, and replay it: the same frames give the same vertices.

python examples/08_record_and_replay.py                    starts its own service
python examples/08_record_and_replay.py 127.0.0.1:7701     uses a running service (ddakf serve)

It needs pip install -e 'clients/python[recording]'. Foxglove and `ddakf view` show the file.
"""

import sys
import tempfile
import threading
from pathlib import Path

import numpy as np
from ddakf_client import Frame, connect, recordings
from ddakf_service.commands.service_process import running_service

from ddakf import data
from ddakf.evaluation.sensors import Sensor

FRAMES = 8


def track(session, sequence, begin: threading.Event) -> None:
    """The camera's program: streams the sample as a depth camera sees it."""
    camera, rng = Sensor("front"), np.random.default_rng(1)

    def frames():
        begin.wait()
        for number in range(1, FRAMES + 1):
            cloud = camera.capture(sequence, number, rng)
            yield Frame(cloud.points, sequence.timestamp(number), cloud.sensor_origin)

    for _ in session.track(frames()):
        pass


def main(address: str, path: Path) -> None:
    sequence = data.sample()
    with connect(address) as client:
        with client.create_session(sequence.template, sequence.garment_faces, flow="lossless") as session:
            session.reset(sequence.garment_vertices[0])
            begin = threading.Event()
            camera = threading.Thread(target=track, args=(session, sequence, begin))
            camera.start()
            with connect(address) as other:  # a recorder is another client, and does not slow the camera
                watched = other.open_session(session.session_id)
                recorded = recordings.record(watched, path, frames=FRAMES, on_start=begin.set)
            camera.join()
        recording = recordings.load(path)
        last = recording.results[-1]
        print(f"{recorded.frames} frames in {path.stat().st_size / 1e6:.1f} MB; the last reliability was {last.reliability:.2f}")
        differences = [np.abs(before.vertices - now.vertices).max() for before, now in recordings.replay(client, recording)]
        print(f"replayed {len(differences)} frames, largest difference of a coordinate: {max(differences):g} m")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "walk.mcap"
        if len(sys.argv) > 1:
            main(sys.argv[1], file)
        else:
            with running_service(["--workers", "1"]) as service:
                main(service.grpc, file)
