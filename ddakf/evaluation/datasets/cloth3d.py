"""CLOTH3D: garments simulated on moving people (Bertiche, Madadi and Escalera 2020).

Published layout, a folder per sequence: ``info.mat``; per garment the template ``Tshirt.obj`` (rest pose, quads or triangles) and
the vertices of every frame ``Tshirt.pc16``, relative to the body's root joint. ``info.mat`` has ``poses (72, T)`` and
``shape (10,)`` of SMPL, ``trans (3, T)`` the place of the root joint, ``zrot`` a turn about the vertical, ``gender`` (0 female, 1
male). Metres, z up; here y up. 30 frames per second. The body is posed where SMPL's arrays are at hand. The template is laid
rigidly onto the first frame, as its own axes are not documented.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from ddakf.data.rotation import rotation_matrices
from ddakf.errors import InvalidArgument, InvalidFile
from ddakf.evaluation.datasets.formats.matlab import read_arrays
from ddakf.evaluation.datasets.formats.point_cache import read_point_cache
from ddakf.evaluation.datasets.formats.smpl import load_smpl
from ddakf.files.io import read_mesh
from ddakf.files.sequence import Sequence

FPS = 30.0  # as published
Y_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # from z up
LARGEST = 1e6  # metres and radians: beyond, single precision says nothing any more
MODELS = {0: "model_f.npz", 1: "model_m.npz"}  # by gender, in a folder of models
NUMBERS = {"poses": "(72, T)", "shape": "(10,)", "trans": "(3, T)", "zrot": "one number", "gender": "0 or 1"}


def is_cloth3d(path: Path) -> bool:
    """True if a folder is a sequence of CLOTH3D."""
    return path.is_dir() and (path / "info.mat").is_file()


def garments(path) -> tuple[str, ...]:
    """The garments of a sequence that have both a template and a cache, in alphabetical order."""
    caches = sorted(Path(path).glob("*.pc16"))
    return tuple(cache.stem for cache in caches if cache.with_suffix(".obj").is_file())


def load_cloth3d(path, garment: str | None = None, smpl=None) -> Sequence:
    """Reads a garment of a sequence.

    Args:
        path: folder of the sequence.
        garment: its name, such as ``Tshirt``; None where there is one only.
        smpl: arrays of SMPL (see :mod:`ddakf.evaluation.datasets.formats.smpl`), or a folder with ``model_f.npz``
            and ``model_m.npz``; None for a sequence without the body.

    Returns:
        With the name ``<folder>_<garment>``, and the garment's.

    Raises:
        InvalidFile: not a sequence as published. InvalidArgument: no such garment.
    """
    path = Path(path)
    info, names = _info(path), garments(path)
    if not names:
        raise InvalidFile(str(path), "a garment's template (.obj) and cache (.pc16)", "none")
    if garment is None and len(names) == 1:
        garment = names[0]
    if garment not in names:
        raise InvalidArgument("garment", f"one of {', '.join(names)}", str(garment))
    rest, faces = read_mesh(path / f"{garment}.obj")
    relative = read_point_cache(path / f"{garment}.pc16")
    frames = len(relative)
    if relative.shape[1] != len(rest):
        raise InvalidFile(f"{garment}.pc16", f"{len(rest)} vertices as in {garment}.obj", str(relative.shape[1]))
    if info["trans"].shape[1] < frames or info["poses"].shape[1] < frames:
        found = f"{info['poses'].shape[1]} and {info['trans'].shape[1]}"
        raise InvalidFile("info.mat", f"poses and trans of {frames} frames as in {garment}.pc16", found)
    turn = Y_UP @ rotation_matrices([0.0, 0.0, float(info["zrot"][0, 0])])
    trans = info["trans"].T[:frames, None]
    body = body_faces = None
    if smpl is not None:
        model = load_smpl(_model(Path(smpl), int(info["gender"][0, 0])))
        poses = info["poses"].T[:frames]
        if poses.shape[1] != 3 * len(model.parents):
            raise InvalidFile(str(smpl), f"{poses.shape[1] // 3} joints as in info.mat", str(len(model.parents)))
        if info["shape"].size > (most := model.shape_directions.shape[2]):
            raise InvalidFile(str(smpl), f"{info['shape'].size} shape directions as in info.mat", str(most))
        body, body_faces = _turned(model(poses, info["shape"].ravel()) + trans, turn), model.faces
    vertices = _turned(relative + trans, turn)
    name, rest = f"{path.name}_{garment}", _laid_onto(rest, vertices[0])
    return Sequence(name, vertices, faces, FPS, rest, body, body_faces, garment=garment)


def _turned(vertices: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(vertices @ turn.T, np.float32)


def _laid_onto(rest: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """(V, 3) float32 rest shape, turned and moved to be as close as it can be to other vertices (V, 3)."""
    from scipy.spatial.transform import Rotation

    centre, target = rest.mean(axis=0), vertices.mean(axis=0, dtype=np.float64)
    turn, _ = Rotation.align_vectors(vertices - target, rest - centre)
    return (turn.apply(rest - centre) + target).astype(np.float32)


def _model(path: Path, gender: int) -> Path:
    return path / MODELS[gender] if path.is_dir() else path


def _info(path: Path) -> dict[str, np.ndarray]:
    """The numbers of ``info.mat``, with two dimensions each."""
    if not (path / "info.mat").is_file():
        raise InvalidFile(str(path), "a folder with info.mat", "none")
    content = read_arrays(path / "info.mat", NUMBERS)
    info = {}
    for name, shape in NUMBERS.items():
        value = content.get(name)
        if value is None or value.ndim != 2 or value.size == 0 or not np.isfinite(value).all():
            got = "none" if value is None else f"{value.dtype} of shape {value.shape}"
            raise InvalidFile(f"info.mat: {name}", f"finite numbers, {shape}", got)
        info[name] = value.astype(np.float64)
    if info["gender"][0, 0] not in MODELS:
        raise InvalidFile("info.mat: gender", NUMBERS["gender"], f"{info['gender'][0, 0]:g}")
    if max(np.abs(info[name]).max() for name in ("trans", "zrot", "poses", "shape")) > LARGEST:
        raise InvalidFile("info.mat", f"numbers up to {LARGEST:g}", "larger ones")
    # one frame only is written as a row
    for name, rows in (("poses", 72), ("trans", 3)):
        if info[name].shape[0] != rows and info[name].size == rows:
            info[name] = info[name].reshape(rows, 1)
        if info[name].shape[0] != rows:
            raise InvalidFile(f"info.mat: {name}", f"shape {NUMBERS[name]}", str(info[name].shape))
    return info
