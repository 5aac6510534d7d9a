"""Closest points on a body through a tree of boxes, and signs by pseudo-normals.

The tree has eight children per node and eight faces per leaf, side by side in memory, so that one pass of vector
instructions tests all eight. Inner nodes are 0..G-1, leaves follow; the children of node n are 8 n + shift + lane. The
root has 1 to 8 children, in its last lanes, which makes shift = (number of them) - 7 the same for every node.
"""

from math import acos, inf, sqrt
from typing import NamedTuple

import numpy as np
from numba import njit

LANES = 8
STACK = 128  # nodes waiting in a depth-first search: at most eight per level, and 2^31 faces have eleven levels
FAR = 1e30  # m: bound of an empty box, finite because the vectorised sums below assume that
SLACK = 1e-6  # relative, its cube in m^2: more than the rounding of any squared distance
SURFACE = 1e-7  # m: closer than this, the direction to the closest point is rounding noise
FEATURE = 1e-9  # barycentric coordinate below which the closest point lies on an edge or a corner


class BodyTree(NamedTuple):
    """The tree of boxes in the pose of one frame. L leaves, G inner nodes, F faces in leaf order."""

    triangles: np.ndarray  # (L, 15, 8), the faces as the search reads them, eight to a leaf
    boxes: np.ndarray  # (G, 6, 8) m, lower and upper corners of the eight children of every inner node
    leaf_start: np.ndarray  # (L + 1,) int32, first face of each leaf
    leaf_of: np.ndarray  # (F,) int32, leaf of each face
    shift: int  # the children of node n are 8 n + shift + 0..7


class BodyFaces(NamedTuple):
    """The faces of a body in the pose of one frame, and their adjacency."""

    vertices: np.ndarray  # (B, 3) m
    faces: np.ndarray  # (F, 3) int32, in leaf order
    neighbour: np.ndarray  # (F, 3) int32, the face across the edge from corner c to c + 1; -1 at a boundary
    ring_start: np.ndarray  # (B + 1,) int32
    ring_face: np.ndarray  # (3 F,) int32, the faces around vertex i are ring_face[ring_start[i]:ring_start[i + 1]]


class Contact(NamedTuple):
    """Closest points of N points on a body. With none within the radius: face -1, distance infinite, the rest 0."""

    face: np.ndarray  # (N,) int32, in leaf order
    barycentric: np.ndarray  # (N, 3)
    point: np.ndarray  # (N, 3) m, on the body
    normal: np.ndarray  # (N, 3) unit, outward: the gradient of the signed distance
    distance: np.ndarray  # (N,) m, negative inside


@njit(nogil=True, cache=True, error_model="numpy")
def edges(vertices, faces, f):
    """Corner 0 of a face and the edges from it to corners 1 and 2."""
    i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
    a = vertices[i, 0], vertices[i, 1], vertices[i, 2]
    b = vertices[j, 0] - a[0], vertices[j, 1] - a[1], vertices[j, 2] - a[2]
    c = vertices[k, 0] - a[0], vertices[k, 1] - a[1], vertices[k, 2] - a[2]
    return a, b, c


@njit(nogil=True, cache=True, error_model="numpy")
def dot(a, b):
    """Scalar product of two vectors."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@njit(nogil=True, cache=True, error_model="numpy")
def cross(a, b):
    """Vector product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@njit(nogil=True, cache=True, error_model="numpy")
