"""Read meshes from OBJ, PLY and glTF files."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from traitbrdf.formats.files import FormatError

if TYPE_CHECKING:
    import trimesh
from traitbrdf.scene.shapes import Mesh, dots, to_unit

Float = NDArray[np.float64]

# ------------------------------------------------------------------------------------ mesh files
_SUFFIXES = (".obj", ".ply", ".gltf", ".glb")

# names that programs write for unnamed pieces
_PLACEHOLDER = re.compile(r"(geometry|GLTF|mesh|default)?([ _.]?\d+)?", re.IGNORECASE)


@dataclass(frozen=True)
class _Piece:
    """Triangles of one part of a file.

    `normals` (F, 3, 3) and `uvs` (F, 3, 2) of the corners are NaN where the file has none.
    """

    name: str
    vertices: Float
    faces: NDArray[np.int64]
    normals: Float
    uvs: Float


def load_mesh(path: str | PathLike[str]) -> Mesh:
    """Read a mesh file: Wavefront OBJ, PLY, glTF or glb.

    Parts are the named pieces of the file. For OBJ they are its groups (``g``) if these divide the
    faces, else its objects (``o``), else its materials (``usemtl``). For glTF they are its meshes,
    and the materials within a mesh of several. A file without names is one part, named after the
    file.

    Normals are those of the file. Where it has none, the normals of the triangles around a vertex
    are averaged, weighted by their angles, also across the borders of parts. Polygons are split
    into fans. The nodes of a glTF scene are placed by their transforms; units and axes are not
    changed. Texture coordinates are kept, with v upwards; corners without any get 0, 0 if others
    have some. Of a glTF file, only those of primitives with a material are read.

    Parameters
    ----------
    path : path-like
        Its suffix selects the format.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    FormatError
        If the format is another, the file cannot be read, has no triangles with an area, or has
        vertices that are not finite.
    """
    file = Path(path)
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such mesh file")
    suffix = file.suffix.lower()
    if not file.is_file() or suffix not in _SUFFIXES:
        got = repr(file.suffix) if file.is_file() else "a folder"
        raise FormatError(file, f"a mesh file ({', '.join(_SUFFIXES)})", got)
    pieces = _read_obj(file) if suffix == ".obj" else _read_trimesh(file)
    pieces = [piece for piece in pieces if len(piece.faces)]
    if not pieces:
        raise FormatError(file, "triangles", "none")
    start = np.cumsum([0] + [len(piece.vertices) for piece in pieces])
    faces = np.concatenate([p.faces + s for p, s in zip(pieces, start, strict=False)])
    vertices = np.concatenate([piece.vertices for piece in pieces])
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise FormatError(
            file, f"vertex indices below {len(vertices)}", f"{faces.min()} to {faces.max()}"
        )
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise FormatError(file, "finite vertices", f"{bad} that are not")
    normals = np.concatenate([piece.normals for piece in pieces])
    length = np.sqrt(dots(normals, normals))
    missing = ~(np.isfinite(length) & (length > 0.0))
    if missing.any():
        normals[missing] = _smooth_corner_normals(vertices, faces)[missing]
    uvs = np.concatenate([piece.uvs for piece in pieces])
    textured = np.isfinite(uvs).all(axis=-1, keepdims=True)
    names = [piece.name for piece in pieces]
    if len(set(names)) == 1 and _PLACEHOLDER.fullmatch(names[0]):
        names = [file.stem] * len(names)
    parts = tuple(dict.fromkeys(names))
    face_part = np.concatenate(
        [np.full(len(p.faces), parts.index(n)) for p, n in zip(pieces, names, strict=True)]
    )
    try:
        return Mesh(
            vertices,
            faces,
            normals,
            face_part,
            parts,
            np.where(textured, uvs, 0.0) if textured.any() else None,
        )
    except ValueError as error:
        raise FormatError(file, "triangles with an area", str(error)) from error


def _smooth_corner_normals(vertices: Float, faces: NDArray[np.int64]) -> Float:
    """Return unit normals (F, 3, 3) of the corners, averaged over all triangles at one position.

    Weighted by the angle of the corner (Thuermer & Wuthrich, "Computing Vertex Normals from
    Polygonal Facets", 1998), so that the result does not depend on how a polygon was split.
    """
    _, weld = np.unique(vertices + 0.0, axis=0, return_inverse=True)  # -0.0 becomes 0.0
    shared = weld.reshape(-1)[faces]
    size = float(np.abs(vertices[np.unique(faces)]).max()) or 1.0
    corner = (vertices / size)[faces]
    following = np.roll(corner, -1, axis=1) - corner
    previous = np.roll(corner, 1, axis=1) - corner
    cross = np.cross(following, previous)
    angle = np.arctan2(np.sqrt(dots(cross, cross)), dots(following, previous))
    facet = to_unit(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]))
    weighted = angle[..., None] * facet[:, None, :]
    sums = [np.bincount(shared.ravel(), weighted[..., k].ravel()) for k in range(3)]
    total = np.stack(sums, axis=-1).astype(np.float64)
    normal = to_unit(total)[shared]
    # the two sides of a sheet may cancel; triangles without area are dropped later
    flat = dots(facet, facet) == 0.0
    own = np.where(flat[:, None], np.array([0.0, 1.0, 0.0]), facet)
    cancelled = dots(total, total)[shared] < 1e-24
    return np.where(cancelled[..., None], own[:, None, :], normal)


def _read_obj(file: Path) -> list[_Piece]:
    """Return the parts of a Wavefront OBJ file in order of appearance.

    trimesh can split a file at its groups, but it counts relative indices from the file's end,
    forgets the names of materials without their library, and drops all normals and texture
    coordinates if one corner has none. Hence this reader.
    """
    text = file.read_text("utf-8", errors="replace").replace("\\\n", " ")
    # flat lists: lists of rows would slow down the garbage collector
    tables: dict[str, list[float]] = {"v": [], "vt": [], "vn": []}
    corners: list[tuple[int, int, int]] = []  # rows of v, vt, vn, or -1; three per triangle
    labels: list[tuple[str, str, str]] = []  # group, object, material of each triangle
    current = {"g": "", "o": "", "usemtl": ""}
    label = ("", "", "")
    known: dict[str, tuple[int, int, int]] = {}  # corners seen before; most occur several times
    for number, line in enumerate(text.splitlines(), start=1):
        key, *words = line.split("#")[0].split() or [""]
        try:
            if key in tables:
                row = [float(x) for x in words[:3]]
                least = 1 if key == "vt" else 3
                if len(row) < least:
                    raise ValueError(f"fewer than {least} coordinates")
                tables[key] += [*row, 0.0][:2] if key == "vt" else row
            elif key == "f":
                polygon = [known.get(w) or _obj_corner(w, tables, known) for w in words]
                if len(polygon) < 3:
                    raise ValueError("fewer than three corners")
                for i in range(1, len(polygon) - 1):
                    corners += [polygon[0], polygon[i], polygon[i + 1]]
                    labels.append(label)
            elif key in current:
                current[key] = " ".join(words)
                label = (current["g"], current["o"], current["usemtl"])
        except ValueError as error:
            raise FormatError(
                file,
                f"'{key}' with valid numbers in line {number}",
                f"{line.strip()[:60]!r} ({error})",
            ) from error
    if not labels:
        return []
    columns = list(zip(*labels, strict=True))
    # the first of groups, objects and materials that divides the faces, else any name
    divides = [c for c in columns if len(set(c)) > 1]
    named = [c for c in columns[:2] if c[0]]
    names = [*divides, *named, columns[0]][0]
    vertex = np.array(tables["v"]).reshape(-1, 3)
    # index -1 selects the last row, which is NaN
    texture = np.array(tables["vt"] + [math.nan] * 2).reshape(-1, 2)
    normal = np.array(tables["vn"] + [math.nan] * 3).reshape(-1, 3)
    face, face_uv, face_normal = np.moveaxis(np.array(corners).reshape(-1, 3, 3), -1, 0)
    order = {name: i for i, name in enumerate(dict.fromkeys(names))}
    index = np.array([order[name] for name in names])
    pieces = []
    for name, i in order.items():
        used, local = np.unique(face[index == i], return_inverse=True)
        pieces.append(
            _Piece(
                name or file.stem,
                vertex[used],
                local.reshape(-1, 3),
                normal[face_normal[index == i]],
                texture[face_uv[index == i]],
            )
        )
    return pieces


def _obj_corner(
    word: str, tables: dict[str, list[float]], known: dict[str, tuple[int, int, int]]
) -> tuple[int, int, int]:
    """Return the rows of an OBJ corner ``v``, ``v/vt``, ``v//vn`` or ``v/vt/vn``; -1 for none."""
    fields = [*word.split("/"), "", ""]

    def row(field: str, count: int) -> int:
        value = int(field)
        found = value - 1 if value > 0 else count + value
        if value == 0 or not 0 <= found < count:
            raise ValueError(f"index {value} of {count}")
        return found

    vertex = row(fields[0], len(tables["v"]) // 3)
    normal = row(fields[2], len(tables["vn"]) // 3) if fields[2] else -1
    try:
        texture = row(fields[1], len(tables["vt"]) // 2) if fields[1] else -1
    except ValueError:
        texture = -1  # some programs write indices without coordinates
    if "-" not in word:  # the meaning of a relative index depends on its place in the file
        known[word] = vertex, texture, normal
    return vertex, texture, normal


def _read_trimesh(file: Path) -> list[_Piece]:
    """Return the parts of a PLY, glTF or glb file, in the order of the file's geometries."""
    try:
        graph, geometries = _load_scene(file)
        uvs = {name: _corner_uvs(g) for name, g in geometries.items()}
        if file.suffix.lower() == ".ply" and not all(np.isnan(uv).all() for uv in uvs.values()):
            # trimesh loses a PLY file's normals where it splits vertices at texture seams
            _, geometries = _load_scene(file, fix_texture=False)
        names = _geometry_names(geometries, file)
        pieces = []
        for node in graph.nodes_geometry:
            matrix, geometry_key = graph[node]
            key = str(geometry_key)
            if key in geometries:
                pieces.append(_placed(geometries[key], np.asarray(matrix), names[key], uvs[key]))
    # a broken file raises many kinds of errors in trimesh; callers get one kind
    except Exception as error:
        raise FormatError(
            file, f"a readable {file.suffix.lower()} file", f"{type(error).__name__}: {error}"
        ) from error
    order = list(names.values())
    return sorted(pieces, key=lambda piece: order.index(piece.name))


def _load_scene(file: Path, **options: Any) -> tuple[Any, dict[str, trimesh.Trimesh]]:
    """Return the scene graph of a file and its geometries that consist of triangles."""
    import trimesh  # takes half a second to import, and most sessions do not need it

    # process=False, or trimesh would merge vertices and lose the file's normals
    scene = trimesh.load(str(file), force="scene", process=False, **options)
    if not isinstance(scene, trimesh.Scene):
        raise TypeError(f"trimesh made a {type(scene).__name__} of it")
    found = {name: g for name, g in scene.geometry.items() if isinstance(g, trimesh.Trimesh)}
    return scene.graph, found


def _geometry_names(geometries: dict[str, trimesh.Trimesh], file: Path) -> dict[str, str]:
    """Return part names by trimesh's geometry names.

    The primitives of one glTF mesh are named after their materials.
    """
    names = {key: file.stem if key == file.name else key for key in geometries}
    split = [k for k, g in geometries.items() if g.metadata.get("from_gltf_primitive")]
    materials = {
        key: str(getattr(getattr(geometries[key].visual, "material", None), "name", None) or "")
        for key in split
    }
    others = [name for key, name in names.items() if key not in materials]
    proposed = [*materials.values(), *others]
    if all(proposed) and len(set(proposed)) == len(proposed):
        names.update(materials)
    return names


def _corner_uvs(geometry: trimesh.Trimesh) -> Float:
    """Return texture coordinates (F, 3, 2) of a geometry's corners; NaN where it has none."""
    uv = getattr(geometry.visual, "uv", None)
    if uv is None or np.shape(uv)[:1] != (len(geometry.vertices),):
        uv = np.full((len(geometry.vertices), 2), np.nan)
    corners: Float = np.asarray(uv, dtype=np.float64)[:, :2][geometry.faces]
    return corners


def _placed(geometry: trimesh.Trimesh, matrix: Float, name: str, uvs: Float) -> _Piece:
    """Return a geometry placed by a node's 4 x 4 transform, with texture coordinates (F, 3, 2)."""
    linear = matrix[:3, :3]
    with np.errstate(invalid="ignore", over="ignore"):  # `load_mesh` rejects such vertices
        vertices = np.asarray(geometry.vertices, dtype=np.float64) @ linear.T + matrix[:3, 3]
    faces = np.asarray(geometry.faces, dtype=np.int64).reshape(-1, 3)
    mirrored = np.linalg.det(linear) < 0.0
    if "vertex_normals" in geometry._cache:  # present only if the file has normals
        # the cofactor matrix turns normals, and exists for singular transforms as well
        cofactor = np.cross(np.roll(linear, -1, axis=0), np.roll(linear, -2, axis=0))
        turned = np.asarray(geometry.vertex_normals) @ (-cofactor if mirrored else cofactor).T
        normals = turned[faces]
    else:
        normals = np.full((len(faces), 3, 3), np.nan)
    # a mirroring transform reverses the winding
    return _Piece(
        name,
        vertices,
        faces[:, ::-1] if mirrored else faces,
        normals[:, ::-1] if mirrored else normals,
        uvs[:, ::-1] if mirrored else uvs,
    )
