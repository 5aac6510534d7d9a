"""Pinhole cameras: look at a scene, render the depth of meshes, and turn depth images into points.

World: metres, y up, right-handed. Camera axes: x right, y down, z forward. The centre of the pixel in row v and
column u is at (u, v). A depth is the z coordinate in camera axes, not the length of the ray.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ddakf.errors import InvalidArgument
from ddakf.files.depth import Intrinsics as Lens
from ddakf.files.depth import seen, unproject
from ddakf.kernels import zbuffer


@dataclass(frozen=True)
class Intrinsics:
    """Image size, focal lengths and principal point, pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


@dataclass(frozen=True, eq=False)
class Camera:
    """A camera in the world.

    Attributes:
        intrinsics: see :class:`Intrinsics`.
        eye: (3,) position, metres.
        axes: (3, 3), whose rows are the camera's x, y and z axes in the world.
    """

    intrinsics: Intrinsics
    eye: np.ndarray
    axes: np.ndarray

    @classmethod
    def looking_at(cls, intrinsics: Intrinsics, eye, target) -> Camera:
        """A camera at ``eye`` (3,) with ``target`` (3,) in the middle and the world's y axis upwards in the image.

        Where it looks along that axis, the world's -z axis points upwards.
        """
        eye, target = np.asarray(eye, float), np.asarray(target, float)
        z = (target - eye) / np.linalg.norm(target - eye)
        x = np.cross(z, [0.0, 1.0, 0.0])
        if np.linalg.norm(x) < 1e-9:
            x = np.cross(z, [0.0, 0.0, -1.0])
        x /= np.linalg.norm(x)
        return cls(intrinsics, eye, np.stack([x, np.cross(z, x), z]))

    @classmethod
    def at_origin(cls, intrinsics: Intrinsics) -> Camera:
        """A camera whose world is its own frame: at the origin, looking along -z, y up, x right."""
        return cls(intrinsics, np.zeros(3), np.diag([1.0, -1.0, -1.0]))

    @property
    def lens(self) -> Lens:
        """Focal lengths and principal point, pixels."""
        i = self.intrinsics
        return Lens(i.fx, i.fy, i.cx, i.cy)

    def to_camera(self, points: np.ndarray) -> np.ndarray:
        """(N, 3) world points in camera axes, float64, contiguous."""
        return np.ascontiguousarray((np.asarray(points, np.float64) - self.eye) @ self.axes.T)

    def project(self, points: np.ndarray) -> np.ndarray:
        """(N, 2) pixel coordinates (u, v) of world points (N, 3) in front of the camera."""
        c, i = self.to_camera(points), self.intrinsics
        return c[:, :2] / c[:, 2:] * [i.fx, i.fy] + [i.cx, i.cy]

    def render(self, meshes) -> tuple[np.ndarray, np.ndarray]:
        """Draws meshes with mutual occlusion.

        Args:
            meshes: pairs of vertices (V, 3), metres, and faces (F, 3).

        Returns:
            Depth (H, W) float64, metres, infinity where there is nothing; and face (H, W) int32: the index of the face
            in the concatenation of all faces, -1 where there is nothing.
        """
        i, label = self.intrinsics, 0
        depth = np.full((i.height, i.width), np.inf)
        face = np.full((i.height, i.width), -1, np.int32)
        for vertices, faces in meshes:
            faces = np.ascontiguousarray(faces, np.int64)
            zbuffer.rasterize(self.to_camera(vertices), faces, self.lens, label, depth, face)
            label += len(faces)
        return depth, face

    def silhouette(self, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """(H, W) bool: the pixels that :meth:`render` draws of one mesh (V, 3), metres, (F, 3), at a cost that hardly grows with
        the size of its faces."""
        i = self.intrinsics
        column = np.arange(i.width + 1, dtype=np.int32)
        free = np.tile(column, (i.height, 1))
        faces = np.ascontiguousarray(faces, np.int64)
        zbuffer.cover(self.to_camera(vertices), faces, self.lens, free)
        return (free != column)[:, :-1]

    def unproject(self, depth: np.ndarray, keep: np.ndarray | None = None) -> np.ndarray:
        """World points of the pixels of a depth image, row by row.

        Args:
            depth: (H, W) metres; zero, negative or non-finite in pixels without a depth.
            keep: (H, W) bool, the pixels to use; default all that saw something.

        Returns:
            (N, 3) float64, metres.
        """
        i = self.intrinsics
        if depth.shape != (i.height, i.width):
            raise InvalidArgument("depth", f"an image of shape {(i.height, i.width)}", str(depth.shape))
        found = seen(depth) if keep is None else seen(depth) & keep
        pose = np.column_stack([self.axes.T, self.eye])
        return unproject(depth, found, self.lens, pose)