def refit(vertices, faces, leaf_start, shift, triangles, boxes):
    """Fits the tree to a pose: the faces as the searches read them, and the boxes, leaves first.

    triangles[leaf, :, lane]: corner 0, both edges from it, inverse squared lengths of the three edges, and the
    inverse Gram matrix of the two; inverses of zero are zero. Spare lanes repeat the leaf's last face.

    Args:
        vertices: (B, 3) metres.
        faces: (F, 3) int32 in leaf order.
        leaf_start, shift: of :class:`BodyTree`.
        triangles, boxes: of :class:`BodyTree`, out.
    """
    n_inner = boxes.shape[0]
    for lane in range(LANES):
        for a in range(3):
            boxes[0, a, lane], boxes[0, 3 + a, lane] = FAR, -FAR
    for node in range(n_inner + leaf_start.shape[0] - 2, 0, -1):
        parent, lane = (node - shift) // LANES, (node - shift) % LANES
        for a in range(3):
            boxes[parent, a, lane], boxes[parent, 3 + a, lane] = FAR, -FAR
        if node < n_inner:
            for a in range(3):
                for child in range(LANES):
                    boxes[parent, a, lane] = min(boxes[parent, a, lane], boxes[node, a, child])
                    boxes[parent, 3 + a, lane] = max(boxes[parent, 3 + a, lane], boxes[node, 3 + a, child])
            continue
        leaf = node - n_inner
        for spot in range(LANES):
            p, b, c = edges(vertices, faces, min(leaf_start[leaf] + spot, leaf_start[leaf + 1] - 1))
            bb, bc, cc = dot(b, b), dot(b, c), dot(c, c)
            opposite, det = bb + cc - 2.0 * bc, bb * cc - bc * bc
            for a in range(3):
                lower, upper = p[a] + min(0.0, b[a], c[a]), p[a] + max(0.0, b[a], c[a])
                boxes[parent, a, lane] = min(boxes[parent, a, lane], lower)
                boxes[parent, 3 + a, lane] = max(boxes[parent, 3 + a, lane], upper)
                triangles[leaf, a, spot], triangles[leaf, 3 + a, spot], triangles[leaf, 6 + a, spot] = p[a], b[a], c[a]
            inverse = 1.0 / det if det > 0.0 else 0.0
            triangles[leaf, 9, spot] = 1.0 / bb if bb > 0.0 else 0.0
            triangles[leaf, 10, spot] = 1.0 / cc if cc > 0.0 else 0.0
            triangles[leaf, 11, spot] = 1.0 / opposite if opposite > 0.0 else 0.0
            triangles[leaf, 12, spot] = cc * inverse
            triangles[leaf, 13, spot] = -bc * inverse
            triangles[leaf, 14, spot] = bb * inverse


# The loops of the next two functions end at a number that is unknown when they are compiled. With the constant LANES the compiler
# unrolls them before it vectorises them, and the search takes 1.4 times as long.
@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def box_distances(boxes, n, x, y, z, squared):
    """squared (n,) out, m^2: squared distances from a point (x, y, z) to the first n of (6, L) boxes, 0 inside."""
    for s in range(n):
        dx = max(max(boxes[0, s] - x, x - boxes[3, s]), 0.0)
        dy = max(max(boxes[1, s] - y, y - boxes[4, s]), 0.0)
        dz = max(max(boxes[2, s] - z, z - boxes[5, s]), 0.0)
        squared[s] = dx * dx + dy * dy + dz * dz


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def leaf_distances(triangles, leaf, x, y, z, squared):
    """squared (8,) out, m^2: squared distances from a point (x, y, z) to a leaf's faces.

    Above the inside of a face it is the distance to its plane, elsewhere to the nearest edge.
    """
    for s in range(triangles.shape[2]):
        ax, ay, az = x - triangles[leaf, 0, s], y - triangles[leaf, 1, s], z - triangles[leaf, 2, s]
        bx, by, bz = triangles[leaf, 3, s], triangles[leaf, 4, s], triangles[leaf, 5, s]
        cx, cy, cz = triangles[leaf, 6, s], triangles[leaf, 7, s], triangles[leaf, 8, s]
        ex, ey, ez = cx - bx, cy - by, cz - bz
        fx, fy, fz = ax - bx, ay - by, az - bz
        along_b, along_c = ax * bx + ay * by + az * bz, ax * cx + ay * cy + az * cz
        along_e = fx * ex + fy * ey + fz * ez
        t = min(max(along_b * triangles[leaf, 9, s], 0.0), 1.0)
        rx, ry, rz = ax - t * bx, ay - t * by, az - t * bz
        edge_b = rx * rx + ry * ry + rz * rz
        t = min(max(along_c * triangles[leaf, 10, s], 0.0), 1.0)
        rx, ry, rz = ax - t * cx, ay - t * cy, az - t * cz
        edge_c = rx * rx + ry * ry + rz * rz
        t = min(max(along_e * triangles[leaf, 11, s], 0.0), 1.0)
        rx, ry, rz = fx - t * ex, fy - t * ey, fz - t * ez
        edge_e = rx * rx + ry * ry + rz * rz
        v = triangles[leaf, 12, s] * along_b + triangles[leaf, 13, s] * along_c
        w = triangles[leaf, 13, s] * along_b + triangles[leaf, 14, s] * along_c
        rx, ry, rz = ax - v * bx - w * cx, ay - v * by - w * cy, az - v * bz - w * cz
        plane = rx * rx + ry * ry + rz * rz
        # all three are computed: the compiler vectorises a selection of values, but no branch between computations
        edge, inside = min(min(edge_b, edge_c), edge_e), min(min(v, w), 1.0 - v - w)
        squared[s] = plane if inside > 0.0 else edge


