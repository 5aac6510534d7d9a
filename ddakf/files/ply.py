"""PLY files: ascii and binary of either byte order, points with colours and polygon meshes; further properties are skipped."""

from __future__ import annotations

import re
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from ddakf.errors import InvalidFile
from ddakf.files.text import quoted, text_of

SCALARS = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4", "float": "f4",
    "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4",
    "float32": "f4", "float64": "f8",
}  # fmt: skip
FORMATS = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
COUNT = re.compile(r"0*[0-9]{1,18}")
INDEX_LISTS = ("vertex_indices", "vertex_index")
COLORS = ("red", "green", "blue")


class Ply(NamedTuple):
    """Content of a PLY file."""

    vertices: np.ndarray  # (V, 3) float64
    polygons: list[np.ndarray]  # integers of shape (polygons, corners)
    colors: np.ndarray | None  # (V, 3) uint8, red, green, blue; None without these as bytes


@dataclass(frozen=True)
class _Property:
    name: str
    type: str  # numpy code of the value
    length_type: str | None = None  # numpy code of a list's length; None for a scalar


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]

    @property
    def has_list(self) -> bool:
        return any(p.length_type for p in self.properties)


def read_ply(path: Path) -> Ply:
    """Reads a PLY file.

    Raises:
        InvalidFile: not a PLY file, a broken header, too few data, no x, y, z, a colour that is no byte.
    """
    order, elements, body = _parse_header(path, path.read_bytes())
    source = _Ascii(path, body) if order is None else _Binary(path, body, order)
    vertices, polygons, colors = None, [], None
    for element in elements:
        columns, lists = source.read(element)
        if element.name == "vertex":
            if not {"x", "y", "z"} <= columns.keys():
                raise InvalidFile(f"{path.name}: vertex", "properties x, y and z", ", ".join(columns) or "none")
            vertices = np.column_stack([columns[axis] for axis in "xyz"]).astype(np.float64)
            colors = _colors(path, element, columns)
        elif element.name == "face":
            polygons = next((lists[name] for name in INDEX_LISTS if name in lists), [])
    if vertices is None:
        raise InvalidFile(f"{path.name}: header", "an element vertex", "none")
    return Ply(vertices, polygons, colors)


def _colors(path: Path, element: _Element, columns: dict[str, np.ndarray]) -> np.ndarray | None:
    if not {(name, "u1") for name in COLORS} <= {(p.name, p.type) for p in element.properties}:
        return None
    values = np.column_stack([columns[name] for name in COLORS])
    if len(values) and not (values.min() >= 0 and values.max() <= 255):
        raise InvalidFile(f"{path.name}: vertex", "red, green and blue of 0 to 255", f"{values.min():g} to {values.max():g}")
    return values.astype(np.uint8)


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray | None, comment: str | None = None) -> None:
    """Writes binary little-endian PLY: float32 vertices (V, 3), and int32 triangles (F, 3) unless ``faces`` is None."""
    header = ["ply", "format binary_little_endian 1.0", *([f"comment {comment}"] if comment else [])]
    header += [f"element vertex {len(vertices)}"]
    header += [f"property float {axis}" for axis in "xyz"]
    body = np.ascontiguousarray(vertices, "<f4").tobytes()
    if faces is not None:
        header += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        records = np.empty(len(faces), [("n", "u1"), ("index", "<i4", 3)])
        records["n"], records["index"] = 3, faces
        body += records.tobytes()
    path.write_bytes("\n".join([*header, "end_header", ""]).encode() + body)


def _parse_header(path: Path, data: bytes) -> tuple[str | None, list[_Element], bytes]:
    begin = re.match(rb"ply[ \t]*(\r\n|\n|\r)", data)  # all lines of a header end as the first one does
    line_end = begin[1] if begin else b"\n"
    end = data.find(line_end + b"end_header")
    if not begin or end < 0:
        raise InvalidFile(path.name, "a PLY header from 'ply' to 'end_header'", repr(data[:16]))
    lines = [line.split() for line in text_of(data[:end]).split("\n")[1:]]
    order, declared = "missing", []
    for number, words in enumerate(lines, start=2):
        match words:
            case [] | ["comment" | "obj_info", *_]:
                continue
            case ["format", name, *_] if name in FORMATS:
                order = FORMATS[name]
            case ["element", name, count] if COUNT.fullmatch(count):
                declared.append((name, int(count), []))
            case ["property", "list", length, kind, name] if declared and length in SCALARS and kind in SCALARS:
                declared[-1][2].append(_Property(name, SCALARS[kind], SCALARS[length]))
            case ["property", kind, name] if declared and kind in SCALARS:
                declared[-1][2].append(_Property(name, SCALARS[kind]))
            case _:
                raise InvalidFile(f"{path.name}: header line {number}", "a PLY statement", quoted(" ".join(words)))
    if order == "missing":
        raise InvalidFile(f"{path.name}: header", "a format line", "none")
    for name, _, properties in declared:
        if twice := [each for each, count in Counter(p.name for p in properties).items() if count > 1]:
            raise InvalidFile(f"{path.name}: header", f"each property of {quoted(name)} once", quoted(twice[0]) + " twice")
    elements = [_Element(name, count, tuple(properties)) for name, count, properties in declared]
    _, _, body = data[end + len(line_end) :].partition(line_end)
    return order, elements, body


