"""Recorded garments with ground truth: a mesh per frame, perhaps with the body beneath, in an ``.npz`` file.

Keys: ``garment_V (T, V, 3)``, ``garment_F (F, 3)``, ``fps``; optionally ``body_V (T, B, 3)`` with ``body_F``, and
``garment_rest (V, 3)``, and the names ``garment`` and ``motion``. Metres, y up. In a packed file, which ``ddakf.data.pack``
writes, coordinates are whole multiples of ``quantum`` metres: ``garment_V_first (V, 3)`` and the ``garment_V_residual
(T - 1, 3, V)`` of :mod:`ddakf.files.moving_mesh` replace ``garment_V``, likewise ``body_V``; in older files the second
differences in time do. Or
``body_V`` is replaced by the pose of the body that ships with ddakf, ``body_rotations (T, J, 3)`` and ``body_shift (T, 3)``, with
its :class:`ddakf.data.body_shape.BodyShape` as ``body_shape (8,)`` where it has another one.
"""

from __future__ import annotations

import lzma
import tokenize
import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.files import moving_mesh

FIRST, RESIDUAL = "_first", "_residual"
OLD_PACKED = "_second_difference"  # what the sample and the training recordings have
UNREADABLE = (ValueError, OSError, EOFError, KeyError, MemoryError, NotImplementedError, RuntimeError, TypeError,
              zipfile.BadZipFile, zlib.error, lzma.LZMAError, tokenize.TokenError)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Sequence:
    """A garment in motion.

    Attributes:
        name: of the file, without its ending.
        garment_vertices: (T, V, 3) float32, metres, y up: the truth of every frame.
        garment_faces: (F, 3) int64.
        fps: frames per second.
        garment_rest: (V, 3) float32 rest shape, metres, or None.
        body_vertices: (T, B, 3) float32, metres, or None.
        body_faces: (G, 3) int64, or None exactly when there is no body.
        garment, motion: what they are called, or "" where the file does not say.
    """

    name: str
    garment_vertices: np.ndarray
    garment_faces: np.ndarray
    fps: float
    garment_rest: np.ndarray | None = None
    body_vertices: np.ndarray | None = None
    body_faces: np.ndarray | None = None
    garment: str = ""
    motion: str = ""

    def __len__(self) -> int:
        """The number of frames T."""
        return len(self.garment_vertices)

    @property
    def has_body(self) -> bool:
        return self.body_vertices is not None

    @property
    def template(self) -> np.ndarray:
        """(V, 3) rest shape: ``garment_rest``, or the first frame where there is none."""
        return self.garment_vertices[0] if self.garment_rest is None else self.garment_rest

    def timestamp(self, frame: int) -> float:
        """Time of a frame in seconds; frame 0 is at 0."""
        return frame / self.fps


def load_sequence(path) -> Sequence:
    """Reads a sequence file. Nothing pickled is ever loaded.

    Raises:
        InvalidFile: not an ``.npz``, a missing key, a wrong shape or dtype, an index out of range, non-finite numbers.
    """
    path = Path(path)
    return _checked(path, _arrays(path))


def read_names(path) -> tuple[str, str]:
    """What a sequence file calls its garment and its motion, "" where it does not say; nothing else of it is read.

    Raises:
        InvalidFile: not an ``.npz``, or not one word each.
    """
    path = Path(path)
    arrays = _arrays(path, ("garment", "motion"))
    return _name(path, arrays, "garment"), _name(path, arrays, "motion")


def why(error: Exception) -> str:
    """The kind of an error and the beginning of what it says; zipfile's quote what they read."""
    return f"{type(error).__name__}: {error!s:.120}"


def _arrays(path: Path, wanted: tuple[str, ...] | None = None) -> dict[str, np.ndarray]:
    """Those of an archive, or of the wanted ones those that it has."""
    if not path.is_file():
        raise InvalidFile(str(path), "a sequence file (.npz)", "nothing there")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            return {key: archive[key] for key in archive.files if wanted is None or key in wanted}
    except UNREADABLE as error:
        archive = isinstance(error, OSError) or zipfile.is_zipfile(path)
        found = why(error) if archive else "something else"  # which NumPy calls pickled, and advises to trust
        raise InvalidFile(str(path), "an .npz archive of plain arrays", found) from error


def _checked(path: Path, arrays: dict[str, np.ndarray]) -> Sequence:
    garment, faces = _moving_mesh(path, arrays, "garment", "(T, V, 3)")
    fps = _required(path, arrays, "fps")
    if fps.shape != () or fps.dtype.kind not in "fiu" or not 1e-6 < fps < 1e6:
        raise InvalidFile(f"{path.name}: fps", "one positive number", f"{fps.dtype} {fps!s:.40}")
    rest = body = body_faces = None
    if "garment_rest" in arrays:
        rest = _finite(path, "garment_rest", arrays["garment_rest"])
        if rest.shape != garment.shape[1:]:
            raise InvalidFile(f"{path.name}: garment_rest", f"shape {garment.shape[1:]} as garment_V", f"{rest.shape}")
    if any("body_V" + ending in arrays for ending in ("", RESIDUAL, OLD_PACKED)):
        body, body_faces = _moving_mesh(path, arrays, "body", "(T, B, 3)")
    elif "body_rotations" in arrays:
        body, body_faces = _posed(path, arrays, len(garment))
    if body is not None and len(body) != len(garment):
        raise InvalidFile(f"{path.name}: body_V", f"{len(garment)} frames as garment_V", f"{len(body)}")
    names = (_name(path, arrays, key) for key in ("garment", "motion"))
    return Sequence(path.stem, garment, faces, float(fps), rest, body, body_faces, *names)