@njit(nogil=True, cache=True, error_model="numpy")
def keep_nearer(candidate, leaf, squared, nearest_leaf):
    """Updates in every lane the least squared distance so far, m^2, and the first leaf that has it.

    Args:
        candidate: (8,) squared distances to the faces of ``leaf``, m^2.
        leaf: its number.
        squared, nearest_leaf: (8,) in and out.
    """
    for s in range(candidate.shape[0]):
        better = (candidate[s] < squared[s]) | ((candidate[s] == squared[s]) & (leaf < nearest_leaf[s]))
        squared[s] = candidate[s] if better else squared[s]
        nearest_leaf[s] = leaf if better else nearest_leaf[s]


@njit(nogil=True, cache=True, error_model="numpy")
def closest_on_triangle(p, b, c):
    """Coordinates (v, w) on edges b and c of the point closest to p, relative to corner 0 (Ericson 2005, 5.1.5)."""
    bb, bc, cc = dot(b, b), dot(b, c), dot(c, c)
    d1, d2 = dot(b, p), dot(c, p)
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0.0 and d2 <= 0.0:
        return 0.0, 0.0
    if d3 >= 0.0 and d4 <= d3:
        return 1.0, 0.0
    if d6 >= 0.0 and d5 <= d6:
        return 0.0, 1.0
    if vc <= 0.0 and d1 >= 0.0 and d3 <= 0.0 and bb > 0.0:
        return d1 / bb, 0.0
    if vb <= 0.0 and d2 >= 0.0 and d6 <= 0.0:
        return 0.0, d2 / cc
    if va <= 0.0 and d4 - d3 >= 0.0 and d5 - d6 >= 0.0:
        w = (d4 - d3) / ((d4 - d3) + (d5 - d6))
        return 1.0 - w, w
    total = max(va + vb + vc, 1e-300)  # zero only by rounding, on a face without area; any point of it will do then
    return min(vb / total, 1.0), min(vc / total, 1.0)


@njit(nogil=True, cache=True, error_model="numpy", fastmath=True)
def distances_between_boxes(boxes, node, lower, upper, squared):
    """squared (8,) out, m^2: squared distances from a box to those of a node's children, 0 where they meet.

    Args:
        boxes: (G, 6, 8) metres, of :class:`BodyTree`.
        node: inner node.
        lower, upper: (3,) corners of the box, metres.
        squared: (8,) out.
    """
    for s in range(boxes.shape[2]):
        dx = max(max(boxes[node, 0, s] - upper[0], lower[0] - boxes[node, 3, s]), 0.0)
        dy = max(max(boxes[node, 1, s] - upper[1], lower[1] - boxes[node, 4, s]), 0.0)
        dz = max(max(boxes[node, 2, s] - upper[2], lower[2] - boxes[node, 5, s]), 0.0)
        squared[s] = dx * dx + dy * dy + dz * dz


