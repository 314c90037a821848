"""Read polygon files: Wavefront OBJ and PLY; and cut polygons into triangles.

What of these formats is read, what is refused and what is ignored stands in docs/files.md.
"""

from __future__ import annotations

import codecs
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import mapbox_earcut
import numpy as np
from numpy.typing import NDArray

from traitbrdf.formats.files import FormatError

Float = NDArray[np.float64]
Int = NDArray[np.int64]

SMOOTH = -1
"""Smoothing group of triangles in files that say nothing about smoothing."""

FLAT = 0
"""Smoothing group of triangles that are flat unless they have normals."""


@dataclass(frozen=True, eq=False)
class Piece:
    """Triangles of one part of a file.

    Parameters
    ----------
    name : str
        Empty where the file has none.
    vertices : (V, 3) float64
    faces : (F, 3) int64
    normals : (F, 3, 3) float64
        Normals of the corners; NaN where the file has none.
    uvs : (F, 3, 2) float64
        Texture coordinates of the corners, v upwards; NaN where the file has none.
    smoothing : (F,) int64
        Smoothing group of each triangle: normals that the file lacks are averaged over the
        triangles of one group around a vertex. `FLAT` averages nothing.
    """

    name: str
    vertices: Float
    faces: Int
    normals: Float
    uvs: Float
    smoothing: Int


def triangulate(points: Float) -> Int:
    """Cut polygons into triangles: fans of convex ones, and ear clipping of the others.

    Corners are projected along the polygon's mean normal (Newell's method), so that a polygon may
    be concave and somewhat bent. The triangles keep its winding.

    Parameters
    ----------
    points : (n, k, 3) array
        Corners of n polygons in order, k at least 3.

    Returns
    -------
    (n, k - 2, 3) int64
        Corners of the triangles. A polygon that crosses itself, or has no area, becomes a fan.
    """
    n, k, _ = points.shape
    fan = np.stack([np.zeros(k - 2, np.int64), np.arange(1, k - 1), np.arange(2, k)], axis=1)
    cuts = np.tile(fan, (n, 1, 1))
    if k == 3:
        return cuts
    with np.errstate(all="ignore"):  # files may hold anything; `load_mesh` checks what comes out
        unit = points - points.mean(axis=1, keepdims=True)
        unit = unit / np.abs(unit).max(axis=(1, 2), keepdims=True)
        normal = np.cross(unit, np.roll(unit, -1, axis=1)).sum(axis=1)
        area = np.sqrt((normal * normal).sum(axis=1))  # twice the area
        normal = normal / area[:, None]
        edge = np.roll(unit, -1, axis=1) - unit
        following = np.roll(edge, -1, axis=1)
        sine = np.einsum("nkc,nc->nk", np.cross(edge, following), normal)
        turn = np.arctan2(sine, (edge * following).sum(axis=2))
        # a star turns to one side as well, but more than once round
        convex = (sine.min(axis=1) >= 0.0) & (np.abs(turn.sum(axis=1) - 2.0 * math.pi) < 0.1)
        cut = np.isfinite(unit).all(axis=(1, 2)) & (area > 1e-12) & ~convex
    for i in np.flatnonzero(cut):
        found = _ears(unit[i], normal[i], float(area[i]))
        if len(found) == k - 2:
            cuts[i] = found
    return cuts


def _ears(points: Float, normal: Float, area: float) -> Int:
    """Return triangles of one polygon (k, 3) with a unit normal, or none if it crosses itself."""
    axis = np.eye(3)[np.argmin(np.abs(normal))]
    u = np.cross(axis, normal)
    u /= np.sqrt(u @ u)
    flat = np.stack([points @ u, points @ np.cross(normal, u)], axis=1)
    cut = mapbox_earcut.triangulate_float64(flat, np.array([len(points)], np.uint32))
    found = np.asarray(cut, np.int64).reshape(-1, 3)
    a, b, c = (flat[found[:, i]] for i in range(3))
    double = (b[:, 0] - a[:, 0]) * (c[:, 1] - a[:, 1]) - (b[:, 1] - a[:, 1]) * (c[:, 0] - a[:, 0])
    if abs(np.abs(double).sum() - area) > 1e-6 * area:
        return found[:0]
    found[double < 0.0] = found[double < 0.0][:, ::-1]
    return found


