"""Folders of point clouds: a .ply, .obj, .xyz, .txt, .csv or .pcd file per frame, perhaps a template beside them."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets.captures.frame_names import in_order
from ddakf.evaluation.datasets.captures.recording import TIMES, frame_times, positive_rate, rate_of, visible
from ddakf.evaluation.sensors.captured_frame import Cloud, ColouredCloud
from ddakf.files.io import MESH_SUFFIXES, POINT_SUFFIXES, read_coloured_points, read_mesh, read_sensor_origin
from ddakf.mesh import Mesh

TEMPLATE = "template"  # name of the mesh file that is no frame
LARGEST = 1e12  # largest coordinate, in any unit

NO_TEMPLATE = f"a mesh file, as the frames are points; {TEMPLATE}.obj beside them, for instance"


@dataclass(frozen=True, eq=False)
class FolderRecording:
    """A folder with one file of points per frame, in the order of the numbers in their names. Axes are those of the files.

    Attributes:
        name: of the folder.
        paths: of the frames.
        fps: frames per second.
        mesh: file of the template, in the pose of the first frame; None if the frames are meshes, or without a template.
        sensor_origin: of the camera in every frame, in the files' unit; None: as each file says.
        unit: metres in a unit of the files.
        times: (T,) seconds, or None where the frames are evenly spaced.
    """

    name: str
    paths: tuple[Path, ...]
    fps: float
    mesh: Path | None = None
    sensor_origin: tuple[float, float, float] | None = None
    unit: float = 1.0
    times: np.ndarray | None = None

    def __len__(self) -> int:
        return len(self.paths)

    def timestamp(self, frame: int) -> float:
        """Seconds since frame 0."""
        return frame / self.fps if self.times is None else float(self.times[frame] - self.times[0])

    def cloud(self, frame: int) -> Cloud | ColouredCloud:
        """The points of one frame, metres, where its sensor was if that is known, and colours where the file has them.

        Raises:
            InvalidFile: an unreadable file, or coordinates beyond :data:`LARGEST`.
        """
        points, colors = read_coloured_points(self.paths[frame], finite=False)
        if np.abs(points).max(initial=0.0) > LARGEST:
            raise InvalidFile(self.paths[frame].name, f"coordinates up to {LARGEST:g}", f"{np.abs(points).max():g}")
        origin = read_sensor_origin(self.paths[frame]) if self.sensor_origin is None else np.array(self.sensor_origin)
        cloud = Cloud((self.unit * points).astype(np.float32), None if origin is None else self.unit * origin)
        return cloud if colors is None else ColouredCloud(*cloud, colors)

    def template(self, frame: int = 0) -> Mesh:
        """As :meth:`repaired`, without the map."""
        return self.repaired(frame)[0]

    def repaired(self, frame: int = 0) -> tuple[Mesh, np.ndarray | None]:
        """The folder's template, or the mesh in a frame's file; cleaned, in metres. With its map, see :func:`repaired_mesh`.

        Raises:
            InvalidArgument: neither, or a template for another frame than the first. InvalidFile: a template that is no mesh.
        """
        if self.mesh is not None:
            if frame != 0:
                raise InvalidArgument("frames", f"a start at frame 0, where {self.mesh.name} lies", str(frame))
            return repaired_mesh(self.mesh, self.unit)
        if self.paths[frame].suffix.lower() not in MESH_SUFFIXES:
            raise InvalidArgument("template", NO_TEMPLATE, "none")
        try:
            return repaired_mesh(self.paths[frame], self.unit)
        except InvalidFile as error:
            raise InvalidArgument("template", NO_TEMPLATE, "none") from error


def repaired_mesh(path, unit: float) -> tuple[Mesh, np.ndarray | None]:
    """The mesh of a file, in metres, and (V,) the vertex of the file that each of its vertices is; None: they are the same."""
    vertices, faces = read_mesh(path)
    mesh, vertex_map = Mesh.cleaned(unit * vertices, faces)
    return mesh, None if np.array_equal(vertex_map, np.arange(len(vertices))) else vertex_map


def load_folder(path, fps: float = 30.0) -> FolderRecording:
    """Opens a folder of .ply, .obj, .xyz, .txt, .csv or .pcd frames, which are read when they are needed.

    Files without a number in their names are frames only where no file has one. ``timestamps.txt``: seconds, a line per frame.

    Raises:
        InvalidFile: no such folder, no frames in it, frames of several formats, times that do not fit.
    """
    path = Path(path)
    if not path.is_dir():
        raise InvalidFile(str(path), "a folder of frames", "no folder")
    found = [entry for entry in visible(path.iterdir()) if entry.suffix.lower() in POINT_SUFFIXES and entry.name != TIMES]
    meshes = sorted(entry for entry in found if entry.stem == TEMPLATE and entry.suffix.lower() in MESH_SUFFIXES)
    frames = [entry for entry in found if entry not in meshes]
    numbered = [entry for entry in frames if any(letter.isdigit() for letter in entry.stem)]
    paths = in_order(numbered or frames)
    if not paths:
        raise InvalidFile(str(path), f"frames ({', '.join(POINT_SUFFIXES)})", "none in the folder")
    formats = Counter(frame.suffix.lower() for frame in paths)
    if len(formats) > 1:
        got = " and ".join(f"{count} {suffix}" for suffix, count in sorted(formats.items()))
        raise InvalidFile(str(path), "frames of one format", got)
    if len(meshes) > 1:
        raise InvalidFile(str(path), "one template", " and ".join(mesh.name for mesh in meshes))
    times = frame_times(path / TIMES, len(paths))
    return FolderRecording(path.resolve().name, paths, positive_rate(rate_of(times, fps)), *meshes, times=times)


