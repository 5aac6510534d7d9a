"""Closest points on a body through a tree of boxes, signs by pseudo-normals, and the motion of the surface."""

from math import acos, inf, sqrt

import numpy as np
from numba import njit

STACK = 64  # nodes waiting in a depth-first search of a balanced tree: its depth plus one, at most 32 for int32 faces
SURFACE = 1e-7  # m: closer than this, the direction to the closest point is rounding noise
FEATURE = 1e-9  # barycentric coordinate below which the closest point lies on an edge or a corner
FACE_AREA = 1e-12  # m^2 of double area against which a degenerate face's rotation counts for nothing


@njit(nogil=True, cache=True, error_model="numpy")
def refit(vertices, faces, leaf_start, corners, boxes):
    """Copies the corners in leaf order and fits the boxes, leaves first."""
    n_leaves = leaf_start.shape[0] - 1
    for leaf in range(n_leaves):
        node = n_leaves + leaf
        for a in range(3):
            boxes[node, a], boxes[node, 3 + a] = inf, -inf
        for f in range(leaf_start[leaf], leaf_start[leaf + 1]):
            for s in range(3):
                i = faces[f, s]
                for a in range(3):
                    x = vertices[i, a]
                    corners[f, s, a] = x
                    boxes[node, a] = min(boxes[node, a], x)
                    boxes[node, 3 + a] = max(boxes[node, 3 + a], x)
    for node in range(n_leaves - 1, 0, -1):
        for a in range(3):
            boxes[node, a] = min(boxes[2 * node, a], boxes[2 * node + 1, a])
            boxes[node, 3 + a] = max(boxes[2 * node, 3 + a], boxes[2 * node + 1, 3 + a])


@njit(nogil=True, cache=True, error_model="numpy")
def box_distance(boxes, node, x, y, z):
    """Squared distance from a point to a box, 0 inside."""
    dx = max(boxes[node, 0] - x, 0.0, x - boxes[node, 3])
    dy = max(boxes[node, 1] - y, 0.0, y - boxes[node, 4])
    dz = max(boxes[node, 2] - z, 0.0, z - boxes[node, 5])
    return dx * dx + dy * dy + dz * dz


@njit(nogil=True, cache=True, error_model="numpy")
def triangle_distance(corners, f, x, y, z):
    """Squared distance to a triangle and the closest point's coordinates (v, w) on corners 1 and 2 (Ericson 2005, 5.1.5)."""
    ax, ay, az = x - corners[f, 0, 0], y - corners[f, 0, 1], z - corners[f, 0, 2]
    bx, by, bz = corners[f, 1, 0] - corners[f, 0, 0], corners[f, 1, 1] - corners[f, 0, 1], corners[f, 1, 2] - corners[f, 0, 2]
    cx, cy, cz = corners[f, 2, 0] - corners[f, 0, 0], corners[f, 2, 1] - corners[f, 0, 1], corners[f, 2, 2] - corners[f, 0, 2]
    bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
    d1, d2 = bx * ax + by * ay + bz * az, cx * ax + cy * ay + cz * az
    d3, d4 = d1 - bb, d2 - bc
    d5, d6 = d1 - bc, d2 - cc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        v, w = 0.0, 0.0
    elif d3 >= 0.0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0.0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and bb > 0.0:
        v, w = d1 / (d1 - d3), 0.0
    elif vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        v, w = 0.0, d2 / (d2 - d6)
    elif va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        v = 1.0 - w
    else:
        scale = 1.0 / max(va + vb + vc, 1e-300)  # no area is left only by rounding; any point of the face is a bound then
        v, w = min(vb * scale, 1.0), min(vc * scale, 1.0)
    dx, dy, dz = ax - v * bx - w * cx, ay - v * by - w * cy, az - v * bz - w * cz
    return dx * dx + dy * dy + dz * dz, v, w


