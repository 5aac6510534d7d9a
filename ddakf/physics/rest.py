"""Rest frames of the triangles: what turns corner positions into the warp and weft tangents w_u and w_v."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.errors import InvalidConfig
from ddakf.mesh import Mesh

MIN_WARP_SINE = 0.1  # a thread direction closer than 6 degrees to the triangle's normal says nothing about its plane


class RestFrames(NamedTuple):
    """w_u = sum_a warp[f, a] p_a and w_v = sum_a weft[f, a] p_a over the three corners a; orthonormal at rest."""

    warp: np.ndarray  # (F, 3) 1/m
    weft: np.ndarray  # (F, 3) 1/m
    area: np.ndarray  # (F,) m^2, at rest


def rest_frames(mesh: Mesh, warp=None) -> RestFrames:
    """Derivatives of the deformation with respect to the rest plane (Baraff and Witkin 1998, section 4.2).

    Args:
        mesh: the garment; its vertices are the rest shape.
        warp: direction of the warp thread in the rest shape, (3,) or one per face (F, 3), any length. Where absent
            or nearly normal to a triangle, the triangle's first edge takes its place.

    Raises:
        InvalidConfig: ``warp`` of another shape, or not finite.
    """
    return frames_of(mesh.vertices[mesh.faces], None if warp is None else _checked_warp(warp, mesh.n_faces))


def frames_of(corners: np.ndarray, warp: np.ndarray | None = None) -> RestFrames:
    """The same of (F, 3, 3) ``corners``, metres, with a direction (F, 3) of each."""
    edge1, edge2 = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    normal = np.cross(edge1, edge2)
    double_area = np.linalg.norm(normal, axis=1)
    normal = normal / double_area[:, None]
    u = _unit(edge1) if warp is None else _warp_in_plane(warp, normal, edge1)
    v = np.cross(normal, u)
    # p(a, b) = p0 + a edge1 + b edge2 over rest coordinates: invert the 2x2 matrix of the edges in (u, v)
    u1, v1 = _dot(edge1, u), _dot(edge1, v)
    u2, v2 = _dot(edge2, u), _dot(edge2, v)
    along_u = np.stack([v1 - v2, v2, -v1], axis=1) / double_area[:, None]
    along_v = np.stack([u2 - u1, -u2, u1], axis=1) / double_area[:, None]
    return RestFrames(along_u, along_v, 0.5 * double_area)


def _checked_warp(warp, n_faces: int) -> np.ndarray:
    direction = np.asarray(warp, float)
    if direction.shape not in ((3,), (n_faces, 3)) or not np.isfinite(direction).all():
        raise InvalidConfig("warp", f"finite numbers of shape (3,) or ({n_faces}, 3)", f"shape {direction.shape}")
    return np.broadcast_to(direction, (n_faces, 3))


def _warp_in_plane(direction: np.ndarray, normal: np.ndarray, edge1: np.ndarray) -> np.ndarray:
    direction = _unit(direction)
    in_plane = direction - _dot(direction, normal)[:, None] * normal
    usable = np.linalg.norm(in_plane, axis=1) > MIN_WARP_SINE
    return _unit(np.where(usable[:, None], in_plane, edge1))


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("fa,fa->f", a, b)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-300)
