"""OpenPBR Surface 1.1 as MaterialX defines it, and `.mtlx` files.

The model is MaterialX 1.39's node graph ``open_pbr_surface`` with its layers by directional albedo.
Its fuzz is not reciprocal; it is taken as the mean of both ways here.
"""

from __future__ import annotations

import functools
import importlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

from traitbrdf.export.lobes import ALPHAS, ANGLES, Pixels, fuzz_albedo
from traitbrdf.formats.files import atomic_path
from traitbrdf.reflectance.models import fresnel_dielectric

Float64 = NDArray[np.float64]
RGB = tuple[float, float, float]

_DENSEST = 3.0  # index of refraction
_COAT_IOR = 1.5
_COLOUR_INPUTS = ("base_color", "specular_color", "fuzz_color")


@dataclass(frozen=True)
class OpenPBRLook:
    """Inputs of ``open_pbr_surface``, by their own names; the others keep what `FIXED` says.

    Attributes
    ----------
    base_color : RGB in [0, 1], linear Rec.709
    base_metalness : float in [0, 1]
    specular_color : RGB in [0, 1]
        Tint of a dielectric's reflection; of a metal's towards grazing angles.
    specular_roughness : float in [0, 1]
    specular_ior : float in [1, 3]
    coat_weight, coat_roughness : float in [0, 1]
    fuzz_weight : float in [0, 1]
    fuzz_color : RGB in [0, 1]
    fuzz_roughness : float in [0, 1]
    """

    base_color: RGB
    base_metalness: float
    specular_color: RGB
    specular_roughness: float
    specular_ior: float
    coat_weight: float = 0.0
    coat_roughness: float = 0.0
    fuzz_weight: float = 0.0
    fuzz_color: RGB = (1.0, 1.0, 1.0)
    fuzz_roughness: float = 0.5


FIXED = {"coat_ior": _COAT_IOR, "coat_darkening": 0.0}
"""Inputs that are written with one value, because their defaults are others."""


class OpenPBRTarget:
    """`OpenPBRLook` as a `traitbrdf.export.fitting.Target`."""

    size = 16

    def look(self, vector: Float64) -> OpenPBRLook:
        """Return the inputs of a vector (16,) in [0, 1]."""
        v = [float(x) for x in vector]
        least = float(ALPHAS[0]) ** 0.5
        return OpenPBRLook(
            base_color=(v[0] ** 2, v[1] ** 2, v[2] ** 2),
            base_metalness=v[3],
            specular_color=(v[5], v[6], v[7]),
            specular_roughness=least + (1.0 - least) * v[4],
            specular_ior=1.0 + (_DENSEST - 1.0) * v[8],
            coat_weight=v[9],
            coat_roughness=least + (1.0 - least) * v[10],
            fuzz_weight=v[15],
            fuzz_color=(v[11] ** 2, v[12] ** 2, v[13] ** 2),
            fuzz_roughness=0.1 + 0.9 * v[14],
        )

    def starts(self, colour: Float64, roughness: float) -> Iterator[Float64]:
        """Return a plastic, a metal, a coated body and a cloth of a colour and roughness."""
        root = np.sqrt(colour)
        plain = np.full(self.size, 0.01)
        plain[:3], plain[4], plain[5:8], plain[8] = root, roughness, 0.98, 0.25
        plain[10], plain[11:14], plain[14] = 0.2, root, 0.5
        yield plain
        metal = plain.copy()
        metal[3] = 0.98
        yield metal
        coated = plain.copy()
        coated[9], coated[4] = 0.9, min(1.6 * roughness, 0.95)
        coated[10] = 0.4 * roughness
        yield coated
        cloth = plain.copy()
        cloth[15], cloth[8], cloth[14] = 0.4, 0.1, roughness
        yield cloth

    def further(self, _vector: Float64) -> Iterator[Float64]:
        """Return no vectors: films are not written."""
        return iter(())

    def cost(self, vector: Float64) -> Float64:
        """Return residuals (6,): coat and fuzz only where they show, metal or none, no tint."""
        between = vector[3] * (1.0 - vector[3])
        return 0.003 * np.array([vector[9], vector[15], between, *(1.0 - vector[5:8])])

    def image(self, look: OpenPBRLook, pixels: Pixels) -> Float64:
        """Return the radiance (m, 3) of pixels."""
        coat = look.coat_weight
        rough = look.specular_roughness
        under = min(1.0, 2.0 * look.coat_roughness**4 + rough**4) ** 0.25
        alpha = (coat * under + (1.0 - coat) * rough) ** 2
        ratio = look.specular_ior / _COAT_IOR
        ior = coat * max(ratio, 1.0 / ratio) + (1.0 - coat) * look.specular_ior
        lobe, albedo = pixels.ggx(alpha), pixels.ggx_albedo(alpha)
        missing = _missing(albedo)
        reflected, through = _dielectric(lobe, albedo, missing, ior)
        base, tint = np.array(look.base_color), np.array(look.specular_color)
        dielectric = (
            base * (through * pixels.diffuse().sum(axis=1))[:, None] + tint * reflected[:, None]
        )
        # Schlick's term, bent so that the tint is right at 82 degrees: Hoffman, "Fresnel Equations
        # Considered Harmful" (2019)
        edge, away = 1.0 / 7.0, (1.0 - ANGLES[:, None])
        bend = (base + (1.0 - base) * (1.0 - edge) ** 5) * (1.0 - tint) / (edge * (1.0 - edge) ** 6)
        fresnel = base + (1.0 - base) * away**5 - bend * ANGLES[:, None] * away**6
        metal = lobe @ np.maximum(fresnel, 0.0) * (1.0 + base * missing[:, None])
        image = look.base_metalness * metal + (1.0 - look.base_metalness) * dielectric
        if coat > 1e-4:
            alpha = look.coat_roughness**2
            lobe, albedo = pixels.ggx(alpha), pixels.ggx_albedo(alpha)
            reflected, through = _dielectric(lobe, albedo, _missing(albedo), _COAT_IOR)
            image = image * (1.0 - coat * (1.0 - through))[:, None] + coat * reflected[:, None]
        if look.fuzz_weight > 1e-4:
            fibres = pixels.fuzz(look.fuzz_roughness)
            hidden = look.fuzz_weight * fuzz_albedo(pixels.cosine, look.fuzz_roughness)
            image = image * (1.0 - hidden)[:, None]
            image = image + look.fuzz_weight * np.array(look.fuzz_color) * fibres[:, None]
        return np.asarray(image, np.float64)