@njit(nogil=True, cache=True, error_model="numpy")
def closest_points(corners, boxes, leaf_start, points, radius, hint, face, barycentric, point):
    n_leaves = leaf_start.shape[0] - 1
    node_stack = np.empty(STACK, np.int64)
    distance_stack = np.empty(STACK)
    previous = -1  # neighbours in the garment's numbering are mostly neighbours in space
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        best, best_face, best_v, best_w = radius * radius, -1, 0.0, 0.0
        first = hint[i] if hint[i] >= 0 else previous
        if first >= 0:
            squared, v, w = triangle_distance(corners, first, x, y, z)
            if squared <= best:
                best, best_face, best_v, best_w = squared, first, v, w
        top = 0
        node_stack[0], distance_stack[0] = 1, box_distance(boxes, 1, x, y, z)
        while top >= 0:
            node, lower = node_stack[top], distance_stack[top]
            top -= 1
            if lower >= best:
                continue
            while node < n_leaves:
                left, right = 2 * node, 2 * node + 1
                dl, dr = box_distance(boxes, left, x, y, z), box_distance(boxes, right, x, y, z)
                if dr < dl:
                    left, right, dl, dr = right, left, dr, dl
                if dr < best:
                    top += 1
                    node_stack[top], distance_stack[top] = right, dr
                node = left
                if dl >= best:
                    break
            else:
                leaf = node - n_leaves
                for f in range(leaf_start[leaf], leaf_start[leaf + 1]):
                    squared, v, w = triangle_distance(corners, f, x, y, z)
                    if squared < best:
                        best, best_face, best_v, best_w = squared, f, v, w
        face[i] = best_face
        previous = best_face if best_face >= 0 else previous
        if best_face < 0:
            for a in range(3):
                barycentric[i, a] = point[i, a] = 0.0
            continue
        u = 1.0 - best_v - best_w
        barycentric[i, 0], barycentric[i, 1], barycentric[i, 2] = u, best_v, best_w
        for a in range(3):
            point[i, a] = (
                u * corners[best_face, 0, a] + best_v * corners[best_face, 1, a] + best_w * corners[best_face, 2, a]
            )


@njit(nogil=True, cache=True, error_model="numpy")
def face_normal(corners, f):
    """Unit normal of a face, zero where it has no area."""
    bx, by, bz = corners[f, 1, 0] - corners[f, 0, 0], corners[f, 1, 1] - corners[f, 0, 1], corners[f, 1, 2] - corners[f, 0, 2]
    cx, cy, cz = corners[f, 2, 0] - corners[f, 0, 0], corners[f, 2, 1] - corners[f, 0, 1], corners[f, 2, 2] - corners[f, 0, 2]
    x, y, z = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    length = sqrt(x * x + y * y + z * z)
    scale = 1.0 / length if length > 0.0 else 0.0
    return x * scale, y * scale, z * scale


@njit(nogil=True, cache=True, error_model="numpy")
def corner_angle(corners, f, s):
    """Angle of a face at its corner s, 0 where an edge has no length."""
    t, r = (s + 1) % 3, (s + 2) % 3
    dot = first = second = 0.0
    for a in range(3):
        b, c = corners[f, t, a] - corners[f, s, a], corners[f, r, a] - corners[f, s, a]
        dot += b * c
        first += b * b
        second += c * c
    lengths = sqrt(first * second)
    return acos(min(1.0, max(-1.0, dot / lengths))) if lengths > 0.0 else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def pseudo_normal(corners, faces, neighbour, ring_start, ring_face, f, barycentric, i):
    """Normal at a closest point, of any length: of the face, of both faces at an edge, by angle around a corner."""
    x, y, z = face_normal(corners, f)
    outside = 0
    zero = corner = -1
    for s in range(3):
        if barycentric[i, s] <= FEATURE:
            outside += 1
            zero = s
        else:
            corner = s
    if outside == 1:
        other = neighbour[f, (zero + 1) % 3]
        if other >= 0:
            ox, oy, oz = face_normal(corners, other)
            x, y, z = x + ox, y + oy, z + oz
    elif outside == 2:
        vertex = faces[f, corner]
        x = y = z = 0.0
        for r in range(ring_start[vertex], ring_start[vertex + 1]):
            g = ring_face[r]
            s = 0 if faces[g, 0] == vertex else (1 if faces[g, 1] == vertex else 2)
            angle = corner_angle(corners, g, s)
            gx, gy, gz = face_normal(corners, g)
            x, y, z = x + angle * gx, y + angle * gy, z + angle * gz
    return x, y, z


