"""Track a garment in a folder of 16-bit depth images with an intrinsics file, as RGB-D recorders write them.

python examples/09_depth_folder.py [FOLDER GARMENT.obj|.ply]

The folder has depth/*.png (millimetres), camera.json and perhaps mask/*.png. Without one the sample is written as such a
folder first. The same folder works in `ddakf track` and in the dashboard. No camera of a manufacturer has been tried.
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import ddakf
from ddakf import data
from ddakf.evaluation.datasets import open_dataset
from ddakf.evaluation.sensors import Camera, Intrinsics
from ddakf.files.io import read_mesh, write_mesh

FRAMES = 10
LENS = Intrinsics(width=320, height=240, fx=270.0, fy=270.0, cx=159.5, cy=119.5)


def write_recording(folder: Path) -> None:
    """Writes what a depth camera in front of the sample sees, with 3 mm of noise."""
    sequence, rng = data.sample(), np.random.default_rng(1)
    camera = Camera.looking_at(LENS, eye=(0.0, 1.2, 1.9), target=(0.0, 1.15, 0.0))
    for name in ("depth", "mask"):
        (folder / name).mkdir()
    for number in range(FRAMES):
        garment = sequence.garment_vertices[number], sequence.garment_faces
        body = sequence.body_vertices[number], sequence.body_faces
        depth, face = camera.render([garment, body])
        depth = np.where(np.isfinite(depth), depth + rng.normal(0, 0.003, depth.shape), 0.0)
        mask = (face >= 0) & (face < len(sequence.garment_faces))
        Image.fromarray(np.rint(1e3 * depth).astype(np.uint16)).save(folder / "depth" / f"{number:04d}.png")
        Image.fromarray(mask.astype(np.uint8) * 255).save(folder / "mask" / f"{number:04d}.png")
    pose = np.vstack([np.column_stack([camera.axes.T, camera.eye]), [0, 0, 0, 1]])  # camera to world
    lens = {name: getattr(LENS, name) for name in ("fx", "fy", "cx", "cy")}
    (folder / "camera.json").write_text(json.dumps({**lens, "depth_scale": 1000, "fps": 30, "T_world_sensor": pose.tolist()}))
    write_mesh(folder / "template.obj", sequence.garment_vertices[0], sequence.garment_faces)


def main(folder: Path, template: Path) -> None:
    garment, _ = ddakf.Mesh.cleaned(*read_mesh(template))
    recording = open_dataset(folder)
    tracker = ddakf.Tracker(garment)
    tracker.reset(vertices=garment.vertices)  # the mesh lies where the garment is; without this, a search
    for frame in range(len(recording)):
        cloud = recording.cloud(frame)
        result = tracker.step(cloud.points, timestamp=recording.timestamp(frame), sensor_origin=cloud.sensor_origin)
        print(f"frame {frame:3d}  {len(cloud.points):6d} points  {result.state}  reliability {result.reliability:.2f}")
    for warning in result.warnings:
        print(f"{warning.field}: {warning.message}")
    print(f"{result.observed.mean():.0%} of the garment measured, mean sigma {1e3 * result.sigma.mean():.1f} mm")


if __name__ == "__main__":
    if len(sys.argv) > 2:
        main(Path(sys.argv[1]), Path(sys.argv[2]))
    elif len(sys.argv) > 1:
        sys.exit(__doc__)
    else:
        with tempfile.TemporaryDirectory() as name:
            write_recording(Path(name))
            main(Path(name), Path(name) / "template.obj")
