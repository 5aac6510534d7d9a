"""Stage B, association (paper, section 2.3): what the cloud says about each vertex."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from ddakf.config import NearestPoint, PlaneAssociation
from ddakf.kernels import associate as kernels
from ddakf.model import Model
from ddakf.preprocess import Cloud


class Measurement(NamedTuple):
    """One measurement per vertex; rows where ``found`` is false hold nothing."""

    target: np.ndarray  # (V, 3) z, m
    normal: np.ndarray | None  # (V, 3) unit normal of the cloud's surface at z; None: measured in all directions alike
    found: np.ndarray  # (V,) bool
    visible: np.ndarray  # (V,) bool, vertices that a sensor may see

    def innovation(self, position: np.ndarray) -> np.ndarray:
        """(V, 3) y = z - p, of a plane only its part along the normal; zero where nothing was found."""
        y = np.where(self.found[:, None], self.target - position, 0.0)
        if self.normal is None:
            return y
        return np.einsum("va,va->v", self.normal, y)[:, None] * self.normal


def gates(cloud: Cloud, config: PlaneAssociation | NearestPoint) -> Iterator[float]:
    """Search radius of each pass inside the frame, metres: wide first, then narrowing. The paper makes one pass."""
    match config:
        case PlaneAssociation():
            passes = 1 if cloud.empty else config.iterations
            for k in range(passes):
                yield max(config.narrow_gate, config.wide_gate * config.narrowing**k)
        case NearestPoint():
            yield config.gate


def associate(
    position: np.ndarray, cloud: Cloud, model: Model, gate: float, config: PlaneAssociation | NearestPoint
) -> Measurement:
    """Measurements for the vertices at ``position`` (V, 3).

    Args:
        position: metres.
        cloud: the preprocessed points.
        model: the garment.
        gate: search radius, metres.
        config: plane-aligned, or the paper's nearest neighbour.
    """
    n = len(position)
    target, distance = np.zeros((n, 3)), np.full(n, -1.0)
    match config:
        case PlaneAssociation():
            plane, normal, visible = np.zeros((n, 3)), np.empty((n, 3)), np.ones(n, bool)
            kernels.vertex_normals(position, model.faces, normal)
            if cloud.oriented:
                kernels.facing(position, normal, cloud.sensor, config.facing_cosine, visible)
            if not cloud.empty:
                kernels.nearest_planes(
                    position, normal, visible, cloud.surfels, cloud.surfel_start, cloud.origin, cloud.cell, cloud.dims,
                    gate, config.normal_cosine, cloud.oriented, target, plane, distance,
                )  # fmt: skip
            return Measurement(target, plane, distance >= 0.0, visible)
        case NearestPoint():
            if not cloud.empty:
                kernels.nearest_points(
                    position, cloud.points, cloud.start, cloud.origin, cloud.cell, cloud.dims, gate, target, distance
                )
            return Measurement(target, None, distance >= 0.0, np.ones(n, bool))
