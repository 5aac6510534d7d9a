"""Virtual sensors: what a scanner or depth cameras see of a garment, with occlusion by garment and body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.spatial import cKDTree

from ddakf.depth import without_fliers
from ddakf.errors import InvalidArgument
from ddakf.evaluation.camera import Camera, Intrinsics
from ddakf.sequence import Sequence

View = Literal["full", "front", "ring4"]

DISTANCE = 2.0  # m: cameras stand this far from the garment's first centroid, horizontally
FRONT_RISE, RING_RISE = 0.2, 0.4  # m: and this much above it
INTRINSICS = Intrinsics(width=320, height=240, fx=285.0, fy=285.0, cx=159.5, cy=119.5)
FLIER_JUMP = 0.03  # m: see ddakf.depth.without_fliers
OUTLIER_MARGIN = 0.3  # m: outliers fill the cloud's bounding box, grown by this on every side
COVERED = 0.06  # m: skin this near to cloth counts as covered


class Cloud(NamedTuple):
    """One frame of a sensor."""

    points: np.ndarray  # (N, 3) float32, m
    sensor_origin: np.ndarray | None  # (3,), or (N, 3) for several cameras, m; None when it has none


@dataclass(frozen=True)
class Sensor:
    """A virtual sensor.

    Attributes:
        view: ``full``: uniform samples of the whole surface, no origin; ``front``: a depth camera (320 x 240, f = 285
            px) 2 m in front of the garment's first centroid and 0.2 m above; ``ring4``: four around it, 0.4 m above.
        points: at most this many, chosen at random.
        noise: standard deviation of the isotropic Gaussian noise, metres.
        drop: share of the points that is lost at random.
        outliers: share of the points that is replaced by uniform ones in the enlarged bounding box.
        segmented: only the garment's points (a perfect mask); otherwise the whole person's.
    """

    view: View = "front"
    points: int = 10_000
    noise: float = 0.003
    drop: float = 0.0
    outliers: float = 0.0
    segmented: bool = True

    def __post_init__(self) -> None:
        if self.view not in get_args(View):
            raise InvalidArgument("view", f"one of {', '.join(get_args(View))}", repr(self.view))
        if self.points < 1:
            raise InvalidArgument("points", "at least 1", str(self.points))
        if not 0 <= self.noise < 1:
            raise InvalidArgument("noise", "metres in [0, 1)", str(self.noise))
        for name in ("drop", "outliers"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidArgument(name, "a share in [0, 1]", str(getattr(self, name)))

    def capture(self, sequence: Sequence, frame: int, rng: np.random.Generator) -> Cloud:
        """What this sensor sees of one frame; the same generator state gives the same cloud."""
        if self.view == "full":
            points, origin = _scan(sequence, frame, self.points, self.segmented, rng), None
        else:
            points, origin = self._look(sequence, frame)
        return self.degrade(Cloud(points, origin), rng)

    def degrade(self, cloud: Cloud, rng: np.random.Generator) -> Cloud:
        """Limit, loss, noise and outliers of this sensor applied to a cloud; the points stay in their order."""
        points, origin = cloud
        chosen = np.arange(len(points))
        if len(points) > self.points:
            chosen = np.sort(rng.permutation(len(points))[: self.points])
        chosen = chosen[rng.random(len(chosen)) >= self.drop]
        points = points[chosen] + self.noise * rng.normal(size=(len(chosen), 3))
        points = _with_outliers(points, self.outliers, rng)
        if origin is not None and origin.ndim == 2:
            origin = origin[chosen]
        return Cloud(points.astype(np.float32), origin)

    def _look(self, sequence: Sequence, frame: int) -> tuple[np.ndarray, np.ndarray]:
        cameras = [front_camera(sequence)]
        if self.view == "ring4":
            # the order in which a stream groups points by sensor, so that sending a cloud does not reorder it
            cameras = sorted(ring_cameras(sequence, 4), key=lambda camera: tuple(camera.eye))
        seen = [_depth_points(sequence, frame, camera, self.segmented) for camera in cameras]
        if self.view == "front":
            return seen[0], cameras[0].eye
        origin = np.repeat([camera.eye for camera in cameras], [len(points) for points in seen], axis=0)
        return np.concatenate(seen), origin


def front_camera(sequence: Sequence, intrinsics: Intrinsics = INTRINSICS) -> Camera:
    """The camera of the view ``front``: on the side of +z, looking at the garment's centroid in the first frame."""
    centre = sequence.garment_vertices[0].astype(np.float64).mean(axis=0)
    return Camera.looking_at(intrinsics, centre + np.array([0.0, FRONT_RISE, DISTANCE]), centre)


def ring_cameras(sequence: Sequence, count: int, intrinsics: Intrinsics = INTRINSICS) -> list[Camera]:
    """Cameras at equal angles around the garment's centroid in the first frame, the first one on the side of +z."""
    centre = sequence.garment_vertices[0].astype(np.float64).mean(axis=0)
    angles = np.arange(count) * 2 * np.pi / count
    eyes = centre + np.column_stack([DISTANCE * np.sin(angles), np.full(count, RING_RISE), DISTANCE * np.cos(angles)])
    return [Camera.looking_at(intrinsics, eye, centre) for eye in eyes]


def sample_surface(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> np.ndarray:
    """(count, 3) points, uniform over the area of a mesh (V, 3), (F, 3); Turk's square-root barycentric coordinates."""
    a, b, c = _corners(vertices, faces)
    area = _areas(vertices, faces)
    face = rng.choice(len(faces), count, p=area / area.sum())
    r, s = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return (1 - r) * a[face] + r * (1 - s) * b[face] + r * s * c[face]


def _corners(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    return [vertices[faces[:, corner]].astype(np.float64) for corner in range(3)]


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = _corners(vertices, faces)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _scan(sequence: Sequence, frame: int, count: int, segmented: bool, rng: np.random.Generator) -> np.ndarray:
    """Samples of the garment, or of garment and bare skin at the same density."""
    cloth, cloth_faces = sequence.garment_vertices[frame], sequence.garment_faces
    garment = sample_surface(cloth, cloth_faces, count, rng)
    if segmented or not sequence.has_body:
        return garment
    skin, skin_faces = sequence.body_vertices[frame], sequence.body_faces
    ratio = _areas(skin, skin_faces).sum() / _areas(cloth, cloth_faces).sum()
    body = sample_surface(skin, skin_faces, round(count * ratio), rng)
    bare = np.isinf(cKDTree(garment).query(body, distance_upper_bound=COVERED)[0])
    return np.concatenate([garment, body[bare]])


def _depth_points(sequence: Sequence, frame: int, camera: Camera, segmented: bool) -> np.ndarray:
    """World points (N, 3) of the pixels of one camera: of the garment, or of everything."""
    meshes = [(sequence.garment_vertices[frame], sequence.garment_faces)]
    if sequence.has_body:
        meshes.append((sequence.body_vertices[frame], sequence.body_faces))
    depth, face = camera.render(meshes)
    keep = without_fliers(depth, FLIER_JUMP)
    if segmented:
        keep &= face < len(sequence.garment_faces)
    return camera.unproject(depth, keep)


def _with_outliers(points: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    bad = rng.random(len(points)) < share
    if not bad.any():
        return points
    low, high = points.min(axis=0) - OUTLIER_MARGIN, points.max(axis=0) + OUTLIER_MARGIN
    return np.where(bad[:, None], rng.uniform(low, high, points.shape), points)
