"""Export of designs: each part's material in the model of another program, and its geometry."""

from __future__ import annotations

import functools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from traitbrdf.arguments import whole
from traitbrdf.design.document import Document, Varying
from traitbrdf.design.surface import SurfaceWeights
from traitbrdf.export.baking import Fitter, columns, painted_tables
from traitbrdf.export.fitting import Target
from traitbrdf.export.gltf import GltfPart, GltfTarget, write_glb
from traitbrdf.export.lobes import PicturePixels, Pixels, fitting_pixels
from traitbrdf.export.mitsuba import MitsubaPart, write_mitsuba
from traitbrdf.export.openpbr import OpenPBRTarget, write_mtlx
from traitbrdf.export.pieces import Piece, Texels, pieces_of, unwrapped, write_obj
from traitbrdf.formats.display import exposure_of, tone_map
from traitbrdf.formats.files import as_path, writable
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

_LARGEST = 8192  # texels on a side

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
    FileNotFoundError, IsADirectoryError, PermissionError
        If the file could not be written; before any fit.
    TypeError
        If the shape is neither a sphere nor a mesh.
    RuntimeError
        If a package of the extra ``export`` is needed and not installed.
    """
    target = as_path(path)
    kinds = {".glb": _to_glb, ".mtlx": _to_mtlx, ".py": _to_mitsuba}
    if target.suffix not in kinds:
        raise ValueError(f"path: expected a name in {', '.join(SUFFIXES)}, got {str(path)!r}")
    size = whole(texture_size, "texture_size", 16)
    if size > _LARGEST:
        raise ValueError(f"texture_size: expected up to {_LARGEST} texels, got {texture_size!r}")
    writable(target)  # fits take long
    shown = _Shown(scene, document, embedding, size, progress or _silent)
    return kinds[target.suffix](target, shown)


def _silent(stage: str, fraction: float) -> None:
    pass


@dataclass(frozen=True)
class _Fitted(Generic[Look]):
    """A part in a target's parameters; `textures` (size, size, p) where it is painted locally."""

    piece: Piece
    look: Look
    error: float
    textures: Float64 | None = None


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

    def fitted(self, target: Target[Look]) -> list[_Fitted[Look]]:
        """Return the parts in a target's parameters."""
        fitter = Fitter(target, self.embedding, fitting_pixels(self.embedding.grid_))
        found: list[_Fitted[Look]] = []
        for i, (piece, varying, texels, amounts) in enumerate(self.parts):
            self.progress(f"fitting {piece.name}", i / len(self.parts))
            if varying is None or texels is None:
                one = fitter.material(self.materials[piece.name])
                found.append(_Fitted(piece, one.look, one.error))
                continue
            baked = fitter.bake(varying, amounts, self.progress)
            textures = texels.spread(baked.values)
            found.append(_Fitted(piece, baked.like, baked.error, textures))
        return found

    def exported(
        self, files: Sequence[Path], target: Target[Look], parts: Sequence[_Fitted[Look]]
    ) -> Exported:
        """Return what was written, with the parts' materials beside their fits."""
        pairs = tuple(
            Pair(
                part.piece.name, self.materials[part.piece.name].as_table(self.embedding),
                functools.partial(target.image, part.look),
            )
            for part in parts
        )  # fmt: skip
        return Exported(tuple(files), {part.piece.name: part.error for part in parts}, pairs)


def _to_glb(path: Path, shown: _Shown) -> Exported:
    target = GltfTarget()
    parts = shown.fitted(target)
    write_glb(path, shown.scene, [GltfPart(one.piece, one.look, one.textures) for one in parts])
    return shown.exported([path], target, parts)


def _to_mtlx(path: Path, shown: _Shown) -> Exported:
    target = OpenPBRTarget()
    parts, files = shown.fitted(target), [path]
    maps: dict[str, dict[str, Path]] = {}
    for part in parts:
        if part.textures is None:
            continue
        name = part.piece.name
        maps[name] = {}
        for key, at in columns(part.look).items():
            file = path.with_name(f"{path.stem}_{name}_{key}.exr")
            values = part.textures[..., at].astype(np.float32)
            write_exr(file, np.broadcast_to(values, (*values.shape[:2], 3)))
            maps[name][key] = Path(file.name)
            files.append(file)
    if maps:  # the textures need its coordinates
        files.append(path.with_suffix(".obj"))
        write_obj(files[-1], [part.piece for part in parts])
    write_mtlx(path, {part.piece.name: part.look for part in parts}, maps)
    return shown.exported(files, target, parts)


def _to_mitsuba(path: Path, shown: _Shown) -> Exported:
    parts = []
    for piece, varying, texels, amounts in shown.parts:
        materials, spread = [shown.materials[piece.name]], None
        if varying is not None and texels is not None:
            materials, paint = painted_tables(varying, amounts)
            square = texels.spread(np.stack([paint["cell"], *paint["share"]], axis=1))
            flat = square.reshape(-1, square.shape[-1]).T
            spread = {"cell": flat[0], "share": flat[1:], "corners": paint["corners"]}
        tables = [one.as_table(shown.embedding) for one in materials]
        parts.append(MitsubaPart(piece, tables, spread))
    write_mitsuba(path, shown.scene, parts)
    errors = dict.fromkeys((part.piece.name for part in parts), 0.0)
    return Exported((path, path.with_suffix(".npz")), errors)
