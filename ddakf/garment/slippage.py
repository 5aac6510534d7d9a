"""Slippage: whether a surface can move along itself, which a cloud of it does not show."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.kernels import slippage as kernels
from ddakf.mesh import Mesh

FACES = 1000  # of a garment, at most, whose slippage is looked at
FOLD_WIDTH = 0.06  # m, along the surface: folds that are wider a mesh can follow without sliding
MOST_PASSES = 25  # of smoothing, so that a small garment's folds are narrower
TINY = 1e-9  # of the mean squared distance from the middle, so that a line, which nothing turns about itself, has a result


def least_normal_share(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Share, in [0, 1], of the squared motion of a surface that is along its normals, in the rigid motion where that is least.

    0 is a surface of revolution, which can turn unnoticed; 1/3 is a surface that faces all directions alike and has no axis.
    Skirts and trousers have 0.02 to 0.05, sleeved shirts 0.08 to 0.15. From the slippage analysis of Gelfand and Guibas ("Shape
    segmentation using local slippage analysis", 2004), its eigenvalues relative to the motions instead of absolute.

    Args:
        vertices: (V, 3) metres.
        faces: (F, 3).
    """
    along, moved = np.empty((6, 6)), np.empty((6, 6))
    if kernels.rigid_motions(vertices, np.ascontiguousarray(faces), along, moved) == 0.0:
        return 0.0
    return min(max(kernels.smallest_share(along, moved, TINY), 0.0), 1.0)


def has_limbs(mesh: Mesh) -> bool:
    """Whether a garment has legs or sleeves, which show its turns: more openings than a tube, by Euler's number."""
    return mesh.n_vertices - len(mesh.edges) + mesh.n_faces < 0


def some_faces(faces: np.ndarray) -> np.ndarray:
    """(F, 3) at most FACES of a garment's faces, spread over it, which tell its slippage."""
    return faces[:: -(-len(faces) // FACES)]


class Turn(NamedTuple):
    """The rotation of a surface that moves it least along its normals."""

    share: float  # in [0, 1], of the squared motion that is along the normals, or across boundaries: 0 is seen by no cloud
    moved: np.ndarray  # (V, 3) m per radian; the axis points toward the greater coordinate


def least_seen_turn(vertices: np.ndarray, normal: np.ndarray, faces: np.ndarray, boundary: np.ndarray) -> Turn:
    """The rotation, about any axis, that a cloud of the surface shows least.

    Args:
        vertices, normal: (V, 3) metres, unit.
        faces: (F, 3).
        boundary: (H, 3) vertex, and the vertices before and after it along the boundary.
    """
    corner = vertices[faces]
    facing = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    area = np.maximum(np.linalg.norm(facing, axis=1), TINY**2)
    weight, facing, at = area / area.sum(), facing / area[:, None], corner.mean(axis=1)
    middle = weight @ at
    shift, turn = facing, np.cross(at - middle, facing)  # motion along the normal, per metre and per radian
    along, crossed = turn.T @ (weight[:, None] * turn), shift.T @ (weight[:, None] * turn)
    follow = np.linalg.solve(shift.T @ (weight[:, None] * shift) + TINY * np.eye(3), crossed)  # the shift that hides a turn best
    axis = np.linalg.eigh(along - crossed.T @ follow)[1][:, 0]
    axis *= np.sign(axis[np.argmax(np.abs(axis))])  # so that frames turn in the same sense
    moved = np.cross(axis, vertices - middle) - follow @ axis
    total = max(float(np.square(moved).sum(axis=1).mean()), TINY)
    across = np.cross(vertices[boundary[:, 2]] - vertices[boundary[:, 1]], normal[boundary[:, 0]])
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), TINY)
    seen = np.einsum("va,va->v", normal, moved), np.einsum("ha,ha->h", across, moved[boundary[:, 0]])
    return Turn(min(sum(float(np.square(part).mean()) for part in seen if len(part)) / total, 1.0), moved)


def fold_height(vertices: np.ndarray, normal: np.ndarray, rings: tuple[np.ndarray, np.ndarray], edge: float) -> float:
    """Metres: root mean square height, along the normals, of folds that are narrower than FOLD_WIDTH.

    A smooth surface of revolution has none. Clothes on a body have 1 to 2 mm.

    Args:
        vertices, normal: (V, 3) metres, unit.
        rings: starts (V + 1,) and neighbours of the one-rings.
        edge: mean length of the edges, metres.
    """
    passes = min(max(2, round((FOLD_WIDTH / edge) ** 2)), MOST_PASSES)
    near, wide = _smoothed(vertices, rings, 1), _smoothed(vertices, rings, passes)
    height = np.einsum("va,va->v", near - wide, normal)[:, None]
    return float((height - _smoothed(height, rings, passes)).std())


def _smoothed(values: np.ndarray, rings: tuple[np.ndarray, np.ndarray], passes: int) -> np.ndarray:
    smooth, spare = values.copy(), np.empty_like(values)
    for _ in range(passes):
        kernels.mean_of_rings(smooth, *rings, spare)
        smooth, spare = spare, smooth
    return smooth
