"""Quality of a simulated recording: stretch against the rest shape, depth inside the body, motion, and their limits."""

from __future__ import annotations

import numpy as np

from ddakf.body import proximity
from ddakf.errors import PoorQuality
from ddakf.files.sequence import Sequence
from ddakf.mesh import Mesh

MM = 1e3  # millimetres per metre
LIMITS = {
    "stretch_p99": 1.15,
    "stretch_worst_frame_p99": 1.3,
    "inside_share_mean": 0.01,
    "penetration_max_mm": 12.0,
    "displacement_max_mm": 300.0,
}  # quality figure: largest allowed value


def figures(sequence: Sequence) -> dict[str, float | int | bool]:
    """Quality figures of a recording with its body.

    Stretch is |e| / |e_rest| over all edges and frames (``_p1``, ``_p99``: percentiles; ``_worst_frame_p99``: the largest of the
    frames' 99th percentiles). Penetration is the depth of vertices inside the body: mean over those that are inside, and
    largest; ``faces_inside`` counts faces whose centre is inside, though their corners need not be. Displacement is from
    frame to frame.
    """
    rest = Mesh(sequence.template, sequence.garment_faces)
    vertices = sequence.garment_vertices.astype(np.float64)
    if not np.isfinite(vertices).all():
        return {"finite": False}
    stretch = _lengths(vertices, rest.edges) / _lengths(rest.vertices[None], rest.edges)
    depth = _depths(sequence, vertices)
    centre_depth = _depths(sequence, vertices[:, rest.faces].mean(axis=2))
    moved = MM * np.linalg.norm(np.diff(vertices, axis=0), axis=2)
    body_moved = MM * np.linalg.norm(np.diff(sequence.body_vertices, axis=0), axis=2)
    inside = depth > 0
    result = {
        "vertices": rest.n_vertices,
        "faces": rest.n_faces,
        "frames": len(sequence),
        "finite": True,
        "edge_mean_mm": MM * rest.edge_length,
        "stretch_mean": stretch.mean(),
        "stretch_p1": np.percentile(stretch, 1),
        "stretch_p99": np.percentile(stretch, 99),
        "stretch_max": stretch.max(),
        "stretch_worst_frame_p99": np.percentile(stretch, 99, axis=1).max(),
        "inside_share_mean": inside.mean(),
        "inside_share_max": inside.mean(axis=1).max(),
        "faces_inside_share_mean": (centre_depth > 0).mean(),
        "penetration_mean_mm": MM * depth[inside].mean() if inside.any() else 0.0,
        "penetration_max_mm": MM * depth.max(),
        "displacement_mean_mm": moved.mean() if moved.size else 0.0,
        "displacement_p99_mm": np.percentile(moved, 99) if moved.size else 0.0,
        "displacement_max_mm": moved.max(initial=0.0),
        "body_displacement_mean_mm": body_moved.mean() if body_moved.size else 0.0,
    }
    return {name: round(float(value), 5) if isinstance(value, np.floating | float) else value for name, value in result.items()}


def check(quality: dict[str, float | int | bool]) -> None:
    """Refuses a recording of poor quality.

    Raises:
        PoorQuality: names the first figure beyond its limit.
    """
    if not quality["finite"]:
        raise PoorQuality("the simulated garment has coordinates that are not finite: the solver diverged")
    for name, limit in LIMITS.items():
        if quality[name] > limit:
            raise PoorQuality(f"the simulated garment is not fit for use: {name} is {quality[name]:g}, above {limit:g}")


def _lengths(vertices: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """(T, E) of vertices (T, V, 3)."""
    return np.linalg.norm(vertices[:, edges[:, 0]] - vertices[:, edges[:, 1]], axis=2)


def _depths(sequence: Sequence, points: np.ndarray) -> np.ndarray:
    """(T, N) metres inside the body of points (T, N, 3), 0 outside."""
    tree = proximity.build(Mesh(sequence.body_vertices[0], sequence.body_faces))
    depth, face = np.zeros(points.shape[:2]), None
    for frame, body in enumerate(sequence.body_vertices):
        surface = proximity.refresh(tree, body)
        found = proximity.closest_points(tree, surface, np.ascontiguousarray(points[frame]), radius=np.inf, hint=face)
        depth[frame], face = np.maximum(-found.distance, 0), found.face
    return depth