@njit(nogil=True, cache=True, error_model="numpy")
def search_limit(best):
    """Squared distance up to which faces are searched so that rounding does not hide one as near as ``best``, m^2."""
    return best * (1.0 + SLACK) + SLACK**3


# Functions that are called for every point take arrays, not named tuples of them: each call would count references to every array
# of the tuple, a fifth of the time of a search.
@njit(nogil=True, cache=True, error_model="numpy")
def search_leaf(triangles, leaf_start, leaf, point, best, best_face, squared):
    """Squared distance and face of the nearest so far, after the search of a leaf; of equally near faces the first.

    Args:
        triangles, leaf_start: of :class:`BodyTree`.
        leaf: its number.
        point: (x, y, z) metres.
        best, best_face: nearest face before, m^2.
        squared: (8,) workspace.
    """
    leaf_distances(triangles, leaf, point[0], point[1], point[2], squared)
    for s in range(leaf_start[leaf + 1] - leaf_start[leaf]):
        if squared[s] <= best and (squared[s] < best or leaf_start[leaf] + s < best_face):
            best, best_face = squared[s], leaf_start[leaf] + s
    return best, best_face


@njit(nogil=True, cache=True, error_model="numpy")
def search_tree(triangles, boxes, leaf_start, shift, point, radius, start, workspace):
    """The nearest face to a point, -1 where none is within the radius.

    Args:
        triangles, boxes, leaf_start, shift: of :class:`BodyTree`.
        point: (x, y, z) metres.
        radius: metres.
        start: leaf that is searched first, which saves time, or -1.
        workspace: (STACK,) nodes that wait, (STACK,) lower bounds of their squared distances, and (8,) squared distances.
    """
    nodes, lower, squared = workspace
    n_inner = boxes.shape[0]
    best, best_face = radius * radius, -1
    top = 0
    nodes[0], lower[0] = 0, 0.0
    if start >= 0:  # a good bound first: it is on the stack above the root
        top = 1
        nodes[1], lower[1] = n_inner + start, -1.0
    while top >= 0:
        node, bound = nodes[top], lower[top]
        top -= 1
        if bound > search_limit(best):
            continue
        if node >= n_inner:
            leaf = node - n_inner
            if leaf != start or bound < 0.0:  # else the first leaf again
                best, best_face = search_leaf(triangles, leaf_start, leaf, point, best, best_face, squared)
            continue
        box_distances(boxes[node], boxes.shape[2], point[0], point[1], point[2], squared)
        nearest = limit = search_limit(best)
        at = top
        for s in range(LANES):  # every child is written, which is cheaper than an unpredictable branch
            nodes[top + 1], lower[top + 1] = LANES * node + shift + s, squared[s]
            top += 1 if squared[s] < limit else 0
            nearer = squared[s] < nearest
            at, nearest = top if nearer else at, squared[s] if nearer else nearest
        if at >= 0:  # the nearest child on top
            nodes[at], nodes[top] = nodes[top], nodes[at]
            lower[at], lower[top] = lower[top], lower[at]
    return best_face


