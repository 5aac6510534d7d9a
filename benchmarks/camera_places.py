"""One camera in other places than in front, and in a scene: ``python benchmarks/camera_places.py [--held-out] [--procs N]``.

Clips of training recordings as a depth camera sees them beside, behind, above and below the wearer, near, far, on its way around,
in a shaking hand, with the garment half outside of the image, with somebody who passes, and with a mask of the garment that is
three pixels too narrow or too wide; and with all that is in the image instead of the garment alone: the wearer, a floor and a
wall, a table in between, somebody beside in the same clothes, a door that passes. Each alone, and with the body. Printed are
RMSE, reliability, the share of all vertices in their 90 % ellipsoids and that of the vertices that are seen. ``--held-out``
tracks the held-out recordings instead, on which nothing was chosen. Writes benchmarks/results/camera_places.json unless ``--out``
says otherwise; ``--table`` prints the table of docs/results/conditions.md from it.
"""

from __future__ import annotations

import itertools
import math
import sys
from dataclasses import dataclass
from pathlib import Path

import clips
import numpy as np
from conditions import FIRST, INSIDE, geometric
from scipy import ndimage

import ddakf
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.sensors import Camera, Intrinsics
from ddakf.evaluation.sensors.captured_frame import Cloud
from ddakf.files.sequence import Sequence

RESULT = Path(__file__).parent / "results" / "camera_places.json"
LENS = Intrinsics(width=320, height=240, fx=285.0, fy=285.0, cx=159.5, cy=119.5)
MOST, NOISE = 10_000, 0.003  # points, and their noise in m
FAR_OFF = 60.0  # mm
BAND, PASSING = 0.12, 25  # m, width of what passes, and frames that it takes
SCENE_MOST = 40_000  # points of a scene, about as many of them on the garment
FLOOR, WALL, DEPTH = 3.0, 2.4, 0.9  # m: side of the floor, height of the wall, and how far it is behind the garment's middle
TABLE, CLOSE = np.array([0.7, 0.24, 0.2]), 0.2  # m: the table's size, and how far its edge is in front of the garment
DOOR, DOOR_AWAY, SWING = np.array([0.35, 1.7, 0.25]), 0.7, 40  # m: size, and how far in front; frames in which it passes
BESIDE = np.array([0.65, 0.0, 0.05], np.float32)  # m, from the wearer to who stands beside


@dataclass(frozen=True)
class Place:
    """Where the camera is, about the garment's centroid in the first frame of the recording."""

    azimuth: float = 0.0  # degrees about the vertical, from the wearer's front to their left
    turn: float = 0.0  # degrees per frame by which that grows
    distance: float = 2.0  # m
    rise: float = 0.2  # m
    past: float = 0.0  # m from the centroid to what the camera looks at, to the wearer's left
    shake: float = 0.0  # m, standard deviation of its place from frame to frame
    told_off: float = 0.0  # m, the same of the place that the tracker is told
    passing: bool = False  # somebody passes in front of the wearer
    margin: int = 0  # pixels by which the mask of the garment is too wide, below 0 too narrow
    scene: str | None = None  # what is seen besides garment and wearer; None: the garment alone, cut out of the image


PLACES = {
    "in front": Place(),
    "beside": Place(azimuth=90.0),
    "behind": Place(azimuth=180.0),
    "above": Place(distance=1.5, rise=1.6),
    "below": Place(distance=1.8, rise=-0.8),
    "near": Place(distance=0.8, rise=0.1),
    "far": Place(distance=5.0, rise=0.5),
    "on its way around": Place(turn=4.0),
    "in a hand": Place(shake=0.03, told_off=0.02),
    "half outside": Place(distance=1.2, past=0.55),
    "somebody passes": Place(passing=True),
    "cut out too narrowly": Place(margin=-3),
    "cut out too widely": Place(margin=3),
    "not cut out": Place(scene="nothing"),
    "not cut out, in a room": Place(scene="room"),
    "not cut out, a table in between": Place(scene="table"),
    "not cut out, somebody beside": Place(scene="person"),
    "not cut out, a door passes": Place(scene="door"),
}
CORNERS = np.array(list(itertools.product([-0.5, 0.5], repeat=3)))
SIDES = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])


