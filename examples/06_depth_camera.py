"""Send depth images and receive the garment at the time of display.

python examples/06_depth_camera.py                    starts its own service
python examples/06_depth_camera.py 127.0.0.1:7701     uses a running service (ddakf serve)
"""

import sys

import numpy as np
from ddakf_client import Frame, connect
from ddakf_service.commands.service_process import running_service

from ddakf import data
from ddakf.evaluation.sensors import Camera, Intrinsics

FRAMES = 14
DELAY = 2  # frames from the capture of an image to its display
PHONE = Intrinsics(width=256, height=192, fx=200.0, fy=200.0, cx=127.5, cy=95.5)


def images(sequence, camera: Camera):
    """Frames with depth in millimetres, 3 mm of noise, and a mask of the garment's pixels."""
    rng = np.random.default_rng(1)
    for number in range(1, FRAMES):
        meshes = [
            (sequence.garment_vertices[number], sequence.garment_faces),
            (sequence.body_vertices[number], sequence.body_faces),
        ]
        depth, face = camera.render(meshes)
        depth = np.where(np.isfinite(depth), depth + rng.normal(0, 0.003, depth.shape), 0.0)
        time = sequence.timestamp(number)
        yield Frame(
            timestamp=time,
            display_time=time + DELAY / sequence.fps,
            depth=np.rint(1e3 * depth).astype(np.uint16),
            intrinsics=(PHONE.fx, PHONE.fy, PHONE.cx, PHONE.cy),
            pose=np.column_stack([camera.axes.T, camera.eye]),  # camera to world; x right, y down, z forward
            mask=(face >= 0) & (face < len(sequence.garment_faces)),
            body_vertices=sequence.body_vertices[number],
        )


def main(address: str) -> None:
    sequence = data.sample()
    camera = Camera.looking_at(PHONE, eye=(0.0, 1.2, 2.0), target=(0.0, 1.1, 0.0))
    with connect(address) as client:
        body = (sequence.body_vertices[0], sequence.body_faces)
        with client.create_session(sequence.template, sequence.garment_faces, body=body, flow="lossless") as session:
            session.reset(sequence.garment_vertices[0])
            ahead, behind = [], []
            for result in session.track(images(sequence, camera), depth_codec="rvl", compact=True):
                shown = sequence.garment_vertices[result.sequence + DELAY]
                ahead.append(np.sqrt(np.mean(np.sum((result.vertices - shown) ** 2, axis=1))))
                captured = sequence.garment_vertices[result.sequence]
                behind.append(np.sqrt(np.mean(np.sum((captured - shown) ** 2, axis=1))))
                print(f"frame {result.sequence:2d}  {result.state}  sigma {1e3 * np.median(result.sigma):.1f} mm")
    better = np.mean(ahead) < np.mean(behind)
    print(f"error when shown: {1e3 * np.mean(ahead):.1f} mm; {1e3 * np.mean(behind):.1f} mm of the true garment as captured")
    print("the prediction is nearer than the truth of the image" if better else "the garment moved too fast to be predicted")


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(sys.argv[1])
    else:
        with running_service(["--workers", "1"]) as service:
            main(service.grpc)
