"""The one place that imports Open3D: file formats that ddakf does not read itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile, MissingDependency

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
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        cloud = o3d.io.read_point_cloud(str(path), remove_nan_points=True, remove_infinite_points=True)
    points = np.asarray(cloud.points, np.float64).reshape(-1, 3)
    if len(points) == 0:
        raise InvalidFile(str(path), "a point cloud that Open3D reads", "no points")
    return points


def read_mesh(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) float64 vertices and (F, 3) int64 faces of a file in any mesh format that Open3D reads."""
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(str(path))
    faces = np.asarray(mesh.triangles, np.int64).reshape(-1, 3)
    if len(faces) == 0:
        raise InvalidFile(str(path), "a triangle mesh that Open3D reads", "no faces")
    return np.asarray(mesh.vertices, np.float64).reshape(-1, 3), faces
