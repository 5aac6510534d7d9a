"""Remeshing: an even mesh on the surface of another, whatever the triangles of that.

Seeds are spread over the surface and relaxed to the centroids of their geodesic Voronoi regions (Lloyd 1982); the regions' dual
is the mesh (Valette and Chassery 2004, "Approximated centroidal Voronoi diagrams for uniform polygonal mesh coarsening").
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from ddakf.errors import InvalidMesh
from ddakf.garment import geodesic
from ddakf.garment.geodesic import Graph
from ddakf.kernels import working_mesh as kernels
from ddakf.mesh import Mesh

FINER = 2.5  # edges of the mesh that carries the regions are shorter than the wanted ones by this factor, at least
MOST_SPLITS = 300_000  # vertices that splitting adds, at most; an even mesh of 5,000 vertices takes a tenth
PACKING = 0.9  # distance that seeds keep, over the mean edge that they give when relaxed
RELAXATIONS = 8  # afterwards the lengths of the edges hardly change
LOOP_EDGES = 12  # round an opening, at least; a narrower one is surrounded by shorter edges
GRADING = 0.3  # growth of the edges with the distance from a narrow opening
TRIES = 8  # with ever shorter edges, until pieces, openings and handles of the mesh are kept
SHORTER = 0.75  # edges of the next try where the surface was torn, or everywhere if it was nowhere and yet has changed
MOST_LOST = 20  # torn places with which an even mesh is still better than one of uneven triangles
MOST_TORN = 50  # places; a whole body with fingers has ten, and each try takes a second
SHORTEST_OF_ALL = 0.5  # longest edge of a try over the wanted one, at least
PINHOLE = 1e-3  # of the surface: a round opening of less area is closed, if it is no larger than a triangle either
SHORTEST = 1.0 / 3.0  # edges round a buttonhole, over the wanted ones


class Remeshed(NamedTuple):
    """An even mesh on the surface of a mesh of V vertices."""

    mesh: Mesh  # of W vertices
    corner: np.ndarray  # (W, 3) int32 in [0, V): corners of the face on which each lies
    share: np.ndarray  # (W, 3) its barycentric coordinates there
    owner: np.ndarray  # (V,) in [0, W): the vertex that is nearest to each one along the surface


class OnFaces(NamedTuple):
    """N points on the faces of a mesh of V vertices."""

    corner: np.ndarray  # (N, 3) int32 in [0, V); a corner without a share repeats the first
    share: np.ndarray  # (N, 3) barycentric coordinates


def remesh(mesh: Mesh, edge: float) -> Remeshed | None:
    """A mesh of about this edge length, or None where the surface cannot be kept.

    It has the pieces, openings and handles of the other mesh. Where no length of its edges keeps them all, as of belt loops, it
    has the pieces and is not torn in more than ``MOST_LOST`` places. A pinhole is no opening, and a vertex that sheets of the
    surface share is one of each.
    Edges are shorter where the surface is thinner than they are long, such as at fingers.

    Args:
        mesh: of V vertices.
        edge: metres.
    """
    template, (mesh, original) = mesh, _without_pinholes(*_without_pinches(mesh), edge)
    wanted, kept = np.full(mesh.n_vertices, edge), _topology(mesh)
    nearest = None
    for _ in range(TRIES):
        if (found := subdivided(mesh, wanted / FINER)) is None:
            return nearest
        fine, place = found
        loops = boundary_loops(fine)
        spacing = np.minimum(_spacing(fine, loops, edge), (place.share * wanted[place.corner]).sum(axis=1))
        graph = _graph(fine, spacing)
        fixed = _on_loops(fine, loops, graph)
        seeds = _relaxed(fine, graph, _spread(fine, graph, fixed), fixed)
        even, owner, seeds = _dual(fine, graph, seeds)
        torn = [] if even is None else _torn(fine, even, seeds)
        has = None if even is None else _topology(even)
        if has is not None and (has == kept or (nearest is None and has[0] == kept[0] and len(torn) <= MOST_LOST)):
            corner, own = original[place.corner[seeds]].astype(np.int32), owner[: template.n_vertices]
            nearest = Remeshed(even, corner, place.share[seeds], own)
        if has == kept or len(torn) > MOST_TORN:
            return nearest
        rim = np.concatenate(torn) if torn else np.arange(fine.n_vertices)
        wanted = np.minimum(wanted, _graded(fine, rim, SHORTER * spacing[rim])[: mesh.n_vertices])
        if wanted.max() < SHORTEST_OF_ALL * edge:
            break
    return nearest


def _without_pinches(mesh: Mesh) -> tuple[Mesh, np.ndarray]:
    """The mesh of V vertices in which every sheet of faces around a vertex has its own, and the vertex of each (V',).

    The first V vertices are those of the mesh. Sheets that share a vertex and no edge are a pinch.
    """
    n, every = mesh.n_vertices, np.arange(mesh.n_vertices)
    after = np.roll(mesh.faces, -1, axis=1)
    if np.bincount(_open_sides(mesh)[:, 0], minlength=n).max(initial=0) < 2:
        return mesh, every
    corner = np.arange(3 * mesh.n_faces).reshape(-1, 3)
    low = np.where(mesh.faces < after, corner, np.roll(corner, -1, axis=1)).ravel()
    high = np.where(mesh.faces < after, np.roll(corner, -1, axis=1), corner).ravel()
    key = (np.minimum(mesh.faces, after) * n + np.maximum(mesh.faces, after)).ravel()
    order = np.argsort(key, kind="stable")
    shared = np.flatnonzero(key[order[1:]] == key[order[:-1]])
    one, other = order[shared], order[shared + 1]
    joined = np.concatenate([np.stack([ends[one], ends[other]], axis=1) for ends in (low, high)])
    sheet = geodesic.pieces(joined, 3 * mesh.n_faces)
    first = np.full(n, -1)
    first[mesh.faces.ravel()[::-1]] = sheet[::-1]
    more = np.unique(sheet[sheet != first[mesh.faces.ravel()]])
    number = np.full(sheet.max() + 1, -1)
    number[more] = n + np.arange(len(more))
    of_corner = number[sheet].reshape(-1, 3)
    original = np.concatenate([every, np.empty(len(more), np.int64)])
    original[of_corner[of_corner >= 0]] = mesh.faces[of_corner >= 0]
    return Mesh(mesh.vertices[original], np.where(of_corner >= 0, of_corner, mesh.faces)), original


def _without_pinholes(mesh: Mesh, original: np.ndarray, edge: float) -> tuple[Mesh, np.ndarray]:
    """The mesh with faces over openings that are no larger than a triangle of the wanted one; ``original`` stays as it is."""
    largest, fans = min(3.0 * edge, _around_a_pinhole(mesh)), []
    small = [loop for loop in boundary_loops(mesh) if _arc(mesh, loop)[-1] < largest]
    if not small:
        return mesh, original
    around = np.zeros(mesh.n_vertices, bool)
    around[np.concatenate(small)] = True
    taken = set(map(tuple, mesh.edges[around[mesh.edges].all(axis=1)].tolist()))
    for loop in small:
        fan = np.stack([np.full(len(loop) - 2, loop[0]), loop[2:], loop[1:-1]], axis=1)
        across = set(map(tuple, np.sort(fan[1:, [0, 2]], axis=1).tolist()))  # its inner edges
        if not across & taken:
            taken |= across
            fans.append(fan)
    try:
        return Mesh(mesh.vertices, np.concatenate([mesh.faces, *fans])), original
    except InvalidMesh:  # no area, or the only face once more
        return mesh, original


def _torn(mesh: Mesh, even: Mesh, seeds: np.ndarray) -> list[np.ndarray]:
    """The vertices round each opening of the seeds' dual that the mesh does not have: a part there is thinner than an edge."""
    loops = (seeds[loop] for loop in boundary_loops(even))
    return [loop for loop in loops if not mesh.boundary_vertices[loop].all()]


def _dual(mesh: Mesh, graph: Graph, seeds: np.ndarray) -> tuple[Mesh | None, np.ndarray, np.ndarray]:
    """The mesh that joins seeds whose regions meet, each vertex's region, and the seeds, less those without a face."""
    while True:
        owner = geodesic.owners(mesh.vertices, graph, seeds)
        faces = owner[mesh.faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        if len(faces) == 0:
            return None, owner, seeds
        try:
            even, used = Mesh.cleaned(mesh.vertices[seeds], faces, alike=0.0)
        except InvalidMesh:
            return None, owner, seeds
        if len(used) == len(seeds):
            return even, owner, seeds
        seeds = seeds[used]


def subdivided(mesh: Mesh, longest: np.ndarray | float) -> tuple[Mesh, OnFaces] | None:
    """The same surface with edges of at most ``longest`` metres, (V,) or one, and the place of its N vertices on the mesh.

    Edges that are longer are split in the middle until none is left; the first V vertices are those of the mesh. None where that
    takes more than ``MOST_SPLITS`` vertices: the mesh consists of needles.
    """
    vertices, faces, longest = mesh.vertices, mesh.faces, np.broadcast_to(longest, mesh.n_vertices)
    own = np.repeat(np.arange(mesh.n_vertices, dtype=np.int32), 3).reshape(-1, 3)
    place = OnFaces(own, np.tile([1.0, 0.0, 0.0], (mesh.n_vertices, 1)))
    while True:
        sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)
        limit = 0.5 * longest[sides].sum(axis=2)
        long = np.linalg.norm(np.subtract(*vertices[sides.transpose(2, 0, 1)]), axis=2) > limit
        if not long.any():
            return Mesh(vertices, faces), place
        ends = np.sort(sides[long], axis=1)
        key, number = np.unique(ends[:, 0] * len(vertices) + ends[:, 1], return_inverse=True)
        if len(vertices) + len(key) > mesh.n_vertices + MOST_SPLITS:
            return None
        middle = np.full(faces.shape, -1)
        middle[long] = len(vertices) + number
        a, b = np.divmod(key, len(vertices))
        vertices = np.concatenate([vertices, 0.5 * (vertices[a] + vertices[b])])
        longest = np.concatenate([longest, 0.5 * (longest[a] + longest[b])])
        place = OnFaces(*map(np.concatenate, zip(place, _middle(place, a, b), strict=True)))
        faces = _split(faces, middle)


def _middle(place: OnFaces, a: np.ndarray, b: np.ndarray) -> OnFaces:
    """The points in the middle between points a and b, (M,) each, of one face."""
    corner, share = (np.concatenate([array[a], array[b]], axis=1) for array in place)
    order = np.argsort(np.where(share > 0, corner, np.iinfo(np.int32).max), axis=1, kind="stable")
    corner, share = np.take_along_axis(corner, order, axis=1), np.take_along_axis(share, order, axis=1)
    # equal corners follow one another, and those without a share come last
    slot = np.cumsum((np.diff(corner, axis=1, prepend=-1) != 0) & (share > 0), axis=1) - 1
    found = OnFaces(np.repeat(corner[:, :1], 3, axis=1), np.zeros((len(a), 3)))
    row = np.broadcast_to(np.arange(len(a))[:, None], slot.shape)
    used = share > 0
    found.corner[row[used], slot[used]] = corner[used]
    np.add.at(found.share, (row[used], slot[used]), 0.5 * share[used])
    return found


def _split(faces: np.ndarray, middle: np.ndarray) -> np.ndarray:
    """Faces with some sides split: ``middle`` (F, 3) is the new vertex of the side from each corner to the next, or -1."""
    count = (middle >= 0).sum(axis=1)
    parts = [faces[count == 0]]
    for wanted in (1, 2, 3):
        chosen = np.flatnonzero(count == wanted)
        split = middle[chosen] >= 0
        # turned so that the split sides come first; of two, so that they follow each other
        first = split.argmax(axis=1) if wanted != 2 else (np.argmin(split, axis=1) + 1) % 3
        turn = (first[:, None] + np.arange(3)) % 3
        (a, b, c), (p, q, r) = (np.take_along_axis(array[chosen], turn, axis=1).T for array in (faces, middle))
        corners = {1: [(a, p, c), (p, b, c)], 2: [(a, p, c), (p, b, q), (p, q, c)]}
        corners[3] = [(a, p, r), (p, b, q), (r, q, c), (p, q, r)]
        parts += [np.stack(corner, axis=1) for corner in corners[wanted]]
    return np.concatenate(parts)


def _open_sides(mesh: Mesh) -> np.ndarray:
    """(B, 2) the sides of faces that no other face has, in the direction of the face."""
    sides = np.concatenate([mesh.faces[:, [0, 1]], mesh.faces[:, [1, 2]], mesh.faces[:, [2, 0]]])
    forward, backward = sides @ [mesh.n_vertices, 1], sides @ [1, mesh.n_vertices]
    return sides[~np.isin(forward, backward, kind="sort")]


def boundary_loops(mesh: Mesh) -> list[np.ndarray]:
    """Openings of a mesh: the vertices of each in the direction of its faces, the one farthest from the mesh's middle first."""
    away = np.square(mesh.vertices - mesh.vertices.mean(axis=0)).sum(axis=1)
    after = dict(_open_sides(mesh).tolist())
    loops = []
    while after:
        vertex, following = after.popitem()
        loop = [vertex]
        while following in after:
            loop.append(following)
            following = after.pop(following)
        loops.append(np.roll(loop, -int(np.argmax(away[loop]))))
    return loops


def openings(mesh: Mesh) -> list[np.ndarray]:
    """The :func:`boundary_loops` but for pinholes."""
    largest = _around_a_pinhole(mesh) if mesh.boundary_vertices.any() else 0.0
    return [loop for loop in boundary_loops(mesh) if _arc(mesh, loop)[-1] >= largest]


def _around_a_pinhole(mesh: Mesh) -> float:
    """Metres around the largest one."""
    return math.sqrt(4.0 * math.pi * PINHOLE * areas(mesh).sum())


def _arc(mesh: Mesh, loop: np.ndarray) -> np.ndarray:
    """(n + 1,) metres along a loop of n vertices, back to its first."""
    closed = mesh.vertices[np.append(loop, loop[0])]
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1)))