def box(middle: np.ndarray, size: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (8, 3) and faces (12, 3) of a box."""
    return middle + size * CORNERS, np.concatenate([SIDES[:, [0, 1, 2]], SIDES[:, [0, 2, 3]]])


def things(scene: str, sequence: Sequence, frame: int) -> list[tuple[np.ndarray, np.ndarray]]:
    """Meshes of what is seen besides the wearer in a garment."""
    garment = np.asarray(sequence.garment_vertices[0], np.float64)
    middle, ground = garment.mean(axis=0), float(sequence.body_vertices[..., 1].min())
    match scene:
        case "room":
            floor = box(np.array([middle[0], ground - 0.05, middle[2]]), np.array([FLOOR, 0.1, FLOOR]))
            return [floor, box(middle - [0.0, 0.0, DEPTH], np.array([FLOOR, WALL, 0.04]))]
        case "table":
            edge = np.array([middle[0], garment[:, 1].min() + 0.15, garment[:, 2].max() + CLOSE])
            return [box(edge + [0.0, 0.0, 0.5 * TABLE[2]], TABLE)]
        case "door":
            across = (frame - FIRST) % SWING / SWING * 2.4 - 1.2
            return [box(middle + [across, 0.0, DOOR_AWAY], DOOR)]
        case "person":
            body, shirt = sequence.body_vertices[frame] + BESIDE, sequence.garment_vertices[frame] + BESIDE
            return [(body, sequence.body_faces), (shirt, sequence.garment_faces)]
    return []


def seen_from(place: Place, sequence: Sequence, frame: int, rng: np.random.Generator) -> Cloud:
    """The garment's points in a frame, or all points of its scene, and where the tracker is told that the camera is."""
    centre = np.asarray(sequence.garment_vertices[0], np.float64).mean(axis=0)
    angle = math.radians(place.azimuth + place.turn * (frame - FIRST))
    away = np.array([place.distance * math.sin(angle), place.rise, place.distance * math.cos(angle)])
    eye = centre + away + place.shake * rng.normal(size=3)
    camera = Camera.looking_at(LENS, eye, centre + [place.past, 0.0, 0.0])
    meshes = [(sequence.garment_vertices[frame], sequence.garment_faces), (sequence.body_vertices[frame], sequence.body_faces)]
    if place.scene is not None:
        meshes += things(place.scene, sequence, frame)
    depth, face = camera.render(meshes)
    most, last = (MOST, len(sequence.garment_faces)) if place.scene is None else (SCENE_MOST, np.inf)
    points = camera.unproject(depth, widened((face >= 0) & (face < last), place.margin) & (face >= 0))
    if place.passing:
        middle = centre[0] + (frame - FIRST) % PASSING / PASSING * 0.8 - 0.4
        points = points[np.abs(points[:, 0] - middle) > 0.5 * BAND]
    if len(points) > most:
        points = points[np.sort(rng.permutation(len(points))[:most])]
    points = points + NOISE * rng.normal(size=points.shape)
    return Cloud(points.astype(np.float32), eye + place.told_off * rng.normal(size=3))


def widened(mask: np.ndarray, pixels: int) -> np.ndarray:
    """A mask (H, W) that is so many pixels wider; below 0 narrower."""
    change = ndimage.binary_dilation if pixels > 0 else ndimage.binary_erosion
    return change(mask, iterations=abs(pixels)) if pixels else mask


def run(job: tuple[str, bool, int]) -> list[dict]:
    """The rows of a recording, one per place, with the body or without, of so many frames."""
    name, with_body, frames = job
    sequence = collection.load(name)
    body = ddakf.Mesh(sequence.body_vertices[FIRST], sequence.body_faces) if with_body else None
    tracker = ddakf.Tracker(ddakf.Mesh(sequence.template, sequence.garment_faces), body=body)
    rows = []
    for title, place in PLACES.items():
        tracker.reset(vertices=sequence.garment_vertices[FIRST])
        found = []
        for k in range(FIRST + 1, min(FIRST + 1 + frames, len(sequence))):
            cloud = seen_from(place, sequence, k, np.random.default_rng([1, k]))
            pose = sequence.body_vertices[k] if with_body else None
            result = tracker.step(
                cloud.points, timestamp=k / sequence.fps, sensor_origin=cloud.sensor_origin, body_vertices=pose
            )
            off = result.vertices - sequence.garment_vertices[k]
            squared = np.einsum("va,va->v", off, np.linalg.solve(result.covariance, off[:, :, None])[:, :, 0])
            rmse = 1e3 * np.sqrt(np.square(off).sum(axis=1).mean())
            found.append((rmse, result.reliability, (squared < INSIDE).mean(), result.observed.mean()))
        means = zip(("rmse_mm", "reliability", "coverage", "seen"), np.mean(found, axis=0), strict=True)
        row = {"recording": name, "body": with_body, "place": title}
        rows.append(row | {key: round(float(value), 4) for key, value in means})
    return rows


def table(rows: list[dict]) -> list[str]:
    """Lines of a table in Markdown: geometric means of the RMSE, and means."""
    lines = ["| one camera | seen | RMSE mm | in ellipsoids | reliability | body: RMSE mm | in ellipsoids | reliability |"]
    lines.append("|---" * 8 + "|")
    for place in PLACES:
        mine = [[row for row in rows if (row["place"], row["body"]) == (place, body)] for body in (False, True)]
        cells = [place, f"{np.mean([row['seen'] for row in mine[0]]):.0%}"]
        for some in mine:
            inside, reliable = (np.mean([row[key] for row in some]) for key in ("coverage", "reliability"))
            cells += [f"{geometric(some, 'rmse_mm'):.1f}", f"{inside:.0%}", f"{reliable:.2f}"]
        lines.append(f"| {' | '.join(cells)} |")
    far_off = [row for row in rows if row["rmse_mm"] > FAR_OFF]
    surest = max((row["reliability"] for row in far_off), default=0.0)
    body = sum(row["body"] for row in far_off)
    worst = f"{len(far_off)} of {len(rows)} runs over {FAR_OFF:g} mm, {body} with the body, reliability at most {surest:.2f}"
    return [*lines, "", worst]


def main(argv: list[str] | None = None) -> int:
    """Runs and prints; returns the exit status."""
    return clips.main(argv, __doc__.splitlines()[0], RESULT, run, (False, True), table)


if __name__ == "__main__":  # the workers are spawned: they import this file
    sys.exit(main())
