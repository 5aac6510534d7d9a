"""Nearest faces of a body through a tree of boxes.

The tree has eight children per node and eight faces per leaf, side by side in memory, so that one pass of vector
instructions tests all eight. Inner nodes are 0..G-1, leaves follow; the children of node n are 8 n + shift + lane. The
root has 1 to 8 children, in its last lanes, which makes shift = (number of them) - 7 the same for every node.
"""

from math import inf
from typing import NamedTuple

import numpy as np
from numba import njit

LANES = 8
STACK = 128  # nodes waiting in a depth-first search: at most eight per level, and 2^31 faces have eleven levels
FAR = 1e30  # m: bound of an empty box, finite because the vectorised sums below assume that
SLACK = 1e-6  # relative, its cube in m^2: more than the rounding of any squared distance
# Bounds of a search in a folded body, where all faces are equally near: it ends with the nearest so far. In a true body a search
# visits up to 70 nodes.
MOST_NODES = 256  # visited for a point
MOST_SHARED = 1024  # leaves that the points of a node share; with more, each point searches on its own


class BodyTree(NamedTuple):
    """The tree of boxes in the pose of one frame. L leaves, G inner nodes, F faces in leaf order."""

    triangles: np.ndarray  # (L, 15, 8), the faces as the search reads them, eight to a leaf
    boxes: np.ndarray  # (G, 6, 8) m, lower and upper corners of the eight children of every inner node
    leaf_start: np.ndarray  # (L + 1,) int32, first face of each leaf
    leaf_of: np.ndarray  # (F,) int32, leaf of each face
    shift: int  # the children of node n are 8 n + shift + 0..7


@njit(nogil=True, cache=True, error_model="numpy")
def least_of(squared):
    """The least of LANES numbers, in three rounds: a loop would wait for each comparison."""
    a, b = min(squared[0], squared[1]), min(squared[2], squared[3])
    c, d = min(squared[4], squared[5]), min(squared[6], squared[7])
    return min(min(a, b), min(c, d))


@njit(nogil=True, cache=True, error_model="numpy")
def most_of(squared):
    """The greatest of LANES numbers."""
    a, b = max(squared[0], squared[1]), max(squared[2], squared[3])
    c, d = max(squared[4], squared[5]), max(squared[6], squared[7])
    return max(max(a, b), max(c, d))


