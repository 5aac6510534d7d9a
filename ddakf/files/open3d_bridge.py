"""The one place that imports Open3D: file formats that ddakf does not read itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile, MissingDependency

HEADER_BYTES = 4096  # of a .pcd, at most
MOST_POINTS_PER_BYTE = 30  # of a compressed .pcd: its LZF makes 264 bytes of 3 at best
MESHES = (".stl", ".off", ".gltf", ".glb")  # formats
SYSTEM_LIBRARIES = "libegl1 libgl1 libx11-6 libusb-1.0-0 libgomp1"


def import_open3d():
    """The module ``open3d``.

    Raises:
        MissingDependency: the package, or a system library that it loads, is absent; the message names what to install.
    """
    try:
        import open3d
    except ModuleNotFoundError as error:
        raise MissingDependency(f"Open3D is not installed ({error}): pip install 'ddakf[evaluation]'.") from error
    except (ImportError, OSError) as error:
        raise MissingDependency(
            f"Open3D is installed but a system library is missing ({error}): apt-get install {SYSTEM_LIBRARIES}"
            " (and pip install 'ddakf[evaluation]' for the package itself)."
        ) from error
    return open3d


def read_points(path: Path) -> np.ndarray:
    """(N, 3) float64 points of a file that Open3D reads, for instance .pcd; NaN rows (no return) are left out."""
    o3d = import_open3d()
    if path.suffix.lower() == ".pcd":
        _require_possible(path)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(path), remove_nan_points=True, remove_infinite_points=True)
    points = np.asarray(cloud.points, np.float64).reshape(-1, 3)
    if len(points) == 0:
        raise InvalidFile(str(path), "a point cloud that Open3D reads", "no points")
    return points


def _require_possible(path: Path) -> None:
    """Refuses a .pcd that announces more points than its bytes can hold: Open3D makes room for them before it reads any."""
    announced, is_text = {b"POINTS": 0, b"WIDTH": 0, b"HEIGHT": 0}, False
    with path.open("rb") as file:
        for line in file.read(HEADER_BYTES).splitlines():
            name, *values = line.split() or [b""]
            if name == b"DATA":
                is_text = values == [b"ascii"]
                break
            if name in announced and len(values) == 1 and values[0].isdigit():
                announced[name] = int(values[0][:20])
    points, size = max(announced[b"POINTS"], announced[b"WIDTH"] * announced[b"HEIGHT"]), path.stat().st_size
    if points > MOST_POINTS_PER_BYTE * size:
        raise InvalidFile(f"{path.name}: POINTS", f"a number of points that {size} bytes can hold", str(points))
    if is_text:
        lines = sum(1 for line in path.read_bytes().partition(b"DATA ascii")[2].splitlines() if line.strip())
        if lines < points:
            raise InvalidFile(f"{path.name}: POINTS", f"a line for each of {points} points", f"{lines} lines")


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) float64 vertices and (F, 3) int64 faces of a file in any mesh format that Open3D reads."""
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(str(path))
    faces = np.asarray(mesh.triangles, np.int64).reshape(-1, 3)
    if len(faces) == 0:
        known = ", ".join(MESHES)
        if path.suffix.lower() not in MESHES:
            raise InvalidFile(str(path), f"a mesh in one of the formats .ply, .obj, {known}", f"{path.suffix}, or no faces in it")
        raise InvalidFile(str(path), "a triangle mesh that Open3D reads", "no faces")
    return np.asarray(mesh.vertices, np.float64).reshape(-1, 3), faces
