"""Export of designs: each part's material in the model of another program, and its geometry."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from traitbrdf.design.document import Document, Varying
from traitbrdf.design.surface import SurfaceWeights
from traitbrdf.export.baking import Baked, Fitter, columns, painted_tables
from traitbrdf.export.fitting import Target
from traitbrdf.export.gltf import GltfPart, GltfTarget, write_glb
from traitbrdf.export.lobes import PicturePixels, Pixels, fitting_pixels
from traitbrdf.export.mitsuba import MitsubaPart, write_mitsuba
from traitbrdf.export.openpbr import OpenPBRTarget, write_mtlx
from traitbrdf.export.pieces import Piece, Texels, pieces_of, unwrapped, write_obj
from traitbrdf.formats.display import exposure_of, tone_map
from traitbrdf.formats.files import as_path
from traitbrdf.formats.images import write_exr
from traitbrdf.reflectance.brdf import TabulatedBRDF
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.scene import Scene
from traitbrdf.space.embedding import BRDFEmbedding
from traitbrdf.space.material import Material
from traitbrdf.transport.visibility import Progress

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Look = TypeVar("Look")

SUFFIXES = (".glb", ".mtlx", ".py")
"""Endings of the names of files that designs are exported to."""


class Pair(NamedTuple):
    """A material as a table and as a file says it, to compare.

    Attributes
    ----------
    part : str
    material : TabulatedBRDF
    image : what gives the radiance (m, 3) of pixels by the file's own model
    """

    part: str
    material: TabulatedBRDF
    image: Callable[[Pixels], Float64]


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
    pairs : tuple of Pair
        The materials of the parts, where nothing is painted locally; none for tables.
    """

    files: tuple[Path, ...]
    errors: dict[str, float]
    pairs: tuple[Pair, ...] = field(default=(), repr=False)

    def __str__(self) -> str:
        said = ", ".join(f"{part} {100.0 * error:.1f} %" for part, error in self.errors.items())
        others = "".join(f", {file.name}" for file in self.files[1:])
        return f"{self.files[0].name}{others}; error of a lit sphere: {said}"

    def picture(self, environment: EnvironmentMap, size: int = 128) -> NDArray[np.uint8]:
        """Draw spheres (2 size, n size, 3): the table of each part, and what the file says below.

        Parameters
        ----------
        environment : EnvironmentMap
        size : int
            Pixels of a sphere.

        Raises
        ------
        ValueError
            If tables were exported, which need no comparison.
        """
        if not self.pairs:
            raise ValueError("picture: expected a file with fitted materials, got one with tables")
        pixels = PicturePixels(self.pairs[0].material.grid, environment, size)
        columns = []
        for pair in self.pairs:
            values = pair.material.values.reshape(-1, 3)
            mirror = np.asarray(pair.material.mirror, np.float64)
            both = [
                pixels.picture(functools.partial(Pixels.of_table, values=values, mirror=mirror)),
                pixels.picture(pair.image),
            ]
            lit = both[0].any(axis=-1)
            exposure = exposure_of(both[0][lit][None])
            columns.append(np.concatenate([tone_map(one, exposure) for one in both]))
        return np.concatenate(columns, axis=1)


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
    target = as_path(path)
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

    def table(self, material: Material) -> TabulatedBRDF:
        """Return a material as a table."""
        grid = self.embedding.grid_
        values = material.values(self.embedding).reshape(*grid.shape, 3)
        return TabulatedBRDF(grid, values, material.mirror, material.name or "")

    def pairs(self, target: Target[Look], looks: Mapping[str, Look]) -> tuple[Pair, ...]:
        """Return the parts' materials beside their fits."""
        return tuple(
            Pair(part, self.table(self.materials[part]), functools.partial(target.image, look))
            for part, look in looks.items()
        )

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
    target = GltfTarget()
    fitter = Fitter(target, shown.embedding, fitting_pixels(shown.embedding.grid_))
    parts, errors, looks = [], {}, {}
    for piece, look, baked, found in shown.fitted(fitter):
        errors[piece.name] = found if baked is None else baked.error
        looks[piece.name] = look
        parts.append(GltfPart(piece, look, None if baked is None else found))
    write_glb(path, shown.scene, parts)
    return Exported((path,), errors, shown.pairs(target, looks))


def _to_mtlx(path: Path, shown: _Shown) -> Exported:
    target = OpenPBRTarget()
    fitter = Fitter(target, shown.embedding, fitting_pixels(shown.embedding.grid_))
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
    return Exported(tuple(files), errors, shown.pairs(target, looks))


def _to_mitsuba(path: Path, shown: _Shown) -> Exported:
    parts = []
    for piece, varying, texels, amounts in shown.parts:
        if varying is None or texels is None:
            parts.append(MitsubaPart(piece, [shown.table(shown.materials[piece.name])]))
            continue
        materials, paint = painted_tables(varying, amounts)
        square = texels.spread(np.stack([paint["cell"], *paint["share"]], axis=1))
        flat = square.reshape(-1, square.shape[-1]).T
        whole = {"cell": flat[0], "share": flat[1:], "corners": paint["corners"]}
        parts.append(MitsubaPart(piece, [shown.table(one) for one in materials], whole))
    write_mitsuba(path, shown.scene, parts)
    errors = dict.fromkeys((part.piece.name for part in parts), 0.0)
    return Exported((path, path.with_suffix(".npz")), errors)
