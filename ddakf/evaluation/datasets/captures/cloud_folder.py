"""Folders of point clouds: a .ply, .obj, .xyz, .txt, .csv or .pcd file per frame, perhaps a template beside them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets.captures.recording import by_number, positive_rate
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
    """

    name: str
    paths: tuple[Path, ...]
    fps: float
    mesh: Path | None = None
    sensor_origin: tuple[float, float, float] | None = None
    unit: float = 1.0

    def __len__(self) -> int:
        return len(self.paths)

    def timestamp(self, frame: int) -> float:
        """Seconds since frame 0."""
        return frame / self.fps

    def cloud(self, frame: int) -> Cloud | ColouredCloud:
        """The points of one frame, metres, where its sensor was if that is known, and colours where the file has them.

        Raises:
            InvalidFile: an unreadable file, or coordinates beyond :data:`LARGEST`.
        """
        points, colors = read_coloured_points(self.paths[frame])
        if np.abs(points).max(initial=0.0) > LARGEST:
            raise InvalidFile(self.paths[frame].name, f"coordinates up to {LARGEST:g}", f"{np.abs(points).max():g}")
        origin = read_sensor_origin(self.paths[frame]) if self.sensor_origin is None else np.array(self.sensor_origin)
        cloud = Cloud((self.unit * points).astype(np.float32), None if origin is None else self.unit * origin)
        return cloud if colors is None else ColouredCloud(*cloud, colors)

    def template(self, frame: int = 0) -> Mesh:
        """The folder's template, or the mesh in a frame's file; cleaned, in metres.

        Raises:
            InvalidArgument: neither, or a template for another frame than the first. InvalidFile: a template that is no mesh.
        """
        if self.mesh is not None:
            if frame != 0:
                raise InvalidArgument("frames", f"a start at frame 0, where {self.mesh.name} lies", str(frame))
            return self._cleaned(self.mesh)
        if self.paths[frame].suffix.lower() not in MESH_SUFFIXES:
            raise InvalidArgument("template", NO_TEMPLATE, "none")
        try:
            return self._cleaned(self.paths[frame])
        except InvalidFile as error:
            raise InvalidArgument("template", NO_TEMPLATE, "none") from error

    def _cleaned(self, path: Path) -> Mesh:
        vertices, faces = read_mesh(path)
        return Mesh.cleaned(self.unit * vertices, faces)[0]


def load_folder(path, fps: float = 30.0) -> FolderRecording:
    """Opens a folder of .ply, .obj, .xyz, .txt, .csv or .pcd frames, which are read when they are needed.

    Files without a number in their names are frames only where no file has one.

    Raises:
        InvalidFile: no such folder, or no frames in it.
    """
    path = Path(path)
    if not path.is_dir():
        raise InvalidFile(str(path), "a folder of frames", "no folder")
    found = [entry for entry in path.iterdir() if entry.suffix.lower() in POINT_SUFFIXES]
    meshes = sorted(entry for entry in found if entry.stem == TEMPLATE and entry.suffix.lower() in MESH_SUFFIXES)
    frames = [entry for entry in found if entry not in meshes]
    numbered = [entry for entry in frames if any(letter.isdigit() for letter in entry.stem)]
    paths = tuple(sorted(numbered or frames, key=by_number))
    if not paths:
        raise InvalidFile(str(path), f"frames ({', '.join(POINT_SUFFIXES)})", "none in the folder")
    if len(meshes) > 1:
        raise InvalidFile(str(path), "one template", " and ".join(mesh.name for mesh in meshes))
    return FolderRecording(path.name, paths, positive_rate(fps), *meshes)


