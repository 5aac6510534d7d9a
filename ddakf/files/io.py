"""Points and meshes from and to files; units and axes are those of the file.

``.ply``, ``.obj``, ``.xyz``, ``.txt`` and ``.csv`` are read here; other formats go through Open3D when it is installed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from ddakf.errors import InvalidFile
from ddakf.files.ply import read_ply, write_ply
from ddakf.files.polygons import triangles
from ddakf.files.sequence import Sequence, load_sequence
from ddakf.files.text import quoted, text_of

__all__ = [
    "Sequence",
    "load_sequence",
    "read_coloured_points",
    "read_mesh",
    "read_points",
    "read_sensor_origin",
    "write_mesh",
    "write_points",
]

TEXT_SUFFIXES = (".xyz", ".txt", ".csv")
POINT_SUFFIXES = (".ply", ".obj", *TEXT_SUFFIXES, ".pcd")
ORIGIN_KEYWORDS = {".pcd": "viewpoint ", ".ply": "comment sensor_origin "}  # before the place of a cloud's sensor
UNKNOWN_VIEWPOINT = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]  # of a .pcd whose writer did not know it
HEADER_BYTES = 1 << 16  # of a cloud, at most
MESH_SUFFIXES = (".ply", ".obj", ".stl", ".off", ".gltf", ".glb")


def read_points(path) -> np.ndarray:
    """Reads a point cloud; of a mesh file, its vertices.

    Args:
        path: .ply, .obj, .xyz, .txt or .csv (first three columns); .pcd and others through Open3D.

    Returns:
        (N, 3) float64, finite; N may be 0.

    Raises:
        InvalidFile: no such file, malformed, or non-finite coordinates.
        MissingDependency: the format needs Open3D, which cannot be imported.
    """
    return read_coloured_points(path)[0]


def read_coloured_points(path, *, finite: bool = True) -> tuple[np.ndarray, np.ndarray | None]:
    """:func:`read_points`, and (N, 3) uint8 red, green and blue of the points; None where no .ply has these as bytes.

    Without ``finite``, points that are not finite are left out, which sensors write for pixels that saw nothing.
    """
    path, colors = _existing(path), None
    suffix = path.suffix.lower()
    if suffix == ".ply":
        points, _, colors = read_ply(path)
    elif suffix == ".obj":
        points = _read_obj(path)[0]
    elif suffix in TEXT_SUFFIXES:
        points = _read_columns(path)
    else:
        from ddakf.files import open3d_bridge

        points = open3d_bridge.read_points(path)
    if finite:
        return _finite(path, points), colors
    kept = np.isfinite(points).all(axis=1)
    return points[kept], None if colors is None else colors[kept]


def read_sensor_origin(path) -> np.ndarray | None:
    """Where the sensor of a point cloud was, in the unit of the file.

    Args:
        path: a .pcd with a line ``VIEWPOINT X Y Z QW QX QY QZ``, or a .ply with ``comment sensor_origin X Y Z``.

    Returns:
        (3,) float64; None where the file does not say, or has the VIEWPOINT that writers put where they do not know it.

    Raises:
        InvalidFile: no such file, or a line that is not of that form.
    """
    path = _existing(path)
    if (keyword := ORIGIN_KEYWORDS.get(path.suffix.lower())) is None:
        return None
    with path.open("rb") as file:
        header = re.split(r"(?m)^(?:end_header|DATA)\b", text_of(file.read(HEADER_BYTES)))[0]
    for line in header.split("\n"):
        if line.lower().startswith(keyword):
            values = _numbers(path, line, line[len(keyword) :].split())
            return None if values == UNKNOWN_VIEWPOINT else np.array(values[:3])
    return None


def _numbers(path: Path, line: str, words: list[str]) -> list[float]:
    """Three or more finite numbers of a line."""
    try:
        values = [float(word) for word in words]
    except ValueError:
        values = []
    if len(values) < 3 or not np.isfinite(values).all():
        raise InvalidFile(f"{path.name}: sensor origin", "three finite numbers", quoted(line))
    return values


def read_mesh(path) -> tuple[np.ndarray, np.ndarray]:
    """Reads a triangle mesh; polygons become fans of triangles.

    Returns:
        (V, 3) float64 finite vertices and (F, 3) int64 faces, with indices inside the vertices. Defects of the topology
        stay: pass the arrays to :class:`ddakf.Mesh`, which refuses them, or to ``Mesh.cleaned``, which repairs them.

    Raises:
        InvalidFile: no such file, malformed, no faces, an index out of range.
        MissingDependency: the format needs Open3D, which cannot be imported.
    """
    path = _existing(path)
    suffix = path.suffix.lower()
    if suffix in (".ply", ".obj"):
        vertices, polygons = read_ply(path)[:2] if suffix == ".ply" else _read_obj(path)
        vertices = _finite(path, vertices)
        faces = triangles(vertices, polygons)
    elif suffix in POINT_SUFFIXES:
        raise InvalidFile(str(path), f"a mesh format such as {', '.join(MESH_SUFFIXES[:2])}", suffix)
    else:
        from ddakf.files import open3d_bridge

        vertices, faces = open3d_bridge.read_mesh(path)
        vertices = _finite(path, vertices)
    if len(faces) == 0:
        raise InvalidFile(f"{path.name}: faces", "at least one face", "none")
    if faces.min() < 0 or faces.max() >= len(vertices):
        worst = faces.min() if faces.min() < 0 else faces.max()
        raise InvalidFile(f"{path.name}: faces", f"indices in [0, {len(vertices)})", str(worst))
    return vertices, faces


def write_mesh(path, vertices, faces) -> None:
    """Writes (V, 3) vertices and (F, 3) triangles: .ply in float32, .obj in text with nine digits."""
    _write(Path(path), np.asarray(vertices), np.asarray(faces))


def write_points(path, points, sensor_origin=None) -> None:
    """Writes (N, 3) points: .ply in float32, .obj or .xyz in text with nine digits.

    A .ply also says where the sensor was, (3,) in the unit of the points, if it is given; see :func:`read_sensor_origin`.
    """
    path, points = Path(path), np.asarray(points)
    if sensor_origin is not None and path.suffix.lower() == ".ply":
        write_ply(path, points, None, "sensor_origin " + " ".join(f"{value:.9g}" for value in sensor_origin))
    else:
        _write(path, points, None)


def _write(path: Path, vertices: np.ndarray, faces: np.ndarray | None) -> None:
    suffix = path.suffix.lower()
    rows = (" ".join(f"{value:.9g}" for value in row) for row in vertices)
    if suffix == ".ply":
        write_ply(path, vertices, faces)
    elif suffix == ".obj":
        lines = [f"v {row}" for row in rows]
        lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1 if faces is not None else ())]
        path.write_text("\n".join(lines) + "\n")
    elif suffix == ".xyz" and faces is None:
        path.write_text("".join(f"{row}\n" for row in rows))
    else:
        accepted = ".ply or .obj" if faces is not None else ".ply, .obj or .xyz"
        raise InvalidFile(str(path), f"a name that ends in {accepted}", suffix)


def _existing(path) -> Path:
    path = Path(path)
    if not path.is_file():
        raise InvalidFile(str(path), "a file", "a folder" if path.is_dir() else "nothing there")
    return path


def _finite(path: Path, points: np.ndarray) -> np.ndarray:
    bad = ~np.isfinite(points).all(axis=1)
    if bad.any():
        found = f"{bad.sum()} non-finite, the first at {bad.argmax()}"
        raise InvalidFile(f"{path.name}: vertices", "finite numbers", found)
    return points


def _read_obj(path: Path) -> tuple[np.ndarray, list[np.ndarray]]:
    """Vertices and polygons of a Wavefront file: `v`, and `f` with slashes and negative (relative) indices."""
    vertices, polygons = [], {}
    for number, line in _statements(text_of(path.read_bytes())):
        key, *words = line.split() or [""]
        try:
            if key == "v":
                x, y, z = map(float, words[:3])
                vertices.append((x, y, z))
            elif key == "f":
                polygon = [_obj_index(word, len(vertices)) for word in words]
                polygons.setdefault(len(polygon), []).append(polygon)
        except ValueError:
            expected = "v x y z" if key == "v" else "f with whole, non-zero vertex indices"
            raise InvalidFile(f"{path.name}: line {number}", expected, quoted(line)) from None
    groups = [np.array(group, np.int64) for corners, group in sorted(polygons.items()) if corners >= 3]
    return np.array(vertices, np.float64).reshape(-1, 3), groups


def _statements(text: str) -> Iterator[tuple[int, str]]:
    """The statements of a Wavefront file without comments, and the number of the line that each begins in.

    A backslash continues a vertex or a face in the next line; elsewhere it may be the end of a path.
    """
    begun, before = 0, ""
    for number, line in enumerate(text.split("\n"), start=1):
        begun, joined = begun or number, before + line.split("#", 1)[0]
        if line.endswith("\\") and joined.endswith("\\") and joined.split()[0] in ("v", "f"):
            before = joined[:-1] + " "
            continue
        yield begun, joined
        begun, before = 0, ""
    if before:
        yield begun, before


def _obj_index(word: str, vertices_so_far: int) -> int:
    index = int(word.split("/", 1)[0])
    if index == 0 or abs(index) > 2**31:
        raise ValueError
    return index - 1 if index > 0 else vertices_so_far + index


def _read_columns(path: Path) -> np.ndarray:
    """Three columns of a text file, separated by blanks and by commas or semicolons; `#` begins a comment.

    The first line may have the number of points or the names of the columns instead. They are those named x, y and z, else the
    first three. A first column without a name, as of an index, may be there too.
    """
    rows, has_title, titles = [], False, []
    for number, line in enumerate(text_of(path.read_bytes()).split("\n"), start=1):
        separators = r"[\s;]+" if ";" in line else r"[\s,]+"  # beside semicolons a comma is that of a decimal
        words = re.split(separators, line.split("#", 1)[0].strip(" \t,;"))
        if words == [""]:
            continue
        try:
            x, y, z = map(float, _coordinates(words, titles))
        except ValueError:
            if not rows and not has_title and (words[0].isdigit() if len(words) == 1 else not any(map(_is_number, words))):
                has_title, titles = True, [word.strip("\"'").lower() for word in words]
                continue
            raise InvalidFile(f"{path.name}: line {number}", "three numbers with decimal points", quoted(line)) from None
        rows.append((x, y, z))
    return np.array(rows, np.float64).reshape(-1, 3)


def _coordinates(words: list[str], titles: list[str]) -> list[str]:
    """The three words of a line that are coordinates, by the names of the columns if there are any."""
    if not {"x", "y", "z"} <= set(titles):
        return words[:3]
    unnamed = len(words) - len(titles) == 1
    return [words[titles.index(axis) + unnamed] for axis in "xyz"] if len(words) >= len(titles) else words[:0]


def _is_number(word: str) -> bool:
    return re.fullmatch(r"[-+]?[0-9.,]+([eE][-+]?[0-9]+)?", word) is not None
