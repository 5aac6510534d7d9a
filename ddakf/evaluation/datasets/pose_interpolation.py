"""Interpolation between two poses of one mesh, by which limbs turn instead of shrinking.

Every triangle's deformation from the first pose to the second is split into a rotation and a stretch (polar decomposition of its
deformation gradient; Sumner and Popovic 2004, "Deformation transfer for triangle meshes", section 3.1). The rotation grows by its
angle, the stretch linearly (Alexa, Cohen-Or and Levin 2000, "As-rigid-as-possible shape interpolation"), and the vertices are
those whose gradients are closest to that (a Poisson equation; Xu, Zhang, Wang and Bao 2005, "Poisson shape interpolation").

A rotation is known up to whole turns about its axis only. Its rotation vector is the one nearest to that of a neighbouring
triangle, along a spanning tree of the least differences, so that a limb that turns by more than 180 degrees turns as one (Gao et
al. 2016, "Efficient and flexible deformation representation for data-driven surface modeling", section 4).
"""

from __future__ import annotations

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from ddakf.errors import InvalidArgument
from ddakf.mesh import Mesh

LEAST_DIFFERENCE = 1e-6  # rad: a spanning tree takes edges of weight 0 for absent


def minimum_jerk(time: float) -> float:
    """10 t^3 - 15 t^4 + 6 t^5: how far a reach of the arm is at the share t of its time, speed and acceleration 0 at both ends
    and the highest speed 1.875 times the mean (Flash and Hogan 1985, "The coordination of arm movements")."""
    return time**3 * (10 - 15 * time + 6 * time**2)


class Interpolation:
    """The path from one pose to another.

    Args:
        mesh: in the first pose, metres.
        last: (V, 3) the vertices in the last pose, metres.

    Raises:
        InvalidArgument: the poses do not fit each other.
    """

    def __init__(self, mesh: Mesh, last: np.ndarray):
        last = np.asarray(last, np.float64)
        if last.shape != mesh.vertices.shape:
            raise InvalidArgument("last", f"shape {mesh.vertices.shape} as the first pose", str(last.shape))
        self._first, self._last = mesh.vertices, last
        frame, area = _frames(mesh.vertices, mesh.faces)
        inverse = np.linalg.inv(frame)
        gradient = _gradient(inverse, mesh.faces, mesh.n_vertices)
        self._divergence = (gradient.T * np.repeat(area, 3)).tocsr()
        edges = sparse.coo_array((np.ones(len(mesh.edges)), mesh.edges.T), (mesh.n_vertices,) * 2)
        self._component = connected_components(edges, directed=False)[1]
        # the gradients leave the place of each connected component open: one vertex is fixed, and the component moved afterwards
        anchor = np.zeros(mesh.n_vertices)
        anchor[np.unique(self._component, return_index=True)[1]] = area.mean()
        self._factor = splu((self._divergence @ gradient + sparse.diags_array(anchor)).tocsc())
        rotation, self._stretch = _polar(_frames(last, mesh.faces)[0] @ inverse)
        self.turn = _unwrapped(Rotation.from_matrix(rotation), mesh)  #: (F, 3) rotation vector of every triangle, rad

    def __call__(self, share: float) -> np.ndarray:
        """(V, 3) vertices at a share of the way, metres; those of the first pose at 0 and of the last one at 1."""
        rotation = Rotation.from_rotvec(share * self.turn).as_matrix()
        wanted = rotation @ ((1 - share) * np.eye(3) + share * self._stretch)
        vertices = self._factor.solve(self._divergence @ wanted.transpose(0, 2, 1).reshape(-1, 3))
        return vertices + self._shift(vertices, (1 - share) * self._first + share * self._last)

    def _shift(self, vertices: np.ndarray, other: np.ndarray) -> np.ndarray:
        """(V, 3) by which every connected component is to be moved so that its centroid is that of another pose."""
        count = np.bincount(self._component)
        off = [np.bincount(self._component, (other - vertices)[:, k]) / count for k in range(3)]
        return np.column_stack(off)[self._component]


def _frames(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3, 3) with two edges and the normal, as long as the root of the doubled area, in the columns; and (F,) areas."""
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    normal = np.cross(b - a, c - a)
    doubled = np.linalg.norm(normal, axis=1)
    return np.stack([b - a, c - a, normal / np.sqrt(np.maximum(doubled, 1e-30))[:, None]], axis=2), doubled / 2


def _polar(matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3, 3) rotations R and symmetric S with R S = M."""
    u, sigma, vt = np.linalg.svd(matrix)
    sign = np.sign(np.linalg.det(u @ vt))
    u[:, :, 2] *= sign[:, None]
    sigma[:, 2] *= sign
    return u @ vt, vt.transpose(0, 2, 1) @ (sigma[:, :, None] * vt)


def _gradient(inverse: np.ndarray, faces: np.ndarray, n_vertices: int) -> sparse.csr_array:
    """(3 F, V): row 3 f + k is the derivative of a function of the vertices along axis k in triangle f.

    Args:
        inverse: (F, 3, 3) of the triangles' frames.
    """
    rows = (3 * np.arange(len(faces))[:, None] + np.arange(3)).ravel()
    of_corner = [-inverse[:, 0] - inverse[:, 1], inverse[:, 0], inverse[:, 1]]
    columns = np.concatenate([np.repeat(faces[:, corner], 3) for corner in range(3)])
    entries = np.concatenate([entry.ravel() for entry in of_corner])
    return sparse.csr_array((entries, (np.tile(rows, 3), columns)), (3 * len(faces), n_vertices))


def _face_pairs(faces: np.ndarray) -> np.ndarray:
    """(n, 2) faces that share an edge."""
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)
    face = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort(edges.T)
    same = (edges[order[1:]] == edges[order[:-1]]).all(axis=1)
    return np.column_stack([face[order[:-1]][same], face[order[1:]][same]])


def _unwrapped(rotation: Rotation, mesh: Mesh) -> np.ndarray:
    """(F, 3) rotation vectors without jumps of whole turns between neighbours. The middle face has the shortest one."""
    pairs = _face_pairs(mesh.faces)
    difference = (rotation[pairs[:, 0]].inv() * rotation[pairs[:, 1]]).magnitude() + LEAST_DIFFERENCE
    graph = sparse.csr_array((difference, pairs.T), (mesh.n_faces,) * 2)
    tree = minimum_spanning_tree(graph)
    component = connected_components(graph, directed=False)[1]
    vectors = rotation.as_rotvec()
    off_middle = np.linalg.norm(mesh.vertices[mesh.faces].mean(axis=1) - mesh.vertices.mean(axis=0), axis=1)
    for part in range(component.max() + 1):
        members = np.flatnonzero(component == part)
        order, before = breadth_first_order(tree, members[off_middle[members].argmin()], directed=False)
        for face in order[1:]:
            vectors[face] = _nearest_turn(vectors[face], vectors[before[face]])
    return vectors


def _nearest_turn(vector: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The rotation vector of the same rotation that is nearest to another vector."""
    angle = np.linalg.norm(vector)
    if angle == 0:
        return vector
    axis = vector / angle
    return (angle + 2 * np.pi * np.rint((axis @ other - angle) / (2 * np.pi))) * axis
