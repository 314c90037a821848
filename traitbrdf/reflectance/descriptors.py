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

from traitbrdf.directions import Array, half_diff_angles
from traitbrdf.reflectance.brdf import HalfDiffGrid, TabulatedBRDF, albedo_operator

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

WHITE = _XYZ / _XYZ.sum(axis=1, keepdims=True)
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
            "log of the breadth of the lobe to the power of 0.4 over that of the lobe itself",
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
            "log of theta_h: integral breadth of the lobe above the body",
            "log rad",
            "breadth of the lobe; d = 1 - alpha in Pellacini et al. 2000",
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
            "standard deviation of the log RGB of the lobe, at its peak and in all", "1", "chroma"
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
        "flat": Descriptor(
            "log of f at theta_h 60 degrees, both directions near each other, over the mirror "
            "direction's",
            "1",
            "flat shading of rough surfaces, Oren & Nayar 1994: nothing but the outline is seen",
        ),
        "chroma": Descriptor("chroma of all reflected light at 30 degrees", "C*ab", "CIELAB, D65"),
        "gold": Descriptor(
            "log distance d of the colours of peak and of all light from gold's, as -log(d + 0.1)",
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
    xyz = linear @ WHITE.T
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
        "side": (tuple(_node_h(i) for i in (50, 56, 60)), tuple(_NODE_D * i for i in (11, 13, 15))),
    }
)  # mean f over all pairs of theta_h and theta_d in degrees, phi_d 45 degrees

READINGS = ("albedo", "gloss 20", "gloss 60", *_POINTS, "albedo 10", "albedo 60")
"""What descriptors are made from, and where colours are seen; each linear in f."""

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
    rows.append(albedo_operator(grid, np.radians([10.0, 60.0])))
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
    flat = np.ascontiguousarray(readings.reshape(-1, *readings.shape[-2:]), np.float64)
    found = np.empty((len(flat), len(DESCRIPTORS)))
    formulas(flat, found)
    return found.reshape(*readings.shape[:-2], len(DESCRIPTORS))


_ALBEDO, _GLOSS_20, _GLOSS_60, _BODY, _MIRROR, _BESIDE, _STEEP, _GRAZING, _INNER, _OUTER = range(10)
_PEAK = 10
_COS_STEEP = math.cos(math.radians(_NODE_D * 4))
_COS_GRAZING = math.cos(math.radians(_NODE_D * 18))
_ROOTS = np.sqrt(np.radians(PROFILE))
_LOG_WIDE = math.log(math.pi / 4)
_CUBE_ROOT_OF_PI = math.pi ** (1 / 3)


# divisions as numpy does them: what raises errors is most of the code that is to be compiled
@numba.njit(cache=True, error_model="numpy")
def formulas(r: Any, out: Any) -> Any:
    """Fill in `DESCRIPTORS` (m, n) of readings (m, len(READINGS), 3), in their order.

    Compiled: a move of a trait reads them some hundred times.
    """
    # sizes that are no constants: for each of those, code that makes an array is compiled
    count, three = r.shape[1], r.shape[2]
    lobe, whole, body_of = np.empty(three), np.empty(three), np.empty(three)
    shed, below, upon = np.empty(three), np.empty(three), np.empty(three)
    light, known, powers = np.empty(count), np.empty(count), np.empty(count)
    for i in range(count):
        known[i] = 0.0
    for m in range(len(r)):
        for i in range(len(light)):
            light[i] = 0.0
            for c in range(3):
                light[i] += LUMINANCE[c] * max(r[m, i, c], 0.0)
        albedo_light = 0.0
        peak_lobe = bright = top = 1e-12
        for c in range(3):
            whole[c] = max(r[m, _ALBEDO, c], 1e-4)
            bright = max(bright, whole[c])
            body_of[c] = max(r[m, _BODY, c], 0.0)
            lobe[c] = above(max(r[m, _PEAK, c], 0.0), body_of[c], 1e-3)
            peak_lobe, top = max(peak_lobe, lobe[c]), max(top, r[m, _PEAK, c])
            shed[c] = above(whole[c], math.pi * body_of[c], _DARK)
            below[c] = math.log(max(whole[c] - shed[c], 0.0) + _DARK)
            upon[c] = math.log(shed[c] + _DARK)
            albedo_light += LUMINANCE[c] * whole[c]
        peak, body = light[_PEAK], light[_BODY]
        specular = above(albedo_light, math.pi * body, _DARK)
        diffuse = max(albedo_light - specular, 0.0)
        steep = above(light[_STEEP], body, _DARK) * _COS_STEEP
        grazing = above(light[_GRAZING], body, _DARK) * _COS_GRAZING
        mean = square = off_gold = 0.0
        faint = 0.02 + 0.1 * body  # what stands out less than that has no colour of its own
        for c in range(3):
            tinted = 0.5 * (math.log(lobe[c] + faint) + math.log(shed[c] + 0.02))
            mean += tinted / 3.0
            square += tinted * tinted / 3.0
            lobe[c] /= peak_lobe
            # of what is seen in the mirror direction: a faint lobe's own colour is anything
            shade = math.log((max(r[m, _PEAK, c], 0.0) + faint) / (top + faint)) - _GOLD[c]
            hue_of_all = math.log((whole[c] + _DARK) / (bright + _DARK)) - _GOLD[c]
            off_gold += (shade * shade + hue_of_all * hue_of_all) / 6.0
            body_of[c] *= math.pi
            one, two = (c + 1) % 3, (c + 2) % 3
            out[m, 13 + c] = (
                below[c] + upon[c] - 0.5 * (below[one] + upon[one] + below[two] + upon[two])
            )
        width, broad = _log_breadths(light, body, known, powers)
        # a lobe that hardly stands out is as wide as the hemisphere, and has no halo
        stands = max(1.0 - body / max(peak, 1e-4), 0.0)
        outer = math.log(light[_OUTER] + 1e-3)
        out[m, 0] = _CUBE_ROOT_OF_PI * (peak ** (1 / 3) - body ** (1 / 3))
        out[m, 1] = light[_GLOSS_20]
        out[m, 2] = light[_GLOSS_60]
        out[m, 3] = stands * (broad - width)
        out[m, 4] = 1.0 - (light[_BESIDE] + 1e-4) / (light[_MIRROR] + 1e-4)
        out[m, 5] = stands * width + (1.0 - stands) * _LOG_WIDE
        out[m, 6] = outer - math.log(light[_INNER] + 1e-3)
        out[m, 7] = math.log((grazing + _DARK) / (steep + _DARK))
        out[m, 8] = albedo_light ** (1 / 3)
        out[m, 9] = specular
        out[m, 10] = diffuse
        out[m, 11] = specular ** (1 / 3) - diffuse ** (1 / 3)
        out[m, 12] = _rounded(max(square - mean * mean, 0.0), 0.12)
        # compiled code of colours is long, so it stands here once
        for i in range(3):
            rgb = body_of if i == 0 else lobe if i == 1 else whole
            a, b = _opponents(rgb)
            chroma = _rounded(a * a + b * b, 4.0)
            if i < 2:
                angle = math.degrees(math.atan2(b, a))
                out[m, 16 + 2 * i] = angle + 360.0 if angle < 0.0 else angle
                out[m, 17 + 2 * i] = chroma
            else:
                out[m, 21] = chroma
        out[m, 20] = outer - math.log(peak + 1e-3)
        out[m, 22] = -math.log(_rounded(off_gold, 0.12) + 0.1)


