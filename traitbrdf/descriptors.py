"""Physical descriptors of a BRDF: what a gloss meter, a colorimeter or a person would read off it.

Every descriptor looks at values of f alone, never at a model's parameters, so that measured and
made materials are read alike. `DESCRIPTORS` says of each what it is, its unit and its source.

Two parts of a reflectance are told apart here: the *body* is what is left far from the highlight
(least f for theta_h of 35 to 50 degrees), the *lobe* is what stands above it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from traitbrdf.brdf import TabulatedBRDF
from traitbrdf.directions import from_half_diff_angles

Float64 = NDArray[np.float64]

LUMINANCE = np.array([0.2126, 0.7152, 0.0722])
"""Rec.709 luminance of linear RGB."""

_XYZ = np.array(
    [
        [0.41239080, 0.35758434, 0.18048079],
        [0.21263901, 0.71516868, 0.07219232],
        [0.01933082, 0.11919478, 0.95053215],
    ]
)  # linear Rec.709 to CIE XYZ, white D65 (ITU-R BT.709, SMPTE RP 177)

_SEEN_FROM = math.radians(30.0)  # the angle whose directional albedo is read

_BLACK_GLASS = 0.1000562
"""Fresnel reflectance of the gloss standard at 60 degrees: n = 1.567, 100 gloss units (ASTM D523)."""

_BLACK_GLASS_20 = 0.0490782


class Descriptor(NamedTuple):
    """What a descriptor is: one line, its unit, and where it comes from."""

    meaning: str
    unit: str
    source: str


DESCRIPTORS: Mapping[str, Descriptor] = MappingProxyType(
    {
        "highlight": Descriptor(
            "contrast of highlight and body, difference of cube roots of their radiance factors",
            "1",
            "contrast gloss, Hunter 1937; cube roots as Pellacini, Ferwerda & Greenberg 2000, eq. 4",
        ),
        "gloss_20": Descriptor("specular gloss at 20 degrees", "GU", "ASTM D523"),
        "gloss_60": Descriptor("specular gloss at 60 degrees", "GU", "ASTM D523"),
        "haze": Descriptor(
            "reflectance 2 degrees beside the mirror direction over that in it", "1", "ASTM E430"
        ),
        "image": Descriptor(
            "distinctness of image: 1 less reflectance at 0.3 degrees over that at 0",
            "1",
            "ASTM E430; Hunter 1937, distinctness-of-reflected-image gloss",
        ),
        "width": Descriptor(
            "log of theta_h at which the lobe has fallen half way to the body",
            "log rad",
            "half width of the lobe; d = 1 - alpha in Pellacini et al. 2000",
        ),
        "sheen": Descriptor(
            "log of f at theta_h 68 over 40 degrees, both directions near each other",
            "1",
            "asperity scattering of cloth and dust, Koenderink & Pont 2003; Hunter's sheen, 1937",
        ),
        "fresnel": Descriptor(
            "log of the lobe's peak times cosine at 70 over 15 degrees of incidence",
            "1",
            "Fresnel: dielectrics rise towards grazing, metals hardly",
        ),
        "lightness": Descriptor(
            "cube root of the luminous albedo at 30 degrees", "1", "CIE 1976 lightness"
        ),
        "body_lightness": Descriptor(
            "the same with the lobe counted by a third",
            "1",
            "observers discount highlights, not wholly: Todd, Norman & Mingolla 2004",
        ),
        "specular": Descriptor("luminous albedo of the lobe at 30 degrees", "1", "energy"),
        "diffuse": Descriptor("luminous albedo of the body", "1", "energy"),
        "tint": Descriptor(
            "standard deviation of the log RGB of the lobe at its peak", "1", "chroma of the lobe"
        ),
        "red": Descriptor("log of the red albedo over the mean log of the others'", "1", "albedo"),
        "green": Descriptor("the same for green", "1", "albedo"),
        "blue": Descriptor("the same for blue", "1", "albedo"),
        "diffuse_hue": Descriptor("hue angle of the body", "degrees", "CIELAB, D65"),
        "diffuse_chroma": Descriptor("chroma of the body", "C*ab", "CIELAB, D65"),
        "specular_hue": Descriptor("hue angle of the lobe at its peak", "degrees", "CIELAB, D65"),
        "specular_chroma": Descriptor("chroma of the lobe scaled to white", "C*ab", "CIELAB, D65"),
        "gold": Descriptor(
            "log distance of the lobe's colour from gold's, negated",
            "1",
            "reflectance of gold at normal incidence: Johnson & Christy 1972",
        ),
    }
)
"""What `descriptors` reads, in this order."""

_GOLD = np.log([1.0, 0.753, 0.374])  # linear Rec.709, over the greatest channel


def cielab(rgb: ArrayLike) -> Float64:
    """CIE 1976 L*a*b* (..., 3) of linear Rec.709 RGB (..., 3), white (1, 1, 1) under D65."""
    linear = np.maximum(np.asarray(rgb, np.float64), 0.0)
    xyz = linear @ (_XYZ / _XYZ.sum(axis=1, keepdims=True)).T
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz * (29 / 6) ** 2 / 3 + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def hue(lab: ArrayLike) -> Float64:
    """Hue angle in degrees [0, 360) and chroma (..., 2) of CIELAB (..., 3)."""
    colour = np.asarray(lab, np.float64)
    a, b = colour[..., 1], colour[..., 2]
    return np.stack([np.degrees(np.arctan2(b, a)) % 360.0, np.hypot(a, b)], axis=-1)


def body_and_lobe(brdf: TabulatedBRDF) -> tuple[Float64, Float64]:
    """f (3,) of the body, and of the lobe above it at its peak, for incidence of 15 to 50 degrees."""
    grid = brdf.grid
    values = np.asarray(brdf.values, np.float64)
    incidence = (grid.theta_d > math.radians(15.0)) & (grid.theta_d < math.radians(50.0))
    body_h = (grid.theta_h > math.radians(35.0)) & (grid.theta_h < math.radians(50.0))
    near = (grid.theta_d > math.radians(2.0)) & (grid.theta_d < math.radians(25.0))
    body = values[body_h][:, near].min(axis=(0, 1, 2))
    peak = values[0, incidence].mean(axis=(0, 1))
    return body, np.maximum(peak - body, 0.0)


def specular_gloss(brdf: TabulatedBRDF, angle: float) -> float:
    """Specular gloss in gloss units (ASTM D523): luminous flux in the receptor over black glass's.

    The receptor of the standard (1.8 by 3.6 degrees at 20, 4.4 by 11.7 at 60) is filled from a
    parallel beam; black glass sends all its mirror reflection there.

    Parameters
    ----------
    angle : 20 or 60, degrees from the normal

    Raises
    ------
    ValueError
        On another angle.
    """
    receptors = {20: (1.8, 3.6, _BLACK_GLASS_20), 60: (4.4, 11.7, _BLACK_GLASS)}
    if angle not in receptors:
        raise ValueError(f"angle: expected 20 or 60 degrees, got {angle!r}")
    tall, wide, standard = receptors[int(angle)]
    incident = math.radians(angle)
    # nodes crowd at the mirror direction, where a polished lobe has all its flux
    x, weight = np.polynomial.legendre.leggauss(24)
    x, weight = 0.5 * (x + 1.0), 0.5 * weight
    node = np.concatenate([-(x[::-1] ** 3), x**3])
    weight = np.concatenate([(3.0 * x**2 * weight)[::-1], 3.0 * x**2 * weight])
    up = incident + math.radians(0.5 * tall) * node[:, None]
    aside = math.radians(0.5 * wide) * node[None, :]
    wo = np.stack(
        [np.sin(up) * np.cos(aside), np.sin(aside) + 0.0 * up, np.cos(up) * np.cos(aside)], axis=-1
    )
    wi = np.broadcast_to([-math.sin(incident), 0.0, math.cos(incident)], wo.shape)
    f = brdf.eval(wi, wo) @ LUMINANCE
    solid = math.radians(0.5 * tall) * math.radians(0.5 * wide) * np.cos(aside)
    flux = np.sum(f * np.maximum(wo[..., 2], 0.0) * solid * weight[:, None] * weight[None, :])
    mirrored = float(brdf.mirror @ LUMINANCE)
    return 100.0 * (float(flux) + mirrored) / standard


def descriptors(brdf: TabulatedBRDF) -> dict[str, float]:
    """All of `DESCRIPTORS` of one table, finite numbers."""
    grid = brdf.grid
    values = np.asarray(brdf.values, np.float64)
    body, lobe = body_and_lobe(brdf)
    peak = body + lobe
    light_body, light_peak = float(body @ LUMINANCE), float(peak @ LUMINANCE)
    albedo = np.maximum(brdf.albedo(_SEEN_FROM), 1e-4)
    logs = np.log(albedo)
    light = float(albedo @ LUMINANCE)
    diffuse = min(math.pi * light_body, light)
    tinted = np.log(np.maximum(lobe, 1e-4))
    mirror, beside, blurred = _along(brdf, (0.0, 0.15, 1.0), 30.0)
    steep, grazing = _along(brdf, (0.0,), 15.0)[0], _along(brdf, (0.0,), 70.0)[0]
    steep = max(steep - light_body, 0.0) * math.cos(math.radians(15.0))
    grazing = max(grazing - light_body, 0.0) * math.cos(math.radians(70.0))
    close = (grid.theta_d > math.radians(2.0)) & (grid.theta_d < math.radians(12.0))
    profile = values[:, close].mean(axis=(1, 2)) @ LUMINANCE
    inner, outer = (float(np.interp(math.radians(a), grid.theta_h, profile)) for a in (40.0, 68.0))
    diffuse_hue, diffuse_chroma = hue(cielab(math.pi * body)).tolist()
    scaled = lobe / max(float(lobe.max()), 1e-12)
    specular_hue, specular_chroma = hue(cielab(scaled)).tolist()
    gold = np.log(np.maximum(scaled, 1e-2)) - _GOLD
    read = {
        "highlight": math.pi ** (1 / 3) * (math.cbrt(light_peak) - math.cbrt(light_body)),
        "gloss_20": specular_gloss(brdf, 20),
        "gloss_60": specular_gloss(brdf, 60),
        "haze": (blurred + 1e-4) / (mirror + 1e-4),
        "image": 1.0 - (beside + 1e-4) / (mirror + 1e-4),
        "width": _log_width(brdf, light_body, light_peak),
        "sheen": math.log((outer + 1e-3) / (inner + 1e-3)),
        "fresnel": math.log((grazing + 1e-3) / (steep + 1e-3)),
        "lightness": math.cbrt(light),
        "body_lightness": math.cbrt(diffuse + (light - diffuse) / 3.0),
        "specular": light - diffuse,
        "diffuse": diffuse,
        "tint": float(tinted.std()),
        "red": float(logs[0] - logs[[1, 2]].mean()),
        "green": float(logs[1] - logs[[0, 2]].mean()),
        "blue": float(logs[2] - logs[[0, 1]].mean()),
        "diffuse_hue": diffuse_hue,
        "diffuse_chroma": diffuse_chroma,
        "specular_hue": specular_hue,
        "specular_chroma": specular_chroma,
        "gold": -float(np.sqrt(np.mean(gold**2))),
    }
    return {name: read[name] for name in DESCRIPTORS}


def _along(brdf: TabulatedBRDF, theta_h: tuple[float, ...], theta_d: float) -> list[float]:
    """Luminance of f at angles theta_h in degrees, halfway between the planes phi_d = 0 and 90."""
    h, d = np.radians(theta_h), np.full(len(theta_h), math.radians(theta_d))
    wi, wo = from_half_diff_angles(h, d, np.full(len(h), math.pi / 4))
    return (brdf.eval(wi, wo) @ LUMINANCE).tolist()  # type: ignore[no-any-return]


def _log_width(brdf: TabulatedBRDF, body: float, peak: float) -> float:
    grid = brdf.grid
    incidence = (grid.theta_d > math.radians(15.0)) & (grid.theta_d < math.radians(50.0))
    profile = np.asarray(brdf.values, np.float64)[:, incidence].mean(axis=(1, 2)) @ LUMINANCE
    half = body + 0.5 * (peak - body)
    below = np.flatnonzero(profile <= half)
    i = int(below[0]) if len(below) and below[0] > 0 else len(profile) - 1
    upper, lower = profile[i - 1], profile[i]
    part = (upper - half) / (upper - lower) if upper > lower else 1.0
    width = float(grid.theta_h[i - 1] + part * (grid.theta_h[i] - grid.theta_h[i - 1]))
    # where no lobe stands out it is as wide as the hemisphere, without a jump between
    stands = np.clip((peak / max(body, 1e-4) - 1.0) / 0.4, 0.0, 1.0)
    return float(stands * math.log(max(width, 1e-4)) + (1.0 - stands) * math.log(math.pi / 4))
