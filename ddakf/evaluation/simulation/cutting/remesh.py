"""Isotropic remeshing of open surfaces: edges of about one length, hems that stay where they are.

Botsch and Kobbelt, "A remeshing approach to multiresolution modeling" (2004): split edges longer than 4/3 of the target,
collapse those shorter than 4/5, flip towards six neighbours (four at a hem), move vertices to the mean of their neighbours
within the tangent plane, and put them back onto the surface.
"""

from __future__ import annotations

import math

import numpy as np

from ddakf.body import proximity
from ddakf.errors import InvalidMesh
from ddakf.mesh import Mesh, vertex_normals

LONGEST, SHORTEST = 4 / 3, 4 / 5  # of the target length
ROUNDS = 6  # of splits, collapses, flips and smoothing
SMOOTHING = 0.5  # share of the way to the mean of the neighbours
FLATTEST = 0.5  # cosine of the largest angle by which a collapse or a flip may turn a face
TRIANGLES_PER_SQUARE = 4 / np.sqrt(3)  # of the edge length, in an equilateral tiling


def remeshed(mesh: Mesh, n_vertices: int) -> Mesh:
    """The same surface with another number of vertices.

    Args:
        mesh: manifold, with or without hems; fine enough to represent the surface.
        n_vertices: wanted number, met within a few per cent.
    """
    area = _areas(mesh.vertices, mesh.faces).sum()
    length = np.sqrt(area * TRIANGLES_PER_SQUARE / (2 * n_vertices))
    surface, result = _Surface(mesh), mesh
    for _ in range(2):
        result = _remeshed(result, surface, length)
        length *= np.sqrt(result.n_vertices / n_vertices)
    return result


def _remeshed(mesh: Mesh, surface: _Surface, length: float) -> Mesh:
    edit = _Editor(mesh)
    for _ in range(ROUNDS):
        edit.split(LONGEST * length)
        edit.collapse(SHORTEST * length, LONGEST * length)
        edit.flip()
        edit.smooth(surface)
    return edit.mesh()


class _Surface:
    """Projects points onto a mesh, and points of its hems onto the hems."""

    def __init__(self, mesh: Mesh):
        self._tree = proximity.build(mesh)
        self._pose = proximity.refresh(self._tree, mesh.vertices)
        edges, count = _edges(mesh.faces)
        hems = mesh.vertices[edges[count == 1]]
        self._start, self._along = hems[:, 0], hems[:, 1] - hems[:, 0]

    def project(self, points: np.ndarray) -> np.ndarray:
        return proximity.closest_points(self._tree, self._pose, np.ascontiguousarray(points), radius=np.inf).point

    def project_to_hem(self, points: np.ndarray) -> np.ndarray:
        squared = (self._along**2).sum(axis=1)
        result = np.empty_like(points)
        for i, point in enumerate(points):
            share = np.clip(((point - self._start) * self._along).sum(axis=1) / squared, 0, 1)
            nearest = self._start + share[:, None] * self._along
            result[i] = nearest[((nearest - point) ** 2).sum(axis=1).argmin()]
        return result