# ---------------------------------------------------------------------------------------------
# Wavefront OBJ


def read_obj(path: Path) -> list[Piece]:
    """Return the parts of a Wavefront OBJ file in order of appearance.

    trimesh can split a file at its groups, but it counts relative indices from the file's end,
    forgets the names of materials without their library, and drops all normals and texture
    coordinates if one corner has none. Hence this reader.

    Parameters
    ----------
    path : Path

    Raises
    ------
    FormatError
        On numbers that are none, or indices of what the file does not have.
    """
    reader = _Obj(path)
    for number, line in enumerate(_lines(path.read_bytes()), start=1):
        try:
            reader.read(line)
        except ValueError as error:
            key = line.split()[0]
            raise FormatError(
                path,
                f"'{key}' with valid numbers in line {number}",
                f"{line.strip()[:60]!r} ({error})",
            ) from error
    return reader.pieces()


def _lines(data: bytes) -> list[str]:
    r"""Return the lines of a text file in whatever encoding; "\" at the end continues a line."""
    marks = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"),
             (codecs.BOM_UTF16_BE, "utf-16-be"))  # fmt: skip
    for mark, encoding in marks:
        if data.startswith(mark):
            text = data[len(mark) :].decode(encoding, "replace")
            break
    else:
        try:
            text = data.decode("utf-8")
        except UnicodeDecodeError:
            text = data.decode("latin-1")  # one letter a byte: other names stay apart
    text = text.replace("\r\n", "\n").replace("\r", "\n").replace("\\\n", " ")
    return text.split("\n")


