"""The triangles of a scene's parts, texture coordinates for them, and the texels of a texture."""

from __future__ import annotations

import importlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.surface import Places
from traitbrdf.formats.files import atomic_path
from traitbrdf.scene.scene import Scene
from traitbrdf.scene.shapes import Mesh, Sphere

Float64 = NDArray[np.float64]
Int64 = NDArray[np.int64]

_SPHERE = (96, 48)  # segments around and from pole to pole
_DISC = 64  # segments of the ground
_GAP = 4  # texels between the charts of a texture
_FULL = 0.98  # share of an atlas's area that texels have to reach, or charts overlap


@dataclass(frozen=True)
class Piece:
    """The triangles of one part.

    Attributes
    ----------
    name : str, of the part
    positions, normals : (V, 3) float64
    faces : (F, 3) int64
    uvs : (V, 2) float64 or None
        u to the right, v up.
    """

    name: str
    positions: Float64
    normals: Float64
    faces: Int64
    uvs: Float64 | None


def pieces_of(scene: Scene) -> list[Piece]:
    """Return the triangles of a scene's parts; a sphere and the ground are cut into some.

    Parameters
    ----------
    scene : Scene
        Parts without triangles are left out.

    Raises
    ------
    TypeError
        On a shape that is neither a mesh nor a sphere.
    """
    shape, found = scene.shape, []
    if isinstance(shape, Sphere):
        found.append(_ball(shape))
    elif isinstance(shape, Mesh):
        for i, name in enumerate(shape.parts):
            mine = np.flatnonzero(shape.face_part == i)
            if len(mine):
                found.append(_part(shape, name, mine))
    else:
        raise TypeError(f"shape: expected a mesh or a sphere, got {type(shape).__name__}")
    if scene.ground:
        found.append(_ground(shape.center, scene.ground * shape.radius, shape.lowest))
    return found


def _part(mesh: Mesh, name: str, faces: Int64) -> Piece:
    """Return one part, with equal corners joined and triangles turned as their normals say."""
    index = mesh.faces[faces]
    normals = mesh.normals[index] if mesh.normals.ndim == 2 else mesh.normals[faces]
    columns = [mesh.vertices[index], normals]
    if mesh.uvs is not None:
        columns.append(mesh.uvs[index] if mesh.uvs.ndim == 2 else mesh.uvs[faces])
    corners = np.concatenate(columns, axis=-1).reshape(len(faces) * 3, -1)
    unique, place = np.unique(corners, axis=0, return_inverse=True)
    order = place.reshape(-1, 3)
    p = unique[order, :3]
    facing = np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0])
    back = (facing * unique[order, 3:6].sum(axis=1)).sum(axis=1) < 0.0
    order[back] = order[back][:, ::-1]
    uvs = unique[:, 6:8] if mesh.uvs is not None else None
    return Piece(name, unique[:, :3], unique[:, 3:6], order.astype(np.int64), uvs)


def _ball(ball: Sphere) -> Piece:
    around, down = _SPHERE
    u, v = np.meshgrid(np.linspace(0, 1, around + 1), np.linspace(0, 1, down + 1), indexing="xy")
    theta, phi = math.pi * (1.0 - v), 2.0 * math.pi * u
    out = np.stack(
        [np.sin(theta) * np.sin(phi), np.cos(theta), np.sin(theta) * np.cos(phi)], axis=-1
    ).reshape(-1, 3)
    row, column = np.meshgrid(np.arange(down), np.arange(around), indexing="ij")
    a = (row * (around + 1) + column).ravel()
    b, c, d = a + 1, a + around + 2, a + around + 1
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)])
    thin = (row.ravel() == 0), (row.ravel() == down - 1)  # one of the two is flat at a pole
    faces = faces[~np.concatenate(thin)]
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)
    return Piece(ball.parts[0], ball.center + ball.radius * out, out, faces, uvs)


def _ground(center: Float64, radius: float, height: float) -> Piece:
    turn = np.linspace(0.0, 2.0 * math.pi, _DISC, endpoint=False)
    rim = np.stack([np.sin(turn), np.zeros(_DISC), np.cos(turn)], axis=1)
    unit = np.concatenate([np.zeros((1, 3)), rim])
    places = np.array([center[0], height, center[2]]) + radius * unit
    i = np.arange(_DISC)
    faces = np.stack([np.zeros_like(i), 1 + i, 1 + (i + 1) % _DISC], axis=1)
    normals = np.broadcast_to((0.0, 1.0, 0.0), places.shape)
    return Piece("ground", places, normals, faces, 0.5 + 0.5 * unit[:, [0, 2]] * (1.0, -1.0))


def write_obj(path: str | PathLike[str], pieces: Sequence[Piece]) -> None:
    """Write pieces as a Wavefront OBJ file, each as an object of its part's name.

    Parameters
    ----------
    path : path-like
    pieces : sequence of Piece
    """
    lines, before = ["# written by traitbrdf"], 1
    for piece in pieces:
        lines.append(f"o {piece.name}")
        lines += [f"v {x:.9g} {y:.9g} {z:.9g}" for x, y, z in piece.positions.tolist()]
        uvs = np.zeros((len(piece.positions), 2)) if piece.uvs is None else piece.uvs
        lines += [f"vt {u:.7g} {v:.7g}" for u, v in uvs.tolist()]
        lines += [f"vn {x:.7g} {y:.7g} {z:.7g}" for x, y, z in piece.normals.tolist()]
        corners = (piece.faces + before).tolist()
        lines += ["f " + " ".join(f"{i}/{i}/{i}" for i in face) for face in corners]
        before += len(piece.positions)
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


