"""What a file holds, in lines of text and as a picture: ``traitbrdf info FILE``."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from traitbrdf.formats.display import exposure_of, tone_map
from traitbrdf.formats.files import unknown_name
from traitbrdf.pictures import spheres
from traitbrdf.reflectance.brdf import Reflectance, TabulatedBRDF, albedo_of
from traitbrdf.reflectance.measured import MeasuredBRDF
from traitbrdf.scene.lights import EnvironmentMap
from traitbrdf.scene.meshes import load_mesh
from traitbrdf.session.editing import EditSession
from traitbrdf.space.library import default_embedding, default_library
from traitbrdf.space.traits import default_traits
from traitbrdf.testing import file_faults

Picture = NDArray[np.uint8]
Float64 = NDArray[np.float64]

MATERIALS = (".binary", ".bsdf", ".npz")
MAPS = (".exr", ".hdr", ".pic")
MESHES = (".obj", ".ply", ".gltf", ".glb")

_ANGLES = (0, 15, 30, 45, 60, 75, 85)  # degrees at which the albedo is told
_NEAREST = 5
_SIDE = 240  # pixels of each panel
_INK, _RULE = (40, 40, 40), (205, 205, 205)
_CHANNELS = ((200, 40, 40), (40, 150, 60), (50, 80, 210))


def facts(name: str) -> tuple[list[str], Picture | None]:
    """Return what a file holds: lines of text, and a picture where there is something to see.

    Parameters
    ----------
    name : str
        Path of a material, map, mesh or design, or the name of a library material.

    Raises
    ------
    FormatError, OSError
        If the file cannot be read.
    ValueError
        On another suffix, or an unknown name.
    """
    path = Path(name)
    suffix = path.suffix.lower()
    if suffix in MATERIALS:
        brdf: Reflectance = (
            MeasuredBRDF.read(path) if suffix == ".bsdf" else TabulatedBRDF.read(path)
        )
        return _material(brdf, file_faults(path))
    if suffix in MAPS:
        return _map(EnvironmentMap.read(path))
    if suffix in MESHES:
        mesh = load_mesh(path)
        lines = [
            f"{len(mesh.vertices)} vertices, {len(mesh.faces)} triangles, "
            f"{'with' if mesh.uvs is not None else 'without'} texture coordinates",
            f"bounding sphere: radius {mesh.radius:.4g} about {np.round(mesh.center, 4).tolist()}",
        ]
        for i, part in enumerate(mesh.parts):
            lines.append(f"{part}: {int((mesh.face_part == i).sum())} triangles")
        return lines, None
    if suffix == ".tbr":
        return _design(EditSession.load(path))
    if not suffix:
        return _material(default_library()[name], [])
    known = (*MATERIALS, *MAPS, *MESHES, ".tbr")
    raise ValueError(unknown_name("kind of file", suffix, known))


def _design(edit: EditSession) -> tuple[list[str], Picture | None]:
    lines = [repr(edit.scene)]
    for part in edit.scene.parts:
        painted = ", painted locally" if part in edit.varying else ""
        lines.append(f"{part}: {edit.material(part).name or 'coordinates'}{painted}")
    lines += [f"layer {i}: {layer!r}" for i, layer in enumerate(edit.layers)]
    return [*lines, *edit.history], None


def _map(environment: EnvironmentMap) -> tuple[list[str], Picture]:
    image = environment.image
    up = environment.irradiance(np.array([0.0, 1.0, 0.0]))
    lines = [
        f"{image.shape[0]} rows by {image.shape[1]} columns",
        f"radiance: mean {image.mean():.4g}, largest {image.max():.4g}",
        f"irradiance on the ground: {np.round(up, 4).tolist()}",
        f"negative texels set to 0: {environment.clipped_texels}",
    ]
    step = max(1, image.shape[0] // 512)
    small = image[::step, ::step]
    return lines, tone_map(small, exposure_of(small))


def _material(brdf: Reflectance, faults: list[str]) -> tuple[list[str], Picture]:
    embedding, space, library = default_embedding(), default_traits(), default_library()
    # measurements and models are looked at on the embedding's own grid
    table = (
        brdf
        if isinstance(brdf, TabulatedBRDF) and brdf.grid.layout == "folded"
        else TabulatedBRDF.from_model(brdf, embedding.grid_, str(getattr(brdf, "name", "")))
    )
    lines = [repr(brdf)]
    lines += [f"fault: {fault}" for fault in faults] or ["no faults"]
    for angle in _ANGLES:
        albedo = albedo_of(brdf.eval, math.radians(angle)) + brdf.mirror
        lines.append(f"albedo at {angle:2d} degrees: {np.round(albedo, 4).tolist()}")
    z = embedding.encode(table)
    scores = space.score(z)
    lines.append("traits: " + ", ".join(f"{name} {value:.2f}" for name, value in scores.items()))
    # alike in what the traits tell, which is what people see
    known = space.scores(library.coordinates)
    away = np.abs(known - np.array(list(scores.values()))).mean(axis=1)
    nearest = np.argsort(away)[:_NEAREST]
    lines.append(
        "nearest materials: "
        + ", ".join(f"{library.names[i]} ({away[i]:.2f})" for i in nearest.tolist())
    )
    return lines, portrait(table)


def portrait(table: TabulatedBRDF) -> Picture:
    """Draw a material (240, 720, 3): a lit sphere, its lobes, and its albedo by the view angle.

    Parameters
    ----------
    table : TabulatedBRDF of the "folded" layout
    """
    image = spheres([table], size=_SIDE)[0]
    lit = image.any(axis=-1)
    ball = tone_map(image, exposure_of(image[lit][None]))
    ball[~lit] = 255
    paper = Image.new("RGB", (3 * _SIDE, _SIDE), (255, 255, 255))
    paper.paste(Image.fromarray(ball), (0, 0))
    draw = ImageDraw.Draw(paper)
    for line, colour in _lobes(table):
        draw.line([(_SIDE + x, y) for x, y in line], fill=colour, width=2)
    base = _SIDE - 24
    draw.line([(_SIDE + 10, base), (2 * _SIDE - 10, base)], fill=_INK)
    draw.text((1.5 * _SIDE, _SIDE - 6), "lobes at 0, 30, 60 degrees", fill=_INK, anchor="ms")
    for line, colour in _albedos(table):
        draw.line([(2 * _SIDE + x, y) for x, y in line], fill=colour, width=2)
    draw.text((2.5 * _SIDE, _SIDE - 6), "albedo, 0 to 85 degrees", fill=_INK, anchor="ms")
    return np.asarray(paper)


def _lobes(table: TabulatedBRDF) -> Iterator[tuple[list[tuple[float, float]], tuple[int, ...]]]:
    """Yield polar curves of the cube root of f cos in the plane of incidence."""
    out = np.radians(np.linspace(-89.5, 89.5, 359))
    wo = np.stack([np.sin(out), np.zeros_like(out), np.cos(out)], axis=-1)
    curves = []
    for angle in (0.0, 30.0, 60.0):
        a = math.radians(angle)
        wi = np.broadcast_to((-math.sin(a), 0.0, math.cos(a)), wo.shape)
        curves.append(np.cbrt(table.eval(wi, wo) * wo[:, 2:]))
    most = max(float(curve.max()) for curve in curves) or 1.0
    reach, base = 0.5 * _SIDE - 14, _SIDE - 24
    for curve in curves:
        for channel, colour in enumerate(_CHANNELS):
            r = reach * curve[:, channel] / most
            x, y = 0.5 * _SIDE + r * np.sin(out), base - r * np.cos(out) * (base - 8) / reach
            yield list(zip(x.tolist(), y.tolist(), strict=True)), colour


def _albedos(table: TabulatedBRDF) -> Iterator[tuple[list[tuple[float, float]], tuple[int, ...]]]:
    """Yield the axes and the curves of the albedo."""
    left, right, top, base = 14.0, _SIDE - 10.0, 10.0, _SIDE - 24.0
    for level in (0.0, 0.5, 1.0):
        y = base + (top - base) * level
        yield [(left, y), (right, y)], _RULE
    angles = np.radians(np.linspace(0.0, 85.0, 35))
    albedo = np.clip(table.albedo(angles), 0.0, 1.05)
    x = np.linspace(left, right, len(angles))
    for channel, colour in enumerate(_CHANNELS):
        height = base + (top - base) * albedo[:, channel]
        yield list(zip(x.tolist(), height.tolist(), strict=True)), colour
