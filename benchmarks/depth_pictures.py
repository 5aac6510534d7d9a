"""Pictures of real depth recordings as they are tracked: ``python benchmarks/depth_pictures.py [NAME ...] [--out FOLDER]``.

For each recording of UTD-MHAD under DDAKF_DATA a sheet of frames, ``NAME.png``, and an animation of all, ``NAME.webp``: the
camera's silhouette in grey, the tracked surface before it in blue, orange where the camera sees nobody; joints of the camera's
skeleton as red rings, those that go with the surface as green ones. They show people, and so they do not ship.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw

import ddakf
from ddakf.evaluation import metrics
from ddakf.evaluation.datasets import DepthRecording, load_depth

SHOWN = 7  # frames of a sheet
LARGER = 2  # pixels of a picture per pixel of the camera
RING = 4  # pixels, radius of a joint
NOBODY, PERSON, FITTED, OUTSIDE = (255, 255, 255), (200, 205, 215), (90, 150, 220), (230, 120, 60)
TRACKED, ATTACHED, INK = (220, 0, 0), (0, 120, 0), (35, 38, 46)
AMBIENT = 0.35  # share of the light that comes from everywhere


def main(argv: list[str] | None = None) -> int:
    """Draws, and names the files."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("names", nargs="*", metavar="NAME", help="such as a12_s1_t1; all if there is none")
    parser.add_argument("--out", type=Path, default=Path("out/depth"))
    arguments = parser.parse_args(argv)
    root = Path(os.environ.get("DDAKF_DATA") or os.devnull) / "depth/utd-mhad"
    names = arguments.names or sorted(path.name.removesuffix("_depth.mat") for path in root.glob("*_depth.mat"))
    if not names:
        parser.error("DDAKF_DATA has no depth/utd-mhad/*_depth.mat")
    arguments.out.mkdir(parents=True, exist_ok=True)
    for name in names:
        recording = load_depth(root / f"{name}_depth.mat")
        pictures = list(drawn(recording))
        sheet(pictures).save(arguments.out / f"{name}.png")
        later, milliseconds = pictures[1:], round(1000 / recording.fps)
        pictures[0].save(arguments.out / f"{name}.webp", save_all=True, append_images=later, duration=milliseconds, loop=0)
        print(f"{name}: {len(pictures)} frames")
    print(f"in {arguments.out}")
    return 0


def drawn(recording: DepthRecording) -> Iterator[Image.Image]:
    """A picture of each frame after the template's."""
    garment = recording.template(0)
    tracker = ddakf.Tracker(garment)
    limbs = None if recording.joints is None else metrics.Limbs(garment.vertices, recording.joints[0])
    for number in range(1, len(recording)):
        cloud = recording.cloud(number)
        result = tracker.step(cloud.points, timestamp=recording.timestamp(number), sensor_origin=cloud.sensor_origin)
        picture = surface(recording, number, result.vertices, garment.faces)
        pen = ImageDraw.Draw(picture)
        caption = f"{recording.name.removesuffix('_depth')} {number}  reliability {result.reliability:.2f}  {result.state}"
        if limbs is not None:
            rings(pen, recording, recording.joints[number], TRACKED)
            rings(pen, recording, limbs.joints(result.vertices), ATTACHED)
            caption += f"\njoints {limbs.error_mm(result.vertices, recording.joints[number])[0]:.0f} mm"
        pen.text((picture.width // 5 + 6, 4), caption, INK)
        yield picture


def surface(recording: DepthRecording, number: int, vertices: np.ndarray, faces: np.ndarray) -> Image.Image:
    """The surface before the camera's silhouette."""
    person = recording.depth[number] > 0
    depth, face = recording.camera.render([(vertices, faces)])
    hit = np.isfinite(depth)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    light = AMBIENT + (1 - AMBIENT) * np.abs(normal[:, 2]) / np.maximum(np.linalg.norm(normal, axis=1), 1e-12)
    image = np.full((*person.shape, 3), NOBODY, np.uint8)
    image[person] = PERSON
    image[hit] = np.array(FITTED) * light[face[hit], None]
    image[hit & ~person] = OUTSIDE
    picture = Image.fromarray(image)
    return picture.resize((LARGER * picture.width, LARGER * picture.height), Image.Resampling.NEAREST)


def rings(pen: ImageDraw.ImageDraw, recording: DepthRecording, joints: np.ndarray, colour: tuple[int, int, int]) -> None:
    """Rings around the joints (J, 3) that are known."""
    known = joints[np.isfinite(joints).all(axis=1)]
    for x, y in LARGER * recording.camera.project(known)[:, :2] if len(known) else ():
        pen.ellipse((x - RING, y - RING, x + RING, y + RING), outline=colour, width=2)


def sheet(pictures: list[Image.Image]) -> Image.Image:
    """Some of the pictures beside each other, evenly spaced in time, each cut to the middle three fifths of its width."""
    chosen = [pictures[k] for k in np.linspace(0, len(pictures) - 1, min(SHOWN, len(pictures))).round().astype(int)]
    width, height = chosen[0].size
    left, right = width // 5, width - width // 5
    wide = Image.new("RGB", ((right - left) * len(chosen), height), NOBODY)
    for k, picture in enumerate(chosen):
        wide.paste(picture.crop((left, 0, right, height)), (k * (right - left), 0))
    return wide


if __name__ == "__main__":
    sys.exit(main())