@njit(nogil=True, cache=True, error_model="numpy")
def signed_distances(
    corners, faces, neighbour, ring_start, ring_face, points, face, barycentric, point, normal, distance
):
    for i in range(points.shape[0]):
        f = face[i]
        if f < 0:
            normal[i, 0] = normal[i, 1] = normal[i, 2] = 0.0
            distance[i] = inf
            continue
        x, y, z = pseudo_normal(corners, faces, neighbour, ring_start, ring_face, f, barycentric, i)
        dx, dy, dz = points[i, 0] - point[i, 0], points[i, 1] - point[i, 1], points[i, 2] - point[i, 2]
        length = sqrt(dx * dx + dy * dy + dz * dz)
        sign = 1.0 if x * dx + y * dy + z * dz >= 0.0 else -1.0
        distance[i] = sign * length
        if length > SURFACE:
            x, y, z, scale = dx, dy, dz, sign / length
        else:
            norm = sqrt(x * x + y * y + z * z)
            scale = 1.0 / norm if norm > 0.0 else 0.0
        normal[i, 0], normal[i, 1], normal[i, 2] = x * scale, y * scale, z * scale


@njit(nogil=True, cache=True, error_model="numpy")
def triangle_frame(vertices, i, j, k):
    """Tangent along the first edge, normal, and the in-plane edges (l, 0) and (x, h); zeros where there is no area."""
    bx, by, bz = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
    cx, cy, cz = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1], vertices[k, 2] - vertices[i, 2]
    nx, ny, nz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    length, area = sqrt(bx * bx + by * by + bz * bz), sqrt(nx * nx + ny * ny + nz * nz)
    if area <= 0.0:
        return (0.0, 0.0, 0.0), (0.0, 0.0, 0.0), 0.0, 0.0, 0.0, 0.0
    tangent, normal = (bx / length, by / length, bz / length), (nx / area, ny / area, nz / area)
    x = cx * tangent[0] + cy * tangent[1] + cz * tangent[2]
    return tangent, normal, length, x, area / length, area


@njit(nogil=True, cache=True, error_model="numpy")
def quaternion(t, u, n, t2, u2, n2):
    """Unit quaternion (w, x, y, z) of the rotation that takes the orthonormal frame (t, u, n) to (t2, u2, n2)."""
    xx, yy, zz = (
        t2[0] * t[0] + u2[0] * u[0] + n2[0] * n[0],
        t2[1] * t[1] + u2[1] * u[1] + n2[1] * n[1],
        t2[2] * t[2] + u2[2] * u[2] + n2[2] * n[2],
    )
    xy, yx = t2[0] * t[1] + u2[0] * u[1] + n2[0] * n[1], t2[1] * t[0] + u2[1] * u[0] + n2[1] * n[0]
    xz, zx = t2[0] * t[2] + u2[0] * u[2] + n2[0] * n[2], t2[2] * t[0] + u2[2] * u[0] + n2[2] * n[0]
    yz, zy = t2[1] * t[2] + u2[1] * u[2] + n2[1] * n[2], t2[2] * t[1] + u2[2] * u[1] + n2[2] * n[1]
    if xx + yy + zz > 0.0:
        w, x, y, z = 1.0 + xx + yy + zz, zy - yz, xz - zx, yx - xy
    elif xx >= yy and xx >= zz:
        w, x, y, z = zy - yz, 1.0 + xx - yy - zz, xy + yx, xz + zx
    elif yy >= zz:
        w, x, y, z = xz - zx, xy + yx, 1.0 - xx + yy - zz, yz + zy
    else:
        w, x, y, z = yx - xy, xz + zx, yz + zy, 1.0 - xx - yy + zz
    scale = 1.0 / sqrt(w * w + x * x + y * y + z * z)
    return w * scale, x * scale, y * scale, z * scale


