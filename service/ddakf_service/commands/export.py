"""Export: the bundled sample as plain files, for a client in any language."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
from ddakf_api.codec.sensors import group_by_sensor
from rich.console import Console
from rich.progress import track

from ddakf import data
from ddakf.errors import InvalidArgument
from ddakf.evaluation.sensors import Cloud, Sensor
from ddakf.files.io import write_mesh, write_points
from ddakf.files.sequence import Sequence

SEED = 7  # of the virtual camera
_SEQUENCE = "sequence.json"
_KINDS = {"points": "ply", "body": "ply", "truth": "json"}  # files of a frame, each in a folder of its own, and their endings
_DIGITS = 5  # of a coordinate in metres: a hundredth of a millimetre

_README = """The sample of ddakf: a T-shirt on a moving body, as a virtual depth camera sees it. Metres, seconds, y up. CC0 1.0.

garment.obj        the template: the garment in its rest shape
body.obj           the body in its pose at the start
sequence.json      the frames in order: capture time, sensors (as in the contract: runs of consecutive points), files
points/NNNN.ply    the cloud of a frame, float32, binary little-endian; a comment has the place of the sensor if there is one
body/NNNN.ply      the vertices of the body in that frame, in the order of body.obj
truth/NNNN.json    the true vertices of the garment, in the order of garment.obj

A client creates a session with garment.obj and body.obj, resets it to truth/0000.json, sends each frame, and compares the
answered vertices with the truth. The command line tracks the clouds alone: ddakf track points --template garment.obj
"""


def export(args: argparse.Namespace, count: int) -> int:
    """Writes the files of the first ``count`` frames and returns the exit status."""
    sequence, folder, rng = data.sample(), args.export, np.random.default_rng(SEED)
    _remove_frames(folder)
    for name in _KINDS:
        (folder / name).mkdir(parents=True, exist_ok=True)
    write_mesh(folder / "garment.obj", sequence.template, sequence.garment_faces)
    write_mesh(folder / "body.obj", sequence.body_vertices[0], sequence.body_faces)
    (folder / "README.txt").write_text(_README)
    sensor, console = Sensor(args.view), Console(stderr=True)
    frames = [
        _write_frame(folder, sequence, number, sensor.capture(sequence, number, rng))
        for number in track(range(count), "writing frames", console=console)
    ]
    description = {"fps": sequence.fps, "garment": "garment.obj", "body": "body.obj", "frames": frames}
    (folder / _SEQUENCE).write_text(json.dumps(description, indent=1) + "\n")
    print(json.dumps({"folder": str(folder), "frames": count}) if args.json else folder)
    return 0


def _remove_frames(folder: Path) -> None:
    """Removes the frames of an earlier export, of which there may be more."""
    if not (folder / _SEQUENCE).is_file():
        return
    try:
        frames = json.loads((folder / _SEQUENCE).read_text())["frames"]
        files = [folder / kind / Path(frame[kind]).name for frame in frames for kind in _KINDS]
    except (ValueError, KeyError, TypeError) as error:
        got = f"{folder} with another {_SEQUENCE}"
        raise InvalidArgument("export", "a new folder, or one of an earlier export", got) from error
    for file in files:
        file.unlink(missing_ok=True)


def _write_frame(folder: Path, sequence: Sequence, number: int, cloud: Cloud) -> dict:
    """Writes one frame and returns its entry in ``sequence.json``."""
    points, sensors = _by_sensor(cloud)
    entry = {"capture_time": sequence.timestamp(number), "sensors": sensors}
    files = {kind: f"{kind}/{number:04d}.{suffix}" for kind, suffix in _KINDS.items()}
    write_points(folder / files["points"], points, cloud.sensor_origin if len(sensors) == 1 else None)
    write_points(folder / files["body"], sequence.body_vertices[number])
    (folder / files["truth"]).write_text(json.dumps({"vertices": _rounded(sequence.garment_vertices[number])}) + "\n")
    return {**entry, **files}


def _by_sensor(cloud: Cloud) -> tuple[np.ndarray, list[dict]]:
    """The points in runs of one sensor, and the sensors as ``Frame.sensors`` has them."""
    origins = np.broadcast_to(cloud.sensor_origin, cloud.points.shape)
    order, counts, distinct = group_by_sensor(origins)
    places = (dict(zip("xyz", row, strict=True)) for row in _rounded(distinct))
    return cloud.points[order], [{"origin": o, "point_count": n} for o, n in zip(places, counts, strict=True)]


def _rounded(rows: np.ndarray) -> list[list[float]]:
    return np.round(rows.astype(np.float64), _DIGITS).tolist()
