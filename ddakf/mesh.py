"""Triangle meshes: topology and rest shape, constant for the life of a tracker."""

from __future__ import annotations

import hashlib
import itertools
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ddakf.errors import InvalidMesh

MAX_COORDINATE = 1e4  # m: what is farther away is in another unit
ALIKE = 0.01  # mean edges
MIN_FACE_AREA = 1e-12  # m^2: a triangle below a square micrometre has no usable normal


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh; for a garment, ``vertices`` are the rest shape.

    Args:
        vertices: (V, 3) positions in metres, finite.
        faces: (F, 3) vertex indices, counter-clockwise seen from outside.

    Raises:
        InvalidMesh: wrong shape or dtype, an index out of range, a non-finite vertex, no area; or unreferenced vertices,
            duplicate faces, degenerate faces, edges with more than two faces, faces wound against their neighbours, or a
            coincident twin of every other vertex, as triangles that share none have; which :meth:`cleaned` repairs.
    """

    vertices: np.ndarray
    faces: np.ndarray

    def __post_init__(self) -> None:
        vertices, faces = _checked_arrays(self.vertices, self.faces)
        object.__setattr__(self, "vertices", vertices)
        object.__setattr__(self, "faces", faces)
        defects = _defects(vertices, faces)
        if any(defects.values()):
            counts = ", ".join(f"{count} {name}" for name, count in defects.items() if count)
            raise InvalidMesh("mesh", "a clean mesh (Mesh.cleaned() or clean=true repairs it)", counts)
        vertices.setflags(write=False)
        faces.setflags(write=False)

    @classmethod
    def cleaned(cls, vertices, faces, *, alike: float = ALIKE) -> tuple[Mesh, np.ndarray]:
        """Repairs what exported garments often have, and says which vertices remain.

        Joins triangles that share no vertices, both sides of a sheet, and open edges at the place of another. Removes
        degenerate and duplicate faces, at every edge with more than two faces the smallest surplus ones, and then the vertices
        that no face uses. Winds all faces of a piece as most of them.

        Args:
            vertices: (V, 3) metres.
            faces: (F, 3) vertex indices.
            alike: mean edges within which the ends of open edges are at one place, as files round coordinates.

        Returns:
            The mesh, and the vertex map (V',) int: vertex i of the mesh is vertex ``map[i]`` of the input.

        Raises:
            InvalidMesh: what cannot be repaired: shapes, indices, non-finite vertices, nothing left.
        """
        vertices, faces = _checked_arrays(vertices, faces)
        first = _first_alike(vertices)
        if _apart(first):
            faces = first[faces]
        else:
            faces = _seamless(_one_sided(faces, first), _first_beside(vertices, faces, alike))
        faces = faces[~_degenerate(vertices, faces)]
        faces = faces[~_repeated(faces, len(vertices))]
        faces = _without_surplus_faces(vertices, faces)
        if len(faces) == 0:
            raise InvalidMesh("mesh.faces", "at least one face with an area", "none after cleaning")
        if _wound_apart(faces, len(vertices)):
            faces = _wound_alike(faces, len(vertices))
        used = _used(faces, len(vertices))
        kept, number = np.flatnonzero(used), np.cumsum(used) - 1
        return cls(vertices[kept], number[faces]), kept

    @property
    def n_vertices(self) -> int:
        return len(self.vertices)

    @property
    def n_faces(self) -> int:
        return len(self.faces)

    @cached_property
    def digest(self) -> bytes:
        """The same for meshes of the same vertices and faces alone."""
        return hashlib.blake2b(self.vertices.tobytes() + self.faces.tobytes(), digest_size=16).digest()

    @cached_property
    def edges(self) -> np.ndarray:
        """(E, 2) int64, each undirected edge once, first index smaller, in lexicographic order."""
        return _edges(self.faces, self.n_vertices)[0]

    @cached_property
    def boundary_vertices(self) -> np.ndarray:
        """(V,) bool: vertices on an open boundary (hem, cuff, neck)."""
        edges, count = _edges(self.faces, self.n_vertices)
        on_boundary = np.zeros(self.n_vertices, bool)
        on_boundary[edges[count == 1]] = True
        return on_boundary

    @cached_property
    def split_edges(self) -> int:
        """Number of open edges at the place of another, as a file has that splits vertices along the seams of a texture."""
        return int(np.count_nonzero(_seams(self.faces, _first_beside(self.vertices, self.faces, ALIKE))[1]))

    @cached_property
    def size(self) -> float:
        """Longest side of the box around it, metres."""
        return float(np.ptp(self.vertices, axis=0).max())

    @cached_property
    def edge_length(self) -> float:
        """Mean length of the edges, metres."""
        ends = self.vertices[self.edges]
        return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).mean())


def vertex_normals(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Area-weighted unit normals (V, 3); zero where the adjacent faces have no area."""
    corners = vertices[faces]
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals = np.zeros_like(vertices)
    for corner in range(3):
        np.add.at(normals, faces[:, corner], face_normals)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def _checked_arrays(vertices, faces) -> tuple[np.ndarray, np.ndarray]:
    given = vertices, faces
    vertices, faces = _rectangular("mesh.vertices", vertices), _rectangular("mesh.faces", faces)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or vertices.dtype.kind not in "fiu":
        raise InvalidMesh("mesh.vertices", "numbers of shape (V, 3)", _described(vertices, given[0]))
    if faces.ndim != 2 or faces.shape[1] != 3 or faces.dtype.kind not in "iu":
        raise InvalidMesh("mesh.faces", "integers of shape (F, 3)", _described(faces, given[1]))
    if len(vertices) == 0 or len(faces) == 0:
        raise InvalidMesh("mesh", "at least one face", f"{len(vertices)} vertices and {len(faces)} faces")
    vertices = np.array(vertices, np.float64, order="C")
    faces = np.array(faces, np.int64, order="C")
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise InvalidMesh("mesh.vertices", "finite numbers", f"{bad.sum()} non-finite, the first at {bad.argmax()}")
    if np.abs(vertices).max() > MAX_COORDINATE:
        raise InvalidMesh("mesh.vertices", f"metres within {MAX_COORDINATE:g} of the origin", f"{np.abs(vertices).max():g}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        worst = faces.min() if faces.min() < 0 else faces.max()
        raise InvalidMesh("mesh.faces", f"indices in [0, {len(vertices)})", str(worst))
    if not (_areas(vertices, faces) > MIN_FACE_AREA).any():
        raise InvalidMesh("mesh", "a surface with an area", "only degenerate faces")
    return vertices, faces


def _described(array: np.ndarray, given) -> str:
    return f"{array.dtype} of shape {array.shape}" if array.ndim else type(given).__name__


def _rectangular(field: str, values) -> np.ndarray:
    try:
        return np.asarray(values)
    except ValueError:
        raise InvalidMesh(field, "rows of three numbers", "rows of different lengths") from None


def _defects(vertices: np.ndarray, faces: np.ndarray) -> dict[str, int]:
    n = len(vertices)
    return {
        "unreferenced vertices": n - np.count_nonzero(_used(faces, n)),
        "duplicate faces": np.count_nonzero(_repeated(faces, n)),
        "degenerate faces": np.count_nonzero(_degenerate(vertices, faces)),
        "non-manifold edges": np.count_nonzero(_edges(faces, n)[1] > 2),
        "edges between faces of opposite winding": _needlessly_wound_apart(faces, n),
        "vertices at the place of another": _apart(_first_alike(vertices)),
    }


def _first_alike(vertices: np.ndarray) -> np.ndarray:
    """(V,) the first vertex at the place of each."""
    order = np.lexsort(vertices.T)  # stable: of vertices at one place the first comes first
    new = np.append(True, (np.diff(vertices[order], axis=0) != 0.0).any(axis=1))
    first = np.empty(len(vertices), np.int64)
    first[order] = order[new][np.cumsum(new) - 1]
    return first


def _first_beside(vertices: np.ndarray, faces: np.ndarray, alike: float) -> np.ndarray:
    """(V,) the first vertex at the place of each; of the ends of open edges the first that is so many mean edges away, or less.

    Points that are nearer than half a cell share it in one of eight grids.
    """
    n, first = len(vertices), _first_alike(vertices)
    edges, count = _edges(faces, n)
    ends = np.unique(edges[count == 1])
    if len(ends) == 0 or alike == 0.0:
        return first
    length = float(np.linalg.norm(vertices[edges[:, 1]] - vertices[edges[:, 0]], axis=1).mean())
    place = vertices[ends] / (2.0 * alike * length)
    cells = [_first_alike(np.floor(place + shift)) for shift in itertools.product((0.0, 0.5), repeat=3)]
    nearby, before = first[ends], np.empty(0)
    while not np.array_equal(nearby, before):
        before = nearby
        for cell in cells:
            least = nearby.copy()
            np.minimum.at(least, cell, nearby)
            nearby = least[cell]
    first[ends] = nearby
    return first


def _apart(first: np.ndarray) -> int:
    """Number of vertices at the place of another, where they are half of all or more."""
    twins = np.count_nonzero(first != np.arange(len(first)))
    return twins if 2 * twins >= len(first) else 0


def _seams(faces: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(B, 2) open edges, and whether another one lies at the same place (B,), by the first vertex at each place."""
    edges, count = _edges(faces, len(first))
    edges = edges[(count == 1) & (first[edges[:, 0]] != first[edges[:, 1]])]
    ends = np.sort(first[edges], axis=1)
    _, place, sharing = np.unique(ends @ [len(first), 1], return_inverse=True, return_counts=True)
    return edges, sharing[place] > 1


def _seamless(faces: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The faces with the ends of such edges joined."""
    edges, seam = _seams(faces, first)
    joined, ends = np.arange(len(first)), edges[seam]
    joined[ends] = first[ends]
    return joined[faces]


def _one_sided(faces: np.ndarray, first: np.ndarray) -> np.ndarray:
    """The faces with the corners of those joined that lie in the place of another one: of both sides of a sheet."""
    _, place, sharing = np.unique(np.sort(first[faces], axis=1), axis=0, return_inverse=True, return_counts=True)
    joined, both = np.arange(len(first)), faces[sharing[place.ravel()] > 1]
    joined[both] = first[both]
    return joined[faces]


def _wound_apart(faces: np.ndarray, n: int) -> int:
    """Number of edges that two faces run through in the same direction."""
    count = np.unique(faces.T.ravel() * n + faces[:, [1, 2, 0]].T.ravel(), return_counts=True)[1]
    return int(np.count_nonzero(count == 2))


def _needlessly_wound_apart(faces: np.ndarray, n: int) -> int:
    """The same number, less that of edges which stay so however the faces are wound: a surface with one side has some."""
    apart = _wound_apart(faces, n)
    return max(0, apart - _wound_apart(_wound_alike(faces, n), n)) if apart else 0


def _wound_alike(faces: np.ndarray, n: int) -> np.ndarray:
    """The faces of each piece wound as most of them; of a surface with one side some edges stay as they are."""
    key, forward = _edge_keys(faces, n), (faces < faces[:, [1, 2, 0]]).T.ravel()
    order = np.argsort(key, kind="stable")
    pairs = order[np.flatnonzero(key[order[1:]] == key[order[:-1]])[:, None] + [0, 1]]
    beside: list[list[tuple[int, bool]]] = [[] for _ in faces]
    for a, b in pairs.tolist():
        other = bool(forward[a] == forward[b])
        beside[a % len(faces)].append((b % len(faces), other))
        beside[b % len(faces)].append((a % len(faces), other))
    turned, seen = np.zeros(len(faces), bool), np.zeros(len(faces), bool)
    for begin in range(len(faces)):
        piece = [] if seen[begin] else [begin]
        seen[begin] = True
        for face in piece:
            for near, other in beside[face]:
                if not seen[near]:
                    seen[near], turned[near] = True, turned[face] != other
                    piece.append(near)
        if 2 * np.count_nonzero(turned[piece]) > len(piece):
            turned[piece] = ~turned[piece]
    return np.where(turned[:, None], faces[:, ::-1], faces)


def _areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    corners = vertices[faces]
    return 0.5 * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)


def _degenerate(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    return _areas(vertices, faces) <= MIN_FACE_AREA


def _used(faces: np.ndarray, n: int) -> np.ndarray:
    """(n,) bool: vertices of a face."""
    return np.bincount(faces.ravel(), minlength=n) > 0


def _repeated(faces: np.ndarray, n: int) -> np.ndarray:
    """(F,) bool: faces with the same three of n vertices as one before them."""
    corners = np.sort(faces, axis=1)
    pair, last = corners[:, 0] * n + corners[:, 1], corners[:, 2]
    order = np.lexsort((last, pair))
    repeated = np.zeros(len(faces), bool)
    repeated[order[1:]] = (np.diff(pair[order]) == 0) & (np.diff(last[order]) == 0)
    return repeated


def _edges(faces: np.ndarray, n: int) -> tuple[np.ndarray, np.ndarray]:
    """(E, 2) undirected edges between n vertices in lexicographic order, and how many faces each has (E,)."""
    key, count = np.unique(_edge_keys(faces, n), return_counts=True)
    return np.stack(np.divmod(key, n), axis=1), count


def _edge_keys(faces: np.ndarray, n: int) -> np.ndarray:
    """(3F,) a number for each undirected edge of each face, which sorts as its ends do; far faster than rows of two."""
    start, end = faces.T.ravel(), faces[:, [1, 2, 0]].T.ravel()
    return np.minimum(start, end) * n + np.maximum(start, end)


def _without_surplus_faces(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Of the faces at an edge keeps the two largest."""
    area = _areas(vertices, faces)
    key = _edge_keys(faces, len(vertices))
    face_of = np.tile(np.arange(len(faces)), 3)
    order = np.lexsort((-area[face_of], key))
    start = np.searchsorted(key[order], key[order])
    rank = np.arange(len(order)) - start
    surplus = np.zeros(len(faces), bool)
    surplus[face_of[order[rank >= 2]]] = True
    return faces[~surplus]