@njit(nogil=True, cache=True, error_model="numpy")
def cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(nogil=True, cache=True, error_model="numpy")
def vertex_rotations(last, now, faces, rotation):
    """Sum, per vertex, of the faces' rotation quaternions, weighted by area and on one hemisphere; not normalised."""
    rotation[:] = 0.0
    rotation[:, 0] = FACE_AREA
    for f in range(faces.shape[0]):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        t1, n1, l1, x1, h1, area1 = triangle_frame(last, i, j, k)
        t2, n2, l2, x2, h2, area2 = triangle_frame(now, i, j, k)
        weight = min(area1, area2)
        # polar factor of the in-plane deformation [[l2/l1, (x2 - x1 l2/l1) / h1], [0, h2/h1]], multiplied by l1 h1
        c, s = l2 * h1 + h2 * l1, l2 * x1 - x2 * l1
        norm = sqrt(c * c + s * s)
        if weight <= 0.0 or norm <= 0.0:
            continue
        c, s = c / norm, s / norm
        b1, b2 = cross(n1, t1), cross(n2, t2)
        turned = (c * t2[0] + s * b2[0], c * t2[1] + s * b2[1], c * t2[2] + s * b2[2])
        w, x, y, z = quaternion(t1, b1, n1, turned, cross(n2, turned), n2)
        for corner in range(3):
            v = faces[f, corner]
            sign = rotation[v, 0] * w + rotation[v, 1] * x + rotation[v, 2] * y + rotation[v, 3] * z
            share = weight if sign >= 0.0 else -weight
            rotation[v, 0] += share * w
            rotation[v, 1] += share * x
            rotation[v, 2] += share * y
            rotation[v, 3] += share * z
    for v in range(rotation.shape[0]):
        w, x, y, z = rotation[v, 0], rotation[v, 1], rotation[v, 2], rotation[v, 3]
        scale = 1.0 / max(sqrt(w * w + x * x + y * y + z * z), 1e-300)
        rotation[v, 0], rotation[v, 1], rotation[v, 2], rotation[v, 3] = w * scale, x * scale, y * scale, z * scale


@njit(nogil=True, cache=True, error_model="numpy")
def carry(last, now, rotation, faces, face, barycentric, points, near, radius, position, weight):
    for i in range(points.shape[0]):
        for a in range(3):
            position[i, a] = points[i, a]
        weight[i] = 0.0
        f = face[i]
        if f < 0:
            continue
        w = x = y = z = 0.0
        ox = oy = oz = tx = ty = tz = 0.0
        for s in range(3):
            v, b = faces[f, s], barycentric[i, s]
            qw, qx, qy, qz = rotation[v, 0], rotation[v, 1], rotation[v, 2], rotation[v, 3]
            if w * qw + x * qx + y * qy + z * qz < 0.0:
                qw, qx, qy, qz = -qw, -qx, -qy, -qz
            w, x, y, z = w + b * qw, x + b * qx, y + b * qy, z + b * qz
            ox, oy, oz = ox + b * last[v, 0], oy + b * last[v, 1], oz + b * last[v, 2]
            tx, ty, tz = tx + b * now[v, 0], ty + b * now[v, 1], tz + b * now[v, 2]
        ox, oy, oz = points[i, 0] - ox, points[i, 1] - oy, points[i, 2] - oz
        share = (radius - sqrt(ox * ox + oy * oy + oz * oz)) / (radius - near)
        share = min(1.0, max(0.0, share))
        share = share * share * (3.0 - 2.0 * share)
        weight[i] = share
        # rotation of the offset o by the quaternion: o + 2 w (q x o) + 2 q x (q x o), over the squared norm
        scale = 2.0 / max(w * w + x * x + y * y + z * z, 1e-300)
        cx, cy, cz = y * oz - z * oy, z * ox - x * oz, x * oy - y * ox
        ox += scale * (w * cx + y * cz - z * cy)
        oy += scale * (w * cy + z * cx - x * cz)
        oz += scale * (w * cz + x * cy - y * cx)
        position[i, 0] += share * (tx + ox - points[i, 0])
        position[i, 1] += share * (ty + oy - points[i, 1])
        position[i, 2] += share * (tz + oz - points[i, 2])