class _Ascii:
    """One line per record; reads elements in the order of the header."""

    def __init__(self, path: Path, body: bytes):
        self.path = path
        self.lines = [line for line in text_of(body).split("\n") if line.strip()]
        self.at = 0

    def read(self, element: _Element):
        rows = self.lines[self.at : self.at + element.count]
        self.at += element.count
        if len(rows) < element.count:
            raise _too_short(self.path, element, len(rows))
        values: dict[str, list] = {p.name: [] for p in element.properties}
        for number, row in enumerate(rows):
            try:
                self._read_row(element, row.split(), values)
            except (ValueError, IndexError, OverflowError):
                raise InvalidFile(f"{self.path.name}: {element.name} {number}", _described(element), quoted(row)) from None
        columns = {p.name: np.array(values[p.name], np.float64) for p in element.properties if not p.length_type}
        return columns, {p.name: _by_length(values[p.name]) for p in element.properties if p.length_type}

    @staticmethod
    def _read_row(element: _Element, words: list[str], values: dict[str, list]) -> None:
        at = 0
        for p in element.properties:
            if p.length_type is None:
                values[p.name].append(float(words[at]))
                at += 1
            else:
                length = int(words[at])
                if length < 0 or at + 1 + length > len(words):
                    raise ValueError
                values[p.name].append(np.array(words[at + 1 : at + 1 + length]).astype(np.float64).astype(np.int64))
                at += 1 + length


class _Binary:
    """Packed records; whole elements at once where every record has the same size."""

    def __init__(self, path: Path, body: bytes, order: str):
        self.path, self.body, self.order = path, body, order
        self.at = 0

    def read(self, element: _Element):
        if element.count == 0:
            return {p.name: np.zeros(0) for p in element.properties if not p.length_type}, {}
        record = self._uniform_record(element)
        if record is None:
            return self._read_one_by_one(element)
        table = np.frombuffer(self.body, record, element.count, self.at)
        self.at += table.nbytes
        columns = {p.name: table[p.name] for p in element.properties if not p.length_type}
        return columns, {p.name: [table[p.name].astype(np.int64)] for p in element.properties if p.length_type}

    def _uniform_record(self, element: _Element) -> np.dtype | None:
        """The dtype of all records, taking list lengths from the first; None when some record differs from it."""
        fields, size = [], 0
        for p in element.properties:
            if p.length_type:
                length = int(self._scalar(element, p.length_type, self.at + size, 0))
                if not 0 <= length <= len(self.body):
                    raise InvalidFile(f"{self.path.name}: {element.name} 0", "a list that fits the file", str(length))
                fields.append((f"length of {p.name}", self.order + p.length_type))
                fields.append((p.name, self.order + p.type, (length,)))
            else:
                fields.append((p.name, self.order + p.type))
            size = np.dtype(fields).itemsize
        record = np.dtype(fields)
        if self.at + element.count * record.itemsize > len(self.body):
            if element.has_list:
                return None
            raise _too_short(self.path, element, (len(self.body) - self.at) // max(record.itemsize, 1))
        table = np.frombuffer(self.body, record, element.count, self.at)
        lengths = [table[f"length of {p.name}"] for p in element.properties if p.length_type]
        return record if all((column == column[0]).all() for column in lengths) else None

    def _read_one_by_one(self, element: _Element):
        values: dict[str, list] = {p.name: [] for p in element.properties}
        for number in range(element.count):
            for p in element.properties:
                length = 1
                if p.length_type:
                    length = int(self._scalar(element, p.length_type, self.at, number))
                    self.at += np.dtype(p.length_type).itemsize
                size = length * np.dtype(p.type).itemsize
                if length < 0 or self.at + size > len(self.body):
                    raise _too_short(self.path, element, number)
                value = np.frombuffer(self.body, self.order + p.type, length, self.at)
                self.at += size
                values[p.name].append(value if p.length_type else value[0])
        columns = {p.name: np.array(values[p.name], np.float64) for p in element.properties if not p.length_type}
        return columns, {p.name: _by_length(values[p.name]) for p in element.properties if p.length_type}

    def _scalar(self, element: _Element, code: str, at: int, number: int):
        if at + np.dtype(code).itemsize > len(self.body):
            raise _too_short(self.path, element, number)
        return np.frombuffer(self.body, self.order + code, 1, at)[0]


def _by_length(rows: list) -> list[np.ndarray]:
    lengths = np.array([len(row) for row in rows], int)
    return [np.array([rows[i] for i in np.flatnonzero(lengths == n)], np.int64) for n in np.unique(lengths) if n]


def _described(element: _Element) -> str:
    names = ", ".join(f"list {p.name}" if p.length_type else p.name for p in element.properties)
    return f"numbers for {names}"


def _too_short(path: Path, element: _Element, got: int) -> InvalidFile:
    return InvalidFile(f"{path.name}: {element.name}", f"{element.count} records", f"{got}")
