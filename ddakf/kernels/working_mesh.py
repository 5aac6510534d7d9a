"""Working mesh: seeds spread over a fine mesh, and the template carried along by the working mesh."""

import numpy as np
from numba import njit

from ddakf.kernels.triangles import closest_on_triangle


@njit(nogil=True, cache=True, error_model="numpy")
def spread_seeds(order, start, neighbour, length, radius, chosen):
    """Chooses in turn each vertex that no chosen one is near, measured along the edges.

    Args:
        order: (V,) vertices in the order of choice.
        start, neighbour, length: one-rings in compressed rows, and the lengths of the edges.
        radius: distance that chosen vertices keep, in the unit of the lengths.
        chosen: (V,) bool in out; those chosen before stay.
    """
    n = order.shape[0]
    distance = np.full(n, np.inf)
    waiting, queued = np.empty(n, np.int64), np.zeros(n, np.bool_)
    for k in range(2 * n):
        i = order[k % n]
        if k < n and not chosen[i]:
            continue
        if k >= n and (chosen[i] or distance[i] < radius):
            continue
        chosen[i], distance[i] = True, 0.0
        head, count = 0, 1
        waiting[0], queued[i] = i, True
        while count > 0:  # shortest paths within the radius, by label correction
            a = waiting[head]
            head, count = (head + 1) % n, count - 1
            queued[a] = False
            for e in range(start[a], start[a + 1]):
                b, through = neighbour[e], distance[a] + length[e]
                if through < radius and through < distance[b]:
                    distance[b] = through
                    if not queued[b]:
                        waiting[(head + count) % n] = b
                        count, queued[b] = count + 1, True


@njit(nogil=True, cache=True, error_model="numpy")
def carry(rest, position, rotation, template, corner, share, carried):
    """Carries the template's vertices along: p_i = sum_k s_ik (x_k + Q_k (t_i - w_k)) over the corners k of its face.

    Args:
        rest, position, rotation: (W, 3) w and x, metres, (W, 3, 3) Q, the working mesh at rest and in a frame.
        template: (V, 3) t, the template at rest, metres.
        corner, share: (V, 3) corners and barycentric coordinates s.
        carried: (V, 3) out, p, metres.
    """
    for i in range(template.shape[0]):
        for a in range(3):
            carried[i, a] = 0.0
        for k in range(3):
            j, s = corner[i, k], share[i, k]
            x, y, z = template[i, 0] - rest[j, 0], template[i, 1] - rest[j, 1], template[i, 2] - rest[j, 2]
            for a in range(3):
                turned = rotation[j, a, 0] * x + rotation[j, a, 1] * y + rotation[j, a, 2] * z
                carried[i, a] += s * (position[j, a] + turned)


@njit(nogil=True, cache=True, error_model="numpy")
def spread(values, corner, share, interpolated):
    """Interpolates values at the working vertices linearly over its faces.

    Args:
        values: (W, C).
        corner, share: (V, 3) corners and barycentric coordinates.
        interpolated: (V, C) out.
    """
    for i in range(corner.shape[0]):
        a, b, c = corner[i, 0], corner[i, 1], corner[i, 2]
        s, t, u = share[i, 0], share[i, 1], share[i, 2]
        for k in range(values.shape[1]):
            interpolated[i, k] = s * values[a, k] + t * values[b, k] + u * values[c, k]


@njit(nogil=True, cache=True, error_model="numpy")
def find_corners(points, vertices, faces, face_start, face_of, owner, corner, share):
    """Finds the point of the working mesh that is closest to each vertex of the template, on the faces around its owner.

    Args:
        points: (V, 3) of the template, metres.
        vertices, faces: (W, 3) metres, (F, 3) of the working mesh.
        face_start, face_of: faces around each of its vertices, in compressed rows.
        owner: (V,) vertex of the working mesh.
        corner: (V, 3) int32 out, corners of that face.
        share: (V, 3) out, barycentric coordinates.
    """
    for i in range(points.shape[0]):
        nearest = np.inf
        for e in range(face_start[owner[i]], face_start[owner[i] + 1]):
            f = face_of[e]
            a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
            p = points[i, 0] - vertices[a, 0], points[i, 1] - vertices[a, 1], points[i, 2] - vertices[a, 2]
            u = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1], vertices[b, 2] - vertices[a, 2]
            v = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1], vertices[c, 2] - vertices[a, 2]
            s, t = closest_on_triangle(p, u, v)
            squared = 0.0
            for k in range(3):
                squared += (p[k] - s * u[k] - t * v[k]) ** 2
            if squared < nearest:
                nearest = squared
                corner[i, 0], corner[i, 1], corner[i, 2] = a, b, c
                share[i, 0], share[i, 1], share[i, 2] = 1.0 - s - t, s, t
