"""Depth files: grey PNG images, images of colours, and the camera that ``camera.json`` or ``intrinsics.txt`` describes."""

from __future__ import annotations

import json
import struct
import warnings
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile, MissingDependency
from ddakf.evaluation.sensors.camera import Camera, Intrinsics
from ddakf.files.text import text_of

MOST_PIXELS = 1 << 24  # of an image: 4096 x 4096
LARGEST_TEXT = 1 << 20  # bytes of intrinsics, and of 50,000 timestamps
GREY, COLOURED = ("1", "L", "I", "I;16", "I;16B"), ("RGB", "RGBA")  # Pillow's names
LARGEST = 1e12  # largest number in a text file, in any unit

def load_camera(path: Path, shape: tuple[int, int]) -> tuple[Camera, dict]:
    """The camera of a folder with ``camera.json`` or ``intrinsics.txt`` and images (H, W), and what else the former says.

    Raises:
        InvalidFile: neither is there, or it does not hold what it should.
    """
    height, width = shape
    if (path / "camera.json").is_file():
        fields = _json(path / "camera.json")
        lens = _lens(fields)
        stated = [fields.get("width"), fields.get("height")]
        if all(map(is_number, stated)) and stated != [width, height]:
            raise InvalidFile("camera.json: width, height", f"{width} x {height} as the images", "{:g} x {:g}".format(*stated))
        camera = _posed_camera(Intrinsics(width, height, *lens), fields.get("T_world_sensor"))
        return camera, fields
    if not (path / "intrinsics.txt").is_file():
        raise InvalidFile(str(path), "camera.json or intrinsics.txt", "neither")
    matrix = read_numbers(path / "intrinsics.txt")
    if matrix.shape not in ((3, 3), (4, 4)):
        raise InvalidFile("intrinsics.txt", "a 3 x 3 or 4 x 4 matrix", f"shape {matrix.shape}")
    if matrix[2, :2].any():
        raise InvalidFile("intrinsics.txt", "a last row of 0 0 1, cx and cy in the last column", str(matrix[2, :3].tolist()))
    lens = _checked_lens("intrinsics.txt", matrix[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
    return Camera.at_origin(Intrinsics(width, height, *lens)), {}


def read_grey(path: Path) -> np.ndarray:
    """(H, W) values of a grey PNG image, uint8, uint16 or int32.

    Raises:
        InvalidFile: no such file, not a grey PNG, more than :data:`MOST_PIXELS`, damaged.
        MissingDependency: Pillow is not installed.
    """
    return _decoded(path, GREY, "PNG")


def read_depth(path: Path) -> np.ndarray:
    """(H, W) depths of a grey PNG image, uint16 or int32.

    Raises:
        InvalidFile: as :func:`read_grey`; 8 bits, which hold shades and no depths.
        MissingDependency: Pillow is not installed.
    """
    depth = read_grey(path)
    if depth.itemsize == 1:
        raise InvalidFile(str(path), "depths of 16 bits", "8 bits")
    return depth


def read_colors(path: Path) -> np.ndarray:
    """(H, W, 3) uint8, red, green and blue of a PNG or JPEG image.

    Raises:
        InvalidFile: no such file, another format, no colours, more than :data:`MOST_PIXELS`, damaged.
        MissingDependency: Pillow is not installed.
    """
    return _decoded(path, COLOURED, "PNG", "JPEG")[:, :, :3]


def _decoded(path: Path, modes: tuple[str, ...], *formats: str) -> np.ndarray:
    """The values of an image in one of Pillow's modes and formats."""
    expected = f"a {' or '.join(formats)} image"
    try:
        from PIL import Image
    except ImportError as error:
        raise MissingDependency("depth images need Pillow: pip install 'ddakf[evaluation]'") from error
    if not path.is_file():
        raise InvalidFile(str(path), expected, "nothing there")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # the number of pixels is checked below
            image = Image.open(path, formats=formats)  # reads the header alone
    except Image.DecompressionBombError as error:
        raise InvalidFile(path.name, f"at most {MOST_PIXELS} pixels", str(error).partition(" exceeds")[0]) from error
    except (OSError, SyntaxError, ValueError, struct.error) as error:
        raise InvalidFile(path.name, expected, f"{type(error).__name__}: {error}") from error
    with image:
        if image.width * image.height > MOST_PIXELS:
            raise InvalidFile(path.name, f"at most {MOST_PIXELS} pixels", f"{image.width} x {image.height}")
        if image.mode not in modes:
            kind = "a grey image" if modes is GREY else "an image in red, green and blue"
            raise InvalidFile(path.name, kind, f"mode {image.mode}")
        try:
            return np.array(image)
        except (OSError, SyntaxError, ValueError, struct.error) as error:
            raise InvalidFile(path.name, expected, f"{type(error).__name__}: {error}") from error


def _text(path: Path) -> str:
    if path.stat().st_size > LARGEST_TEXT:
        raise InvalidFile(path.name, f"at most {LARGEST_TEXT} bytes", str(path.stat().st_size))
    return text_of(path.read_bytes())


def read_numbers(path: Path) -> np.ndarray:
    """(rows, columns) finite numbers of a text file."""
    rows = [line.replace(",", " ").split() for line in _text(path).split("\n") if line.strip()]
    try:
        values = np.array(rows, np.float64)
    except ValueError:
        raise InvalidFile(path.name, "rows of numbers, equally long", str(rows[0])[:40]) from None
    if values.ndim != 2:
        raise InvalidFile(path.name, "rows of numbers", "none")
    if not (np.abs(values) <= LARGEST).all():
        raise InvalidFile(path.name, f"finite numbers up to {LARGEST:g}", str(values[~(np.abs(values) <= LARGEST)][0]))
    return values


def _json(path: Path) -> dict:
    try:
        fields = json.loads(_text(path))
    except (ValueError, RecursionError) as error:
        raise InvalidFile(path.name, "JSON", str(error)[:80]) from error
    if not isinstance(fields, dict):
        raise InvalidFile(path.name, "a JSON object", type(fields).__name__)
    return fields


def _lens(fields: dict) -> list[float]:
    """fx, fy, cx, cy; Open3D writes the matrix column by column, others row by row."""
    matrix = fields.get("intrinsic_matrix")
    if isinstance(matrix, list) and len(matrix) == 9:
        by_rows = matrix[6] == matrix[7] == 0 != (matrix[2] or matrix[5])
        return _checked_lens("camera.json: intrinsic_matrix", [matrix[k] for k in ((0, 4, 2, 5) if by_rows else (0, 4, 6, 7))])
    return _checked_lens("camera.json", [fields.get(name) for name in ("fx", "fy", "cx", "cy")])


def _checked_lens(where: str, values: list) -> list[float]:
    if not all(map(is_number, values)) or min(values[:2]) <= 0:
        raise InvalidFile(where, "fx, fy, cx, cy in pixels, the first two positive", str(values)[:80])
    return [float(value) for value in values]


def is_number(value) -> bool:
    """A finite one; JSON has whole numbers beyond all floats, and true is none."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= LARGEST


def _posed_camera(intrinsics: Intrinsics, pose) -> Camera:
    if pose is None:
        return Camera.at_origin(intrinsics)
    try:
        matrix = np.array(pose, np.float64)
    except (TypeError, ValueError):
        matrix = np.zeros(0)
    if matrix.shape != (4, 4) or not (np.abs(matrix) <= LARGEST).all():
        raise InvalidFile("camera.json: T_world_sensor", "4 rows of 4 finite numbers", str(pose)[:80])
    turn = matrix[:3, :3]
    orthogonal = np.allclose(turn @ turn.T, np.eye(3), atol=1e-3) and np.linalg.det(turn) > 0
    if not orthogonal or not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise InvalidFile("camera.json: T_world_sensor", "a rotation, a shift and the row 0, 0, 0, 1", str(pose)[:80])
    return Camera(intrinsics, matrix[:3, 3], matrix[:3, :3].T)