@njit(nogil=True, cache=True, error_model="numpy")
def list_leaves(boxes, shift, box, reach, nodes, squared, leaf, leaf_box):
    """Lists the leaves whose boxes are near a given box. Returns their number.

    Args:
        boxes, shift: of :class:`BodyTree`.
        box: its lower and upper corner, (3,) metres each.
        reach: squared distance between the boxes, m^2.
        nodes, squared: (STACK,) and (8,) workspace.
        leaf: (L + 1,) out.
        leaf_box: (6, L + 1) out, their boxes, metres.
    """
    lower, upper = box
    n_inner, found, top = boxes.shape[0], 0, 0
    nodes[0] = 0
    while top >= 0:
        node = nodes[top]
        top -= 1
        distances_between_boxes(boxes, node, lower, upper, squared)
        child = LANES * node + shift
        if child + LANES - 1 < n_inner:
            for s in range(LANES):  # here too every child is written
                nodes[top + 1] = child + s
                top += 1 if squared[s] <= reach else 0
            continue
        for s in range(LANES):
            leaf[found] = child + s - n_inner
            for a in range(6):
                leaf_box[a, found] = boxes[node, a, s]
            found += 1 if squared[s] <= reach else 0
    return found


@njit(nogil=True, cache=True, error_model="numpy")
def sort_by_leaf(leaf_of, hint, n_leaves, first, order):
    """Sorts N points by the leaf of their hint; those without a hint come last.

    Args:
        leaf_of: (F,) leaf of each face.
        hint: (N,) face of each point, or -1.
        n_leaves: L.
        first: (L + 2,) out: the points of leaf l are ``order[first[l]:first[l + 1]]``.
        order: (N,) out.
    """
    first[:] = 0
    for i in range(hint.shape[0]):
        first[(leaf_of[hint[i]] if hint[i] >= 0 else n_leaves) + 1] += 1
    for leaf in range(n_leaves + 1):
        first[leaf + 1] += first[leaf]
    for i in range(hint.shape[0]):
        leaf = leaf_of[hint[i]] if hint[i] >= 0 else n_leaves
        order[first[leaf]] = i
        first[leaf] += 1
    for leaf in range(n_leaves, 0, -1):
        first[leaf] = first[leaf - 1]
    first[0] = 0


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_faces(tree, points, radius, hint, face):
    """The nearest face of every point, of equally near ones the first; -1 where none is within the radius.

    A hint saves time and never changes the result: everything within rounding of the best is searched. Points whose hints
    are in one leaf share one search of the tree for near leaves; each point then searches those leaves on its own.

    Args:
        tree: :class:`BodyTree`.
        points: (N, 3) metres.
        radius: metres.
        hint: (N,) int32 face that is probably near, or -1.
        face: (N,) int32 out; may be ``hint``.
    """
    triangles, boxes, leaf_start, leaf_of, shift = tree
    n, n_leaves = points.shape[0], leaf_start.shape[0] - 1
    nodes, lower = np.empty(STACK, np.int64), np.empty(STACK)
    squared, candidate = np.empty(LANES), np.empty(LANES)
    first, order = np.empty(n_leaves + 2, np.int64), np.empty(n, np.int64)
    best, least, most = np.empty(n), np.empty(3), np.empty(3)
    near_leaf, leaf_box = np.empty(n_leaves + 1, np.int64), np.empty((6, n_leaves + 1))
    box_squared, nearest_leaf = np.empty(n_leaves), np.empty(LANES, np.int64)
    chosen = np.empty(n_leaves + 1, np.int64)
    sort_by_leaf(leaf_of, hint, n_leaves, first, order)
    for start in range(n_leaves):
        if first[start + 1] == first[start]:
            continue
        least[:], most[:], reach = inf, -inf, 0.0
        for o in range(first[start], first[start + 1]):
            i = order[o]
            point = points[i, 0], points[i, 1], points[i, 2]
            best[i], face[i] = search_leaf(triangles, leaf_start, start, point, radius * radius, -1, squared)
            reach = max(reach, best[i])
            for a in range(3):
                least[a], most[a] = min(least[a], points[i, a]), max(most[a], points[i, a])
        found = list_leaves(boxes, shift, (least, most), search_limit(reach), nodes, squared, near_leaf, leaf_box)
        for o in range(first[start], first[start + 1]):
            i = order[o]
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            box_distances(leaf_box, found, x, y, z, box_squared)
            n_chosen, limit = 0, search_limit(best[i])
            for k in range(found):
                chosen[n_chosen] = near_leaf[k]
                n_chosen += 1 if box_squared[k] <= limit else 0
            squared[:], nearest_leaf[:] = inf, n_leaves
            for k in range(n_chosen):
                leaf_distances(triangles, chosen[k], x, y, z, candidate)
                keep_nearer(candidate, chosen[k], squared, nearest_leaf)
            for s in range(LANES):
                if squared[s] < best[i] or (squared[s] == best[i] and leaf_start[nearest_leaf[s]] + s < face[i]):
                    best[i], face[i] = squared[s], leaf_start[nearest_leaf[s]] + s
    previous = -1  # neighbours in the garment's numbering are mostly neighbours in space
    for o in range(first[n_leaves], n):
        i = order[o]
        point = points[i, 0], points[i, 1], points[i, 2]
        face[i] = search_tree(triangles, boxes, leaf_start, shift, point, radius, previous, (nodes, lower, squared))
        previous = leaf_of[face[i]] if face[i] >= 0 else previous


