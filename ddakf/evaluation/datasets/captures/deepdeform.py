"""DeepDeform: pairs of depth images, far apart in time, with the scene flow between them (Bozic et al. 2020).

Published layout, a folder per sequence: ``depth/000110.png`` (16 bit, millimetres), ``intrinsics.txt``, ``mask/000000_shirt.png``
of the object in the first image, and ``scene_flow/shirt_000000_000110.sflow``: int32 width, height, 3, then float32 (3, H, W)
metres in camera axes, not finite where there is no label. Here as everywhere: y up, the sensor at the origin, looking along -z.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from ddakf.body import proximity
from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets.captures.depth_template import JUMP, template_from_depth
from ddakf.evaluation.datasets.formats.depth_files import load_camera, read_depth, read_grey
from ddakf.evaluation.sensors.camera import Camera
from ddakf.evaluation.sensors.captured_frame import Cloud
from ddakf.files.depth import without_fliers
from ddakf.mesh import Mesh

MM = 1e-3  # metres
FPS = 30.0  # rate of the frame numbers in file names
REACH = 0.3  # m: the target is the largest surface in the source object's bounding box, enlarged by this on every side
FLOW = re.compile(r"(?P<object>\w+?)_(?P<source>\d+)_(?P<target>\d+)\.sflow")


@dataclass(frozen=True, eq=False)
class Pair:
    """Two frames of a sensor, and the true displacement from the first to the second.

    Attributes:
        name: of the sequence and the pair.
        garment: grid mesh of the object in the source frame, metres.
        points: (N, 3) float64 points of the source frame with a label, metres.
        flow: (N, 3) float64 their true displacement, metres.
        target: the cloud of the largest surface of the target frame near the object, and the sensor's origin.
        seconds: between the frames.
    """

    name: str
    garment: Mesh
    points: np.ndarray
    flow: np.ndarray
    target: Cloud
    seconds: float

    def flow_of(self, vertices: np.ndarray) -> np.ndarray:
        """(N, 3) displacement of the points by a garment at ``vertices`` (V, 3): that of the nearest places on it, metres."""
        corners, weight = self._attached
        moved = np.asarray(vertices, np.float64) - self.garment.vertices
        return np.einsum("nc,nca->na", weight, moved[corners])

    @cached_property
    def _attached(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 3) vertices and (N, 3) barycentric coordinates of the places nearest to the points."""
        tree = proximity.build(self.garment)
        surface = proximity.refresh(tree, self.garment.vertices)
        found = proximity.closest_points(tree, surface, np.ascontiguousarray(self.points), radius=np.inf)
        return tree.faces[found.face], found.barycentric


def pairs(path) -> tuple[str, ...]:
    """The pairs of a sequence's folder: names of the files in ``scene_flow`` without their ending."""
    return tuple(sorted(file.stem for file in (Path(path) / "scene_flow").glob("*.sflow")))


def load_pair(path, part: str | None = None) -> Pair:
    """Reads a pair.

    Args:
        path: the folder of a sequence, or a file in its ``scene_flow``.
        part: of the folder's :func:`pairs`; None where there is one only.

    Raises:
        InvalidFile: not the published layout. InvalidArgument: no such pair, or nothing seen of the object.
        MissingDependency: Pillow is not installed.
    """
    path = Path(path)
    if path.suffix.lower() == ".sflow":
        path, part = path.parent.parent, path.stem
    known = pairs(path)
    if part is None and len(known) == 1:
        part = known[0]
    if part not in known:
        raise InvalidArgument("pair", f"one of {', '.join(known) or 'none in scene_flow'}", str(part))
    file = path / "scene_flow" / f"{part}.sflow"
    if not (found := FLOW.fullmatch(file.name)):
        raise InvalidFile(file.name, "a name OBJECT_SOURCE_TARGET.sflow", file.name)
    source = _depth(path / "depth" / f"{found['source']}.png")
    target = _depth(path / "depth" / f"{found['target']}.png")
    mask = read_grey(path / "mask" / f"{found['source']}_{found['object']}.png") > 0
    flow = read_scene_flow(file)
    for name, image in (("mask", mask), ("scene flow", flow[0]), ("target", target)):
        if image.shape != source.shape:
            raise InvalidFile(f"{part}: {name}", f"shape {source.shape} as the source image", str(image.shape))
    camera, _ = load_camera(path, source.shape)
    labelled = np.isfinite(flow).all(axis=0) & (source > 0)
    if not labelled.any():
        raise InvalidFile(file.name, "a label for at least one pixel with a depth", "none")
    points = camera.unproject(source, labelled)
    seconds = (int(found["target"]) - int(found["source"])) / FPS
    garment = template_from_depth(np.where(mask, source, 0.0), camera)
    near = _near(camera, target, np.concatenate([points, garment.vertices]))
    if len(near.points) == 0:
        raise InvalidFile(f"depth/{found['target']}.png", f"a surface within {REACH:g} m of the object in the source", "none")
    return Pair(f"{path.resolve().name}_{part}", garment, points, flow[:, labelled].T @ camera.axes, near, seconds)


def read_scene_flow(path) -> np.ndarray:
    """(3, H, W) float64 metres in camera axes of an ``.sflow`` file, not finite where there is no label.

    Raises:
        InvalidFile: no such file, or not as long as its header says.
    """
    path = Path(path)
    if not path.is_file():
        raise InvalidFile(str(path), "scene flow (.sflow)", "nothing there")
    data = path.read_bytes()
    width, height, channels = np.frombuffer(data[:12], "<i4").tolist() if len(data) >= 12 else (0, 0, 0)
    if min(width, height) < 1 or channels != 3 or len(data) != 12 + 4 * width * height * channels:
        raise InvalidFile(path.name, "int32 W, H, 3 and 12 W H bytes", f"{width}, {height}, {channels} and {len(data)} bytes")
    with np.errstate(invalid="ignore"):  # signalling NaN
        return np.frombuffer(data, "<f4", offset=12).reshape(3, height, width).astype(np.float64)


def _depth(path: Path) -> np.ndarray:
    return read_depth(path) * MM


def _near(camera: Camera, depth: np.ndarray, points: np.ndarray) -> Cloud:
    """The cloud of the largest surface in the bounding box of another frame's points, enlarged by :data:`REACH`."""
    keep = without_fliers(depth, JUMP)
    seen, surface = camera.unproject(depth, keep), _surfaces(depth)[keep]
    inside = ((seen >= points.min(axis=0) - REACH) & (seen <= points.max(axis=0) + REACH)).all(axis=1)
    if inside.any():
        inside &= surface == np.bincount(surface[inside]).argmax()
    return Cloud(seen[inside].astype(np.float32), camera.eye)


def _surfaces(depth: np.ndarray) -> np.ndarray:
    """(H, W) int: the number of the surface that a pixel is of; neighbours on one are less than :data:`JUMP` apart in depth."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    index = np.arange(depth.size).reshape(depth.shape)
    pairs = []
    for one, other in ((np.s_[:, :-1], np.s_[:, 1:]), (np.s_[:-1], np.s_[1:])):
        near = (depth[one] > 0) & (depth[other] > 0) & (np.abs(depth[one] - depth[other]) < JUMP)
        pairs.append([index[one][near], index[other][near]])
    edges = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(edges.shape[1]), edges), shape=(depth.size, depth.size))
    return connected_components(graph, directed=False)[1].reshape(depth.shape)