# -- texels ---------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Texels:
    """Where the texels of a part's texture lie on its surface.

    Attributes
    ----------
    size : int, texels on a side
    place : (T,) int64, flat index of each texel that lies on a triangle; row 0 is the top
    positions, normals : (T, 3) float64
    """

    size: int
    place: Int64
    positions: Float64
    normals: Float64

    def places(self, part: int) -> Places:
        """Return positions, normals and the part of all texels, as masks take them."""
        index = np.full(len(self.place), part, np.int32)
        return self.positions.astype(np.float32), self.normals.astype(np.float32), index

    def spread(self, values: Float64) -> Float64:
        """Return a picture (size, size, n) of values (T, n); texels beside charts take the nearest.

        So no other colour bleeds in at the edges of charts.
        """
        import scipy.ndimage  # takes a tenth of a second

        known = np.zeros(self.size * self.size, np.bool_)
        known[self.place] = True
        whole = np.zeros((self.size * self.size, values.shape[1]))
        whole[self.place] = values
        square = known.reshape(self.size, self.size)
        near = scipy.ndimage.distance_transform_edt(
            ~square, return_distances=False, return_indices=True
        )
        picture: Float64 = whole.reshape(self.size, self.size, -1)[near[0], near[1]]
        return picture


def unwrapped(piece: Piece, size: int) -> tuple[Piece, Texels]:
    """Return a piece with texture coordinates that do not overlap, and its texels.

    Its own coordinates are kept where they do; else xatlas makes some.

    Parameters
    ----------
    piece : Piece
    size : int
        Texels on a side.

    Raises
    ------
    RuntimeError
        If xatlas is needed and not installed.
    """
    if piece.uvs is not None and (piece.uvs >= 0.0).all() and (piece.uvs <= 1.0).all():
        found = _texels(piece, piece.uvs, size)
        (bx, by), (cx, cy) = (
            (piece.uvs[piece.faces[:, i]] - piece.uvs[piece.faces[:, 0]]).T for i in (1, 2)
        )
        area = 0.5 * float(np.abs(bx * cy - by * cx).sum())
        if len(found.place) >= _FULL * area * size * size > 0.0:
            return piece, found
    xatlas = _xatlas()
    atlas = xatlas.Atlas()
    atlas.add_mesh(
        np.ascontiguousarray(piece.positions, np.float32),
        np.ascontiguousarray(piece.faces, np.uint32),
        np.ascontiguousarray(piece.normals, np.float32),
    )
    packing = xatlas.PackOptions()
    packing.resolution, packing.padding = size, _GAP
    atlas.generate(xatlas.ChartOptions(), packing)
    origin, faces, uvs = atlas[0]
    made = replace(
        piece, positions=piece.positions[origin], normals=piece.normals[origin],
        faces=faces.astype(np.int64), uvs=uvs.astype(np.float64),
    )  # fmt: skip
    return made, _texels(made, made.uvs, size)  # type: ignore[arg-type]


def _xatlas() -> ModuleType:
    try:
        return importlib.import_module("xatlas")
    except ImportError as error:
        raise RuntimeError(
            "local layers on a mesh without texture coordinates need xatlas: "
            "pip install 'traitbrdf[export]'"
        ) from error


def _texels(piece: Piece, uvs: Float64, size: int) -> Texels:
    """Find the triangle under the centre of every texel: rays onto the flat atlas."""
    flat = np.append(uvs, np.zeros((len(uvs), 1)), axis=1)
    corner = flat[piece.faces]
    side, up = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    wide = np.flatnonzero(np.abs(side[:, 0] * up[:, 1] - side[:, 1] * up[:, 0]) > 1e-14)
    # each triangle is a part of its own, because hits tell parts
    turned = np.broadcast_to((0.0, 0.0, 1.0), flat.shape)
    atlas = Mesh(flat, piece.faces[wide], turned, np.arange(len(wide)), [str(i) for i in wide])
    centre = (np.arange(size) + 0.5) / size
    u, v = np.meshgrid(centre, 1.0 - centre, indexing="xy")
    eye = np.stack([u, v, np.ones_like(u)], axis=-1).reshape(-1, 3)
    hit = atlas.intersect(eye, np.broadcast_to((0.0, 0.0, -1.0), eye.shape))
    place = np.flatnonzero(hit.part >= 0)
    face = wide[hit.part[place]]
    a, b, c = (uvs[piece.faces[face, i]] for i in range(3))
    p = np.stack([u.ravel()[place], v.ravel()[place]], axis=1) - a
    (bx, by), (cx, cy) = (b - a).T, (c - a).T
    whole = bx * cy - by * cx
    second, third = (p[:, 0] * cy - p[:, 1] * cx) / whole, (bx * p[:, 1] - by * p[:, 0]) / whole
    weights = np.stack([1.0 - second - third, second, third], axis=1)
    faces = piece.faces[face]
    positions = np.einsum("nc,nck->nk", weights, piece.positions[faces])
    normals = np.einsum("nc,nck->nk", weights, piece.normals[faces])
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    return Texels(size, place, positions, normals / np.maximum(length, 1e-12))