def _spacing(mesh: Mesh, loops: list[np.ndarray], edge: float) -> np.ndarray:
    """(V,) metres, the wanted length of the edges: shorter round narrow openings, growing with the distance from them."""
    n, length = mesh.n_vertices, np.array([_arc(mesh, loop)[-1] / LOOP_EDGES for loop in loops])
    narrow = np.flatnonzero(length < edge)
    if len(narrow) == 0:
        return np.full(n, edge)
    rim = np.concatenate([loops[k] for k in narrow])
    short = np.repeat(np.maximum(length[narrow], SHORTEST * edge), [len(loops[k]) for k in narrow])
    return np.minimum(edge, _graded(mesh, rim, short))


def _graded(mesh: Mesh, vertex: np.ndarray, length: np.ndarray) -> np.ndarray:
    """(V,) metres, the length of edges that are so long (n,) at some vertices (n,) and grow with the distance from these."""
    distance, _ = geodesic.distances(_graph(mesh, np.ones(mesh.n_vertices)), vertex, length / GRADING)
    return GRADING * distance


def _graph(mesh: Mesh, spacing: np.ndarray) -> Graph:
    """Edges with their length over the wanted one there."""
    a, b = mesh.edges.T
    length = np.linalg.norm(mesh.vertices[a] - mesh.vertices[b], axis=1) / (0.5 * (spacing[a] + spacing[b]))
    return geodesic.graph_of(mesh.edges, length, mesh.n_vertices)