@njit(nogil=True, cache=True, error_model="numpy")
def fit_leaf(lanes):
    """What a search reads of the faces in LANES lanes, and their boxes.

    Args:
        lanes: (21 * LANES,) in and out, flat, so that the distance of its rows is known when this is compiled: corner 0 and both
            edges from it, the inverses (see :func:`refit`), lower and upper corners of the faces' boxes.
    """
    for s in range(LANES):
        px, py, pz = lanes[s], lanes[LANES + s], lanes[2 * LANES + s]
        bx, by, bz = lanes[3 * LANES + s], lanes[4 * LANES + s], lanes[5 * LANES + s]
        cx, cy, cz = lanes[6 * LANES + s], lanes[7 * LANES + s], lanes[8 * LANES + s]
        bb, bc, cc = bx * bx + by * by + bz * bz, bx * cx + by * cy + bz * cz, cx * cx + cy * cy + cz * cz
        opposite, det = bb + cc - 2.0 * bc, bb * cc - bc * bc
        inverse = 1.0 / det if det > 0.0 else 0.0
        lanes[9 * LANES + s] = 1.0 / bb if bb > 0.0 else 0.0
        lanes[10 * LANES + s] = 1.0 / cc if cc > 0.0 else 0.0
        lanes[11 * LANES + s] = 1.0 / opposite if opposite > 0.0 else 0.0
        lanes[12 * LANES + s], lanes[13 * LANES + s], lanes[14 * LANES + s] = cc * inverse, -bc * inverse, bb * inverse
        lanes[15 * LANES + s], lanes[18 * LANES + s] = px + min(min(bx, cx), 0.0), px + max(max(bx, cx), 0.0)
        lanes[16 * LANES + s], lanes[19 * LANES + s] = py + min(min(by, cy), 0.0), py + max(max(by, cy), 0.0)
        lanes[17 * LANES + s], lanes[20 * LANES + s] = pz + min(min(bz, cz), 0.0), pz + max(max(bz, cz), 0.0)


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
    n_inner, lanes = boxes.shape[0], np.empty(21 * LANES)
    for lane in range(LANES):
        for a in range(3):
            boxes[0, a, lane], boxes[0, 3 + a, lane] = FAR, -FAR
    for node in range(n_inner + leaf_start.shape[0] - 2, 0, -1):
        parent, lane = (node - shift) // LANES, (node - shift) % LANES
        if node < n_inner:
            for a in range(3):
                boxes[parent, a, lane] = least_of(boxes[node, a])
                boxes[parent, 3 + a, lane] = most_of(boxes[node, 3 + a])
            continue
        leaf = node - n_inner
        for spot in range(LANES):
            f = np.uint32(max(min(leaf_start[leaf] + spot, leaf_start[leaf + 1] - 1), 0))  # of one face the first leaf is empty
            i, j, k = np.uint32(faces[f, 0]), np.uint32(faces[f, 1]), np.uint32(faces[f, 2])
            for a in range(3):
                lanes[a * LANES + spot] = vertices[i, a]
                lanes[(3 + a) * LANES + spot] = vertices[j, a] - vertices[i, a]
                lanes[(6 + a) * LANES + spot] = vertices[k, a] - vertices[i, a]
        fit_leaf(lanes)
        for a in range(3):
            boxes[parent, a, lane] = least_of(lanes[(15 + a) * LANES : (16 + a) * LANES])
            boxes[parent, 3 + a, lane] = most_of(lanes[(18 + a) * LANES : (19 + a) * LANES])
        for row in range(15):
            for s in range(LANES):
                triangles[leaf, row, s] = lanes[row * LANES + s]


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
    """The nearest face to a point, -1 where none is within the radius; after MOST_NODES the nearest so far.

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
    top = visited = 0
    nodes[0], lower[0] = 0, 0.0
    if start >= 0:  # a good bound first: it is on the stack above the root
        top = 1
        nodes[1], lower[1] = n_inner + start, -1.0
    while top >= 0 and visited < MOST_NODES:
        node, bound = nodes[top], lower[top]
        top -= 1
        if bound > search_limit(best):
            continue
        visited += 1
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
    """Lists the leaves whose boxes are near a given box. Returns their number, or one above MOST_SHARED.

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
    while top >= 0 and found <= MOST_SHARED:
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
def sort_by_node(leaf_of, hint, n_nodes, first, order):
    """Sorts N points by the node above the leaf of their hint; those without a hint come last.

    Args:
        leaf_of: (F,) leaf of each face.
        hint: (N,) face of each point, or -1.
        n_nodes: M, nodes with LANES leaves each.
        first: (M + 2,) out: the points of node m are ``order[first[m]:first[m + 1]]``.
        order: (N,) out.
    """
    first[:] = 0
    for i in range(hint.shape[0]):
        first[(leaf_of[hint[i]] // LANES if hint[i] >= 0 else n_nodes) + 1] += 1
    for node in range(n_nodes + 1):
        first[node + 1] += first[node]
    for i in range(hint.shape[0]):
        node = leaf_of[hint[i]] // LANES if hint[i] >= 0 else n_nodes
        order[first[node]] = i
        first[node] += 1
    for node in range(n_nodes, 0, -1):
        first[node] = first[node - 1]
    first[0] = 0


@njit(nogil=True, cache=True, error_model="numpy")
def first_face(leaf_start, squared, nearest_leaf, best):
    """The first of the lanes' faces whose squared distance is ``best``; of a leaf's last face not the repetitions.

    Args:
        leaf_start: of :class:`BodyTree`.
        squared, nearest_leaf: (8,) of :func:`keep_nearer`, m^2.
        best: m^2, least of ``squared``.
    """
    face = leaf_start[-1]
    for s in range(LANES):
        here = leaf_start[nearest_leaf[s]] + np.int32(s)
        face = min(face, here if squared[s] == best else face)
    return face


@njit(nogil=True, cache=True, error_model="numpy")
def nearest_faces(tree, points, radius, hint, face):
    """The nearest face of every point, of equally near ones the first; -1 where none is within the radius.

    A hint saves time and never changes the result: everything within rounding of the best is searched, up to MOST_NODES. Points
    whose hints are in the leaves of one node share one search of the tree for near leaves; each point then searches those leaves
    on its own.

    Args:
        tree: :class:`BodyTree`.
        points: (N, 3) metres.
        radius: metres.
        hint: (N,) int32 face that is probably near, or -1.
        face: (N,) int32 out; may be ``hint``.
    """
    triangles, boxes, leaf_start, leaf_of, shift = tree
    n, n_leaves = points.shape[0], leaf_start.shape[0] - 1
    n_nodes = (n_leaves + LANES - 1) // LANES
    nodes, lower = np.empty(STACK, np.int64), np.empty(STACK)
    squared, candidate = np.empty(LANES), np.empty(LANES)
    first, order = np.empty(n_nodes + 2, np.int64), np.empty(n, np.int64)
    best, least, most = np.empty(n), np.empty(3), np.empty(3)
    near_leaf, leaf_box = np.empty(n_leaves + 1, np.int64), np.empty((6, n_leaves + 1))
    box_squared, nearest_leaf = np.empty(n_leaves), np.empty(LANES, np.int64)
    chosen, in_hint = np.empty(n_leaves + 1, np.int64), np.empty((n, LANES))
    sort_by_node(leaf_of, hint, n_nodes, first, order)
    for node in range(n_nodes):
        if first[node + 1] == first[node]:
            continue
        least[:], most[:], reach = inf, -inf, 0.0
        for o in range(first[node], first[node + 1]):
            i = order[o]
            leaf_distances(triangles, leaf_of[hint[i]], points[i, 0], points[i, 1], points[i, 2], in_hint[o])
            nearest = least_of(in_hint[o])
            best[i] = nearest if nearest < radius * radius else radius * radius
            reach = max(reach, best[i])
            for a in range(3):
                least[a], most[a] = min(least[a], points[i, a]), max(most[a], points[i, a])
        found = list_leaves(boxes, shift, (least, most), search_limit(reach), nodes, squared, near_leaf, leaf_box)
        for o in range(first[node], first[node + 1]):
            i = order[o]
            start = leaf_of[hint[i]]
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            if found > MOST_SHARED:
                face[i] = search_tree(triangles, boxes, leaf_start, shift, (x, y, z), radius, start, (nodes, lower, squared))
                continue
            box_distances(leaf_box, found, x, y, z, box_squared)
            n_chosen, limit = 0, search_limit(best[i])
            for k in range(found):
                chosen[n_chosen] = near_leaf[k]
                n_chosen += 1 if (box_squared[k] <= limit) & (near_leaf[k] != start) else 0
            nearest_leaf[:] = start
            for k in range(n_chosen):
                leaf_distances(triangles, chosen[k], x, y, z, candidate)
                keep_nearer(candidate, chosen[k], in_hint[o], nearest_leaf)
            nearest = least_of(in_hint[o])
            face[i] = first_face(leaf_start, in_hint[o], nearest_leaf, nearest) if nearest < radius * radius else -1
    previous = -1  # neighbours in the garment's numbering are mostly neighbours in space
    for o in range(first[n_nodes], n):
        i = order[o]
        point = points[i, 0], points[i, 1], points[i, 2]
        face[i] = search_tree(triangles, boxes, leaf_start, shift, point, radius, previous, (nodes, lower, squared))
        previous = leaf_of[face[i]] if face[i] >= 0 else previous
