"""Pictures and animations of a tracked garment: the cloud, the fit coloured by its uncertainty, the body.

Three panels, painted in software: the cloud alone from the sensor's side, the fit from there, and the fit from another
side. The colour of the garment is sigma in millimetres, on one scale for all frames of an animation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidArgument, MissingDependency
from ddakf.evaluation.sensors.camera import Camera, Intrinsics
from ddakf.kernels import zbuffer
from ddakf.mesh import vertex_normals

PANEL_WIDTH, PANEL_HEIGHT, GAP, HEADER, FOOTER = 232, 330, 6, 60, 58  # pixels
OVERSAMPLING = 2  # pixels are painted this many times finer and averaged
CAMERA_DISTANCE = 4.0  # m
AROUND = 0.12  # m of surroundings shown around the garment
POINT_RADIUS = 2.0  # fine pixels
POINT_BIAS = 0.015  # m: points this far behind the surface still show, as noise puts half of them there
MOST_POINTS, MOST_POINTS_ON_FIT = 4000, 500  # drawn per panel; few over the fit, whose colour is to be seen
BEHIND, BESIDE = 150.0, 55.0  # degrees from the sensor's side
MOST_FRAMES = 75  # of an animation
AMBIENT = 0.62  # share of the light that comes from everywhere: shading must not be mistaken for colour

# Colours are RGB. Points are red, which the scale of the uncertainty does not contain
WHITE, BACKGROUND, INK, PALE_INK = (255, 255, 255), (244, 245, 247), (35, 38, 46), (110, 114, 124)
BODY, POINT = (186, 188, 194), (226, 60, 24)
# Viridis (van der Walt and Smith, CC0): perceptually uniform, readable without colour vision, and free of red
COLOURS = np.array([
    [68, 1, 84], [72, 40, 120], [62, 74, 137], [49, 104, 142], [38, 130, 142],
    [31, 158, 137], [53, 183, 121], [110, 206, 88], [181, 222, 43], [253, 231, 37],
], float)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Shot:
    """Content of one picture: cloud, fit and body of a frame.

    Attributes:
        points: (N, 3) of the sensor, metres.
        vertices: (V, 3) fitted garment, metres.
        sigma: (V,) metres.
        caption: one line about this frame.
        body: (B, 3) metres, or None.
    """

    points: np.ndarray
    vertices: np.ndarray
    sigma: np.ndarray
    caption: str
    body: np.ndarray | None = None


class Painter:
    """Paints shots of one recording with fixed cameras and a fixed scale of colours.

    Args:
        shots: all that will be painted, or a selection of them: they set the frame and the scale.
        faces: (F, 3) of the garment.
        body_faces: (G, 3), or None.
        title: one line above.
        sensor_origin: (3,) metres; the first two panels look from its side; default from +z.
        see_behind: the third panel looks from behind; otherwise from beside, for surfaces that have no back.
    """

    def __init__(
        self,
        shots: Sequence[Shot],
        faces: np.ndarray,
        body_faces: np.ndarray | None = None,
        *,
        title: str,
        sensor_origin: np.ndarray | None = None,
        see_behind: bool = True,
    ):
        if not shots:
            raise InvalidArgument("shots", "at least one frame", "none")
        self.faces, self.body_faces, self.title = faces, body_faces, title
        self.scale_mm = round_up(1e3 * np.percentile(np.concatenate([shot.sigma for shot in shots]), 99))
        scene = np.concatenate([part for shot in shots for part in (shot.vertices[::7], _core(shot.points)[::7])])
        centre = (scene.min(axis=0) + scene.max(axis=0)) / 2
        toward = np.array([0.0, 0.0, 1.0]) if sensor_origin is None else sensor_origin - centre
        front = np.degrees(np.arctan2(toward[0], toward[2]))
        turn = BEHIND if see_behind else BESIDE
        cameras = [_camera(scene, centre, front), _camera(scene, centre, front + turn)]
        where = "from behind" if see_behind else "from the side"
        self._panels = (
            ("what the sensor sees", cameras[0], False),
            ("fitted garment", cameras[0], True),
            (f"fitted garment, {where}", cameras[1], True),
        )

    def paint(self, shot: Shot):
        """The picture of one shot, a ``PIL.Image``."""
        pil = _pillow()
        width = len(self._panels) * (PANEL_WIDTH + GAP) + GAP
        picture = pil.Image.new("RGB", (width, HEADER + PANEL_HEIGHT + FOOTER), WHITE)
        draw = pil.ImageDraw.Draw(picture)
        title, text = (pil.ImageFont.load_default(size=size) for size in (17, 13))
        draw.text((12, 8), self.title, INK, title)
        draw.text((width - 12, 10), shot.caption, INK, text, anchor="ra")
        for number, (name, camera, fitted) in enumerate(self._panels):
            left = GAP + number * (PANEL_WIDTH + GAP)
            panel = pil.Image.fromarray(self._panel(shot, camera, fitted))
            size = (PANEL_WIDTH, PANEL_HEIGHT)
            picture.paste(panel.resize(size, pil.Image.Resampling.BOX), (left, HEADER))
            draw.text((left + PANEL_WIDTH // 2, HEADER - 20), name, PALE_INK, text, anchor="ma")
        self._legend(draw, text, HEADER + PANEL_HEIGHT, width, with_body=shot.body is not None)
        return picture

    def _panel(self, shot: Shot, camera: Camera, fitted: bool) -> np.ndarray:
        """(H, W, 3) uint8 in fine pixels."""
        surfaces = []
        if fitted:
            surfaces.append((shot.vertices, self.faces, colours(1e3 * shot.sigma, self.scale_mm)))
        if shot.body is not None and self.body_faces is not None:
            surfaces.append((shot.body, self.body_faces, np.tile(np.array(BODY, float), (len(shot.body), 1))))
        depth, face = camera.render([(vertices, faces) for vertices, faces, _ in surfaces])
        image, label = np.tile(np.array(BACKGROUND, float), (*depth.shape, 1)), 0
        for vertices, faces, colour in surfaces:
            shade = _shade(vertices, faces, camera)
            faces = np.ascontiguousarray(faces, np.int64)
            zbuffer.interpolate(camera.to_camera(vertices), faces, colour * shade, camera.lens, label, face, image)
            label += len(faces)
        most = MOST_POINTS_ON_FIT if fitted else MOST_POINTS
        points = np.random.default_rng(0).permutation(shot.points)[:most]
        nearest, index = depth + POINT_BIAS, np.full(depth.shape, -1, np.int32)
        zbuffer.splat(camera.to_camera(points), camera.lens, POINT_RADIUS, nearest, index)
        image[index >= 0] = POINT
        return np.clip(image, 0, 255).astype(np.uint8)

    def _legend(self, draw, font, top: int, width: int, with_body: bool) -> None:
        left, y = 16, top + 24
        draw.ellipse((left, y - 4, left + 8, y + 4), POINT)
        draw.text((left + 16, y), "point cloud", INK, font, anchor="lm")
        if with_body:
            draw.rectangle((left + 108, y - 6, left + 120, y + 6), BODY)
            draw.text((left + 128, y), "body", INK, font, anchor="lm")
        bar, right = width // 2 + 60, width - 24
        draw.text((bar - 10, y), "uncertainty of the fit (mm)", INK, font, anchor="rm")
        for x in range(bar, right):
            colour = colours(np.array([(x - bar) / (right - bar) * self.scale_mm]), self.scale_mm)[0]
            draw.line((x, y - 8, x, y + 8), tuple(int(c) for c in colour))
        for share in (0, 0.25, 0.5, 0.75, 1):
            x = bar + share * (right - bar)
            draw.line((x, y + 8, x, y + 12), PALE_INK)
            draw.text((x, y + 14), f"{share * self.scale_mm:g}", PALE_INK, font, anchor="ma")


def save_still(path, painter: Painter, shot: Shot) -> None:
    """Paints one shot into a .png file (or any format Pillow writes)."""
    _save(Path(path), painter.paint(shot))


def save_animation(path, painter: Painter, shots: Sequence[Shot], fps: float) -> None:
    """Paints shots into an endless .gif or .webp animation; of more than 75, every n-th, at the true speed.

    Args:
        path: of the file.
        painter: see :class:`Painter`.
        shots: consecutive frames.
        fps: their frames per second.
    """
    path, stride = Path(path), -(-len(shots) // MOST_FRAMES)
    if path.suffix.lower() not in (".gif", ".webp"):
        raise InvalidArgument("animation", "a name that ends in .gif or .webp", path.name)
    frames = [painter.paint(shot) for shot in shots[::stride]]
    if path.suffix.lower() == ".gif":
        pil = _pillow()
        seen = painter.paint(shots[len(shots) // 2])
        palette = seen.quantize(192, method=pil.Image.Quantize.MAXCOVERAGE)  # with rare colours: those of the whole scale
        frames = [frame.quantize(palette=palette, dither=pil.Image.Dither.NONE) for frame in frames]
    milliseconds = round(1000 * stride / fps)
    _save(path, frames[0], save_all=True, append_images=frames[1:], duration=milliseconds, loop=0, quality=70)


def colours(values: np.ndarray, top: float) -> np.ndarray:
    """(N, 3) colours in [0, 255] of values (N,) on a scale from 0 to ``top``; beyond it, the last colour."""
    at = np.clip(np.asarray(values, float) / top, 0, 1) * (len(COLOURS) - 1)
    return np.column_stack([np.interp(at, np.arange(len(COLOURS)), COLOURS[:, channel]) for channel in range(3)])


def writable_formats() -> set[str]:
    """Suffixes of the picture files that Pillow can write.

    Raises:
        MissingDependency: Pillow is not installed.
    """
    image = _pillow().Image
    return {suffix for suffix, name in image.registered_extensions().items() if name in image.SAVE}


def _pillow():
    try:
        import PIL.Image
        import PIL.ImageDraw
        import PIL.ImageFont
    except ImportError as error:
        raise MissingDependency("Pillow, which paints pictures, is not installed: pip install pillow") from error
    return PIL


def _save(path: Path, image, **options) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        image.save(path, **options)
    except (ValueError, OSError) as error:
        raise InvalidArgument("picture", "a path that Pillow can write", f"{path} ({error})") from error


def _core(points: np.ndarray) -> np.ndarray:
    """The points without the outermost percent along each axis, which may be outliers."""
    if len(points) == 0:
        return points
    low, high = np.percentile(points, [1, 99], axis=0)
    return points[((points >= low) & (points <= high)).all(axis=1)]


def _camera(scene: np.ndarray, centre: np.ndarray, azimuth: float) -> Camera:
    """A distant camera at an azimuth in degrees (0 is +z) whose panel holds the scene (N, 3)."""
    width, height = PANEL_WIDTH * OVERSAMPLING, PANEL_HEIGHT * OVERSAMPLING
    a = np.radians(azimuth)
    eye = centre + CAMERA_DISTANCE * np.array([np.sin(a), 0.12, np.cos(a)])
    unit = Camera.looking_at(Intrinsics(width, height, 1.0, 1.0, 0.0, 0.0), eye, centre)
    spot = unit.project(scene)
    low, high = spot.min(axis=0) - AROUND / CAMERA_DISTANCE, spot.max(axis=0) + AROUND / CAMERA_DISTANCE
    focal = min(width / (high[0] - low[0]), height / (high[1] - low[1]))
    cx, cy = np.array([width, height]) / 2 - focal * (low + high) / 2
    return Camera(Intrinsics(width, height, focal, focal, cx, cy), unit.eye, unit.axes)


def _shade(vertices: np.ndarray, faces: np.ndarray, camera: Camera) -> np.ndarray:
    """(V, 1) brightness by a light at the camera, the same for both sides of a surface."""
    vertices = np.asarray(vertices, np.float64)
    ray = camera.eye - vertices
    ray /= np.linalg.norm(ray, axis=1, keepdims=True)
    facing = np.abs((vertex_normals(vertices, faces) * ray).sum(axis=1, keepdims=True))
    return AMBIENT + (1 - AMBIENT) * facing


def round_up(value: float) -> float:
    """The next of 1, 2, 3, 4, 6, 8 times a power of ten: the legend's quarters are short numbers."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-3)))
    return float(next(step * power for step in (1, 2, 3, 4, 6, 8, 10) if step * power >= value * (1 - 1e-9)))