def _on_loops(mesh: Mesh, loops: list[np.ndarray], graph: Graph) -> np.ndarray:
    """(V,) bool: seeds at even distances along each opening, whose place is kept."""
    fixed = np.zeros(mesh.n_vertices, bool)
    for loop in loops:
        step = graph.between(loop, np.roll(loop, -1))
        arc = np.append(0.0, np.cumsum(step))
        count = max(round(arc[-1]), 3)
        fixed[loop[np.searchsorted(arc[:-1], arc[-1] * np.arange(count) / count) % len(loop)]] = True
    return fixed


def _spread(mesh: Mesh, graph: Graph, fixed: np.ndarray) -> np.ndarray:
    """Seeds that keep their distance, in the order of their distance from the first, so that they pack densely."""
    middle = np.square(mesh.vertices - mesh.vertices.mean(axis=0)).sum(axis=1)
    away, _ = geodesic.distances(graph, [int(np.argmax(middle))])
    chosen = fixed.copy()
    kernels.spread_seeds(np.argsort(away, kind="stable"), *graph, PACKING, chosen)
    return np.flatnonzero(chosen)


def _relaxed(mesh: Mesh, graph: Graph, seeds: np.ndarray, fixed: np.ndarray) -> np.ndarray:
    """The seeds after moves to the middle of their regions; ``fixed`` ones stay."""
    free = ~fixed[seeds]
    mass = np.bincount(mesh.faces.ravel(), np.repeat(areas(mesh), 3), mesh.n_vertices)
    for _ in range(RELAXATIONS):
        owner = geodesic.owners(mesh.vertices, graph, seeds)
        total = np.bincount(owner, mass, len(seeds))
        centre = np.column_stack([np.bincount(owner, mass * mesh.vertices[:, a], len(seeds)) for a in range(3)]) / total[:, None]
        order = np.lexsort((np.square(mesh.vertices - centre[owner]).sum(axis=1), owner))
        middle = order[np.searchsorted(owner[order], np.arange(len(seeds)))]
        seeds = np.where(free, middle, seeds)
    return seeds


def areas(mesh: Mesh) -> np.ndarray:
    """(F,) square metres."""
    a, b, c = mesh.vertices[mesh.faces].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _topology(mesh: Mesh) -> tuple[int, int, int]:
    """Pieces, openings, and the Euler characteristic."""
    pieces = _graph(mesh, np.ones(mesh.n_vertices)).pieces()
    return pieces, len(boundary_loops(mesh)), mesh.n_vertices - len(mesh.edges) + mesh.n_faces
