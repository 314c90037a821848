"""Read meshes from OBJ, PLY and glTF files."""

from __future__ import annotations

import re
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from traitbrdf.formats.files import FormatError, as_path
from traitbrdf.formats.gltf import read_gltf
from traitbrdf.formats.polygons import FLAT, read_obj, read_ply
from traitbrdf.host import steady
from traitbrdf.scene.shapes import Mesh, dots, to_unit

Float = NDArray[np.float64]

_READERS = {".obj": read_obj, ".ply": read_ply, ".gltf": read_gltf, ".glb": read_gltf}

# names that programs write for unnamed pieces
_PLACEHOLDER = re.compile(r"(geometry|GLTF|mesh|default)?([ _.]?\d+)?", re.IGNORECASE)


@steady
def load_mesh(path: str | PathLike[str]) -> Mesh:
    """Read a mesh file: Wavefront OBJ, PLY, glTF or glb.

    Parts are the named pieces of the file. For OBJ they are its groups (``g``) if these divide the
    faces, else its objects (``o``), else its materials (``usemtl``). For glTF they are its meshes,
    and the materials within a mesh of several. A file without names is one part, named after the
    file.

    Normals are those of the file. Where it has none, the normals of the triangles around a vertex
    are averaged, weighted by their angles, also across the borders of parts; but glTF faces are
    flat then, and so are those of an OBJ file after ``s off``, while others are averaged within
    their smoothing group. Concave polygons are cut by ear clipping. The nodes of a glTF scene are
    placed by their transforms; units and axes are not changed. Texture coordinates are kept, with v
    upwards; corners without any get 0, 0 if others have some. docs/files.md lists what of each
    format is read, refused and ignored.

    Parameters
    ----------
    path : path-like
        Its suffix selects the format.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    FormatError
        If the format is another, the file cannot be read, needs what is not supported, has no
        triangles with an area, or has vertices that are not finite.
    """
    file = as_path(path)
    if not file.exists():
        raise FileNotFoundError(f"{file}: no such mesh file")
    suffix = file.suffix.lower()
    if not file.is_file() or suffix not in _READERS:
        got = repr(file.suffix) if file.is_file() else "a folder"
        raise FormatError(file, f"a mesh file ({', '.join(_READERS)})", got)
    pieces = [piece for piece in _READERS[suffix](file) if len(piece.faces)]
    if not pieces:
        raise FormatError(file, "triangles", "none")
    start = np.cumsum([0] + [len(piece.vertices) for piece in pieces])
    faces = np.concatenate([p.faces + s for p, s in zip(pieces, start, strict=False)])
    vertices = np.concatenate([piece.vertices for piece in pieces])
    bad = int((~np.isfinite(vertices)).any(axis=1).sum())
    if bad:
        raise FormatError(file, "finite vertices", f"{bad} that are not")
    normals = np.concatenate([piece.normals for piece in pieces])
    with np.errstate(over="ignore"):
        length = np.sqrt(dots(normals, normals))
    missing = ~(np.isfinite(length) & (length > 0.0))
    if missing.any():
        smoothing = np.concatenate([piece.smoothing for piece in pieces])
        normals[missing] = _corner_normals(vertices, faces, smoothing)[missing]
    uvs = np.concatenate([piece.uvs for piece in pieces])
    textured = np.isfinite(uvs).all(axis=-1, keepdims=True)
    names = [piece.name or file.stem for piece in pieces]
    if len(set(names)) == 1 and _PLACEHOLDER.fullmatch(names[0]):
        names = [file.stem] * len(names)
    index = np.concatenate(
        [np.full(len(p.faces), names.index(n)) for p, n in zip(pieces, names, strict=True)]
    )
    try:
        mesh = Mesh(
            vertices,
            faces,
            normals,
            np.unique(index, return_inverse=True)[1],
            tuple(dict.fromkeys(names)),
            np.where(textured, uvs, 0.0) if textured.any() else None,
        )
    except ValueError as error:
        raise FormatError(file, "triangles with an area", str(error)) from error
    used = np.unique(mesh.face_part)
    if len(used) == len(mesh.parts):
        return mesh
    parts = tuple(mesh.parts[i] for i in used)  # no parts of no triangles
    part = np.searchsorted(used, mesh.face_part)
    return Mesh(mesh.vertices, mesh.faces, mesh.normals, part, parts, mesh.uvs)


def _corner_normals(
    vertices: Float, faces: NDArray[np.int64], smoothing: NDArray[np.int64]
) -> Float:
    """Return unit normals (F, 3, 3) of the corners, averaged over the triangles at one position.

    Only triangles of one smoothing group count together, and none for a flat one.

    Weighted by the angle of the corner (Thuermer & Wuthrich, "Computing Vertex Normals from
    Polygonal Facets", 1998), so that the result does not depend on how a polygon was split.
    """
    _, weld = np.unique(vertices + 0.0, axis=0, return_inverse=True)  # -0.0 becomes 0.0
    count = int(weld.max()) + 1
    group = np.where(smoothing == FLAT, -2 - np.arange(len(faces)), smoothing)  # each its own
    group = np.unique(group, return_inverse=True)[1].ravel()
    place = weld.reshape(-1)[faces] + count * group[:, None]
    shared = np.unique(place, return_inverse=True)[1].reshape(faces.shape)
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