class _Editor:
    """A triangle mesh that can be changed edge by edge: faces by number, and of every vertex the faces around it."""

    def __init__(self, mesh: Mesh):
        self.points = [np.array(vertex) for vertex in mesh.vertices]
        self.faces: dict[int, tuple[int, int, int]] = {}
        self.around: list[set[int]] = [set() for _ in self.points]
        self._next = 0
        for face in mesh.faces.tolist():
            self._add(tuple(face))

    def mesh(self) -> Mesh:
        faces = np.array(list(self.faces.values()))
        used, flat = np.unique(faces, return_inverse=True)
        return Mesh(np.array(self.points)[used], flat.reshape(-1, 3))

    def split(self, longest: float) -> None:
        """Halves every edge that is too long, the longest first; a new vertex lies on the chord until it is projected."""
        while True:
            long = [(-length, edge) for edge in self._edges() if (length := self._length(*edge)) > longest]
            if not long:
                return
            for _, (a, b) in sorted(long):
                self._halve(a, b)

    def collapse(self, shortest: float, longest: float) -> None:
        """Removes edges that are too short, the shortest first, unless that would make a long edge, turn a face over, or
        change the topology."""
        short = sorted((length, edge) for edge in self._edges() if (length := self._length(*edge)) < shortest)
        gone: set[int] = set()
        for _, (a, b) in short:
            if a not in gone and b not in gone and self._length(a, b) < shortest:
                removed = self._merge(a, b, longest)
                if removed is not None:
                    gone.add(removed)

    def flip(self) -> None:
        """Turns inner edges where that brings the four vertices nearer to six neighbours, or four at a hem."""
        hem = self._hem()
        valence = [len(self._neighbours(vertex)) if faces else 0 for vertex, faces in enumerate(self.around)]
        wish = [4 if vertex in hem else 6 for vertex in range(len(self.points))]
        for a, b in self._edges():
            faces = self.around[a] & self.around[b]
            if len(faces) != 2:
                continue
            c, d = (self._opposite(face, a, b) for face in self._oriented(faces, a, b))
            change = {a: -1, b: -1, c: 1, d: 1}
            before = sum((valence[v] - wish[v]) ** 2 for v in change)
            after = sum((valence[v] + step - wish[v]) ** 2 for v, step in change.items())
            if after < before and self._turn(a, b, c, d):
                for vertex, step in change.items():
                    valence[vertex] += step

    def smooth(self, surface: _Surface) -> None:
        """Moves every vertex within its tangent plane towards its neighbours' mean; those of a hem along the hem."""
        mesh_faces = np.array(list(self.faces.values()))
        points = np.array(self.points)
        normals = vertex_normals(points, mesh_faces)
        edges, count = _edges(mesh_faces)
        hem = np.zeros(len(points), bool)
        hem[edges[count == 1]] = True
        inner = _step_to_mean(points, edges, ~hem)
        inner -= (inner * normals).sum(axis=1, keepdims=True) * normals
        along = _step_to_mean(points, edges[count == 1], hem)
        moved = points + SMOOTHING * (inner + along)
        used = np.unique(mesh_faces)
        inside, border = used[~hem[used]], used[hem[used]]
        moved[inside] = surface.project(moved[inside])
        if len(border):
            moved[border] = surface.project_to_hem(moved[border])
        self.points = list(moved)

    def _add(self, face: tuple[int, int, int]) -> None:
        self.faces[self._next] = face
        for vertex in face:
            self.around[vertex].add(self._next)
        self._next += 1

    def _remove(self, number: int) -> tuple[int, int, int]:
        face = self.faces.pop(number)
        for vertex in face:
            self.around[vertex].discard(number)
        return face

    def _edges(self) -> list[tuple[int, int]]:
        return [tuple(edge) for edge in _edges(np.array(list(self.faces.values())))[0].tolist()]

    def _length(self, a: int, b: int) -> float:
        return math.dist(self.points[a], self.points[b])

    def _neighbours(self, vertex: int) -> set[int]:
        return {other for face in self.around[vertex] for other in self.faces[face]} - {vertex}

    def _hem(self) -> set[int]:
        edges, count = _edges(np.array(list(self.faces.values())))
        return set(np.unique(edges[count == 1]).tolist())

    def _opposite(self, face: int, a: int, b: int) -> int:
        return next(vertex for vertex in self.faces[face] if vertex not in (a, b))

    def _oriented(self, faces: set[int], a: int, b: int) -> list[int]:
        """The two faces at an edge, first the one that runs from a to b."""
        return sorted(faces, key=lambda number: self._after(self.faces[number], a) != b)

    def _after(self, face: tuple[int, int, int], vertex: int) -> int:
        return face[(face.index(vertex) + 1) % 3]

    def _halve(self, a: int, b: int) -> None:
        middle = len(self.points)
        self.points.append((self.points[a] + self.points[b]) / 2)
        self.around.append(set())
        for number in self.around[a] & self.around[b]:
            face = self._remove(number)
            self._add(tuple(middle if vertex == a else vertex for vertex in face))
            self._add(tuple(middle if vertex == b else vertex for vertex in face))

    def _merge(self, a: int, b: int, longest: float) -> int | None:
        """Collapses an edge; returns the removed vertex, or None if the collapse is not allowed."""
        shared = self.around[a] & self.around[b]
        neighbours_a, neighbours_b = self._neighbours(a), self._neighbours(b)
        if len(neighbours_a & neighbours_b) != len(shared):  # the link condition: topology would change
            return None
        hem_a, hem_b = self._at_hem(a), self._at_hem(b)
        if hem_a and hem_b and len(shared) == 2:  # an inner edge between two hems
            return None
        if hem_a and not hem_b:
            remaining, removed, place = a, b, self.points[a]
        elif hem_b and not hem_a:
            remaining, removed, place = b, a, self.points[b]
        else:
            remaining, removed, place = a, b, (self.points[a] + self.points[b]) / 2
        rest = (neighbours_a | neighbours_b) - {a, b}
        if len(rest) < 3 or any(math.dist(self.points[other], place) > longest for other in rest):
            return None
        changed = (self.around[a] | self.around[b]) - shared
        if any(self._would_turn(self.faces[number], {a: place, b: place}) for number in changed):
            return None
        for number in shared:
            self._remove(number)
        for number in list(self.around[removed]):
            self._add(tuple(remaining if vertex == removed else vertex for vertex in self._remove(number)))
        self.points[remaining] = place
        return removed

    def _at_hem(self, vertex: int) -> bool:
        return len(self._neighbours(vertex)) != len(self.around[vertex])

    def _would_turn(self, face: tuple[int, int, int], places: dict[int, np.ndarray]) -> bool:
        before = _normal(*(self.points[vertex] for vertex in face))
        return _apart(before, _normal(*(places.get(vertex, self.points[vertex]) for vertex in face)))

    def _turn(self, a: int, b: int, c: int, d: int) -> bool:
        """Replaces the edge a-b of the faces (a, b, c) and (b, a, d) by c-d."""
        if self.around[c] & self.around[d]:
            return False
        old = _normal(*(self.points[v] for v in (a, b, c))), _normal(*(self.points[v] for v in (b, a, d)))
        mean = tuple(x + y for x, y in zip(*old, strict=True))
        new = ((c, a, d), (d, b, c))
        if any(_apart(mean, _normal(*(self.points[vertex] for vertex in face))) for face in new):
            return False
        for number in self.around[a] & self.around[b]:
            self._remove(number)
        for face in new:
            self._add(face)
        return True


