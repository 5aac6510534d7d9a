"""Stages B and F, points on faces: points of the cloud, each with the face of the garment beneath it."""

from typing import NamedTuple

import numpy as np
from numba import njit

from ddakf.kernels import FAST
from ddakf.kernels.face_walk import distance_to_face
from ddakf.kernels.triangles import FEATURE, face_normal, ring_step

NO_FACE = np.int32(-1)
AS_NEAR = 1e-12  # m^2: squared distances to faces with a common edge that differ by less are equal


class FaceRings(NamedTuple):
    """F faces with their edges, and the faces around V vertices."""

    corner: np.ndarray  # (F, 3) int32
    edge: np.ndarray  # (F, 3) int32, the mesh's edge of corners 0 and 1, 1 and 2, 2 and 0
    ring_start: np.ndarray  # (V + 1,) int32
    ring_face: np.ndarray  # (3F,) int32, the faces around vertex i are ring_face[ring_start[i]:ring_start[i + 1]]


class Sample(NamedTuple):
    """P points of the cloud."""

    point: np.ndarray  # (P, 3) m
    normal: np.ndarray  # (P, 3) unit, of the plane around it; 0 where there is none
    oriented: bool  # the normals point to the sensor


class Agreement(NamedTuple):
    """When a point measures the face that is nearest to it."""

    min_cosine: float  # of the normals of the point's plane and of the face
    beside: float  # m along the face from its nearest place, at most


class FoundFaces(NamedTuple):
    """The face beneath each of P points."""

    face: np.ndarray  # (P,) int32; NO_FACE
    share: np.ndarray  # (P, 3) barycentric coordinates of its nearest place
    normal: np.ndarray  # (P, 3) unit, the face's
    offset: np.ndarray  # (P,) m along it, from the face to the point
    agrees: np.ndarray  # (P,) bool, points that measure their face


@njit(nogil=True, cache=True, error_model="numpy", inline="always")
def height_above(position, corner, f, x, y, z):
    """Metres of (x, y, z) above the plane of a face, along its normal."""
    i, n = corner[f, 0], face_normal(position, corner, f)
    return n[0] * (x - position[i, 0]) + n[1] * (y - position[i, 1]) + n[2] * (z - position[i, 2])


@njit(nogil=True, cache=True, error_model="numpy")
def faces_beneath(position, rings, vertex, sample, agreement, found):
    """Finds the nearest face around the vertex that is nearest to each point; of a point with a face, around that one's corner.

    A point stays on its face while the nearest place is inside.

    Args:
        position: (V, 3) or wider, metres.
        rings: :class:`FaceRings`.
        vertex: (P,) int32, nearest to each point without a face, or -1 where none is near.
        sample, agreement: :class:`Sample`, :class:`Agreement`.
        found: :class:`FoundFaces`, faces in and out, all else out.
    """
    corner, _, ring_start, ring_face = rings
    point, plane, oriented = sample
    min_cosine, beside = agreement
    face, share, normal, offset, agrees = found
    for p in range(point.shape[0]):
        agrees[p] = False
        nearest, i = face[p], vertex[p]
        x, y, z = point[p, 0], point[p, 1], point[p, 2]
        best, height, v, w = np.inf, 0.0, 0.0, 0.0
        if nearest >= 0:
            best, v, w = distance_to_face(position, corner, nearest, x, y, z)
            height = height_above(position, corner, nearest, x, y, z)
            u = 1.0 - v - w
            inside = min(u, v, w) >= FEATURE
            i = -1 if inside else corner[nearest, 0 if u >= max(v, w) else 1 if v >= w else 2]
        if i >= 0:
            for e in range(ring_start[i], ring_start[i + 1], ring_step(ring_start, i)):
                squared, b, c = distance_to_face(position, corner, ring_face[e], x, y, z)
                if squared > best + AS_NEAR:
                    continue
                other = height_above(position, corner, ring_face[e], x, y, z)
                # of two faces whose common edge is nearest, the one that the point is higher above, whatever their order
                if squared < best - AS_NEAR or abs(other) > abs(height):
                    best, height, nearest, v, w = squared, other, ring_face[e], b, c
        if nearest < 0:
            continue
        n = face_normal(position, corner, nearest)
        face[p], offset[p] = nearest, height
        share[p, 0], share[p, 1], share[p, 2] = 1.0 - v - w, v, w
        normal[p, 0], normal[p, 1], normal[p, 2] = n
        px, py, pz = plane[p, 0], plane[p, 1], plane[p, 2]
        cosine = n[0] * px + n[1] * py + n[2] * pz
        if not oriented:
            cosine = abs(cosine)
        flat = px * px + py * py + pz * pz > 0.0  # a point without a plane agrees with every face
        agrees[p] = (cosine >= min_cosine or not flat) and best - height * height <= beside * beside