def _posed(path: Path, arrays: dict[str, np.ndarray], n_frames: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (T, B, 3) and faces of the body that ships with ddakf, in the shape and the poses of a file."""
    from ddakf.data.body import Pose, load_body
    from ddakf.data.body_shape import BodyShape, shaped

    body = load_body()
    if "body_shape" in arrays:
        try:
            body = shaped(body, BodyShape.from_array(_finite(path, "body_shape", arrays["body_shape"])))
        except InvalidArgument as error:
            raise InvalidFile(f"{path.name}: body_shape", error.expected, error.got) from error
    rotations = _finite(path, "body_rotations", arrays["body_rotations"])
    shift = _finite(path, "body_shift", _required(path, arrays, "body_shift"))
    expected = (n_frames, len(body.names), 3), (n_frames, 3)
    if (rotations.shape, shift.shape) != expected:
        found = f"{rotations.shape} and {shift.shape}"
        raise InvalidFile(f"{path.name}: body_rotations", f"with body_shift shapes {expected[0]} and {expected[1]}", found)
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = body.skinned(Pose(rotations.astype(np.float64), shift.astype(np.float64)))
    return _finite(path, "body_shift", vertices), body.faces


def _name(path: Path, arrays: dict[str, np.ndarray], key: str) -> str:
    name = arrays.get(key, np.array(""))
    if name.shape != () or name.dtype.kind != "U":
        raise InvalidFile(f"{path.name}: {key}", "one word", f"{name.dtype} of shape {name.shape}")
    return str(name)


def _required(path: Path, arrays: dict[str, np.ndarray], key: str) -> np.ndarray:
    if key not in arrays:
        raise InvalidFile(f"{path.name}: {key}", "to be in the file", f"only {', '.join(sorted(arrays)) or 'nothing'}")
    return arrays[key]


def _moving_mesh(path: Path, arrays: dict[str, np.ndarray], name: str, shape: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of the garment or the body."""
    key = f"{name}_V"
    if key + RESIDUAL in arrays:
        return _decoded(path, arrays, name)
    if key + OLD_PACKED in arrays:
        vertices = _unpacked(path, key + OLD_PACKED, arrays[key + OLD_PACKED], _quantum(path, arrays))
    else:
        vertices = _required(path, arrays, key)
    if vertices.ndim != 3 or vertices.shape[2] != 3 or 0 in vertices.shape:
        raise InvalidFile(f"{path.name}: {key}", f"shape {shape}", str(vertices.shape))
    return _finite(path, key, vertices), _faces(path, arrays, f"{name}_F", vertices.shape[1])


def _decoded(path: Path, arrays: dict[str, np.ndarray], name: str) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces from residuals."""
    key = f"{name}_V"
    first, residuals = _required(path, arrays, key + FIRST), arrays[key + RESIDUAL]
    if first.ndim != 2 or first.shape[1] != 3 or len(first) == 0 or first.dtype != np.int32:
        raise InvalidFile(f"{path.name}: {key + FIRST}", "int32 of shape (V, 3)", f"{first.dtype} of shape {first.shape}")
    narrow = residuals.dtype in (moving_mesh.SMALL, moving_mesh.WIDE)
    if residuals.ndim != 3 or residuals.shape[1:] != (3, len(first)) or not narrow:
        expected = f"int8 or int16 of shape (T - 1, 3, {len(first)})"
        raise InvalidFile(f"{path.name}: {key + RESIDUAL}", expected, f"{residuals.dtype} of shape {residuals.shape}")
    faces, quantum = _faces(path, arrays, f"{name}_F", len(first)), _quantum(path, arrays)
    return (moving_mesh.decode(first, residuals, faces) * quantum).astype(np.float32), faces


def _quantum(path: Path, arrays: dict[str, np.ndarray]) -> float:
    quantum = _required(path, arrays, "quantum")
    if quantum.shape != () or quantum.dtype.kind != "f" or not 0 < quantum <= 1:
        raise InvalidFile(f"{path.name}: quantum", "one float in (0, 1], metres", f"{quantum.dtype} {quantum!s:.40}")
    return float(quantum)


def _finite(path: Path, key: str, values: np.ndarray) -> np.ndarray:
    if values.dtype.kind not in "fiu":
        raise InvalidFile(f"{path.name}: {key}", "numbers", str(values.dtype))
    with np.errstate(over="ignore"):
        values = np.ascontiguousarray(values, np.float32)
    if not np.isfinite(values).all():
        raise InvalidFile(f"{path.name}: {key}", "finite numbers", f"{(~np.isfinite(values)).sum()} non-finite")
    return values


def _faces(path: Path, arrays: dict[str, np.ndarray], key: str, n_vertices: int) -> np.ndarray:
    faces = _required(path, arrays, key)
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu" or len(faces) == 0:
        raise InvalidFile(f"{path.name}: {key}", "integers of shape (F, 3)", f"{faces.dtype} of shape {faces.shape}")
    if faces.min() < 0 or faces.max() >= n_vertices:
        worst = faces.min() if faces.min() < 0 else faces.max()
        raise InvalidFile(f"{path.name}: {key}", f"indices in [0, {n_vertices})", str(worst))
    return faces.astype(np.int64)


def _unpacked(path: Path, key: str, differences: np.ndarray, quantum: float) -> np.ndarray:
    """(T, V, 3) metres from second differences in time, int16 (T, 3, V), frames before the first being zero."""
    if differences.ndim != 3 or differences.dtype.kind != "i" or differences.dtype.itemsize != 2:
        raise InvalidFile(f"{path.name}: {key}", "int16 of shape (T, 3, V)", f"{differences.dtype} of shape {differences.shape}")
    steps = np.cumsum(np.cumsum(differences, axis=0, dtype=np.int64), axis=0)
    return (steps * quantum).astype(np.float32).transpose(0, 2, 1)
