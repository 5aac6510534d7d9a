"""Packs a sequence file so that it may ship: ``python -m ddakf.data.pack SOURCE.npz TARGET.npz [--quantum METRES]``.

Coordinates are rounded to multiples of the quantum and stored as what :mod:`ddakf.files.moving_mesh` leaves of them, which
deflate squeezes to an eighth of the plain coordinates.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from ddakf.errors import DdakfError, InvalidFile
from ddakf.files import moving_mesh
from ddakf.files.sequence import FIRST, RESIDUAL, Sequence, load_sequence

DEFAULT_QUANTUM = 2.0**-13  # m
POSE = ("body_rotations", "body_shift", "body_shape")


def packed(sequence: Sequence, quantum: float = DEFAULT_QUANTUM) -> dict[str, np.ndarray]:
    """The arrays of a packed file."""
    arrays = {
        **_moving_mesh("garment", sequence.garment_vertices, sequence.garment_faces, quantum),
        "fps": np.float32(sequence.fps),
        "quantum": np.float64(quantum),
        "garment": np.array(sequence.garment),
        "motion": np.array(sequence.motion),
    }
    if sequence.garment_rest is not None:
        arrays["garment_rest"] = sequence.garment_rest
    if sequence.has_body:
        arrays |= _moving_mesh("body", sequence.body_vertices, sequence.body_faces, quantum)
    return arrays


def _moving_mesh(name: str, vertices: np.ndarray, faces: np.ndarray, quantum: float) -> dict[str, np.ndarray]:
    steps = np.rint(vertices.astype(np.float64) / quantum)
    if np.abs(steps).max() > np.iinfo(np.int32).max:
        raise InvalidFile(f"{name}_V", f"coordinates of up to {2**31} quanta", f"{np.abs(steps).max():g}")
    steps = steps.astype(np.int64)
    try:
        residuals = moving_mesh.encode(steps, faces)
    except OverflowError as error:
        raise InvalidFile(f"{name}_V", f"motion of up to {2**15} quanta in a frame", str(error)) from error
    first = steps[0].astype(np.int32)
    return {f"{name}_V{FIRST}": first, f"{name}_V{RESIDUAL}": residuals, f"{name}_F": faces.astype(np.int32)}


def pack(source, target, quantum: float = DEFAULT_QUANTUM) -> float:
    """Writes the packed file and reads it back.

    Where the source has the pose of the body that ships with ddakf, as simulated recordings do, the pose is kept and the
    body's vertices are not: they are most of a file.

    Returns:
        The largest difference of a coordinate between source and target, metres.

    Raises:
        InvalidFile: no sequence, motion too fast for the quantum, or a target that does not end in ``.npz``.
    """
    if Path(target).suffix != ".npz":
        raise InvalidFile(str(target), "a name that ends in .npz", Path(target).suffix or "none")
    sequence = load_sequence(source)
    with np.load(source, allow_pickle=False) as archive:
        pose = {key: archive[key] for key in POSE if key in archive.files}
    kept = replace(sequence, body_vertices=None, body_faces=None) if pose else sequence
    arrays = packed(kept, quantum) | pose
    np.savez_compressed(target, **arrays)
    written = load_sequence(target)
    errors = [np.abs(written.garment_vertices - sequence.garment_vertices).max()]
    if sequence.has_body:
        errors.append(np.abs(written.body_vertices - sequence.body_vertices).max())
    return float(max(errors))


def main(words: list[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("source")
    parser.add_argument("target")
    parser.add_argument("--quantum", type=float, default=DEFAULT_QUANTUM, help="metres (default: 2^-13, 0.122 mm)")
    arguments = parser.parse_args(words)
    try:
        error = pack(arguments.source, arguments.target, arguments.quantum)
    except DdakfError as refused:
        parser.error(str(refused))
    print(f"{arguments.target}: largest difference of a coordinate to the source {error * 1e3:.3f} mm")


if __name__ == "__main__":
    main()
