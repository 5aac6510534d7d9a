"""Packs a sequence file so that it may ship: ``python -m ddakf.data.pack SOURCE.npz TARGET.npz [--quantum METRES]``.

Coordinates are rounded to multiples of the quantum and stored as second differences in time, which deflate squeezes to
about half the size of the plain coordinates under LZMA: smooth motion leaves only small numbers.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from ddakf.errors import DdakfError, InvalidFile
from ddakf.files.sequence import PACKED, Sequence, load_sequence

DEFAULT_QUANTUM = 2.0**-13  # m


def second_differences(vertices: np.ndarray, quantum: float) -> np.ndarray:
    """(T, 3, V) int16 second differences in time of (T, V, 3) metres / quantum; frames before the first are zero."""
    steps = np.rint(vertices.astype(np.float64) / quantum).astype(np.int64).transpose(0, 2, 1)
    differences = np.diff(steps, n=2, axis=0, prepend=np.zeros((2, *steps.shape[1:]), np.int64))
    if np.abs(differences).max() > np.iinfo(np.int16).max:
        raise InvalidFile("vertices", f"second differences below {2**15} quanta", str(np.abs(differences).max()))
    return differences.astype(np.int16)


def packed(sequence: Sequence, quantum: float = DEFAULT_QUANTUM) -> dict[str, np.ndarray]:
    """The arrays of a packed file."""
    arrays = {
        "garment_V" + PACKED: second_differences(sequence.garment_vertices, quantum),
        "garment_F": sequence.garment_faces.astype(np.int32),
        "fps": np.float32(sequence.fps),
        "quantum": np.float64(quantum),
        "garment": np.array(sequence.garment),
        "motion": np.array(sequence.motion),
    }
    if sequence.garment_rest is not None:
        arrays["garment_rest"] = sequence.garment_rest
    if sequence.has_body:
        arrays["body_V" + PACKED] = second_differences(sequence.body_vertices, quantum)
        arrays["body_F"] = sequence.body_faces.astype(np.int32)
    return arrays


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
    arrays = packed(sequence, quantum)
    with np.load(source, allow_pickle=False) as archive:
        pose = {key: archive[key] for key in ("body_rotations", "body_shift") if key in archive.files}
    if len(pose) == 2:
        arrays = {key: array for key, array in arrays.items() if not key.startswith("body_")} | pose
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
