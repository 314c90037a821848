"""Physical descriptors of a BRDF: what a gloss meter, a colorimeter or a person would read off it.

Every descriptor looks at values of f alone, never at a model's parameters, so that measured and
made materials are read alike. `DESCRIPTORS` says of each what it is, its unit and its source.

They are formulas of `READINGS`, a few dozen numbers that are linear in f: f at some angles, the
flux into a gloss meter's receptor, and an albedo. So they can be had of a table, and of coordinates
of an embedding without decoding all of it.

Two parts of a reflectance are told apart: the *body* is what is left far from the highlight
(theta_h of 44 to 50 degrees), the *lobe* is what stands above it. No reading takes a direction
beyond 75 degrees, where measurements are not to be trusted, but for the albedo and "fresnel".
"""

from __future__ import annotations

import functools
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numba
import numpy as np
import scipy.sparse
from numpy.typing import ArrayLike, NDArray

from traitbrdf.brdf import HalfDiffGrid, TabulatedBRDF, albedo_operator
from traitbrdf.directions import Array, half_diff_angles

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

_WHITE = _XYZ / _XYZ.sum(axis=1, keepdims=True)

_SEEN_FROM = math.radians(30.0)  # the angle whose directional albedo is read

_BLACK_GLASS = 0.1000562
"""Fresnel reflectance of the standard at 60 degrees: n = 1.567 has 100 gloss units (ASTM D523)."""

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
            "contrast gloss, Hunter 1937; cube roots as in Pellacini et al. 2000, eq. 4",
        ),
        "gloss_20": Descriptor("specular gloss at 20 degrees", "GU", "ASTM D523"),
        "gloss_60": Descriptor("specular gloss at 60 degrees", "GU", "ASTM D523"),
        "haze": Descriptor(
            "log of the lobe's width at a tenth of its height over that at half of it",
            "1",
            "a halo around a highlight, whatever its width: hazy gloss, Barla, Pacanowski & "
            "Vangorp 2018; ASTM E430 takes one angle, which wide lobes fill without a halo",
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
            "log of f at theta_h 60 over 40 degrees, both directions near each other",
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
        "specular": Descriptor("luminous albedo of the lobe at 30 degrees", "1", "energy"),
        "diffuse": Descriptor("luminous albedo of the body", "1", "energy"),
        "reflection": Descriptor(
            "cube root of the specular less that of the diffuse albedo", "1", "energy, as lightness"
        ),
        "tint": Descriptor(
            "standard deviation of the log RGB of the lobe at its peak", "1", "chroma of the lobe"
        ),
        "red": Descriptor(
            "log of red over the mean log of the others, of the body's and of the lobe's albedo",
            "1",
            "a colourless highlight takes nothing from the colour: Todd, Norman & Mingolla 2004",
        ),
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

_DARK = 0.01  # an albedo that has no colour to speak of

_GOLD = np.log([1.0, 0.753, 0.374])  # linear Rec.709, over the greatest channel


def cielab(rgb: ArrayLike) -> Float64:
    """CIE 1976 L*a*b* (..., 3) of linear Rec.709 RGB (..., 3), white (1, 1, 1) under D65."""
    linear = np.maximum(np.asarray(rgb, np.float64), 0.0)
    xyz = linear @ _WHITE.T
    f = np.where(xyz > (6 / 29) ** 3, np.cbrt(xyz), xyz * (29 / 6) ** 2 / 3 + 4 / 29)
    x, y, z = f[..., 0], f[..., 1], f[..., 2]
    return np.stack([116.0 * y - 16.0, 500.0 * (x - y), 200.0 * (y - z)], axis=-1)


def hue(lab: ArrayLike) -> Float64:
    """Hue angle in degrees [0, 360) and chroma (..., 2) of CIELAB (..., 3)."""
    colour = np.asarray(lab, np.float64)
    a, b = colour[..., 1], colour[..., 2]
    return np.stack([np.degrees(np.arctan2(b, a)) % 360.0, np.hypot(a, b)], axis=-1)


_NODE_D = 90.0 / 23.0  # degrees between the nodes theta_d of the library's grid


def _node_h(i: int) -> float:
    """theta_h in degrees of a node of the library's grid."""
    return 90.0 * (i / 89.0) ** 2


_NODES_H = (0, 2, 4, 6, 8, 10, 12, 14, 17, 20, 23, 26, 30, 34, 38, 42, 46, 50, 54, 58, 62, 66)
PROFILE = tuple(_node_h(i) for i in _NODES_H)
"""theta_h in degrees at which the profile of the lobe is read; incidence of 16 to 47 degrees."""

_MIDDLE = tuple(_NODE_D * i for i in (4, 8, 12))
_NEAR = tuple(_NODE_D * i for i in (1, 2, 3))

_POINTS: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = MappingProxyType(
    {
        "body": (tuple(_node_h(i) for i in (62, 64, 66)), tuple(_NODE_D * i for i in (1, 3, 5))),
        "mirror": ((0.0,), (_NODE_D * 8,)),
        "beside": ((0.15,), (_NODE_D * 8,)),
        "steep": ((0.0,), (_NODE_D * 4,)),
        "grazing": ((0.0,), (_NODE_D * 18,)),
        "inner": ((_node_h(59),), _NEAR),
        "outer": ((_node_h(73),), _NEAR),
        **{f"profile {i}": ((theta,), _MIDDLE) for i, theta in enumerate(PROFILE)},
    }
)  # mean f over all pairs of theta_h and theta_d in degrees, phi_d 45 degrees

READINGS = ("albedo", "gloss 20", "gloss 60", *_POINTS)
"""What descriptors are made from, each linear in f."""

_AT = MappingProxyType({name: i for i, name in enumerate(READINGS)})


@functools.lru_cache(maxsize=16)
def reading_rows(grid: HalfDiffGrid) -> scipy.sparse.csr_array:
    """Sparse rows (len(READINGS), grid.size) that turn flat tables into readings."""
    rows = [albedo_operator(grid, _SEEN_FROM)]
    for angle in (20, 60):
        wi, wo, weight = _receptor(angle)
        rows.append(_row(grid, *half_diff_angles(wi, wo), weight))
    for theta_h, theta_d in _POINTS.values():
        h, d = np.meshgrid(np.radians(theta_h), np.radians(theta_d))
        phi_d = np.full(h.size, math.pi / 4)
        rows.append(_row(grid, h.ravel(), d.ravel(), phi_d, np.full(h.size, 1.0 / h.size)))
    return scipy.sparse.csr_array(scipy.sparse.vstack(rows))


def _row(
    grid: HalfDiffGrid, theta_h: Array, theta_d: Array, phi_d: Array, weight: Float64
) -> scipy.sparse.csr_array:
    index, corner = grid.stencil(theta_h, theta_d, phi_d)
    dense = np.bincount(index.ravel(), (corner * weight[:, None]).ravel(), minlength=grid.size)
    return scipy.sparse.csr_array(np.where(dense > 1e-12, dense, 0.0)[None])


def _receptor(angle: int) -> tuple[Float64, Float64, Float64]:
    """Directions (n, 3) from a gloss meter's lamp and into its receptor, and weights: their sum
    with f is the flux over that of black glass, in gloss units (ASTM D523).

    The receptor of the standard (1.8 by 3.6 degrees at 20, 4.4 by 11.7 at 60) is filled from a
    parallel beam; black glass sends all its mirror reflection there.
    """
    tall, wide, standard = {20: (1.8, 3.6, _BLACK_GLASS_20), 60: (4.4, 11.7, _BLACK_GLASS)}[angle]
    incident = math.radians(angle)
    # nodes crowd at the mirror direction, where a polished lobe has all its flux
    x, weight = np.polynomial.legendre.leggauss(24)
    x, weight = 0.5 * (x + 1.0), 0.5 * weight
    node = np.concatenate([-(x[::-1] ** 3), x**3])
    weight = np.concatenate([(3.0 * x**2 * weight)[::-1], 3.0 * x**2 * weight])
    up, aside = np.meshgrid(
        incident + math.radians(0.5 * tall) * node, math.radians(0.5 * wide) * node, indexing="ij"
    )
    wo = np.stack([np.sin(up) * np.cos(aside), np.sin(aside), np.cos(up) * np.cos(aside)], axis=-1)
    wi = np.broadcast_to([-math.sin(incident), 0.0, math.cos(incident)], wo.shape)
    solid = math.radians(0.5 * tall) * math.radians(0.5 * wide) * np.cos(aside)
    flux = wo[..., 2] * solid * weight[:, None] * weight[None, :]
    return wi.reshape(-1, 3), wo.reshape(-1, 3), (100.0 / standard * flux).ravel()


def describe(readings: ArrayLike) -> dict[str, Float64]:
    """All of `DESCRIPTORS` (...,) of readings (..., len(READINGS), 3), finite numbers."""
    columns = describe_columns(np.asarray(readings, np.float64))
    return {name: columns[..., i] for i, name in enumerate(DESCRIPTORS)}


def describe_columns(readings: Float64) -> Float64:
    """`describe` as one array (..., len(DESCRIPTORS))."""
    found = formulas(np.ascontiguousarray(readings.reshape(-1, *readings.shape[-2:])))
    return np.asarray(found).reshape(*readings.shape[:-2], len(DESCRIPTORS))


_ALBEDO, _GLOSS_20, _GLOSS_60, _BODY, _MIRROR, _BESIDE, _STEEP, _GRAZING, _INNER, _OUTER = range(10)
_PEAK = 10
_COS_STEEP = math.cos(math.radians(_NODE_D * 4))
_COS_GRAZING = math.cos(math.radians(_NODE_D * 18))
_ROOTS = np.sqrt(np.radians(PROFILE))
_LOG_WIDE = math.log(math.pi / 4)


@numba.njit(cache=True, nogil=True)
def formulas(readings: Any) -> Any:
    """`DESCRIPTORS` (m, n) of readings (m, len(READINGS), 3), in their order.

    Compiled: a move of a trait reads them some hundred times.
    """
    out = np.empty((len(readings), 21))
    lobe, body_rgb, scaled, colour = np.empty(3), np.empty(3), np.empty(3), np.empty((3, 2))
    profile = np.empty(len(_ROOTS))
    for m in range(len(readings)):
        r = readings[m]
        albedo_light = 0.0
        peak_lobe = 1e-12
        for c in range(3):
            albedo = max(r[_ALBEDO, c], 1e-4)
            body_rgb[c] = max(r[_BODY, c], 0.0)
            lobe[c] = above(max(r[_PEAK, c], 0.0), body_rgb[c], 1e-3)
            peak_lobe = max(peak_lobe, lobe[c])
            reflected = above(albedo, math.pi * body_rgb[c], _DARK)
            colour[c, 0] = math.log(max(albedo - reflected, 0.0) + _DARK)
            colour[c, 1] = math.log(reflected + _DARK)
            albedo_light += LUMINANCE[c] * albedo
        for i in range(len(profile)):
            profile[i] = _light(r[_PEAK + i])
        peak, body = profile[0], _light(r[_BODY])
        specular = above(albedo_light, math.pi * body, _DARK)
        diffuse = max(albedo_light - specular, 0.0)
        steep = max(_light(r[_STEEP]) - body, 0.0) * _COS_STEEP
        grazing = max(_light(r[_GRAZING]) - body, 0.0) * _COS_GRAZING
        mean = square = off_gold = 0.0
        for c in range(3):
            tinted = math.log(lobe[c] + 1e-2)
            mean += tinted / 3.0
            square += tinted * tinted / 3.0
            scaled[c] = lobe[c] / peak_lobe
            off_gold += (math.log(max(scaled[c], 1e-2)) - _GOLD[c]) ** 2 / 3.0
            body_rgb[c] *= math.pi
        width = _log_width(profile, body, 0.5)
        row = out[m]
        row[0] = math.pi ** (1 / 3) * (np.cbrt(peak) - np.cbrt(body))
        row[1] = max(_light(r[_GLOSS_20]), 0.0)
        row[2] = max(_light(r[_GLOSS_60]), 0.0)
        row[3] = _log_width(profile, body, 0.1) - width
        row[4] = 1.0 - (_light(r[_BESIDE]) + 1e-4) / (_light(r[_MIRROR]) + 1e-4)
        row[5] = width
        row[6] = math.log((_light(r[_OUTER]) + 1e-3) / (_light(r[_INNER]) + 1e-3))
        row[7] = math.log((grazing + 1e-3) / (steep + 1e-3))
        row[8] = np.cbrt(albedo_light)
        row[9] = specular
        row[10] = diffuse
        row[11] = np.cbrt(specular) - np.cbrt(diffuse)
        row[12] = math.sqrt(max(square - mean * mean, 0.0))
        for c in range(3):
            one, two = (c + 1) % 3, (c + 2) % 3
            row[13 + c] = (
                colour[c, 0] + colour[c, 1]
                - 0.5 * (colour[one, 0] + colour[one, 1] + colour[two, 0] + colour[two, 1])
            )  # fmt: skip
        row[16], row[17] = _hue(body_rgb)
        row[18], row[19] = _hue(scaled)
        row[20] = -math.sqrt(off_gold)
    return out


@numba.njit(cache=True, nogil=True)
def _light(rgb: Any) -> Any:
    """Luminance, of positive channels."""
    light = 0.0
    for c in range(3):
        light += LUMINANCE[c] * max(rgb[c], 0.0)
    return light


@numba.njit(cache=True, nogil=True)
def _hue(rgb: Any) -> Any:
    """Hue angle in degrees and chroma of one linear RGB, as `hue` of `cielab`."""
    a, b = opponents(rgb)
    return math.degrees(math.atan2(b, a)) % 360.0, math.hypot(a, b)


@numba.njit(cache=True, nogil=True)
def opponents(rgb: Any) -> Any:
    """a* and b* of one linear RGB, as of `cielab`."""
    f = np.empty(3)
    for i in range(3):
        x = 0.0
        for c in range(3):
            x += _WHITE[i, c] * rgb[c]
        f[i] = np.cbrt(x) if x > (6 / 29) ** 3 else x * (29 / 6) ** 2 / 3 + 4 / 29
    return 500.0 * (f[0] - f[1]), 200.0 * (f[1] - f[2])


@numba.njit(cache=True, nogil=True)
def above(whole: Any, body: Any, soft: Any) -> Any:
    """What of the whole is above the body, never quite nothing: max(whole - body, 0), but smooth,
    and no more than the whole."""
    over = whole - body
    return min(0.5 * (over + math.sqrt(over * over + soft * soft)), whole)


@numba.njit(cache=True, nogil=True)
def _log_width(profile: Any, body: Any, height: Any) -> Any:
    """log of theta_h at which a profile (n,) has fallen to a height above the body."""
    peak = profile[0]
    level = body + height * max(peak - body, 0.0)
    i = 0
    while i < len(profile) - 2 and profile[i + 1] > level:
        i += 1
    # lobes fall by large factors from node to node: log f between them, along the root of theta_h
    fall = math.log((profile[i] + 1e-9) / (profile[i + 1] + 1e-9))
    part = 1.0
    if abs(fall) > 1e-9:
        part = min(max(math.log((profile[i] + 1e-9) / (level + 1e-9)) / fall, 0.0), 1.0)
    width = (_ROOTS[i] + part * (_ROOTS[i + 1] - _ROOTS[i])) ** 2
    # where no lobe stands out it is as wide as the hemisphere, without a jump between
    stands = min(max((peak / max(body, 1e-4) - 1.0) / 0.4, 0.0), 1.0)
    return stands * math.log(max(width, 1e-4)) + (1.0 - stands) * _LOG_WIDE


def read(brdf: TabulatedBRDF) -> Float64:
    """`READINGS` (len(READINGS), 3) of a table; a mirror's delta goes into gloss and albedo."""
    flat = np.asarray(brdf.values, np.float64).reshape(-1, 3)
    readings = np.asarray(reading_rows(brdf.grid) @ flat, np.float64)
    for name, whole in (
        ("albedo", 1.0), ("gloss 20", 100.0 / _BLACK_GLASS_20), ("gloss 60", 100.0 / _BLACK_GLASS)
    ):  # fmt: skip
        readings[_AT[name]] += whole * brdf.mirror
    return readings


def descriptors(brdf: TabulatedBRDF) -> dict[str, float]:
    """All of `DESCRIPTORS` of one table."""
    return {name: float(value) for name, value in describe(read(brdf)).items()}