class _Obj:
    """What has been read of an OBJ file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # flat lists: lists of rows would slow down the garbage collector
        self.tables: dict[str, list[float]] = {"v": [], "vt": [], "vn": []}
        # rows of v, vt, vn, or -1; three corners a triangle
        self.corners: list[tuple[int, int, int]] = []
        self.labels: list[tuple[str, str, str]] = []  # group, object, material of each triangle
        self.groups: list[int] = []  # smoothing group of each triangle
        # first triangles of polygons of more than three corners, by the number of corners
        self.polygons: dict[int, list[int]] = {}
        self.current = {"g": "", "o": "", "usemtl": ""}
        self.label = ("", "", "")
        self.smoothing = SMOOTH
        # corners seen before; most occur several times
        self.known: dict[str, tuple[int, int, int]] = {}

    def read(self, line: str) -> None:
        """Read one line; ValueError says what is wrong with it."""
        words = line.split()
        if not words or words[0][0] == "#":
            return
        key = words[0]
        if key in self.current:
            # the rest of the line: "#" is a letter of many programs' names
            self.current[key] = " ".join(words[1:])
            self.label = (self.current["g"], self.current["o"], self.current["usemtl"])
            return
        if "#" in line:
            words = line.split("#")[0].split()
        if key in self.tables:
            row = [float(x) for x in words[1:4]]
            least = 1 if key == "vt" else 3
            if len(row) < least:
                raise ValueError(f"fewer than {least} coordinates")
            self.tables[key] += [*row, 0.0][:2] if key == "vt" else row
        elif key in ("f", "fo"):  # "fo" is what very old files say
            polygon = [self.known.get(w) or self._corner(w) for w in words[1:]]
            if len(polygon) < 3:
                raise ValueError("fewer than three corners")
            if len(polygon) > 3:
                self.polygons.setdefault(len(polygon), []).append(len(self.labels))
            for i in range(1, len(polygon) - 1):
                self.corners += [polygon[0], polygon[i], polygon[i + 1]]
                self.labels.append(self.label)
                self.groups.append(self.smoothing)
        elif key == "s" and len(words) > 1:
            self.smoothing = FLAT if words[1] == "off" else max(int(words[1]), 0)

    def _corner(self, word: str) -> tuple[int, int, int]:
        """Return the rows of a corner ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``; -1 for none."""
        fields = [*word.split("/"), "", ""]

        def row(field: str, count: int) -> int:
            value = int(field)
            found = value - 1 if value > 0 else count + value
            if value == 0 or not 0 <= found < count:
                raise ValueError(f"index {value} of {count}")
            return found

        vertex = row(fields[0], len(self.tables["v"]) // 3)
        normal = row(fields[2], len(self.tables["vn"]) // 3) if fields[2] else -1
        try:
            texture = row(fields[1], len(self.tables["vt"]) // 2) if fields[1] else -1
        except ValueError:
            texture = -1  # some programs write indices without coordinates
        if "-" not in word:  # the meaning of a relative index depends on its place in the file
            self.known[word] = vertex, texture, normal
        return vertex, texture, normal

    def pieces(self) -> list[Piece]:
        """Return the parts of what has been read."""
        if not self.labels:
            return []
        columns = list(zip(*self.labels, strict=True))
        # the first of groups, objects and materials that divides the faces, else any name
        divides = [c for c in columns if len(set(c)) > 1]
        named = [c for c in columns[:2] if c[0]]
        names = [*divides, *named, columns[0]][0]
        vertex = np.array(self.tables["v"]).reshape(-1, 3)
        # index -1 selects the last row, which is NaN
        texture = np.array(self.tables["vt"] + [math.nan] * 2).reshape(-1, 2)
        normal = np.array(self.tables["vn"] + [math.nan] * 3).reshape(-1, 3)
        rows = np.array(self.corners).reshape(-1, 3, 3)
        for count, starts in self.polygons.items():
            own = np.array(starts)[:, None] + np.arange(count - 2)
            fan = rows[own]
            polygon = np.concatenate([fan[:, 0, :2], fan[:, :, 2]], axis=1)
            cut = triangulate(vertex[polygon[..., 0]])
            rows[own] = polygon[np.arange(len(polygon))[:, None, None], cut]
        face, face_uv, face_normal = np.moveaxis(rows, -1, 0)
        groups = np.array(self.groups)
        order = {name: i for i, name in enumerate(dict.fromkeys(names))}
        index = np.array([order[name] for name in names])
        made = []
        for name, i in order.items():
            own = index == i
            used, local = np.unique(face[own], return_inverse=True)
            made.append(
                Piece(
                    name,
                    vertex[used],
                    local.reshape(-1, 3),
                    normal[face_normal[own]],
                    texture[face_uv[own]],
                    groups[own],
                )
            )
        return made


# ---------------------------------------------------------------------------------------------
# PLY

_PLY_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2",
    "ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip


@dataclass(frozen=True)
class _Property:
    """A property of an element; `length` is the type of a list's length, empty for a number."""

    name: str
    kind: str
    length: str


@dataclass(frozen=True)
class _Element:
    name: str
    count: int
    properties: tuple[_Property, ...]


def read_ply(path: Path) -> list[Piece]:
    """Return a PLY file as one piece: ascii or binary, polygons of any size, triangle strips.

    plyfile, the well-kept reader, is under the GPL, and trimesh reads mixed polygons of binary
    files wrongly. Hence this reader.

    Parameters
    ----------
    path : Path

    Raises
    ------
    FormatError
        If it is no PLY file, is cut, or its faces use vertices that do not exist.
    """
    data = path.read_bytes()
    form, elements, start = _ply_header(path, data)
    if form == "ascii":
        tables = _ply_text(path, data[start:], elements)
    else:
        tables = _ply_bytes(path, data, start, elements, "<" if "little" in form else ">")
    vertex = tables.get("vertex", {})
    if not all(name in vertex for name in "xyz"):
        _not_ply(path, f"properties {', '.join(vertex) or 'none'} of vertices")
    vertices = np.stack([vertex[name] for name in "xyz"], axis=1).astype(np.float64)
    polygons = _ply_polygons(tables)
    faces, source, corners = _ply_triangles(path, polygons, vertices)
    normals = np.full((len(faces), 3, 3), np.nan)
    if all(name in vertex for name in ("nx", "ny", "nz")):
        normals = np.stack([vertex[n] for n in ("nx", "ny", "nz")], 1).astype(np.float64)[faces]
    uvs = np.full((len(faces), 3, 2), np.nan)
    for u, v in (("u", "v"), ("s", "t"), ("texture_u", "texture_v"), ("texture_s", "texture_t")):
        if u in vertex and v in vertex:
            uvs = np.stack([vertex[u], vertex[v]], axis=1).astype(np.float64)[faces]
    found = tables.get("face", {}).get("texcoord")
    if found is not None:  # of the corners, which decides at seams
        for row, polygon in enumerate(source):
            own = np.asarray(found[polygon], np.float64)
            if len(own) == 2 * len(polygons[polygon]):
                uvs[row] = own.reshape(-1, 2)[corners[row]]
    return [Piece("", vertices, faces, normals, uvs, np.full(len(faces), SMOOTH))]


