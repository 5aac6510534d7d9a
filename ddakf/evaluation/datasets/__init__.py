"""Data sets: sequences with truth, recordings of sensors without it, pairs of frames with scene flow.

``docs/datasets.md`` lists layouts, units, axes and terms. Metres everywhere, y up.
"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path

from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets.captures.cloud_folder import FolderRecording, load_folder
from ddakf.evaluation.datasets.captures.deepdeform import Pair, load_pair, pairs
from ddakf.evaluation.datasets.captures.recording import DepthRecording, Recording
from ddakf.evaluation.datasets.captures.rgbd import is_rgbd, load_rgbd
from ddakf.evaluation.datasets.captures.utd_mhad import KINECT, load_depth
from ddakf.evaluation.datasets.cloth3d import garments, is_cloth3d, load_cloth3d
from ddakf.evaluation.datasets.faust import REGISTRATION, Faust, is_faust, load_faust
from ddakf.files.sequence import Sequence, load_sequence

__all__ = [
    "KINECT", "DepthRecording", "Faust", "FolderRecording", "Pair", "Recording", "load_cloth3d", "load_depth", "load_faust",
    "load_folder", "load_pair", "load_rgbd", "open_dataset", "parts",
]  # fmt: skip

KNOWN = (
    "a sequence (.npz), FAUST (MPI-FAUST, or its registrations), a sequence of CLOTH3D (a folder with info.mat), depth of "
    "UTD-MHAD (.mat), a pair of DeepDeform (.sflow, or a folder with scene_flow), a folder with depth/*.png, or one of clouds"
)


def open_dataset(path, *, fps: float = 30.0, smpl=None) -> Sequence | Recording | Pair:
    """Opens the recording at a path, of any known kind.

    Args:
        path: of a file or folder; behind a ``#`` the name of one of its :func:`parts`, where there are several:
            ``MPI-FAUST#s3_p7``, ``00042#Tshirt``, ``seq258#shirt_000000_000110``.
        fps: frames per second of a recording that does not state them.
        smpl: see :func:`ddakf.evaluation.datasets.cloth3d.load_cloth3d`; None: what DDAKF_SMPL names, if anything.

    Raises:
        InvalidFile: no file, of no known kind, or damaged. InvalidArgument: no such part, or a missing name of one.
    """
    path, part = _split(path)
    if path.is_dir():
        return _folder(path, part, fps, smpl or os.environ.get("DDAKF_SMPL"))
    if found := REGISTRATION.fullmatch(path.name):
        return load_faust(path.parent).clip("s{}_p{}".format(*divmod(int(found[1]), 10)))
    suffix = path.suffix.lower()
    if suffix == ".npz" and _is_archive_of(path, {"V.npy", "F.npy"}):
        return load_faust(path).clip(_named(path, part))
    if part is not None:
        raise InvalidArgument("part", "none of a file with one recording", repr(part))
    loaders = {".npz": load_sequence, ".sflow": load_pair, ".mat": lambda file: load_depth(file, fps)}
    if suffix not in loaders:
        raise InvalidFile(str(path), KNOWN, f"a file {suffix or 'without a suffix'}")
    return loaders[suffix](path)


def parts(path) -> tuple[str, ...]:
    """Names that can follow the ``#``: clips of FAUST, garments of CLOTH3D, pairs of DeepDeform; none for the other kinds.

    Raises:
        InvalidFile: no file, or a damaged one.
    """
    path, _ = _split(path)
    if path.is_dir():
        if is_cloth3d(path):
            return garments(path)
        return load_faust(path).clips if is_faust(path) else pairs(path)
    return load_faust(path).clips if _is_archive_of(path, {"V.npy", "F.npy"}) else ()


def _folder(path: Path, part: str | None, fps: float, smpl) -> Sequence | Recording | Pair:
    if is_cloth3d(path):
        return load_cloth3d(path, part, smpl)
    if is_faust(path):
        return load_faust(path).clip(_named(path, part))
    if pairs(path):
        return load_pair(path, part)
    if part is not None:
        raise InvalidArgument("part", "none of a folder with one recording", repr(part))
    return load_rgbd(path, fps) if is_rgbd(path) else load_folder(path, fps)


def _split(path) -> tuple[Path, str | None]:
    """The path of the file or folder, and the name behind its ``#``."""
    whole = Path(path)
    before, mark, part = str(path).rpartition("#")
    if whole.exists() or not mark:
        before, part = str(path), ""
    if not Path(before).exists():
        raise InvalidFile(before, KNOWN, "nothing there")
    return Path(before), part or None


def _named(path: Path, part: str | None) -> str:
    """The name of the part.

    Raises:
        InvalidArgument: none is given.
    """
    if part is None:
        known = parts(path)
        some = ", ".join(known[:3]) + (", ..." if len(known) > 3 else "")
        raise InvalidArgument("path", f"{path.name}#PART with one of {len(known)} parts ({some})", path.name)
    return part


def _is_archive_of(path: Path, members: set[str]) -> bool:
    try:
        with zipfile.ZipFile(path) as archive:
            return members <= set(archive.namelist())
    except (OSError, zipfile.BadZipFile, ValueError, NotImplementedError):
        return False  # its loader reports the error