def cut(mesh: Mesh, field: np.ndarray) -> Mesh:
    """The part of a surface where a field is positive; faces that it crosses are cut along its zero line.

    Args:
        mesh: a surface.
        field: (V,) interpolated linearly over the faces.

    Raises:
        InvalidMesh: the field is positive nowhere.
    """
    keep = field > 0
    vertices, crossing, faces = list(mesh.vertices), {}, []

    def between(a: int, b: int) -> int:
        key = (min(a, b), max(a, b))
        if key not in crossing:
            share = field[a] / (field[a] - field[b])
            crossing[key] = len(vertices)
            vertices.append(mesh.vertices[a] + share * (mesh.vertices[b] - mesh.vertices[a]))
        return crossing[key]

    for face in mesh.faces.tolist():
        inside = [corner for corner in range(3) if keep[face[corner]]]
        if len(inside) == 3:
            faces.append(face)
        elif len(inside) == 1:
            a, b, c = (face[(inside[0] + step) % 3] for step in range(3))
            faces.append([a, between(a, b), between(a, c)])
        elif len(inside) == 2:
            lost = next(corner for corner in range(3) if corner not in inside)
            c, a, b = (face[(lost + step) % 3] for step in range(3))
            first, second = between(a, c), between(b, c)
            faces.extend(([a, b, second], [a, second, first]))
    if not faces:
        raise InvalidMesh("garment", "a part of the surface", "nothing left after cutting")
    return Mesh.cleaned(np.array(vertices), np.array(faces), alike=0.0)[0]


def largest_part(mesh: Mesh) -> Mesh:
    """The connected part with the most vertices."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    a, b = mesh.edges.T
    label = connected_components(coo_matrix((np.ones(len(a)), (a, b)), (mesh.n_vertices, mesh.n_vertices)), False)[1]
    largest = label == np.bincount(label).argmax()
    return Mesh.cleaned(mesh.vertices, mesh.faces[largest[mesh.faces[:, 0]]], alike=0.0)[0]


def subdivided(mesh: Mesh) -> Mesh:
    """Every face in four, the surface unchanged."""
    edges, flat = np.unique(_sorted_edges(mesh.faces), axis=0, return_inverse=True)
    ab, bc, ca = flat.reshape(3, -1) + mesh.n_vertices
    a, b, c = mesh.faces.T
    faces = np.concatenate([np.column_stack(t) for t in ((a, ab, ca), (b, bc, ab), (c, ca, bc), (ab, bc, ca))])
    return Mesh(np.concatenate([mesh.vertices, mesh.vertices[edges].mean(axis=1)]), faces)


def _step_to_mean(points: np.ndarray, edges: np.ndarray, moving: np.ndarray) -> np.ndarray:
    """(V, 3) from every moving vertex to the mean of its neighbours along the given edges."""
    total, count = np.zeros_like(points), np.zeros(len(points))
    for one, other in (edges.T, edges.T[::-1]):
        np.add.at(total, one, points[other])
        np.add.at(count, one, 1)
    step = np.zeros_like(points)
    moving = moving & (count > 0)
    step[moving] = total[moving] / count[moving, None] - points[moving]
    return step


def _edges(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Each undirected edge once (E, 2), and how many faces have it (E,)."""
    base = int(faces.max()) + 1
    keys, count = np.unique(_sorted_edges(faces) @ np.array([base, 1]), return_counts=True)
    return np.column_stack(np.divmod(keys, base)), count


def _sorted_edges(faces: np.ndarray) -> np.ndarray:
    return np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1)


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2


def _normal(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> tuple[float, float, float]:
    """Twice the area times the unit normal of a triangle."""
    (ax, ay, az), (bx, by, bz), (cx, cy, cz) = a.tolist(), b.tolist(), c.tolist()
    ux, uy, uz, vx, vy, vz = bx - ax, by - ay, bz - az, cx - ax, cy - ay, cz - az
    return uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx


def _apart(one: tuple[float, float, float], other: tuple[float, float, float]) -> bool:
    """True if two directions differ by more than a face may turn."""
    product, squared = (sum(x * y for x, y in zip(a, b, strict=True)) for a, b in ((one, other), (one, one)))
    return product < FLATTEST * (squared * sum(x * x for x in other)) ** 0.5
