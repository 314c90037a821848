"""Export of designs: each part's material in the model of another program, and its geometry."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.document import Document, Varying
from traitbrdf.design.surface import SurfaceWeights
from traitbrdf.export.baking import Baked, Fitter, columns, painted_tables
from traitbrdf.export.gltf import GltfPart, GltfTarget, write_glb
from traitbrdf.export.lobes import fitting_pixels
from traitbrdf.export.mitsuba import MitsubaPart, write_mitsuba
from traitbrdf.export.openpbr import OpenPBRTarget, write_mtlx
from traitbrdf.export.pieces import Piece, Texels, pieces_of, unwrapped, write_obj
from traitbrdf.formats.images import write_exr
from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.scene.scene import Scene
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.material import Material
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]
Look = TypeVar("Look")

SUFFIXES = (".glb", ".mtlx", ".py")
"""Endings of the names of files that designs are exported to."""


@dataclass(frozen=True)
class Exported:
    """What an export wrote.

    Attributes
    ----------
    files : tuple of Path
        The file asked for is the first.
    errors : dict of part to float
        Mean relative L1 of a sphere of the exported material against that of the table, under
        lights that the fit did not see; 0 where tables are exported as they are.
    """

    files: tuple[Path, ...]
    errors: dict[str, float]

    def __str__(self) -> str:
        said = ", ".join(f"{part} {100.0 * error:.1f} %" for part, error in self.errors.items())
        others = "".join(f", {file.name}" for file in self.files[1:])
        return f"{self.files[0].name}{others}; error of a lit sphere: {said}"


def export_design(
    path: str | PathLike[str],
    scene: Scene,
    document: Document,
    embedding: BRDFEmbedding,
    texture_size: int = 1024,
    progress: Progress | None = None,
) -> Exported:
    """Write a design for another program, which the ending of the name tells.

    Parameters
    ----------
    path : path-like
        ``.glb``, ``.mtlx`` or ``.py``.
    scene : Scene
    document : Document, of the design
    embedding : BRDFEmbedding
    texture_size : int
        Texels on a side of the textures of parts that are painted locally.
    progress : called with (stage, fraction done); may raise to cancel

    Returns
    -------
    Exported

    Raises
    ------
    ValueError
        On another ending or size; nothing is written then.
    TypeError
        If the shape is neither a sphere nor a mesh.
    RuntimeError
        If a package of the extra ``export`` is needed and not installed.
    """
    target = Path(path)
    kinds = {".glb": _to_glb, ".mtlx": _to_mtlx, ".py": _to_mitsuba}
    if target.suffix not in kinds:
        raise ValueError(f"path: expected a name in {', '.join(SUFFIXES)}, got {str(path)!r}")
    whole = isinstance(texture_size, (int, np.integer)) and not isinstance(texture_size, bool)
    if not (whole and 16 <= texture_size <= 8192):
        raise ValueError(f"texture_size: expected 16 to 8192 texels, got {texture_size!r}")
    shown = _Shown(scene, document, embedding, int(texture_size), progress or _silent)
    return kinds[target.suffix](target, shown)


def _silent(stage: str, fraction: float) -> None:
    pass


class _Shown:
    """The parts of a design, cut into triangles, with texels where they are painted locally."""

    def __init__(
        self,
        scene: Scene,
        document: Document,
        embedding: BRDFEmbedding,
        texture_size: int,
        progress: Progress,
    ) -> None:
        self.scene, self.embedding, self.progress = scene, embedding, progress
        self.materials: Mapping[str, Material] = document.materials
        self.parts: list[tuple[Piece, Varying | None, Texels | None, Float32]] = []
        for piece in pieces_of(scene):
            varying = document.varying(piece.name)
            texels, amounts = None, np.zeros((0, 0), np.float32)
            if varying is not None:
                progress(f"unwrapping {piece.name}", 0.0)
                piece, texels = unwrapped(piece, texture_size)
                places = texels.places(scene.parts.index(piece.name))
                amounts = SurfaceWeights(scene, places).amounts(varying)
            self.parts.append((piece, varying, texels, amounts))

    def fitted(self, fitter: Fitter[Look]) -> list[tuple[Piece, Look, Baked[Look] | None, Any]]:
        """Return each part's piece, look and error, and what is baked for its texels."""
        found: list[tuple[Piece, Look, Baked[Look] | None, Any]] = []
        for i, (piece, varying, texels, amounts) in enumerate(self.parts):
            self.progress(f"fitting {piece.name}", i / len(self.parts))
            if varying is None or texels is None:
                one = fitter.material(self.materials[piece.name])
                found.append((piece, one.look, None, one.error))
                continue
            baked = fitter.bake(varying, amounts, self.progress)
            found.append((piece, baked.like, baked, texels.spread(baked.values)))
        return found


def _to_glb(path: Path, shown: _Shown) -> Exported:
    fitter = Fitter(GltfTarget(), shown.embedding, fitting_pixels(shown.embedding.grid_))
    parts, errors = [], {}
    for piece, look, baked, found in shown.fitted(fitter):
        errors[piece.name] = found if baked is None else baked.error
        parts.append(GltfPart(piece, look, None if baked is None else found))
    write_glb(path, shown.scene, parts)
    return Exported((path,), errors)


def _to_mtlx(path: Path, shown: _Shown) -> Exported:
    fitter = Fitter(OpenPBRTarget(), shown.embedding, fitting_pixels(shown.embedding.grid_))
    looks, errors, files, pieces = {}, {}, [path], []
    maps: dict[str, dict[str, Path]] = {}
    for piece, look, baked, found in shown.fitted(fitter):
        name = piece.name
        looks[name], errors[name] = look, found if baked is None else baked.error
        pieces.append(piece)
        if baked is None:
            continue
        maps[name] = {}
        for key, at in columns(look).items():
            file = path.with_name(f"{path.stem}_{name}_{key}.exr")
            values = found[..., at].astype(np.float32)
            write_exr(file, np.broadcast_to(values, (*values.shape[:2], 3)))
            maps[name][key] = Path(file.name)
            files.append(file)
    if maps:  # the textures need its coordinates
        files.append(path.with_suffix(".obj"))
        write_obj(files[-1], pieces)
    write_mtlx(path, looks, maps)
    return Exported(tuple(files), errors)


def _to_mitsuba(path: Path, shown: _Shown) -> Exported:
    parts, grid = [], shown.embedding.grid_

    def table(material: Material) -> TabulatedBRDF:
        values = material.values(shown.embedding).reshape(*grid.shape, 3)
        return TabulatedBRDF(grid, values, material.mirror, material.name or "")

    for piece, varying, texels, amounts in shown.parts:
        if varying is None or texels is None:
            parts.append(MitsubaPart(piece, [table(shown.materials[piece.name])]))
            continue
        materials, paint = painted_tables(varying, amounts)
        whole = {
            "cell": texels.spread(paint["cell"][:, None].astype(np.float64))[..., 0].ravel(),
            "share": np.stack(
                [texels.spread(axis[:, None])[..., 0].ravel() for axis in paint["share"]]
            ),
            "corners": paint["corners"],
        }
        parts.append(MitsubaPart(piece, [table(one) for one in materials], whole))
    write_mitsuba(path, shown.scene, parts)
    return Exported((path, path.with_suffix(".npz")), {p.piece.name: 0.0 for p in parts})
