"""Virtual sensors: point clouds of a garment from a scanner or from depth cameras, occluded by garment and body."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeVar, get_args

import numpy as np

from ddakf.errors import InvalidArgument
from ddakf.evaluation.sensors import depth_errors
from ddakf.evaluation.sensors.camera import Camera, Intrinsics
from ddakf.evaluation.sensors.captured_frame import Cloud, ColouredCloud
from ddakf.evaluation.sensors.texture import Texture
from ddakf.files.depth import seen, without_fliers
from ddakf.files.sequence import Sequence

View = Literal["full", "front", "ring4"]
C = TypeVar("C", Cloud, ColouredCloud)

DISTANCE = 2.0  # m: cameras stand this far from the garment's first centroid, horizontally
FRONT_RISE, RING_RISE = 0.2, 0.4  # m: and this much above it
INTRINSICS = Intrinsics(width=320, height=240, fx=285.0, fy=285.0, cx=159.5, cy=119.5)  # nearly the first Kinect's
FLIER_JUMP = 0.03  # m: see ddakf.files.depth.without_fliers
BACKGROUND = 1.0  # m: distance from the garment's first centroid to the wall that edge fliers mix with
OUTLIER_MARGIN = 0.3  # m: outliers fill the cloud's bounding box, enlarged by this on every side
OF_A_CAMERA = ("depth_noise", "depth_step", "fliers")  # fields of a sensor that only a depth camera has
COVERED = 0.06  # m: skin this near to cloth counts as covered


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
        depth_noise: of a camera: standard deviation along its axis at 1 m, growing with the square of the depth; metres.
        depth_step: of a camera: distance of its depth steps at 1 m, growing with the square of the depth; metres; 0 for none.
        fliers: of a camera: share of the pixels at depth edges that is a mixture of both sides.
        occlude: frames (first, last + 1) in which a side of the garment is hidden, see :func:`occluded_side`; None for none.
        occluded: share of the garment's vertices on that side.
        every: stride of the frames, see :meth:`frames`.
    """

    view: View = "front"
    points: int = 10_000
    noise: float = 0.003
    drop: float = 0.0
    outliers: float = 0.0
    segmented: bool = True
    depth_noise: float = 0.0
    depth_step: float = 0.0
    fliers: float = 0.0
    occlude: tuple[int, int] | None = None
    occluded: float = 0.4
    every: int = 1

    def __post_init__(self) -> None:
        if self.view not in get_args(View):
            raise InvalidArgument("view", f"one of {', '.join(get_args(View))}", repr(self.view))
        for name in ("points", "every"):
            if getattr(self, name) < 1:
                raise InvalidArgument(name, "at least 1", str(getattr(self, name)))
        for name in ("noise", "depth_noise", "depth_step"):
            if not 0 <= getattr(self, name) < 1:
                raise InvalidArgument(name, "metres in [0, 1)", str(getattr(self, name)))
        for name in ("drop", "outliers", "fliers", "occluded"):
            if not 0 <= getattr(self, name) <= 1:
                raise InvalidArgument(name, "a share in [0, 1]", str(getattr(self, name)))
        for name in OF_A_CAMERA:
            if self.view == "full" and getattr(self, name):
                raise InvalidArgument(name, "0 where there is no camera, as in the view full", str(getattr(self, name)))
        if self.occlude is not None and not 0 <= self.occlude[0] < self.occlude[1]:
            raise InvalidArgument("occlude", "frames FROM:TO with 0 <= FROM < TO", "{}:{}".format(*self.occlude))

    def require_no_camera(self) -> None:
        """Refuses errors of a virtual depth camera for the frames of a real one, which has its own.

        Raises:
            InvalidArgument: one of them is not 0.
        """
        for name in OF_A_CAMERA:
            if value := getattr(self, name):
                raise InvalidArgument(name, "0 for a recording, whose camera has errors of its own", str(value))

    def frames(self, frames: range) -> range:
        """The frames of a range that this sensor takes: every :attr:`every`-th, from the first one on."""
        return frames[:: self.every]

    def occludes(self, frame: int) -> bool:
        """True if a side of the garment is hidden in the frame of this number."""
        return self.occlude is not None and self.occlude[0] <= frame < self.occlude[1]

    def capture(
        self, sequence: Sequence, frame: int, rng: np.random.Generator, texture: Texture | None = None
    ) -> Cloud | ColouredCloud:
        """The cloud of one frame, with colours where a texture is given. The same generator state gives the same cloud."""
        if self.view == "full":
            (points, face), origin = _scan(sequence, frame, self.points, self.segmented, rng), None
        else:
            points, face, origin = self._look(sequence, frame, rng)
        cloud = Cloud(points, origin)
        if texture is not None:  # another generator: the points are the same with colours and without
            cloud = ColouredCloud(*cloud, texture.colors(sequence, frame, (points, face), rng.spawn(1)[0]))
        if self.occludes(frame):
            from scipy.spatial import cKDTree

            hidden = occluded_side(sequence, self.occluded)
            cloud = _selected(cloud, ~hidden[cKDTree(sequence.garment_vertices[frame]).query(cloud.points)[1]])
        return self.degrade(cloud, rng)

    def degrade(self, cloud: C, rng: np.random.Generator, frame: int | None = None) -> C:
        """Limit, loss, noise and outliers of this sensor applied to a cloud; the points stay in their order.

        Args:
            cloud: as it was captured.
            rng: random numbers.
            frame: number of a recorded frame, whose occlusion is applied here. A recording has no vertices, so that the share
                of the points with the largest x is hidden. None if the occlusion is done.
        """
        if frame is not None and self.occludes(frame) and len(cloud.points):
            cloud = _selected(cloud, cloud.points[:, 0] <= np.quantile(cloud.points[:, 0], 1 - self.occluded))
        chosen = np.arange(len(cloud.points))
        if len(chosen) > self.points:
            chosen = np.sort(rng.permutation(len(chosen))[: self.points])
        chosen = chosen[rng.random(len(chosen)) >= self.drop]
        cloud = _selected(cloud, chosen)
        points = cloud.points + self.noise * rng.normal(size=(len(chosen), 3))
        return cloud._replace(points=_with_outliers(points, self.outliers, rng).astype(np.float32))

    def _look(self, sequence: Sequence, frame: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points (N, 3), their faces (N,) and their sensors."""
        cameras = [front_camera(sequence)]
        if self.view == "ring4":
            # the order in which a stream groups points by sensor, so that sending a cloud does not reorder it
            cameras = sorted(ring_cameras(sequence, 4), key=lambda camera: tuple(camera.eye))
        found = [self._depth_points(sequence, frame, camera, rng) for camera in cameras]
        if self.view == "front":
            return *found[0], cameras[0].eye
        origin = np.repeat([camera.eye for camera in cameras], [len(points) for points, _ in found], axis=0)
        return np.concatenate([points for points, _ in found]), np.concatenate([face for _, face in found]), origin

    def _depth_points(
        self, sequence: Sequence, frame: int, camera: Camera, rng: np.random.Generator
    ) -> tuple[np.ndarray, np.ndarray]:
        """World points (N, 3) and faces (N,) of one camera's pixels: of the garment if segmented, else of the whole scene."""
        meshes = [(sequence.garment_vertices[frame], sequence.garment_faces)]
        if sequence.has_body:
            meshes.append((sequence.body_vertices[frame], sequence.body_faces))
        depth, face = camera.render(meshes)
        # pixels that mix two surfaces are added to those that stay: they stand for the ones that no filter has found
        keep = without_fliers(depth, FLIER_JUMP)
        if self.segmented:
            keep &= face < len(sequence.garment_faces)
        depth = self._disturbed(depth, rng)
        return camera.unproject(depth, keep), face[seen(depth) & keep]

    def _disturbed(self, depth: np.ndarray, rng: np.random.Generator) -> np.ndarray:
        """The depth image with the errors of this sensor."""
        if self.fliers:
            depth = depth_errors.mixed_at_edges(depth, self.fliers, FLIER_JUMP, DISTANCE + BACKGROUND, rng)
        if self.depth_noise:
            depth = depth_errors.with_axial_noise(depth, self.depth_noise, rng)
        return depth_errors.quantised(depth, self.depth_step) if self.depth_step else depth


def occluded_side(sequence: Sequence, share: float) -> np.ndarray:
    """(V,) bool: the side of the garment that an occlusion hides, the share of its vertices with the largest x in the rest shape.

    Of a person who faces +z it is their left, with sleeve and under-arm; it stays the same part of the cloth while that moves.
    """
    order = np.argsort(-sequence.template[:, 0], kind="stable")
    hidden = np.zeros(len(order), bool)
    hidden[order[: round(share * len(order))]] = True
    return hidden


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
    return _sampled(vertices, faces, count, rng)[0]


def _sampled(vertices: np.ndarray, faces: np.ndarray, count: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """:func:`sample_surface`, and the (count,) faces of the points."""
    a, b, c = _corners(vertices, faces)
    area = _areas(vertices, faces)
    face = rng.choice(len(faces), count, p=area / area.sum())
    r, s = np.sqrt(rng.random((count, 1))), rng.random((count, 1))
    return (1 - r) * a[face] + r * (1 - s) * b[face] + r * s * c[face], face


def _corners(vertices: np.ndarray, faces: np.ndarray) -> list[np.ndarray]:
    return [vertices[faces[:, corner]].astype(np.float64) for corner in range(3)]


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = _corners(vertices, faces)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _scan(
    sequence: Sequence, frame: int, count: int, segmented: bool, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Samples of the garment, or of the garment and the uncovered skin at the same density, and their faces."""
    cloth, cloth_faces = sequence.garment_vertices[frame], sequence.garment_faces
    garment, face = _sampled(cloth, cloth_faces, count, rng)
    if segmented or not sequence.has_body:
        return garment, face
    from scipy.spatial import cKDTree

    skin, skin_faces = sequence.body_vertices[frame], sequence.body_faces
    ratio = _areas(skin, skin_faces).sum() / _areas(cloth, cloth_faces).sum()
    body, skin_face = _sampled(skin, skin_faces, round(count * ratio), rng)
    uncovered = np.isinf(cKDTree(garment).query(body, distance_upper_bound=COVERED)[0])
    face = np.concatenate([face, len(cloth_faces) + skin_face[uncovered]])
    return np.concatenate([garment, body[uncovered]]), face


def _selected(cloud: C, keep: np.ndarray) -> C:
    """The points that a mask (N,) or indices choose, the origins of their sensors, and their colours."""
    points, origin = cloud.points[keep], cloud.sensor_origin
    cloud = cloud._replace(points=points, sensor_origin=origin[keep] if origin is not None and origin.ndim == 2 else origin)
    return cloud._replace(colors=cloud.colors[keep]) if isinstance(cloud, ColouredCloud) else cloud


def _with_outliers(points: np.ndarray, share: float, rng: np.random.Generator) -> np.ndarray:
    bad = rng.random(len(points)) < share
    if not bad.any():
        return points
    low, high = points.min(axis=0) - OUTLIER_MARGIN, points.max(axis=0) + OUTLIER_MARGIN
    return np.where(bad[:, None], rng.uniform(low, high, points.shape), points)