def _not_ply(path: Path, got: str) -> NoReturn:
    raise FormatError(path, "a readable .ply file", got)


def _ply_header(path: Path, data: bytes) -> tuple[str, list[_Element], int]:
    """Return the format, the elements and where the data start."""
    if not data.startswith(b"ply"):
        _not_ply(path, f"a file that starts with {data[:8]!r}")
    position, form, elements = 0, "", []
    while True:
        end = data.find(b"\n", position, position + 4096)
        if end < 0:
            end = data.find(b"\r", position, position + 4096)
        if end < 0:
            _not_ply(path, "a header without an end")
        words = data[position:end].decode("latin-1").split()
        position = end + 1
        match words:
            case ["end_header"]:
                break
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as form, _]:
                pass
            case ["element", name, count] if count.isdigit() and len(count) < 12:
                elements.append(_Element(name, int(count), ()))
            case ["property", "list", length, kind, name] if elements and {length, kind} <= set(
                _PLY_TYPES
            ):
                _add_property(path, elements, _Property(name, _PLY_TYPES[kind], _PLY_TYPES[length]))
            case ["property", kind, name] if elements and kind in _PLY_TYPES:
                _add_property(path, elements, _Property(name, _PLY_TYPES[kind], ""))
            case [] | ["ply"] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                _not_ply(path, f"a header with {' '.join(words)[:60]!r}")
    if not form:
        _not_ply(path, "a header without a known format")
    return form, elements, position


def _add_property(path: Path, elements: list[_Element], added: _Property) -> None:
    last = elements[-1]
    if any(added.name == one.name for one in last.properties):
        _not_ply(path, f"property {added.name!r} of {last.name!r} twice")
    elements[-1] = _Element(last.name, last.count, (*last.properties, added))


_Table = dict[str, Any]
"""Arrays by property; lists are (n, length) arrays or lists of arrays."""


def _ply_text(path: Path, data: bytes, elements: list[_Element]) -> dict[str, _Table]:
    words = data.split()
    at = 0
    tables: dict[str, _Table] = {}
    for element in elements:
        rows: dict[str, list[Any]] = {p.name: [] for p in element.properties}
        if element.properties and element.count > len(words) - at:
            _not_ply(path, f"{len(words)} numbers, fewer than it has {element.name} elements")
        for _ in range(element.count if element.properties else 0):
            for p in element.properties:
                try:
                    count = int(words[at]) if p.length else 1
                    at += bool(p.length)
                    if not 0 <= count <= len(words) - at:
                        raise IndexError
                    values = np.array(words[at : at + count], np.float64)
                except (ValueError, IndexError):
                    _not_ply(path, f"{p.name!r} of {element.name!r} that is cut or no number")
                at += count
                rows[p.name].append(values if p.length else values[0])
        tables[element.name] = {
            p.name: rows[p.name] if p.length else np.array(rows[p.name]) for p in element.properties
        }
    return tables


def _ply_bytes(
    path: Path, data: bytes, at: int, elements: list[_Element], order: str
) -> dict[str, _Table]:
    tables: dict[str, _Table] = {}
    for element in elements:
        if not element.properties:
            continue
        table = _equal_rows(data, at, element, order)
        if table is None:
            table, at = _unequal_rows(path, data, at, element, order)
        else:
            at += table.nbytes
            table = {
                p.name: table[p.name]["values"] if p.length else table[p.name]
                for p in element.properties
            }
        tables[element.name] = table
    return tables