@numba.njit(cache=True, error_model="numpy")
def _rounded(square: Any, soft: Any) -> Any:
    """A distance of which the square is known, without the kink at 0: it has a slope there too."""
    return math.sqrt(square + soft * soft) - soft


@numba.njit(cache=True, error_model="numpy")
def _opponents(rgb: Any) -> Any:
    """a* and b* of one linear RGB, as of `cielab`."""
    a = b = 0.0
    for i in range(3):
        x = 0.0
        for c in range(3):
            x += WHITE[i, c] * rgb[c]
        f = x ** (1 / 3) if x > (6 / 29) ** 3 else x * (29 / 6) ** 2 / 3 + 4 / 29
        a += 500.0 * f if i == 0 else -500.0 * f if i == 1 else 0.0
        b += 200.0 * f if i == 1 else -200.0 * f if i == 2 else 0.0
    return a, b


@numba.njit(cache=True, error_model="numpy")
def above(whole: Any, body: Any, soft: Any) -> Any:
    """What of the whole is above the body, never quite nothing: max(whole - body, 0), but smooth,
    and no more than the whole."""
    over = whole - body
    return min(0.5 * (over + math.sqrt(over * over + soft * soft)), whole)


@numba.njit(cache=True, error_model="numpy")
def _log_breadths(light: Any, body: Any, known: Any, powers: Any) -> Any:
    """log of the integral breadth in theta_h of what the profile has above the body, and
    of that to the power of 0.4: the width of a box as high as the peak that holds as much, along
    the root of theta_h.

    An integral, not where a height is crossed: that leaps where a profile has a shelf. `known`
    and `powers` keep the inverse of a share at each place, and its power.
    """
    above_body = light[_PEAK] - body + 0.02 * body + 1e-4
    breadth = broad = last = last_broad = 0.0
    for i in range(len(_ROOTS)):
        share = min(max((light[_PEAK + i] - body) / above_body, 0.0), 1.0)
        # powers are most of the work. Rows of slopes differ hardly: there, a series is as exact
        near = share * known[i] - 1.0
        if abs(near) < 1e-3:
            terms = 0.4 + near * (-0.12 + near * (0.064 + near * (-0.0416 + near * 0.029952)))
            spread = powers[i] * (1.0 + near * terms)
        else:
            spread = share**0.4 if share > 0.0 else 0.0
            if share > 0.0:
                known[i], powers[i] = 1.0 / share, spread
        if i > 0:
            wide = 0.5 * (_ROOTS[i] - _ROOTS[i - 1])
            breadth += wide * (share + last)
            broad += wide * (spread + last_broad)
        last, last_broad = share, spread
    least = 0.5 * _ROOTS[1]
    return 2.0 * math.log(max(breadth, least)), 2.0 * math.log(max(broad, least))


def read(brdf: TabulatedBRDF) -> Float64:
    """`READINGS` (len(READINGS), 3) of a table; a mirror's delta goes into gloss and albedo."""
    flat = np.asarray(brdf.values, np.float64).reshape(-1, 3)
    readings = np.asarray(reading_rows(brdf.grid) @ flat, np.float64)
    for name, whole in (
        ("albedo", 1.0), ("albedo 10", 1.0), ("albedo 60", 1.0),
        ("gloss 20", 100.0 / _BLACK_GLASS_20), ("gloss 60", 100.0 / _BLACK_GLASS)
    ):  # fmt: skip
        readings[_AT[name]] += whole * brdf.mirror
    return readings


def descriptors(brdf: TabulatedBRDF) -> dict[str, float]:
    """All of `DESCRIPTORS` of one table."""
    return {name: float(value) for name, value in describe(read(brdf)).items()}