@njit(nogil=True, cache=True, error_model="numpy", fastmath=FAST)
def add_points(rings, found, information, D, blocks, force):
    """Adds points that measure the height of a face: E = k (offset - n . sum u_a d_a)^2 / 2, of the moves d of its corners.

    The rows of ``ddakf.kernels.fuse.add_coupling`` add up to zero; the sum of u being 1, D takes u_a k n n' beyond them.

    Args:
        rings, found: :class:`FaceRings`, :class:`FoundFaces`.
        information: (P,) k, 1/m^2.
        D: (V, 3, 3) diagonal blocks, 1/m^2, added to.
        blocks: (E, 12) float32, of each edge i < j, by columns, padded, added to.
        force: (V, 4) padded, 1/m, added to.
    """
    corner, edge, _, _ = rings
    face, share, normal, offset, _ = found
    for p in range(face.shape[0]):
        f, k = face[p], information[p]
        if k <= 0.0:
            continue
        x, y, z = normal[p, 0], normal[p, 1], normal[p, 2]
        for a in range(3):
            i, w = corner[f, a], k * share[p, a]
            push = w * offset[p]
            force[i, 0] += push * x
            force[i, 1] += push * y
            force[i, 2] += push * z
            D[i, 0, 0] += w * x * x
            D[i, 1, 1] += w * y * y
            D[i, 2, 2] += w * z * z
            D[i, 0, 1] += w * x * y
            D[i, 1, 0] += w * x * y
            D[i, 0, 2] += w * x * z
            D[i, 2, 0] += w * x * z
            D[i, 1, 2] += w * y * z
            D[i, 2, 1] += w * y * z
            block, c = blocks[edge[f, a]], np.float32(w * share[p, (a + 1) % 3])
            gx, gy, gz = np.float32(x), np.float32(y), np.float32(z)
            block[0] += c * gx * gx
            block[5] += c * gy * gy
            block[10] += c * gz * gz
            block[1] += c * gx * gy
            block[4] += c * gx * gy
            block[2] += c * gx * gz
            block[8] += c * gx * gz
            block[6] += c * gy * gz
            block[9] += c * gy * gz


@njit(nogil=True, cache=True, error_model="numpy")
def add_information(rings, found, information, patch, added):
    """Adds k n n' of each point to the information of the patch that its nearest corner is in.

    Args:
        rings, found: :class:`FaceRings`, :class:`FoundFaces`.
        information: (P,) k, 1/m^2.
        patch: (V,) int32 in [0, L).
        added: (L, 6) 1/m^2, xx, yy, zz, xy, xz, yz, added to.
    """
    face, share, normal, _, _ = found
    for p in range(face.shape[0]):
        k = information[p]
        if k <= 0.0:
            continue
        u, v, w = share[p, 0], share[p, 1], share[p, 2]
        c = patch[rings.corner[face[p], 0 if u >= max(v, w) else 1 if v >= w else 2]]
        x, y, z = normal[p, 0], normal[p, 1], normal[p, 2]
        added[c, 0] += k * x * x
        added[c, 1] += k * y * y
        added[c, 2] += k * z * z
        added[c, 3] += k * x * y
        added[c, 4] += k * x * z
        added[c, 5] += k * y * z