def _equal_rows(data: bytes, at: int, element: _Element, order: str) -> Any:
    """Return a structured array if all lists are as long as those of the first row, else None."""
    fields: list[Any] = []
    offset = at
    for p in element.properties:
        if not p.length:
            fields.append((p.name, order + p.kind))
            offset += np.dtype(p.kind).itemsize
            continue
        size = np.dtype(p.length).itemsize
        first = data[offset : offset + size]
        if len(first) < size or p.length[0] == "f":
            return None
        count = int(np.frombuffer(first, order + p.length)[0])
        offset += size + count * np.dtype(p.kind).itemsize
        if count < 0 or offset > len(data):
            return None
        fields.append((p.name, [("count", order + p.length), ("values", order + p.kind, (count,))]))
    row = np.dtype(fields)
    if at + row.itemsize * element.count > len(data):
        return None
    table = np.frombuffer(data, row, element.count, at)
    for p in element.properties:
        if p.length and len(table) and (table[p.name]["count"] != table[p.name]["count"][0]).any():
            return None
    return table


def _unequal_rows(
    path: Path, data: bytes, at: int, element: _Element, order: str
) -> tuple[_Table, int]:
    rows: dict[str, list[Any]] = {p.name: [] for p in element.properties}
    kinds = [
        (p.name, np.dtype(order + p.kind), np.dtype(order + p.length) if p.length else None)
        for p in element.properties
    ]
    for _ in range(element.count):
        for name, kind, length in kinds:
            count = 1
            if length is not None:
                if at + length.itemsize > len(data):
                    _not_ply(path, f"{len(data)} bytes, cut within {element.name!r}")
                count = int(np.frombuffer(data, length, 1, at)[0])
                at += length.itemsize
            if count < 0 or at + count * kind.itemsize > len(data):
                _not_ply(path, f"{len(data)} bytes, cut within {element.name!r}")
            values = np.frombuffer(data, kind, count, at)
            at += values.nbytes
            rows[name].append(values if length is not None else values[0])
    table: _Table = {
        p.name: rows[p.name] if p.length else np.array(rows[p.name]) for p in element.properties
    }
    return table, at


def _ply_polygons(tables: dict[str, _Table]) -> Any:
    """Return the corners of each polygon: an (F, n) array or a list of arrays."""
    face = tables.get("face", {})
    for name in ("vertex_indices", "vertex_index"):
        if name in face:
            return face[name]
    strips = tables.get("tristrips", {}).get("vertex_indices", [])
    found: list[Any] = []
    for strip in strips:
        for part in np.split(strip, np.flatnonzero(strip < 0)):  # -1 ends a strip
            own = part[part >= 0]
            for i in range(len(own) - 2):
                a, b, c = own[i : i + 3]
                found.append(np.array([a, b, c] if i % 2 == 0 else [b, a, c]))
    return found


def _ply_triangles(path: Path, polygons: Any, vertices: Float) -> tuple[Int, Int, Int]:
    """Return triangles (F, 3), the polygon (F,) of each and its corners (F, 3) within that."""
    lengths = np.array([len(p) for p in polygons], np.int64)
    parts = []
    for count in np.unique(lengths[lengths >= 3]).tolist():
        own = np.flatnonzero(lengths == count)
        given = np.array([polygons[i] for i in own]) if isinstance(polygons, list) else polygons
        if (given != np.floor(given)).any() or given.min() < 0 or given.max() >= len(vertices):
            _not_ply(
                path, f"faces of {given.min()} to {given.max()}, with {len(vertices)} vertices"
            )
        index = given.astype(np.int64)
        cut = triangulate(vertices[index])
        faces = index[np.arange(len(index))[:, None, None], cut]
        parts.append((faces.reshape(-1, 3), np.repeat(own, count - 2), cut.reshape(-1, 3)))
    if not parts:
        return np.empty((0, 3), np.int64), np.empty(0, np.int64), np.empty((0, 3), np.int64)
    faces, source, corners = (np.concatenate(column) for column in zip(*parts, strict=True))
    order = np.argsort(source, kind="stable")
    return faces[order], source[order], corners[order]