@njit(nogil=True, cache=True, error_model="numpy")
def face_normal(vertices, faces, f):
    """Unit normal of a face, zero where it has no area."""
    _, b, c = edges(vertices, faces, f)
    n = cross(b, c)
    length = sqrt(dot(n, n))
    scale = 1.0 / length if length > 0.0 else 0.0
    return n[0] * scale, n[1] * scale, n[2] * scale


@njit(nogil=True, cache=True, error_model="numpy")
def corner_angle(vertices, i, j, k):
    """Angle at vertex i of the face i, j, k; 0 where an edge has no length."""
    b = vertices[j, 0] - vertices[i, 0], vertices[j, 1] - vertices[i, 1], vertices[j, 2] - vertices[i, 2]
    c = vertices[k, 0] - vertices[i, 0], vertices[k, 1] - vertices[i, 1], vertices[k, 2] - vertices[i, 2]
    lengths = sqrt(dot(b, b) * dot(c, c))
    return acos(min(1.0, max(-1.0, dot(b, c) / lengths))) if lengths > 0.0 else 0.0


@njit(nogil=True, cache=True, error_model="numpy")
def pseudo_normal(vertices, faces, neighbour, ring_start, ring_face, f, barycentric):
    """Normal at a point of a face, of any length: the face's, both faces' at an edge, by angle around a corner.

    Args:
        vertices, faces, neighbour, ring_start, ring_face: of :class:`BodyFaces`.
        f: the face.
        barycentric: (u, v, w) of the point.
    """
    u, v, w = barycentric
    on_edges = (1 if u <= FEATURE else 0) + (1 if v <= FEATURE else 0) + (1 if w <= FEATURE else 0)
    x, y, z = face_normal(vertices, faces, f)
    if on_edges == 1:
        other = neighbour[f, 1 if u <= FEATURE else (2 if v <= FEATURE else 0)]
        if other >= 0:
            ox, oy, oz = face_normal(vertices, faces, other)
            x, y, z = x + ox, y + oy, z + oz
    elif on_edges == 2:
        corner = faces[f, 0 if u > FEATURE else (1 if v > FEATURE else 2)]
        x = y = z = 0.0
        for r in range(ring_start[corner], ring_start[corner + 1]):
            g = ring_face[r]
            s = 0 if faces[g, 0] == corner else (1 if faces[g, 1] == corner else 2)
            angle = corner_angle(vertices, corner, faces[g, (s + 1) % 3], faces[g, (s + 2) % 3])
            gx, gy, gz = face_normal(vertices, faces, g)
            x, y, z = x + angle * gx, y + angle * gy, z + angle * gz
    return x, y, z


