"""Data to evaluate on: sequences with truth, recordings of sensors without it, pairs of frames with scene flow."""

from __future__ import annotations

from pathlib import Path

from ddakf.evaluation.datasets.folder import FolderRecording, load_folder
from ddakf.evaluation.datasets.recording import DepthRecording, Recording
from ddakf.evaluation.datasets.utd_mhad import KINECT, load_depth

__all__ = ["KINECT", "DepthRecording", "FolderRecording", "Recording", "load_depth", "load_folder", "load_recording"]


def load_recording(path, fps: float = 30.0) -> Recording:
    """A folder of frames, or a depth recording (.mat)."""
    return load_folder(path, fps) if Path(path).is_dir() else load_depth(path, fps)