def _dielectric(
    lobe: Float64, albedo: Float64, missing: Float64, ior: float
) -> tuple[Float64, Float64]:
    """Return the images (m,) of a dielectric's reflection, and the share (m,) that it lets through.

    `lobe` and `albedo` (m, angles) are a GGX lobe's, `missing` (m,) is `_missing` of it. What is
    let through is by Schlick's term there, and what is reflected by Fresnel's equations.
    """
    f0 = ((ior - 1.0) / (ior + 1.0)) ** 2
    more = 1.0 + f0 * missing
    schlick = f0 + (1.0 - f0) * (1.0 - ANGLES) ** 5
    through = np.clip(1.0 - albedo @ schlick * more, 0.0, 1.0)
    return lobe @ fresnel_dielectric(ANGLES, ior) * more, through


def _missing(albedo: Float64) -> Float64:
    """Return what bounces more than once (m,), over the albedo; MaterialX adds it."""
    whole = albedo.sum(axis=1)
    return np.asarray((1.0 - whole) / whole)


# -- files ----------------------------------------------------------------------------------------


def write_mtlx(
    path: str | PathLike[str],
    looks: Mapping[str, OpenPBRLook],
    maps: Mapping[str, Mapping[str, Path]] | None = None,
) -> None:
    """Write one OpenPBR material for each part, and which part has which.

    Parameters
    ----------
    path : path-like
    looks : mapping of part to OpenPBRLook
    maps : mapping of part to the file of each input that is a texture
        Colours are in linear Rec.709, as all numbers of the file are.

    Raises
    ------
    RuntimeError
        If the materialx package is not installed.
    ValueError
        If MaterialX finds a fault in the file, which is then not written.
    """
    mx = _materialx()
    document = mx.createDocument()
    document.setDataLibrary(_standard_library())
    document.setColorSpace("lin_rec709")
    assigned = document.addLook("traitbrdf")
    for part, look in looks.items():
        name = document.createValidChildName(part)
        shader = document.addNode("open_pbr_surface", f"{name}_surface", "surfaceshader")
        textures = (maps or {}).get(part, {})
        for key, value in {**vars(look), **FIXED}.items():
            if key in textures:
                kind = "color3" if key in _COLOUR_INPUTS else "float"
                image = document.addNode("image", f"{name}_{key}", kind)
                image.setInputValue("file", str(textures[key]), "filename")
                shader.addInput(key, kind).setConnectedNode(image)
            elif isinstance(value, tuple):
                shader.setInputValue(key, mx.Color3(*value))
            else:
                shader.setInputValue(key, float(value))
        material = document.addMaterialNode(name, shader)
        assignment = assigned.addMaterialAssign(f"{name}_assign", material.getName())
        assignment.setGeom(f"/{name}")
    sound, fault = document.validate()
    if not sound:
        raise ValueError(f"expected a document that MaterialX accepts, it says: {fault}")
    with atomic_path(path) as temporary:
        mx.writeToXmlFile(document, str(temporary))


def _materialx() -> ModuleType:
    try:
        return importlib.import_module("MaterialX")
    except ImportError as error:
        raise RuntimeError(
            "MaterialX files need the materialx package: pip install 'traitbrdf[export]'"
        ) from error


@functools.cache
def _standard_library() -> object:
    """Return MaterialX's own definitions, which documents are checked against."""
    mx = _materialx()
    library = mx.createDocument()
    mx.loadLibraries(mx.getDefaultDataLibraryFolders(), mx.getDefaultDataSearchPath(), library)
    return library
