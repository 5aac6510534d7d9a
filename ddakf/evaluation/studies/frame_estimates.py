"""Frame estimates: the surfaces that several systems estimate for one frame, and their file for the report."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile


@dataclass(frozen=True, eq=False)
class FrameEstimates:
    """Estimates of several systems for one frame, with the truth.

    Attributes:
        meta: the trial's fields without the system, the frame's number, commit, date, machine.
        truth: (V, 3) metres.
        faces: (F, 3).
        estimates: by system, (V, 3) metres.
        eye: (3,) metres, position of the figure's camera.
        points: (N, 3) metres, the cloud of the frame; None in files without one.
    """

    meta: dict
    truth: np.ndarray
    faces: np.ndarray
    estimates: dict[str, np.ndarray]
    eye: np.ndarray
    points: np.ndarray | None = None

    def save(self, path: Path) -> None:
        """Writes an .npz file."""
        estimates = {f"estimate {name}": vertices.astype(np.float32) for name, vertices in self.estimates.items()}
        if self.points is not None:
            estimates["points"] = self.points.astype(np.float32)
        meta = np.array(json.dumps(self.meta))
        np.savez_compressed(path, meta=meta, truth=self.truth, faces=self.faces, eye=self.eye, **estimates)


def load_frame_estimates(path: Path) -> FrameEstimates:
    """Reads a file of :meth:`FrameEstimates.save`.

    Raises:
        InvalidFile: not such a file.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            estimates = {key.removeprefix("estimate "): file[key] for key in file.files if key.startswith("estimate ")}
            points = file["points"] if "points" in file.files else None
            return FrameEstimates(json.loads(str(file["meta"])), file["truth"], file["faces"], estimates, file["eye"], points)
    except (OSError, ValueError, KeyError) as error:
        raise InvalidFile(str(path), "frame estimates of a study (.npz)", f"{type(error).__name__}: {error}") from error


