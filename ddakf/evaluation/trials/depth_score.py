"""Depth score: what depth images without truth say of an estimate that did not see all of their pixels."""

from __future__ import annotations

import numpy as np

from ddakf.evaluation import metrics, statistics
from ddakf.evaluation.datasets import DepthRecording
from ddakf.evaluation.datasets.captures.depth_template import JUMP
from ddakf.evaluation.datasets.captures.recording import MM
from ddakf.files.depth import seen, without_fliers
from ddakf.mesh import Mesh

EVERY = 10  # columns of pixels: one of them is held out
WITHIN = 0.03  # m: a depth that is predicted; steps and noise of the first Kinect are half of it at 3 m


class DepthScore:
    """Scores of a surface against the images of a recording, frame by frame.

    Args:
        recording: its joints, if any, are those of a body tracker.
        garment: the template.
        first: frame of the template.

    Attributes:
        recording: to track: without the columns that are held out.
    """

    def __init__(self, recording: DepthRecording, garment: Mesh, first: int):
        self.recording = recording.without_columns(EVERY)
        self._faces = garment.faces
        self._limbs = None if recording.joints is None else metrics.Limbs(garment.vertices, recording.joints[first])

    def __call__(self, number: int, vertices: np.ndarray) -> dict[str, float]:
        """Scores of a frame.

        Args:
            number: of the frame. vertices: (V, 3) metres.

        Returns:
            ``held_out_mm``: mean difference in depth in the columns held out, where both the surface and the camera have one;
            ``held_out_share``: share of the camera's that the surface has within :data:`WITHIN`. ``iou``, ``silhouette_covered``,
            ``silhouette_inside``: see :class:`ddakf.evaluation.metrics.Overlap`, of the surface's silhouette and the pixels with
            a depth. With joints ``limb_mm`` and ``moved_limb_mm``: see :meth:`ddakf.evaluation.metrics.Limbs.error_mm`. NaN where
            there is nothing to compare.
        """
        measured = self.recording.depth[number] * MM
        drawn, _ = self.recording.camera.render([(vertices, self._faces)])
        columns = np.zeros(measured.shape, bool)
        columns[:, self.recording.held_out_columns] = True
        held_out = columns & without_fliers(measured, JUMP)
        difference = np.abs(drawn[held_out] - measured[held_out])
        overlap = metrics.silhouette_overlap(np.isfinite(drawn), seen(measured))
        scores = {
            "held_out_mm": metrics.MM * statistics.finite_mean(difference),
            "held_out_share": statistics.finite_mean(difference < WITHIN),
            "iou": overlap.iou, "silhouette_covered": overlap.covered, "silhouette_inside": overlap.inside,
        }  # fmt: skip
        if self._limbs is not None:
            errors = self._limbs.error_mm(vertices, self.recording.joints[number])
            scores |= dict(zip(("limb_mm", "moved_limb_mm"), errors, strict=True))
        return scores
