"""FAUST: scans of ten people in ten poses each, and one mesh registered to all of them (Bogo, Romero, Loper and Black 2014).

Published layout: ``MPI-FAUST/training/registrations/tr_reg_037.ply`` is pose 7 of subject 3, metres, y up, vertex i the same
place in all of them; ``MPI-FAUST/training/scans/tr_scan_037.ply`` is the scan. Or all registrations in one ``.npz``:
``V (10 S, V, 3)``, pose p of subject s at 10 s + p, and ``F (F, 3)``. FAUST is static: a clip leads from a subject's neutral pose
to another one within a second, by :class:`ddakf.evaluation.datasets.pose_interpolation.Interpolation`, and then stands still.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidArgument, InvalidFile, InvalidMesh
from ddakf.files.io import read_mesh, read_points
from ddakf.files.sequence import UNREADABLE, Sequence, why
from ddakf.mesh import Mesh

POSES = 10  # of every subject; the first one is neutral
NEUTRAL = 0  # pose from which clips start
FPS = 30.0  # of the clips; FAUST itself is static
MOVING, RESTING = 30, 6  # frames after the neutral one in which a clip moves, and then stands still
REGISTRATION, SCAN = re.compile(r"tr_reg_(\d{3})\.ply"), re.compile(r"tr_scan_(\d{3})\.ply")
CLIP = re.compile(r"s(\d+)_p(\d+)")


@dataclass(frozen=True, eq=False)
class Faust:
    """The registrations of some subjects.

    Attributes:
        path: where they are.
        faces: (F, 3) int64, of all of them.
        shapes: by (subject, pose), (V, 3) metres or the file.
        scans: by (subject, pose), the file.
    """

    path: Path
    faces: np.ndarray
    shapes: Mapping[tuple[int, int], np.ndarray | Path]
    scans: Mapping[tuple[int, int], Path]

    @property
    def subjects(self) -> tuple[int, ...]:
        return tuple(sorted({subject for subject, _ in self.shapes}))

    @property
    def clips(self) -> tuple[str, ...]:
        """The parts that :meth:`clip` knows: every pose but the neutral one, of the subjects that have that."""
        known = (key for key in sorted(self.shapes) if key[1] != NEUTRAL and (key[0], NEUTRAL) in self.shapes)
        return tuple(f"s{subject}_p{pose}" for subject, pose in known)

    def registration(self, subject: int, pose: int) -> np.ndarray:
        """(V, 3) float64 vertices of a subject in a pose, metres.

        Raises:
            InvalidArgument: not at hand. InvalidFile: not a mesh of these faces.
        """
        shape = self.shapes.get((subject, pose))
        if shape is None:
            raise InvalidArgument("pose", f"one of {_listed(self.shapes)}", f"s{subject}_p{pose}")
        if not isinstance(shape, Path):
            return np.asarray(shape, np.float64)
        vertices, faces = read_mesh(shape)
        if not np.array_equal(faces, self.faces):
            raise InvalidFile(f"{shape.name}: faces", "those of the other registrations", f"{len(faces)} others")
        return vertices

    def scan(self, subject: int, pose: int) -> np.ndarray:
        """(N, 3) float64 points of the raw scan, metres.

        Raises:
            InvalidArgument: not at hand. InvalidFile: not a point cloud.
        """
        if (subject, pose) not in self.scans:
            raise InvalidArgument("scan", f"one of {_listed(self.scans)}", f"s{subject}_p{pose}")
        return read_points(self.scans[subject, pose])

    def clip(self, part: str) -> Sequence:
        """``s3_p7``: subject 3 from the neutral pose to pose 7 by interpolation; 1 + :data:`MOVING` + :data:`RESTING` frames.

        Raises:
            InvalidArgument: not at hand. InvalidFile, InvalidMesh: not registrations.
        """
        if part not in self.clips:
            known = ", ".join(self.clips) or "none, as there is no subject with the neutral pose and another"
            raise InvalidArgument("clip", f"one of those at hand ({known})", repr(part))
        subject, pose = (int(number) for number in CLIP.fullmatch(part).groups())
        neutral = Mesh(self.registration(subject, NEUTRAL), self.faces)
        last = self.registration(subject, pose)
        if last.shape != neutral.vertices.shape:
            expected = f"{neutral.n_vertices} vertices as s{subject}_p{NEUTRAL}"
            raise InvalidFile(f"{self.path.name}: {part}", expected, str(len(last)))
        from ddakf.evaluation.datasets.pose_interpolation import Interpolation, minimum_jerk

        way = Interpolation(neutral, last)
        moving = [way(minimum_jerk(frame / MOVING)) for frame in range(MOVING + 1)]
        vertices = np.stack(moving + [moving[-1]] * RESTING).astype(np.float32)
        return Sequence(f"faust_{part}", vertices, self.faces, FPS, garment="whole body", motion=f"p{pose}")


def load_faust(path) -> Faust:
    """Finds the registrations in an ``.npz``, or below the folder ``MPI-FAUST``, its ``training`` or its ``registrations``.

    Raises:
        InvalidFile: none there, or not as published.
    """
    path = Path(path)
    if path.is_dir():
        return _from_folder(path)
    if not path.is_file():
        raise InvalidFile(str(path), "FAUST: a folder MPI-FAUST, or an .npz of registrations", "nothing there")
    state = path.stat()
    return _from_archive(path, state.st_mtime_ns, state.st_size)


def is_faust(path: Path) -> bool:
    """True if a folder holds FAUST in its published layout."""
    return _registrations(path) is not None


def _registrations(path: Path) -> Path | None:
    folders = (path, path / "registrations", path / "training" / "registrations")
    return next((folder for folder in folders if any(folder.glob("tr_reg_*.ply"))), None)


def _from_folder(path: Path) -> Faust:
    folder = _registrations(path)
    if folder is None:
        raise InvalidFile(str(path), "registrations tr_reg_000.ply and so on", "none")
    shapes = _numbered(folder, REGISTRATION)
    return Faust(path, read_mesh(next(iter(shapes.values())))[1], shapes, _numbered(folder.parent / "scans", SCAN))


def _numbered(folder: Path, name: re.Pattern) -> dict[tuple[int, int], Path]:
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    return {divmod(int(found[1]), POSES): path for path in files if (found := name.fullmatch(path.name))}


@lru_cache(maxsize=1)  # one file serves many clips, and takes longer to unpack than a clip
def _from_archive(path: Path, modified: int, size: int) -> Faust:
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            vertices, faces = archive["V"], archive["F"]
    except UNREADABLE as error:
        raise InvalidFile(str(path), "an .npz archive with V and F", why(error)) from error
    if vertices.ndim != 3 or vertices.shape[2] != 3 or vertices.dtype.kind != "f" or len(vertices) % POSES or not len(vertices):
        raise InvalidFile(f"{path.name}: V", f"floats of shape ({POSES} S, V, 3)", f"{vertices.dtype} of shape {vertices.shape}")
    if not np.isfinite(vertices).all():
        raise InvalidFile(f"{path.name}: V", "finite numbers", f"{(~np.isfinite(vertices)).sum()} non-finite")
    try:
        mesh = Mesh(vertices[0], faces)
    except InvalidMesh as error:
        raise InvalidFile(f"{path.name}: {error.field}", error.expected, error.got) from error
    return Faust(path, mesh.faces, {divmod(k, POSES): shape for k, shape in enumerate(vertices)}, {})


def _listed(keys) -> str:
    return ", ".join(f"s{subject}_p{pose}" for subject, pose in sorted(keys)) or "none at hand"