@njit(nogil=True, cache=True, error_model="numpy")
def side_of_face(vertices, faces, f, d):
    """1 where the vector d points to the outside of a face, 0 where it lies in the face's plane, -1 to the inside."""
    _, b, c = edges(vertices, faces, f)
    along = dot(cross(b, c), d)
    return (1 if along > 0.0 else 0) - (1 if along < 0.0 else 0)


@njit(nogil=True, cache=True, error_model="numpy")
def outside(vertices, faces, neighbour, ring_start, ring_face, f, barycentric, d):
    """Whether the offset d from a point of a face does not point against the pseudo-normal there.

    Where all faces around the point agree, so does any positive combination of their normals. Roots and angles are needed only
    within the fold of a crease.

    Args:
        vertices, faces, neighbour, ring_start, ring_face: of :class:`BodyFaces`.
        f: the face.
        barycentric: (u, v, w) of the point.
        d: (dx, dy, dz) metres.
    """
    u, v, w = barycentric
    on_edges = (1 if u <= FEATURE else 0) + (1 if v <= FEATURE else 0) + (1 if w <= FEATURE else 0)
    least = most = side_of_face(vertices, faces, f, d)
    if on_edges == 1:
        other = neighbour[f, 1 if u <= FEATURE else (2 if v <= FEATURE else 0)]
        if other >= 0:
            side = side_of_face(vertices, faces, other, d)
            least, most = min(least, side), max(most, side)
    elif on_edges == 2:
        corner = faces[f, 0 if u > FEATURE else (1 if v > FEATURE else 2)]
        for r in range(ring_start[corner], ring_start[corner + 1]):
            side = side_of_face(vertices, faces, ring_face[r], d)
            least, most = min(least, side), max(most, side)
    if least < 0 < most:
        return dot(pseudo_normal(vertices, faces, neighbour, ring_start, ring_face, f, barycentric), d) >= 0.0
    return least >= 0


@njit(nogil=True, cache=True, error_model="numpy")
def contacts(body, points, contact):
    """Closest point of every point on its face, and its signed distance from the body.

    Args:
        body: :class:`BodyFaces`.
        points: (N, 3) metres.
        contact: :class:`Contact` of N points, its faces in, the rest out.
    """
    vertices, faces, neighbour, ring_start, ring_face = body
    face, barycentric, point, normal, distance = contact
    for i in range(points.shape[0]):
        f = face[i]
        if f < 0:
            for a in range(3):
                barycentric[i, a] = point[i, a] = normal[i, a] = 0.0
            distance[i] = inf
            continue
        p, b, c = edges(vertices, faces, f)
        ax, ay, az = points[i, 0] - p[0], points[i, 1] - p[1], points[i, 2] - p[2]
        v, w = closest_on_triangle((ax, ay, az), b, c)
        u = 1.0 - v - w
        barycentric[i, 0], barycentric[i, 1], barycentric[i, 2] = u, v, w
        dx, dy, dz = ax - v * b[0] - w * c[0], ay - v * b[1] - w * c[1], az - v * b[2] - w * c[2]
        length = sqrt(dx * dx + dy * dy + dz * dz)
        inside = not outside(vertices, faces, neighbour, ring_start, ring_face, f, (u, v, w), (dx, dy, dz))
        sign = -1.0 if inside else 1.0
        point[i, 0], point[i, 1], point[i, 2] = points[i, 0] - dx, points[i, 1] - dy, points[i, 2] - dz
        distance[i] = sign * length
        if length > SURFACE:
            x, y, z, scale = dx, dy, dz, sign / length
        else:
            x, y, z = pseudo_normal(vertices, faces, neighbour, ring_start, ring_face, f, (u, v, w))
            norm = sqrt(x * x + y * y + z * z)
            scale = 1.0 / norm if norm > 0.0 else 0.0
        normal[i, 0], normal[i, 1], normal[i, 2] = x * scale, y * scale, z * scale
